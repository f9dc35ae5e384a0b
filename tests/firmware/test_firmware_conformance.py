"""Conformance of the firmware, on every kind of wire, on a clock that is moved."""

from pathlib import Path

import pytest

from drivers.conformance import LEVEL, CheckResult, of_kind
from drivers.conformance.check import run_checks
from firmware_line import LINES, FirmwarePort
from judged_line import CLIENTS
from virtual_loop import run_virtual

SKIPPED = {"sensors", "steps_as_stated", "readings", "measured", "limited"}


@pytest.mark.parametrize("kind", LINES)
def test_firmware_passes_conformance(kind: str, replaying: Path) -> None:
    """Every check of its wire; nothing is skipped but what it has not."""

    async def judged() -> list[CheckResult]:
        port = FirmwarePort(kind, replaying)
        client = CLIENTS[kind](1)
        client.port, port.take = port, client.received
        return [*await run_checks(of_kind(kind), client, level=LEVEL)]

    results = run_virtual(judged())
    failed = [f"{each.check.name}: {each.reason}" for each in results if each.result == "failed"]
    assert not failed, failed
    assert {each.check.name for each in results if each.result == "skipped"} == (
        SKIPPED | ({"events"} if kind in ("rtu", "tcp") else set())
    )
