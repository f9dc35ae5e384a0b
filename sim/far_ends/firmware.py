"""The project's firmware in place of simulated amplifiers: a process and a serial line for each.

`make firmware` builds it for this machine and for a Cortex-M3, which QEMU emulates. Its C sources
are part of a checkout, not of the wheel. Its samples drive nothing, so the plate does not move.

Both kinds of process end with this one, even if this one is killed: their standard input ends.
"""

import asyncio
import contextlib
import os
import shutil
import signal
import socket
from collections.abc import AsyncIterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from drivers.errors import LinkError
from model.errors import InputError

FIRMWARE_FOLDER = Path(__file__).parents[2] / "out" / "firmware"
"""Where `make firmware` puts its programs."""

EMULATOR = "qemu-system-arm"
EMULATED_BAUD = 57600
"""The host allows for the transmission time of such a line: QEMU passes on 11 kB/s or more."""

_STARTUP_TIMEOUT = 10.0  # s
_READY = "redirected to"
"""QEMU prints this once it has opened its lines."""

# QEMU does not read its standard input, so a shell does, and ends the group at its end.
_UNTIL_EOF = '"$@" </dev/null & cat >/dev/null; kill -s KILL 0'


@dataclass(frozen=True)
class Firmware:
    """A built program: for this machine, or for the emulated Cortex-M3."""

    program: Path
    is_emulated: bool = False


def find_firmware(*, is_emulated: bool) -> Firmware:
    """Return the built firmware; raises InputError if it, or its emulator, does not exist."""
    name = "era-firmware-mps2.elf" if is_emulated else "era-firmware"
    program = FIRMWARE_FOLDER / name
    if is_emulated and shutil.which(EMULATOR) is None:
        raise InputError(
            f"firmware: {EMULATOR} is not installed; on Debian and Ubuntu: apt install {EMULATOR}"
        )
    if program.exists():
        return Firmware(program, is_emulated)
    if not (FIRMWARE_FOLDER.parents[1] / "firmware").is_dir():
        raise InputError(
            "firmware: its C sources are not part of this installation; run from a checkout of "
            "era-haptics, after `make firmware`"
        )
    remedy = "run `make firmware` first"
    if is_emulated:
        remedy = "install gcc-arm-none-eabi and libnewlib-arm-none-eabi, then run `make firmware`"
    raise InputError(f"firmware: {program} does not exist; {remedy}")


@contextlib.asynccontextmanager
async def running_firmware(firmware: Firmware, name: str) -> AsyncIterator[str]:
    """Run the firmware for an amplifier, yield its URL. Raises LinkError."""
    if firmware.is_emulated:
        port = _free_port()
        url = f"serial+tcp://127.0.0.1:{port}?baud={EMULATED_BAUD}"
        async with _first_line_of(_emulator_command(firmware.program, port), name) as line:
            _require_line(_READY in line, line, name)
            yield url
    else:
        command = [str(firmware.program), "--serial", "--until-eof"]
        async with _first_line_of(command, name) as url:
            _require_line(url.startswith("serial://"), url, name)
            yield url


@contextlib.asynccontextmanager
async def _first_line_of(command: Sequence[str], name: str) -> AsyncIterator[str]:
    """Run a command for the duration of the context; yield the first line that it prints."""
    process = await asyncio.create_subprocess_exec(
        *command,
        stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.DEVNULL,
        start_new_session=True,
    )
    assert process.stdout is not None  # noqa: S101  a pipe was requested
    try:
        async with asyncio.timeout(_STARTUP_TIMEOUT):
            line = (await process.stdout.readline()).decode().strip()
        yield line
    except TimeoutError:
        raise LinkError(f"firmware of {name}: not ready in {_STARTUP_TIMEOUT:g} s") from None
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        await process.wait()


def _require_line(is_open: bool, printed: str, name: str) -> None:
    """Raise LinkError, with what the process printed, if it has no line open."""
    if not is_open:
        raise LinkError(f"firmware of {name}: no line was opened, got {printed!r}")


def _emulator_command(kernel: Path, port: int) -> Sequence[str]:
    """Return the command of a board whose serial line is a TCP port; `make qemu` has more lines."""
    line = f"tcp:127.0.0.1:{port},server=on,wait=off,nodelay=on"
    board = [EMULATOR, "-M", "mps2-an385", "-display", "none", "-monitor", "none"]
    lines = ["-serial", line, "-serial", "pty", "-serial", "null"]
    return ["sh", "-c", _UNTIL_EOF, "sh", *board, *lines, "-kernel", str(kernel)]


def _free_port() -> int:
    """Return a TCP port of this machine that is free now."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        port: int = server.getsockname()[1]
    return port
