"""Delays of a process that is an amplifier."""

import os
import subprocess
import sys

import pytest

from drivers.conformance.lateness import waited_for_processor

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
    """Each is late while the other computes; no process, or one that has ended, is not."""
    before = [waited_for_processor(process.pid) for process in rivals]
    while any(
        waited_for_processor(process.pid) < since + LEAST
        for process, since in zip(rivals, before, strict=True)
    ):
        pass
    assert waited_for_processor(None) == 0.0
    rivals[0].kill()
    rivals[0].wait()
    assert waited_for_processor(rivals[0].pid) == 0.0
