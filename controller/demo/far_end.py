"""Simulated amplifiers and their plate, in a process of their own behind a real wire.

The controller reaches the amplifiers over the wire only; the control socket places the fingers and
reads their vibration.
"""

import asyncio
import contextlib
import json
import os
import sys
import tempfile
from collections.abc import AsyncIterator, Collection, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from urllib.parse import quote

import numpy as np
from pydantic import BaseModel, ValidationError

from controller.demo.touch_row import FingerVibration, Position
from controller.process.child import ended
from drivers.errors import LinkError
from model.finger import DEFAULT_THRESHOLD
from registry.wording import first_problem

WATCHDOG = 2.0
"""Watchdog [s] of simulated amplifiers, the longest of the protocol: their machine may be busy."""

STARTUP_TIMEOUT = 120.0  # s; solving the plate takes long on a busy machine
EXIT_TIMEOUT = 3.0  # s
_REPLY_TIMEOUT = 30.0  # s; long enough for a busy machine
_MAX_REPLY = 1 << 20  # bytes; what ten fingers feel takes a fiftieth of it
_REMEDY = "see its output above and start the demonstration again"

SIM_OPTIONS: Mapping[str, Sequence[str]] = {
    "serial": ("--serial", "--shared"),
    "modbus": ("--modbus-tcp", "0"),
    "can": ("--socketcand", "0"),
    "firmware": ("--firmware",),
}
"""Options of `era sim` by wire; amplifiers share a bus, so that they start together."""


class SimulatedPlate:
    """The plate behind the amplifiers, with their URLs by name; methods raise LinkError.

    control: path of its control socket; each request has a connection of its own, so that no finger
    waits for a vibration.
    """

    def __init__(
        self, control: Path, urls: Mapping[str, str], *, threshold: str = DEFAULT_THRESHOLD
    ) -> None:
        self.urls = urls
        self._control = control
        self._threshold = threshold
        self._placing = asyncio.Lock()  # fingers are placed in order

    async def place_fingers(
        self, positions: Mapping[str, Position], loads: Mapping[str, float] = MappingProxyType({})
    ) -> None:
        """Place fingers at positions [m] by id, loads by id, too; all others are removed."""
        async with self._placing:
            await self._request("fingers", fingers=dict(positions), loads=dict(loads))

    async def vibration(self, since: float, until: float) -> dict[str, FingerVibration]:
        """Vibration of each finger by id between two times [s] of time.monotonic()."""
        reply = await self._request("felt", since_s=since, until_s=until)
        return {
            id: FingerVibration(
                frequencies=np.array(felt.frequencies_hz),
                amplitudes=np.array(felt.amplitude_m_s2).reshape(
                    len(felt.frequencies_hz), len(felt.peak_m_s2)
                ),
                peaks=np.array(felt.peak_m_s2),
                weights=np.array(felt.weights),
                threshold=self._threshold,
            )
            for id, felt in reply.fingers.items()
        }

    async def _request(self, op: str, **values: object) -> "_Reply":
        """The reply to a request; raises LinkError if there is none or it is an error."""
        try:
            async with asyncio.timeout(_REPLY_TIMEOUT):
                path = str(self._control)
                reader, writer = await asyncio.open_unix_connection(path, limit=_MAX_REPLY)
                with contextlib.closing(writer):
                    writer.write(json.dumps({"op": op, **values}).encode() + b"\n")
                    reply = _Reply.model_validate_json(await reader.readline())
        except (OSError, ValueError) as error:  # no line, or half of one, is no JSON
            why = str(error) or "it took too long"
            if isinstance(error, ValidationError):
                why = " ".join(first_problem(error))
            raise LinkError(
                f"simulated plate at {self._control}: no reply to {op} ({why}); {_REMEDY}"
            ) from error
        if reply.error is not None:
            raise LinkError(f"simulated plate: {op} refused: {reply.error}")
        return reply


class _FingerRecord(BaseModel):
    """Vibration of a finger, as the control socket has it."""

    frequencies_hz: list[float]
    amplitude_m_s2: list[list[float]]
    peak_m_s2: list[float]
    weights: list[float]


class _Reply(BaseModel):
    """What is read of a reply of the control socket."""

    error: str | None = None
    fingers: dict[str, _FingerRecord] = {}


@contextlib.asynccontextmanager
async def simulated_plate(
    rig_file: Path,
    amplifiers: Collection[str],
    *,
    wire: str,
    seed: int | None = 0,
    threshold: str = DEFAULT_THRESHOLD,
) -> AsyncIterator[SimulatedPlate]:
    """Simulate the amplifiers of a rig file for the duration of the context.

    wire: a key of `SIM_OPTIONS` for a process of their own, "sim" for a plate in this process;
    seed: of the plate within the rig's uncertainty, None for the rig's own; threshold: name of the
    set for levels. Raises LinkError if the process does not start.
    """
    with tempfile.TemporaryDirectory(prefix="era-") as folder:
        path = Path(folder) / "control"
        async with contextlib.AsyncExitStack() as stack:
            if wire == "sim":
                plate = "exact" if seed is None else f"seed={seed}"
                base = f"sim://{quote(os.fsencode(rig_file))}?control={quote(os.fsencode(path))}&{plate}&amplifier="
                urls = {name: base + quote(name) for name in amplifiers}
            else:
                process = await _start(rig_file, wire=wire, control=path, seed=seed)
                stack.push_async_callback(_terminate, process)
                urls = await _read_urls(process, count=len(amplifiers))
            yield SimulatedPlate(path, urls, threshold=threshold)


async def _start(
    rig_file: Path, *, wire: str, control: Path, seed: int | None
) -> asyncio.subprocess.Process:
    return await asyncio.create_subprocess_exec(
        # -P: do not import a folder named sim in the working directory
        *(sys.executable, "-P", "-m", "sim", str(rig_file), *SIM_OPTIONS[wire]),
        *(("--exact",) if seed is None else ("--seed", str(seed))),
        *("--control", str(control)),
        "--until-eof",  # ends with the pipe below, however this process ends
        stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.PIPE,
        start_new_session=True,  # Ctrl-C must not end the amplifiers before they are silenced
    )


async def _read_urls(process: asyncio.subprocess.Process, *, count: int) -> dict[str, str]:
    """Read a line `NAME: URL` per amplifier from the process."""
    urls: dict[str, str] = {}
    assert process.stdout is not None  # noqa: S101  a pipe was requested
    try:
        async with asyncio.timeout(STARTUP_TIMEOUT):
            while len(urls) < count and (line := (await process.stdout.readline()).decode()):
                name, _, url = line.strip().partition(": ")
                urls[name] = url
    except TimeoutError:
        reason = f"not ready within {STARTUP_TIMEOUT:g} s"
        raise LinkError(f"simulated amplifiers: {reason}; {_REMEDY}") from None
    if len(urls) < count:
        status = await process.wait()
        raise LinkError(f"simulated amplifiers: exited with status {status}; {_REMEDY}")
    return urls


async def _terminate(process: asyncio.subprocess.Process) -> None:
    with contextlib.suppress(ProcessLookupError):
        process.terminate()
    await ended(process, EXIT_TIMEOUT)
