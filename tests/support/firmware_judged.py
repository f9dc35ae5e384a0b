"""Conformance of the firmware on the clock of a virtual loop."""

from collections.abc import Sequence
from pathlib import Path

from drivers.conformance import LEVEL, CheckResult, of_kind
from drivers.conformance.check import run_checks
from firmware_line import FirmwarePort
from judged_line import CLIENTS
from virtual_loop import run_virtual


def firmware_results(kind: str, folder: Path, names: Sequence[str] = ()) -> list[CheckResult]:
    """Results of checks by name, all without names; folder: of its library."""

    async def judged() -> list[CheckResult]:
        port, client = FirmwarePort(kind, folder), CLIENTS[kind](1)
        client.port, port.take = port, client.received
        chosen = [each for each in of_kind(kind) if not names or each[1].name in names]
        return [*await run_checks(chosen, client, level=LEVEL)]

    return run_virtual(judged())
