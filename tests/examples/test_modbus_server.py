"""The amplifier on pymodbus's server, a process of its own, under conformance."""

import asyncio
import sys
from asyncio.subprocess import PIPE
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, closing
from pathlib import Path

import pytest

import era_haptics
from era_haptics.lab.conformance import judge_client
from era_haptics.lab.conformance.contract import of_kind
from sim.transport.far_end import make_terminal

EXAMPLE = Path(era_haptics.__file__).parents[1] / "examples" / "modbus_server" / "modbus_server.py"
FAILED = {"pieces", "exceptions"}
"""What docs/how-to/write-an-amplifier.md says that the server cannot do."""
SKIPPED = {"sensors", "steps_as_stated", "limited", "readings", "events"}
BY_MACHINE = {"clock_rate"}
"""What is skipped, with that reason, where exchanges are long on the machine of the test."""

pytestmark = pytest.mark.real_time


@asynccontextmanager
async def served(kind: str) -> AsyncIterator[str]:
    """The example on a TCP port, or on a pseudo-terminal that is joined to another; its URL."""
    here = make_terminal(lambda data: there.write(data))
    there = make_terminal(here.write)
    with closing(here), closing(there):
        for each in (here, there):
            each.listen()
        place = ["0"] if kind == "tcp" else [there.port, "N"]
        command = sys.executable, str(EXAMPLE), kind, *place
        process = await asyncio.create_subprocess_exec(*command, stdout=PIPE)
        try:
            assert process.stdout is not None
            url = (await process.stdout.readline()).decode().strip()
            yield url.replace(there.port, here.port)
        finally:
            process.terminate()
            await process.wait()


@pytest.mark.parametrize(
    "drives", [False, pytest.param(True, marks=[pytest.mark.long, pytest.mark.alone])]
)
@pytest.mark.parametrize("kind", ["tcp", "rtu"])
async def test_conformance_finds_what_the_server_cannot_do(kind: str, drives: bool) -> None:
    """Every check of the wire has a verdict, and those fail that the page names, no others."""
    async with served(kind) as url:
        report = await judge_client(url, drives=drives)
    checks = [(number, check) for number, check in of_kind(kind) if drives or not check.drives]
    assert [(each.number, each.check) for each in report.results] == checks
    failed = {each.check.name: each.reason for each in report.results if each.result == "failed"}
    skipped = {each.check.name for each in report.results if each.result == "skipped"}
    names = {check.name for _, check in checks}
    assert set(failed) == names & FAILED, failed
    assert skipped - BY_MACHINE == names & SKIPPED
