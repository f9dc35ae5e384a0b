"""Conformance checks over a wire in memory, in virtual time."""

from collections.abc import Sequence

from drivers.amplifier import Amplifier
from drivers.conformance import CHECKS, LEVEL, Check, CheckResult, raw_line
from drivers.conformance.series import run_checks
from drivers.registry import open_backend
from memory_machine import live_in_memory
from model.rig.rig import Rig
from virtual_loop import Seen, run_virtual
from wires import WIRES, far_side, patient

ALL = ("serial", "modbus+tcp", "modbus+rtu", "can+slcan")
"""Wires on which conformance of the simulated amplifier is tried."""


async def results_at(
    url: str,
    checks: Sequence[Check] = CHECKS,
    *,
    level: float = LEVEL,
) -> list[CheckResult]:
    """Results of checks on the amplifier at a URL, driven at a level."""
    amplifier, raw = Amplifier(open_backend(url)), raw_line(url)
    await amplifier.open()
    try:
        return list(await run_checks(checks, amplifier, raw, level=level))
    finally:
        await amplifier.close()


def results_on(
    wire: str,
    rig: Rig,
    checks: Sequence[Check] = CHECKS,
    *,
    seen: Seen | None = None,
    level: float = LEVEL,
) -> list[CheckResult]:
    """Results of checks on the simulated amplifier of a rig; seen: observer of the bytes."""

    async def run() -> list[CheckResult]:
        live_in_memory()
        async with far_side(WIRES[wire], rig) as far:
            return await results_at(patient(far.url), checks, level=level)

    return run_virtual(run(), seen=seen)
