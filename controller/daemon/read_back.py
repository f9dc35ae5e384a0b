"""Read-back of disarmed amplifiers: silent and without a fault."""

import asyncio
import contextlib
from collections.abc import Mapping

from controller.group.tasks import retry_while_degraded
from drivers.amplifier import Amplifier
from drivers.errors import Preempted
from drivers.operation.silence import is_silent
from drivers.protocol.messages import AmplifierState, Fault, Status

READ_BACK_INTERVAL = 0.02  # s

_DISARMED = (AmplifierState.SWITCH_ON_DISABLED, AmplifierState.READY_TO_SWITCH_ON)


async def read_statuses(amplifiers: Mapping[str, Amplifier]) -> dict[str, Status]:
    """Read the status of each amplifier, again if preempted or on a degraded link."""
    while True:
        with contextlib.suppress(Preempted):
            return {
                name: await retry_while_degraded(each.status) for name, each in amplifiers.items()
            }
        await asyncio.sleep(READ_BACK_INTERVAL)


def all_silent(statuses: Mapping[str, Status]) -> bool:
    """Whether all amplifiers report that nothing plays."""
    return all(is_silent(status) for status in statuses.values())


def find_problem(statuses: Mapping[str, Status]) -> str | None:
    """Describe the first amplifier that is not disarmed, not at level zero or in a fault."""
    for name, status in statuses.items():
        if status.state not in _DISARMED or status.fault is not Fault.NONE:
            fault = "" if status.fault is Fault.NONE else f", fault {status.fault.name}"
            return f"amplifier {name} is in {status.state.name}{fault}"
        if any(status.levels):
            return f"amplifier {name} reports a level although it is disarmed"
    return None
