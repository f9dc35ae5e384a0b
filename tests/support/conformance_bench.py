"""Conformance checks over a wire in memory, in virtual time."""

from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager

import pytest

from drivers.amplifier import Amplifier
from drivers.conformance import CHECKS, Check, CheckResult, raw_line, run_check
from drivers.conformance.raw.line import RawLine
from drivers.registry import open_backend
from memory_machine import live_in_memory
from model.rig.rig import Rig
from planted_faults import PlantedFault
from virtual_loop import Seen, run_virtual
from wires import WIRES, far_side, patient


@asynccontextmanager
async def opened(wire: str, rig: Rig) -> AsyncIterator[tuple[Amplifier, RawLine | None]]:
    """The simulated amplifier of a rig behind a wire in memory, and raw access."""
    live_in_memory()
    async with far_side(WIRES[wire], rig) as far:
        url = patient(far.url)
        amplifier = Amplifier(open_backend(url))
        await amplifier.open()
        try:
            yield amplifier, raw_line(url)
        finally:
            await amplifier.close()


def results_on(
    wire: str, rig: Rig, checks: Sequence[Check] = CHECKS, *, seen: Seen | None = None
) -> list[CheckResult]:
    """Results of checks on one amplifier; seen: observer of the bytes."""

    async def run() -> list[CheckResult]:
        async with opened(wire, rig) as (amplifier, raw):
            return [await run_check(check, amplifier, raw) for check in checks]

    return run_virtual(run(), seen=seen)


def result_of(fault: PlantedFault, wire: str, rig: Rig) -> CheckResult:
    """The result of the check that must find a fault, on an amplifier that has it."""
    (check,) = [check for check in CHECKS if check.name == fault.check]
    with pytest.MonkeyPatch.context() as patch:
        fault.plant(patch)
        (result,) = results_on(wire, rig, [check])
    return result
