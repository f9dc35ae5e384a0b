"""Delays of a process that is an amplifier."""

import asyncio
import os
import subprocess
import sys
from pathlib import Path

import pytest

from drivers.conformance.lateness import ProcessorWaits
from drivers.conformance.stolen_time import StolenTime
from virtual_loop import in_virtual_time

ENDLESS = """
import os, sys
os.sched_setaffinity(0, {int(sys.argv[1])})
print(flush=True)
while True:
    pass
"""
LEAST = 0.02  # s; some turns of the scheduler


@pytest.fixture
def rivals() -> "list[subprocess.Popen[bytes]]":
    """Two processes that compute without end on one processor."""
    command = [sys.executable, "-c", ENDLESS, str(min(os.sched_getaffinity(0)))]
    started = [subprocess.Popen(command, stdout=subprocess.PIPE) for _ in range(2)]
    for process in started:
        assert process.stdout is not None
        process.stdout.readline()
    yield started
    for process in started:
        process.kill()
        process.communicate()


def test_processes_on_one_processor_wait_for_it(rivals: "list[subprocess.Popen[bytes]]") -> None:
    """Each is late while the other computes, and no later once it has ended."""
    with ProcessorWaits(rivals[0].pid) as first, ProcessorWaits(rivals[1].pid) as second:
        before = [first.total(), second.total()]
        while first.total() < before[0] + LEAST or second.total() < before[1] + LEAST:
            pass
        rivals[0].kill()
        rivals[0].wait()
        ended_with = first.total()
        assert ended_with >= before[0] + LEAST
        assert first.total() == ended_with


def test_no_process_never_waits(rivals: "list[subprocess.Popen[bytes]]") -> None:
    """Neither without a number nor with that of a process that has ended."""
    rivals[0].kill()
    rivals[0].wait()
    for process in (None, rivals[0].pid):
        with ProcessorWaits(process) as waits:
            assert waits.total() == 0.0


def test_threads_that_begin_later_count(rivals: "list[subprocess.Popen[bytes]]") -> None:
    """The one that computes is the second thread of its process."""
    program = (
        "import sys, threading; print(flush=True); input(); "
        f"threading.Thread(target=exec, args=({ENDLESS!r},), daemon=True).start(); input()"
    )
    command = [sys.executable, "-c", program, str(min(os.sched_getaffinity(0)))]
    with (
        subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1
        ) as process,
        ProcessorWaits(process.pid) as waits,
    ):
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdout.readline()
        before = waits.total()
        process.stdin.write("\n")
        while waits.total() < before + LEAST:
            pass
        process.kill()


@in_virtual_time
async def test_stalls_of_a_virtual_machine_count(tmp_path: Path) -> None:
    """By the eighth number of /proc/stat, in ticks; what an amplifier makes up for does not."""
    file, ticks = tmp_path / "stat", os.sysconf("SC_CLK_TCK")

    def steal(total: float) -> None:
        file.write_text(f"cpu  9 9 9 9 9 9 9 {100 + round(total * ticks)} 0 0\ncpu0 9 9 9 9\n")

    steal(0.0)
    with StolenTime(file) as stolen:
        seen = []
        for total in (0.01, 0.31, 0.32):
            steal(total)
            await asyncio.sleep(0.02)
            seen.append(stolen.total())
    assert seen == pytest.approx([0.0, 0.3, 0.3])


@in_virtual_time
async def test_machine_without_such_statistics_is_never_stalled(tmp_path: Path) -> None:
    """Neither without the file nor with another content."""
    (tmp_path / "short").write_text("cpu 1 2\n")
    for name in ("none", "short"):
        with StolenTime(tmp_path / name) as stolen:
            await asyncio.sleep(0.02)
            assert stolen.total() == 0.0
