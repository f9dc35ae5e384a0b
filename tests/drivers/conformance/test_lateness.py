"""Delays of a process that is an amplifier."""

import os
import subprocess
import sys

import pytest

from drivers.conformance.lateness import ProcessorWaits

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
