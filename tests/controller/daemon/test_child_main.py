"""Modules that run as children of a daemon."""

import os
import signal
import subprocess
import sys


def test_child_ends_by_none_of_the_daemons_own_signals() -> None:
    """A signal to the whole service reopens the log or does nothing; SIGTERM ends a child."""
    command = [sys.executable, "-P", "-u", "-m", "controller.daemon.child_main", str(os.getpid())]
    with subprocess.Popen([*command, "http.server", "0"], stdout=subprocess.PIPE) as child:
        assert child.stdout is not None
        child.stdout.readline()  # it serves
        for number in (signal.SIGHUP, signal.SIGUSR1, signal.SIGTERM):
            child.send_signal(number)
        assert child.wait(20) == -signal.SIGTERM
