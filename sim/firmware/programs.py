"""Start the firmware as a process for each amplifier.

`make firmware` builds it from the sources of a checkout; it is not part of the wheel.
"""

import asyncio
import contextlib
import fcntl
import os
import re
import sys
from collections.abc import AsyncIterator, Sequence
from pathlib import Path

import numpy as np

from drivers.errors import LinkError
from model.arrays import FloatArray
from model.errors import InputError

RATE = 16_000.0
"""Samples per second and channel [Hz]."""

CHANNELS = 4
"""Channels of an amplifier."""

FOLDER = Path(__file__).parents[2] / "out" / "firmware"
"""Where `make firmware` puts its programs."""

_FULL_STROKE = 32767.0  # as a sample
_PIPE_SIZE = 1 << 20  # bytes; eight seconds
_STARTUP_TIMEOUT = 10.0  # s
_WITH_PARENT = (
    "import ctypes, os, signal, sys; "
    "ctypes.CDLL(None).prctl(1, signal.SIGTERM); "  # PR_SET_PDEATHSIG
    "os.getppid() == int(sys.argv[1]) and os.execvp(sys.argv[2], sys.argv[2:])"
)


def find_firmware() -> Path:
    """The built firmware, a program; InputError where there is none."""
    program = FOLDER / "era-firmware"
    if program.exists():
        return program
    if (FOLDER.parents[1] / "firmware").is_dir():
        raise InputError(f"firmware: {program} does not exist; run `make firmware` first")
    raise InputError(
        "firmware: its C sources are not part of this installation; run from a checkout of "
        "era-haptics, after `make firmware`"
    )


def ending_with_parent(command: Sequence[str | Path]) -> list[str | Path]:
    """A command whose process ends with the thread that starts it, also if that is killed.

    On Linux only.
    """
    if sys.platform != "linux":
        return [*command]
    return [sys.executable, "-c", _WITH_PARENT, str(os.getpid()), *command]


class RunningFirmware:
    """A running amplifier: its URL, and its samples as they come."""

    def __init__(self, url: str, pipe: int) -> None:
        self.url = url
        self._pipe = pipe
        self._rest = b""

    def read(self) -> FloatArray:
        """The samples since the last call, (n, channels) in full strokes."""
        with contextlib.suppress(BlockingIOError):
            while piece := os.read(self._pipe, _PIPE_SIZE):
                self._rest += piece
        size = len(self._rest) // (2 * CHANNELS) * 2 * CHANNELS
        whole, self._rest = self._rest[:size], self._rest[size:]
        return np.frombuffer(whole, "<i2").reshape(-1, CHANNELS) / _FULL_STROKE


@contextlib.asynccontextmanager
async def running(program: Path, folder: Path, name: str) -> AsyncIterator[RunningFirmware]:
    """Run the firmware for an amplifier; folder: for its pipe. Raises LinkError."""
    path = folder / f"{name}.samples"
    os.mkfifo(path)
    async with contextlib.AsyncExitStack() as stack:
        pipe = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
        stack.callback(os.close, pipe)
        fcntl.fcntl(pipe, fcntl.F_SETPIPE_SZ, _PIPE_SIZE)
        process = await asyncio.create_subprocess_exec(
            *ending_with_parent([program, "--serial", "--samples", path]),
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.DEVNULL,
        )
        stack.push_async_callback(_terminate, process)
        yield RunningFirmware(f"serial://{await _terminal_of(process, name)}", pipe)


async def _terminal_of(process: asyncio.subprocess.Process, name: str) -> str:
    """The pseudo-terminal that the process prints; raises LinkError."""
    assert process.stdout is not None  # noqa: S101  a pipe was requested
    try:
        async with asyncio.timeout(_STARTUP_TIMEOUT):
            line = (await process.stdout.readline()).decode()
    except TimeoutError:
        raise LinkError(f"firmware of {name}: not ready in {_STARTUP_TIMEOUT:g} s") from None
    found = re.search(r"/dev/\S+", line)
    if found is None:
        raise LinkError(f"firmware of {name}: no line was opened, got {line.strip()!r}")
    return found[0]


async def _terminate(process: asyncio.subprocess.Process) -> None:
    with contextlib.suppress(ProcessLookupError):
        process.terminate()
    await process.wait()
