"""Programs of the benchmark, their priorities and processor time, and load by others.

Amplifiers and a panel would not use the daemon's processors: the program that represents them has
the highest priority. The daemon has that of `examples/systemd`, floods the ordinary one.
"""

import asyncio
import contextlib
import os
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

DAEMON_NICE = -10  # as in the unit
TIMEOUT = 180.0  # s; a table may have to be built
_STAT = Path("/proc/stat")
_IDLE, _WAITING, _STOLEN = 3, 4, 7  # columns of /proc/stat's line of all processors, proc(5)

_children: set[int] = set()  # process ids of running programs
_ended = 0.0  # s; processor time of those that have ended


class EndedEarly(Exception):
    """A program of the benchmark has ended early, or does not get ready."""


def become_device() -> bool:
    """Take the highest priority, which children do not inherit; False if that is not permitted."""
    try:
        policy = os.SCHED_RR | os.SCHED_RESET_ON_FORK
        os.sched_setscheduler(0, policy, os.sched_param(1))
    except (AttributeError, PermissionError):
        return False
    return True


@asynccontextmanager
async def running(
    *command: object, nice: int = 0, has_line: bool = True
) -> AsyncIterator[tuple[asyncio.subprocess.Process, str]]:
    """Run a program while this lasts; yields it and its first line of output.

    Raises EndedEarly if it ends before that line.
    """
    global _ended
    process = await asyncio.create_subprocess_exec(
        *map(str, command),
        stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.PIPE,
        start_new_session=nice != 0,
    )
    if nice:
        _set_nice(process.pid, nice)
    _children.add(process.pid)
    try:
        line = b""
        if has_line:
            assert process.stdout is not None
            line = await asyncio.wait_for(process.stdout.readline(), TIMEOUT)
            if not line:
                raise EndedEarly(f"{' '.join(map(str, command[1:4]))} has ended")
        yield process, line.decode().strip()
    finally:
        _ended += computed(process.pid)
        _children.discard(process.pid)
        with contextlib.suppress(ProcessLookupError):
            process.terminate()
        await process.wait()


def _set_nice(process: int, nice: int) -> None:
    """Set the level of a process and of its session, as far as that is permitted.

    Where sessions share the processors, the level of a process counts within its session only; that
    of the session is as the unit's `CPUWeight=`.
    """
    with contextlib.suppress(PermissionError):
        os.setpriority(os.PRIO_PROCESS, process, nice)
    with contextlib.suppress(OSError):
        Path(f"/proc/{process}/autogroup").write_text(str(nice), "ascii")


def peak_memory(pid: int) -> int:
    """Return the most memory [bytes] that a process has had."""
    status = Path(f"/proc/{pid}/status").read_text("ascii")
    return 1024 * int(status.partition("VmHWM:")[2].split()[0])


def computed(process: int) -> float:
    """Processor time [s] of all threads of a process so far; 0 where not reported."""
    total = 0
    for file in Path(f"/proc/{process}/task").glob("*/schedstat"):
        with contextlib.suppress(OSError):  # the thread has ended
            total += int(file.read_text("ascii").split()[0])
    return total * 1e-9


class OtherLoad:
    """How busy other programs keep the processors, from construction on."""

    def __init__(self) -> None:
        self._begun = time.monotonic()
        self._before = _busy_with_others()

    def processors(self) -> float:
        """Average number of processors kept busy by others, including the kernel.

        Includes time stolen by other guests of the host; 0 where the system does not report it.
        """
        lasted = max(time.monotonic() - self._begun, 1e-9)
        return max(0.0, _busy_with_others() - self._before) / lasted


def _busy_with_others() -> float:
    """Processor time [s] of all others since the system started."""
    if not _STAT.exists():
        return 0.0
    busy = busy_ticks(_STAT.read_text("ascii").splitlines()[0]) / os.sysconf("SC_CLK_TCK")
    return busy - _ended - sum(map(computed, [os.getpid(), *_children]))


def busy_ticks(line: str) -> int:
    """Ticks of all processors, neither idle nor waiting, from the first line of /proc/stat."""
    ticks = [int(word) for word in line.split()[1:]]
    # The time of guests is included in the first columns.
    return sum(ticks[: _STOLEN + 1]) - ticks[_IDLE] - ticks[_WAITING]
