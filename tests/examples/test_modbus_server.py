"""The amplifier on pymodbus's server, which shares no table with the host, under conformance."""

import asyncio
import sys
from asyncio.subprocess import PIPE
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, closing
from pathlib import Path

import pytest

from era_haptics.lab.conformance.contract import of_kind
from era_haptics.lab.conformance.session import judge
from sim.transport.pseudo_terminal import make_terminal

ROOT = Path(__file__).parents[2]


EXAMPLE = ROOT / "examples" / "modbus_server" / "modbus_server.py"
FAILED = {"pieces", "exceptions"}
"""What docs/how-to/write-an-amplifier.md says that the server cannot do."""
SKIPPED = {"sensors", "steps_as_stated", "limited", "readings", "events"}
BY_MACHINE = {"clock_rate", "replies_in_time"}
"""What is skipped or fails, with that reason, where the machine of the test is slow."""


@asynccontextmanager
async def served(kind: str) -> AsyncIterator[str]:
    """The example on a TCP port, or on a pseudo-terminal that is joined to another; its URL."""
    near_end = make_terminal(lambda data: far_end.write(data))
    far_end = make_terminal(near_end.write)
    with closing(near_end), closing(far_end):
        for terminal in (near_end, far_end):
            terminal.listen()
        place = ["0"] if kind == "tcp" else [far_end.port, "N"]
        command = sys.executable, str(EXAMPLE), kind, *place
        process = await asyncio.create_subprocess_exec(*command, stdout=PIPE)
        try:
            url = (await process.stdout.readline()).decode().strip()
            yield url.replace(far_end.port, near_end.port)
        finally:
            process.terminate()
            await process.wait()


@pytest.mark.real_time
@pytest.mark.parametrize(
    "drives", [False, pytest.param(True, marks=[pytest.mark.long, pytest.mark.alone])]
)
@pytest.mark.parametrize("kind", ["tcp", "rtu"])
async def test_conformance_finds_what_the_server_cannot_do(
    kind: str, drives: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those checks fail that the page names, no others; on RTU they are the last that drive."""
    # What is late on this machine is not a missing reply.
    for module in ("judge_client", "judged_exchange"):
        monkeypatch.setattr(f"era_haptics.lab.conformance.{module}.JUDGE_REPLY_TIMEOUT", 3.0)
    async with served(kind) as url:
        report = await asyncio.to_thread(judge, url, may_drive=lambda count: drives)
    checks = [(number, check) for number, check in of_kind(kind) if drives or not check.drives]
    assert [(result.number, result.check) for result in report.results] == checks
    failed = {
        result.check.name: result.reason for result in report.results if result.result == "failed"
    }
    skipped = {result.check.name for result in report.results if result.result == "skipped"}
    not_run = {result.check.name for result in report.results if result.result == "not_run"}
    names = {check.name for _, check in checks}
    assert set(failed) - BY_MACHINE == names & FAILED, failed
    assert skipped - BY_MACHINE == names & SKIPPED - not_run
    # It does not reply behind a request of another function, so that none can see it silent.
    assert bool(not_run) == (drives and kind == "rtu")
