"""Judge statuses of amplifiers: whether they are disarmed, silent and without a fault.

The supervisor polls disarmed amplifiers; the control loop reads the statuses of armed ones.
"""

from collections.abc import Mapping

from drivers.host.amplifier import Amplifier
from drivers.host.group_states import GroupState
from drivers.protocol.definition import FAULTS, STATES, name_of
from drivers.protocol.records import Values

STATUS_INTERVAL = 0.5  # s; between status requests to disarmed amplifiers
SILENT_GROUP = (GroupState.DISARMED, GroupState.STOPPED)
"""States of a group that plays nothing."""

_ENABLED = STATES["OPERATION_ENABLED"]
_DISARMED = STATES["SWITCH_ON_DISABLED"]


def are_silent(statuses: Mapping[str, Values], amplifiers: Mapping[str, Amplifier]) -> bool:
    """Whether all amplifiers report that they are disarmed and silent."""
    for name, status in statuses.items():
        if status["state"] == _ENABLED or not amplifiers[name].is_silent(status):
            return False
    return True


def is_any_armed(statuses: Mapping[str, Values]) -> bool:
    """Whether an amplifier reports that it is armed."""
    states = [status["state"] for status in statuses.values()]
    return _ENABLED in states


def find_problem(statuses: Mapping[str, Values], amplifiers: Mapping[str, Amplifier]) -> str | None:
    """Describe the first amplifier that is armed, in a fault or not silent; None without one."""
    for name, status in statuses.items():
        if status["state"] != _DISARMED or status["fault"]:
            problem = f"amplifier {name} is in {name_of(STATES, status['state'])}"
            if status["fault"]:
                problem += f", fault {name_of(FAULTS, status['fault'])}"
            return problem
        if not amplifiers[name].is_silent(status):
            return (
                f"amplifier {name}: levels of all channels must be 0 while it is disarmed, got "
                f"{status['levels']}"
            )
    return None
