"""Processes of firmware, which end with the one that started them."""

import os
import signal
import subprocess
import sys

from sim.firmware.programs import ending_with_parent

PARENT = """
import subprocess, sys, time
from sim.firmware.programs import ending_with_parent
child = [sys.executable, "-c", "import time; print('here', flush=True); time.sleep(60)"]
subprocess.Popen(ending_with_parent(child))
time.sleep(60)
"""


def test_child_ends_when_its_parent_is_killed() -> None:
    """Its output is at its end then, although nobody has told it."""
    with subprocess.Popen([sys.executable, "-c", PARENT], stdout=subprocess.PIPE) as parent:
        assert parent.stdout is not None
        assert parent.stdout.readline() == b"here\n"
        parent.send_signal(signal.SIGKILL)
        assert parent.stdout.read() == b""


def test_child_whose_parent_is_gone_does_not_start() -> None:
    """As if the parent had been killed before the child could ask to be told."""
    command = ending_with_parent([sys.executable, "-c", "print('here')"])
    command[3] = str(os.getpid() + 1)
    done = subprocess.run(command, capture_output=True, check=False)
    assert done.stdout == b""
