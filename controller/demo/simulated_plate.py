"""The simulated plate of the demonstration, and the vibration of the fingers on it.

`simulated_plate` starts amplifiers in a process of their own behind a real wire. The controller
reaches them over the wire only; `SimulatedPlate` places the fingers and reads their vibration over
the control socket.
"""

import asyncio
import contextlib
import json
import os
import sys
import tempfile
from collections.abc import AsyncIterator, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from urllib.parse import quote

import numpy as np
from pydantic import BaseModel, ValidationError

from controller.process.child import ended
from drivers.errors import LinkError
from model.arrays import FloatArray, Point
from model.finger import DEFAULT_THRESHOLD, mean_level_db_sl, sensation_level
from registry.wording import first_problem

_SAME_FREQUENCY = 1.0
"""Difference [Hz] within which a tone belongs to a content, due to rounding by the amplifier."""

SIMULATED_WATCHDOG = 2.0
"""Watchdog [s] of simulated amplifiers, the longest of the protocol: their machine may be busy."""

STARTUP_TIMEOUT = 120.0  # s; solving the plate takes long on a busy machine
EXIT_TIMEOUT = 3.0  # s
_REPLY_TIMEOUT = 30.0  # s; long enough for a busy machine
_MAX_REPLY = 1 << 20  # bytes; a reply for ten fingers takes a fiftieth of this
_REMEDY = "see its output above and start the demonstration again"

SIM_OPTIONS: Mapping[str, Sequence[str]] = {
    "serial": ("--serial", "--shared"),
    "modbus": ("--modbus-tcp", "0"),
    "can": ("--socketcand", "0"),
    "firmware": ("--firmware",),
    "cortex-m": ("--cortex-m",),
}
"""Options of `era sim` by wire; amplifiers share a bus, so that they start together."""


@dataclass(frozen=True)
class FingerVibration:
    """Measured vibration of a fingertip over a time window, at p points of the tip."""

    frequencies: FloatArray
    """Frequencies (f,) [Hz]."""
    amplitudes: FloatArray
    """Amplitudes (f, p) [m/s²] of the steady part."""
    weights: FloatArray
    """Weights (p,) of the points in the mean over the tip."""
    thresholds: tuple[str, ...] = (DEFAULT_THRESHOLD,)
    """Threshold sets: levels refer to the first, contrasts are the lowest of all sets."""

    @property
    def level_db_sl(self) -> float:
        """Sensation level, mean over the tip; -inf without vibration."""
        return self.level_by(self.thresholds[0])

    @property
    def loudest_db_sl(self) -> float:
        """Sensation level at the loudest point of the tip; -inf without vibration."""
        return self.loudest_by(self.thresholds[0])

    def level_by(self, threshold: str) -> float:
        """Sensation level relative to a threshold set by name, mean over the tip."""
        return mean_level_db_sl(self.frequencies, self.amplitudes, self.weights, threshold)

    def loudest_by(self, threshold: str) -> float:
        """Sensation level relative to a threshold set by name, at the loudest point of the tip."""
        return float(sensation_level(self.frequencies, self.amplitudes, threshold).max())

    def parted(self, frequency: float) -> tuple["FingerVibration", "FingerVibration"]:
        """Split into the part at a content's frequency [Hz] and the rest."""
        is_own = np.abs(self.frequencies - frequency) < _SAME_FREQUENCY
        parts = []
        for is_part in (is_own, ~is_own):
            frequencies = self.frequencies[is_part]
            amplitudes = self.amplitudes[is_part]
            parts.append(replace(self, frequencies=frequencies, amplitudes=amplitudes))
        return parts[0], parts[1]


