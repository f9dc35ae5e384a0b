"""Conformance of the firmware, on every kind of wire, on a clock that is moved."""

from pathlib import Path

import pytest

from firmware_judged import firmware_results
from firmware_line import LINES

SKIPPED = {"sensors", "steps_as_stated", "readings", "measured", "limited"}


@pytest.mark.parametrize("kind", LINES)
def test_firmware_passes_conformance(kind: str, replaying: Path) -> None:
    """Every check of its wire; nothing is skipped but what it has not."""
    results = firmware_results(kind, replaying)
    failed = [f"{each.check.name}: {each.reason}" for each in results if each.result == "failed"]
    assert not failed, failed
    assert {each.check.name for each in results if each.result == "skipped"} == (
        SKIPPED | ({"events"} if kind in ("rtu", "tcp") else set())
    )
