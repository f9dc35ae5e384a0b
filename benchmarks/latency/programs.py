"""Processes of the latency benchmark and their priorities.

A real amplifier or panel does not use the daemon's processors; here it does, at the highest
priority. The daemon has the priority of `examples/systemd`, load programs
the ordinary one.
"""

import contextlib
import os
import signal
import subprocess
import sys
from collections.abc import Mapping
from enum import Enum, auto
from pathlib import Path

TIMEOUT = 60.0  # s
DEVICE_NICE = -20
DAEMON_NICE = -10  # as in the unit
_DEVICE_PRIORITY = 1  # of SCHED_RR


class Rank(Enum):
    """Priority of a program."""

    DEVICE = auto()
    SERVICE = auto()
    ORDINARY = auto()


class Ended(Exception):
    """A program of the benchmark has ended early, or does not get ready."""


class Program:
    """A process that ends with the stack, with the priority of its rank.

    is_urgent: whether the priority was allowed.
    """

    def __init__(
        self, stack: contextlib.ExitStack, *command: object, rank: Rank = Rank.ORDINARY
    ) -> None:
        self._process = subprocess.Popen(
            list(map(str, command)),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, **_ONE_THREAD},
            text=True,
            start_new_session=rank is not Rank.ORDINARY,
        )
        self._name = " ".join(map(str, command[1:4]))
        stack.callback(self.end)
        self.is_urgent = rank is Rank.ORDINARY or _is_made_urgent(self._process.pid, rank)

    def line(self) -> str:
        """Read the next line of its output; raises Ended."""
        assert self._process.stdout is not None
        line = self._process.stdout.readline().strip()
        if not line:
            raise Ended(f"{self._name} has ended early")
        return line

    def tell(self, text: str) -> None:
        """Write a line to its input."""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{text}\n")
        self._process.stdin.flush()

    def wait(self, timeout: float) -> None:
        """Wait until it ends; raises Ended after a timeout [s] or for another status than 0."""
        try:
            status = self._process.wait(timeout)
        except subprocess.TimeoutExpired:
            raise Ended(f"{self._name} does not end") from None
        if status:
            raise Ended(f"{self._name} has ended with status {status}")

    def check(self) -> None:
        """Raise Ended if it has ended."""
        if self._process.poll() is not None:
            raise Ended(f"{self._name} has ended; its log says why")

    def computed(self) -> float:
        """Processor time [s] of all its threads so far; 0 where not reported."""
        total = 0
        for file in Path(f"/proc/{self._process.pid}/task").glob("*/schedstat"):
            with contextlib.suppress(OSError):  # the thread has ended
                total += int(file.read_text("ascii").split()[0])
        return total * 1e-9

    def finish(self) -> None:
        """Make it write its record, and continue."""
        self._process.send_signal(signal.SIGUSR1)
        self.line()

    def end(self) -> None:
        """Terminate it unless it has ended."""
        if self._process.poll() is None:
            self._process.terminate()
        self._process.wait(TIMEOUT)
        for stream in (self._process.stdin, self._process.stdout):
            if stream is not None:
                with contextlib.suppress(OSError):
                    stream.close()


def module(name: str) -> tuple[str, ...]:
    """The command that runs a program of the benchmark."""
    return (sys.executable, "-m", f"benchmarks.latency.{name}")


def _is_made_urgent(process: int, rank: Rank) -> bool:
    """Set the priority of a process; False if not permitted."""
    nice = DEVICE_NICE if rank is Rank.DEVICE else DAEMON_NICE
    try:
        os.setpriority(os.PRIO_PROCESS, process, nice)
        # Where sessions share the cores among them, nice counts within a session only.
        group = Path(f"/proc/{process}/autogroup")
        if group.exists():
            group.write_text(str(nice), "ascii")
    except PermissionError:
        return False
    if rank is Rank.DEVICE and hasattr(os, "sched_setscheduler"):
        with contextlib.suppress(PermissionError):  # nice remains
            os.sched_setscheduler(process, os.SCHED_RR, os.sched_param(_DEVICE_PRIORITY))
    return True


_ONE_THREAD: Mapping[str, str] = dict.fromkeys(
    ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1"
)
