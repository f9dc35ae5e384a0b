"""Measurements of a simulated plate, over its control socket, for one situation of a touch stream.

Fingers are at every place of the stream, so that what they felt can be read for any window
afterwards; those that do not touch have no weight.
"""

import asyncio
import contextlib
import json
import math
from collections.abc import AsyncIterator, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from controller.api.client_protocol import Notification
from model.arrays import ComplexArray, FloatArray
from touch_stream import Place, Situation

PATIENCE = 180.0  # s; for a loaded machine, not an expectation
SENSORS: Mapping[str, Place] = {
    "P1": (0.03, 0.05),
    "P2": (0.20, 0.11),
    "P3": (0.29, 0.20),
    "P4": (0.08, 0.19),
    "P5": (0.15, 0.04),
    "P6": (0.26, 0.09),
}
STEADY = 0.3  # s; the end of each situation, when its transients have decayed
ONSET = 0.1  # s; over which an onset is judged


@dataclass(frozen=True)
class Felt:
    """Vibration of a fingertip: frequencies (f,) [Hz], amplitudes (f, p) and peaks (p,) [m/s²].

    weights (p,): of the points in the mean over the tip.
    """

    frequencies: FloatArray
    amplitudes: FloatArray
    peaks: FloatArray
    weights: FloatArray


@dataclass(frozen=True)
class Signals:
    """Readings of the sensors: times (n,) on time.monotonic() [s], samples (n, s) [m/s²]."""

    times: FloatArray
    samples: FloatArray


@dataclass(frozen=True)
class Heard:
    """A situation as it was on the plate, from start to end on time.monotonic() [s].

    patterns: as the daemon reported them, the first after a delay [s]; steady,
    onset: what fingertips felt in the end and in the first 100 ms, by place; phasors (f, s) [m/s²]:
    at the sensors in the end, at the frequencies that were played; fading: what sensors read where
    nobody touched.
    """

    situation: Situation
    begin: float
    end: float
    patterns: tuple[Mapping[str, Any], ...] = ()
    delay: float = 0.0
    steady: Mapping[str, Felt] = field(default_factory=dict)
    onset: Mapping[str, Felt] = field(default_factory=dict)
    phasors: ComplexArray | None = None
    fading: Signals | None = None


class Refused(AssertionError):
    """The plate refused a request; it keeps the last ten seconds."""


class Control:
    """The control socket of a simulated plate, in a far end or in the daemon itself."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._reader, self._writer = reader, writer
        self._turn = asyncio.Lock()

    @classmethod
    @asynccontextmanager
    async def at(cls, path: Path) -> AsyncIterator["Control"]:
        """Connect to an existing socket."""
        reader, writer = await asyncio.open_unix_connection(path, limit=1 << 26)
        try:
            yield cls(reader, writer)
        finally:
            writer.close()
            with contextlib.suppress(OSError):
                await writer.wait_closed()

    async def ask(self, op: str, **request: Any) -> dict[str, Any]:
        """Send a request and return its reply; raises Refused."""
        async with self._turn:
            self._writer.write(json.dumps({"op": op, **request}).encode() + b"\n")
            line = await asyncio.wait_for(self._reader.readline(), PATIENCE)
        answer: dict[str, Any] = json.loads(line)
        if "error" in answer:
            raise Refused(f"{op}: {answer['error']}")
        return answer


async def hear(
    control: Control,
    situation: Situation,
    begin: float,
    end: float,
    *,
    events: Sequence[Notification],
) -> Heard:
    """Read what was felt in a situation between two times [s]."""
    heard = Heard(situation, begin, end)
    if situation.target is None:
        return replace(heard, fading=await _signals(control, begin, end))
    patterns = [one for one in events if one.topic == "pattern" and begin <= one.time < end]
    steady = await _felt(control, end - STEADY, end)
    signals = await _signals(control, end - STEADY, end)
    frequencies = next(iter(steady.values())).frequencies
    heard = replace(
        heard,
        patterns=tuple(one.data for one in patterns),
        delay=patterns[0].time - begin if patterns else math.inf,
        steady=steady,
        phasors=_phasors(signals, frequencies),
    )
    if not situation.from_rest:
        return heard
    first = await _signals(control, begin, begin + 2 * ONSET)
    motion = np.abs(first.samples).max(axis=1)
    onset = float(first.times[np.argmax(motion > 1e-3 * motion.max())])
    return replace(heard, onset=await _felt(control, onset, onset + ONSET))


async def _signals(control: Control, since: float, until: float) -> Signals:
    answer = await control.ask("signals", since_s=since, until_s=until)
    samples = np.array([answer["sensors"][name]["m_s2"] for name in SENSORS]).T
    return Signals(answer["start_s"] + np.arange(len(samples)) / answer["sample_rate_hz"], samples)


async def _felt(control: Control, since: float, until: float) -> dict[str, Felt]:
    answer = await control.ask("felt", since_s=since, until_s=until)
    return {
        place: Felt(
            np.array(felt["frequencies_hz"], dtype=float),
            np.array(felt["amplitude_m_s2"], dtype=float).reshape(
                len(felt["frequencies_hz"]), len(felt["peak_m_s2"])
            ),
            np.array(felt["peak_m_s2"], dtype=float),
            np.array(felt["weights"], dtype=float),
        )
        for place, felt in answer["fingers"].items()
    }


def _phasors(signals: Signals, frequencies: FloatArray) -> ComplexArray:
    """Complex amplitudes (f, s) of Im[a exp(i omega t)], t from the first sample on.

    Least squares under a Hann window, which keeps out what still rings at other frequencies.
    """
    weights = np.sqrt(np.hanning(len(signals.times)))[:, None]
    angles = 2 * np.pi * np.outer(signals.times - signals.times[0], frequencies)
    basis = np.hstack([np.sin(angles), np.cos(angles)])
    found = np.linalg.lstsq(weights * basis, weights * signals.samples, rcond=None)[0]
    return np.asarray(found[: len(frequencies)] + 1j * found[len(frequencies) :])
