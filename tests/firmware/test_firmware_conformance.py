"""Conformance of the firmware on every wire, on a clock that the test moves."""

from pathlib import Path

import pytest

from conformance_bench import results_at
from drivers.conformance import CheckResult, Result
from firmware_programs import build_firmware
from long_form import shortly
from memory_machine import live_in_memory
from moved_firmware import WIRES, moved_firmware
from virtual_loop import run_virtual

NOTHING_TO_CHECK = {
    "sensor_descriptions",
    "readings",
    "readings_change_nothing",
    "disturbed_readings",
    "readings_of_tones",
    "raw_samples",
    "steps_as_stated",  # they are those of the wire
    "phases",  # levels are those of single tones
    "frames_in_any_order",  # on CAN alone
    "vanished_host",  # there is no other process
}


@pytest.fixture(scope="session")
def moved(compiled: Path) -> Path:
    """The folder of its programs, with the library on a moved clock."""
    return build_firmware(compiled, "era-moved.so")


@pytest.mark.parametrize("wire", shortly(WIRES, ["serial", "can+slcan"]))
def test_every_check_has_a_verdict_and_none_failed(wire: str, moved: Path) -> None:
    """However busy the machine: passed, or skipped for what this firmware does not have."""

    async def run() -> list[CheckResult]:
        live_in_memory()
        async with moved_firmware(moved, wire) as url:
            return await results_at(url)

    results = run_virtual(run())
    assert {one.check.name: one.problem for one in results if one.problem} == {}
    skipped = {one.check.name for one in results if one.result is Result.SKIPPED}
    assert skipped <= NOTHING_TO_CHECK
