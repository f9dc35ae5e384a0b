"""Child processes that end with their parent: `python -m controller.process.child PARENT MODULE`.

PARENT is the process number of the starting process. On Linux the kernel terminates the module when
that process exits, however it exits. Signals to the daemon that also reach its children, such
as those of `systemctl kill`, have no effect on them.
"""

import asyncio
import contextlib
import ctypes
import os
import runpy
import signal
import sys

_PR_SET_PDEATHSIG = 1  # prctl(2)


def child_command(module: str, *arguments: str) -> list[str]:
    """The command of a module as a child of this process."""
    # -P: do not import a folder named controller in the working directory
    command = [sys.executable, "-P", "-m", "controller.process.child", str(os.getpid())]
    return [*command, module, *arguments]


async def ended(process: asyncio.subprocess.Process, timeout: float) -> None:
    """Wait for the end of a terminated process; kill it after a timeout [s]."""
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(timeout):
            await process.wait()
    with contextlib.suppress(ProcessLookupError):
        process.kill()
    await process.wait()


def end_with_parent(parent: int) -> None:
    """Let the kernel terminate this process when its parent exits (Linux); exit if it already has.

    parent: its process number.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    if os.getppid() != parent:
        os._exit(0)  # the parent exited before prctl


def _main() -> None:
    _, parent, module, *arguments = sys.argv
    end_with_parent(int(parent))
    for number in (signal.SIGHUP, signal.SIGUSR1):
        signal.signal(number, signal.SIG_IGN)
    sys.argv[:] = [module, *arguments]
    runpy.run_module(module, run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    _main()