class SimulatedPlate:
    """The plate behind the amplifiers, with their URLs by name; methods raise LinkError.

    control: path of its control socket; each request has a connection of its own, so that no finger
    waits for a vibration.
    """

    def __init__(
        self,
        control: Path,
        urls: Mapping[str, str],
        *,
        thresholds: Sequence[str] = (DEFAULT_THRESHOLD,),
    ) -> None:
        self.urls = urls
        self._control = control
        self._thresholds = tuple(thresholds)
        self._placing = asyncio.Lock()  # fingers are placed in order

    async def place_fingers(
        self, positions: Mapping[str, Point], loads: Mapping[str, float] = MappingProxyType({})
    ) -> None:
        """Place fingers at positions [m] by id, loads by id, too; all others are removed."""
        async with self._placing:
            await self._request("fingers", fingers=dict(positions), loads=dict(loads))

    async def vibration(self, since: float, until: float) -> dict[str, FingerVibration]:
        """Vibration of each finger by id between two times [s] of time.monotonic()."""
        reply = await self._request("felt", since_s=since, until_s=until)
        vibration = {}
        for id, finger in reply.fingers.items():
            shape = len(finger.frequencies_hz), len(finger.weights)
            vibration[id] = FingerVibration(
                frequencies=np.array(finger.frequencies_hz),
                amplitudes=np.array(finger.amplitude_m_s2).reshape(shape),
                weights=np.array(finger.weights),
                thresholds=self._thresholds,
            )
        return vibration

    async def _request(self, op: str, **values: object) -> "_Reply":
        """Return the reply to a request; raises LinkError without a reply or for an error."""
        try:
            async with asyncio.timeout(_REPLY_TIMEOUT):
                path = str(self._control)
                reader, writer = await asyncio.open_unix_connection(path, limit=_MAX_REPLY)
                with contextlib.closing(writer):
                    writer.write(json.dumps({"op": op, **values}).encode() + b"\n")
                    reply = _Reply.model_validate_json(await reader.readline())
        except (OSError, ValueError) as error:  # a missing or incomplete line is not JSON
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
    weights: list[float]


class _Reply(BaseModel):
    """The fields used from a reply of the control socket."""

    error: str | None = None
    fingers: dict[str, _FingerRecord] = {}


@contextlib.asynccontextmanager
async def simulated_plate(
    rig_file: Path,
    amplifiers: Collection[str],
    *,
    wire: str,
    seed: int | None = 0,
    thresholds: Sequence[str] = (DEFAULT_THRESHOLD,),
) -> AsyncIterator[SimulatedPlate]:
    """Simulate the amplifiers of a rig file for the duration of the context.

    wire: a key of `SIM_OPTIONS` for a process of their own, "sim" for a plate in this process;
    seed: of the plate within the rig's uncertainty, None for the rig's own; thresholds: see
    `FingerVibration`. Raises LinkError if the process does not start.
    """
    with tempfile.TemporaryDirectory(prefix="era-") as folder:
        path = Path(folder) / "control"
        async with contextlib.AsyncExitStack() as stack:
            if wire == "sim":
                rig = quote(os.fsencode(rig_file))
                control = quote(os.fsencode(path))
                plate = "exact" if seed is None else f"seed={seed}"
                base = f"sim://{rig}?control={control}&{plate}&amplifier="
                urls = {name: base + quote(name) for name in amplifiers}
            else:
                process = await start_simulation(rig_file, wire=wire, control=path, seed=seed)
                stack.push_async_callback(end_simulation, process)
                urls = await _read_urls(process, count=len(amplifiers))
            yield SimulatedPlate(path, urls, thresholds=thresholds)


async def start_simulation(
    rig_file: Path, *, wire: str, control: Path, seed: int | None
) -> asyncio.subprocess.Process:
    """Start simulated amplifiers as a process that ends with this one."""
    plate = ("--exact",) if seed is None else ("--seed", str(seed))
    return await asyncio.create_subprocess_exec(
        # -P: do not import a folder named sim in the working directory
        sys.executable,
        "-P",
        "-m",
        "sim",
        str(rig_file),
        *SIM_OPTIONS[wire],
        *plate,
        "--control",
        str(control),
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
            while len(urls) < count:
                line = await process.stdout.readline()
                if not line:
                    break
                name, _, url = line.decode().strip().partition(": ")
                urls[name] = url
    except TimeoutError:
        reason = f"not ready within {STARTUP_TIMEOUT:g} s"
        raise LinkError(f"simulated amplifiers: {reason}; {_REMEDY}") from None
    if len(urls) < count:
        status = await process.wait()
        raise LinkError(f"simulated amplifiers: exited with status {status}; {_REMEDY}")
    return urls


async def end_simulation(process: asyncio.subprocess.Process) -> None:
    """Terminate the process of simulated amplifiers, and wait until it has ended."""
    with contextlib.suppress(ProcessLookupError):
        process.terminate()
    await ended(process, EXIT_TIMEOUT)
