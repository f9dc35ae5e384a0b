"""The far end of the demonstration: simulated amplifiers and the plate that they drive.

The controller reaches them over their wire. Here the control socket is used: to say where
fingers rest, and to ask what they felt.
"""

import asyncio
import contextlib
import sys
import tempfile
from collections.abc import AsyncIterator, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import cast
from urllib.parse import quote

import numpy as np

from controller.plate_control import PlateControl
from drivers.errors import LinkError
from model.arrays import FloatArray

STARTUP_TIMEOUT = 30.0  # seconds; a machine at work on something else solves the plate slowly
EXIT_TIMEOUT = 3.0
_AGAIN = "start the demonstration again; what the plate said last stands above"

# Options of `era sim` by wire; there is none for a plate within this process.
OPTIONS: Mapping[str, Sequence[str]] = {
    "serial": ("--serial",),
    "modbus": ("--modbus-tcp", "0"),
    "can": ("--socketcand", "0"),
}


@dataclass(frozen=True)
class FingerFelt:
    """What one fingertip felt over a window.

    frequencies (f,) [Hz]; amplitudes (f, p) [m/s²] of the steady part at each point of the tip;
    peaks (p,) [m/s²], the largest acceleration seen there, transients included.
    """

    frequencies: FloatArray
    amplitudes: FloatArray
    peaks: FloatArray


class BenchControl:
    """What the demonstration asks of a simulated plate; raises LinkError."""

    def __init__(self, control: PlateControl) -> None:
        self._control = control

    async def place_fingers(self, positions: Mapping[str, tuple[float, float]]) -> None:
        """Let fingers rest at these positions [m], by id, and at no others."""
        await self._control.ask(
            {"op": "fingers", "fingers": {id: list(at) for id, at in positions.items()}}
        )

    async def felt(self, since: float, until: float) -> dict[str, FingerFelt]:
        """What each finger felt between two times [s] of time.monotonic(), by id."""
        answer = await self._control.ask({"op": "felt", "since_s": since, "until_s": until})
        return {
            id: FingerFelt(
                frequencies=np.array(felt["frequencies_hz"], dtype=float),
                amplitudes=np.array(felt["amplitude_m_s2"], dtype=float).reshape(
                    len(felt["frequencies_hz"]), len(felt["peak_m_s2"])
                ),
                peaks=np.array(felt["peak_m_s2"], dtype=float),
            )
            for id, felt in answer["fingers"].items()
        }


@dataclass(frozen=True)
class FarEnd:
    """What the controller needs of it: a URL by amplifier name, and the control of the bench."""

    urls: Mapping[str, str]
    bench: BenchControl


@contextlib.asynccontextmanager
async def open_far_end(
    rig_file: Path, amplifiers: Collection[str], *, wire: str
) -> AsyncIterator[FarEnd]:
    """The simulated amplifiers of a rig file on a wire; they end with the context.

    amplifiers: their names; wire: "sim" for a plate within this process, otherwise a key of
    `OPTIONS`, for one in a process of its own. Raises LinkError if that does not start.
    """
    with tempfile.TemporaryDirectory(prefix="era-") as folder:
        control = Path(folder) / "control"
        async with contextlib.AsyncExitStack() as stack:
            plate = PlateControl(control, remedy=_AGAIN)
            stack.push_async_callback(plate.close)
            if wire == "sim":
                query = f"?control={quote(str(control))}&amplifier="
                base = f"sim://{quote(str(rig_file))}{query}"
                urls = {name: base + quote(name) for name in amplifiers}
            else:
                process, said = await _start(rig_file, wire=wire, control=control)
                stack.push_async_callback(_end, process)
                urls = await _read_urls(process, said, count=len(amplifiers))
            yield FarEnd(urls, BenchControl(plate))


async def _start(
    rig_file: Path, *, wire: str, control: Path
) -> tuple[asyncio.subprocess.Process, asyncio.StreamReader]:
    """The process, and what it says."""
    process = await asyncio.create_subprocess_exec(
        # -P: a folder named sim where the user stands must not be taken for ours
        *(sys.executable, "-P", "-m", "sim", str(rig_file), *OPTIONS[wire]),
        *("--control", str(control)),
        # A pipe that nobody writes to: it closes when we die, however that is, and ends the process
        "--until-eof",
        stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.PIPE,
        start_new_session=True,  # or Ctrl-C would end the amplifiers before they were silenced
    )
    return process, cast(asyncio.StreamReader, process.stdout)  # there is one: it was asked for


async def _read_urls(
    process: asyncio.subprocess.Process, said: asyncio.StreamReader, *, count: int
) -> dict[str, str]:
    """The lines `NAME: URL` that the process prints when it is ready, one per amplifier."""
    urls: dict[str, str] = {}
    try:
        async with asyncio.timeout(STARTUP_TIMEOUT):
            while len(urls) < count and (line := (await said.readline()).decode()):
                name, _, url = line.strip().partition(": ")
                urls[name] = url
    except TimeoutError:
        raise LinkError(
            f"the simulated amplifiers did not start within {STARTUP_TIMEOUT:g} s; start the "
            "demonstration again when this machine has less to do"
        ) from None
    if len(urls) < count:
        raise LinkError(
            f"the simulated amplifiers did not start (exit status {await process.wait()}); "
            "what they said stands above"
        )
    return urls


async def _end(process: asyncio.subprocess.Process) -> None:
    if process.returncode is not None:
        return
    with contextlib.suppress(ProcessLookupError):
        process.terminate()
    try:
        async with asyncio.timeout(EXIT_TIMEOUT):
            await process.wait()
    except TimeoutError:
        process.kill()
        await process.wait()
