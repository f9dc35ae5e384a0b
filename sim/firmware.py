"""The project's firmware in place of simulated amplifiers: a process with a serial line for each.

`make firmware` builds it from the sources of a checkout; it is not part of the wheel. Its samples
go nowhere, so the plate of the simulation does not move.
"""

import asyncio
import contextlib
from collections.abc import AsyncIterator
from pathlib import Path

from drivers.errors import LinkError
from model.errors import InputError

FOLDER = Path(__file__).parents[1] / "out" / "firmware"
"""Where `make firmware` puts its programs."""

_STARTUP_TIMEOUT = 10.0  # s


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


@contextlib.asynccontextmanager
async def running(program: Path, name: str) -> AsyncIterator[str]:
    """Run the firmware for an amplifier, yield its URL. Raises LinkError.

    It ends with this process, also if that is killed: its standard input is at its end then.
    """
    process = await asyncio.create_subprocess_exec(
        program,
        "--serial",
        "--until-eof",
        stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.DEVNULL,
    )
    assert process.stdout is not None  # noqa: S101  a pipe was requested
    try:
        async with asyncio.timeout(_STARTUP_TIMEOUT):
            url = (await process.stdout.readline()).decode().strip()
        if not url.startswith("serial://"):
            raise LinkError(f"firmware of {name}: no line was opened, got {url!r}")
        yield url
    except TimeoutError:
        raise LinkError(f"firmware of {name}: not ready in {_STARTUP_TIMEOUT:g} s") from None
    finally:
        with contextlib.suppress(ProcessLookupError):
            process.terminate()
        await process.wait()
