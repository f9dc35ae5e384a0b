"""Sensors on the plate while it is driven: those of a simulated one, by its control socket."""

import asyncio
import contextlib
import json
from abc import ABC, abstractmethod
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import numpy as np

from drivers.errors import LinkError
from model.arrays import ComplexArray, FloatArray

_VERSION = 2
_LINE_MAX = 1 << 20  # bytes of an answer
_VIRTUAL_BEAT = 0.2  # s; of the 0.25 s that amplifiers wait; virtual time is never late
_PATIENCE = 30.0  # s; a far end on a busy machine


class Sensors(ABC):
    """What listens to the plate.

    names (s,); points (s, 2) [m]; beat [s]: how long may be waited at once, for amplifiers want to
    be fed meanwhile.
    """

    names: tuple[str, ...]
    points: FloatArray
    beat: float = 0.05

    @abstractmethod
    async def wait(self, seconds: float) -> None:
        """Let time pass [s], by the plate's clock."""

    @abstractmethod
    async def time(self) -> float:
        """The plate's time [s]."""

    @abstractmethod
    async def tone(self, frequency: float, *, since: float, until: float) -> ComplexArray:
        """Complex amplitudes (s,) [m/s²] of a tone [Hz] over a window of the plate's time [s]."""


class SimulatedSensors(Sensors):
    """Accelerometers on a simulated plate, read over its control socket."""

    def __init__(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, points: FloatArray
    ) -> None:
        self._reader, self._writer = reader, writer
        self._is_virtual = False
        self.points = points
        self.names = tuple(f"P{number}" for number in range(1, len(points) + 1))

    async def begin(self, *, noise: float) -> None:
        """Place the sensors; noise [m/s²/√Hz]. LinkError for a far end that does not know any."""
        hello = await self.ask({"op": "hello"})
        if hello.get("version", 0) < _VERSION:
            raise LinkError("the simulated plate is of an older version, without sensors")
        self._is_virtual = hello["clock"] == "virtual"
        if self._is_virtual:
            self.beat = _VIRTUAL_BEAT
        sensors = {
            name: {"at_m": point, "noise_m_s2_rthz": noise}
            for name, point in zip(self.names, self.points.tolist(), strict=True)
        }
        await self.ask({"op": "sensors", "sensors": sensors})

    async def wait(self, seconds: float) -> None:
        """Let time pass [s]: the clock's, or the far end's where that is virtual."""
        if self._is_virtual:
            await self.ask({"op": "step", "seconds": seconds})
        else:
            await asyncio.sleep(seconds)

    async def time(self) -> float:
        """The plate's time [s]."""
        return float((await self.ask({"op": "state"}))["time_s"])

    async def tone(self, frequency: float, *, since: float, until: float) -> ComplexArray:
        """Complex amplitudes (s,) [m/s²] of a tone [Hz] over a window [s]."""
        heard = await self.ask(
            {"op": "tones", "since_s": since, "until_s": until, "frequencies_hz": [frequency]}
        )
        found = [heard["sensors"][name] for name in self.names]
        return np.array([each["real_m_s2"][0] + 1j * each["imag_m_s2"][0] for each in found])

    async def ask(self, question: dict[str, Any]) -> dict[str, Any]:
        """One line of control and its answer; raises LinkError for an error in it."""
        try:
            self._writer.write(json.dumps(question).encode() + b"\n")
            async with asyncio.timeout(_PATIENCE):
                line = await self._reader.readline()
        except (OSError, TimeoutError, ValueError) as error:
            raise LinkError(f"the simulated plate does not answer: {error}") from error
        if not line:
            raise LinkError("the simulated plate is gone: its process closed the control socket")
        answer: dict[str, Any] = json.loads(line)
        if "error" in answer:
            raise LinkError(f"the simulated plate refused {question['op']}: {answer['error']}")
        return answer


@asynccontextmanager
async def simulated_sensors(
    control: Path, points: Sequence[tuple[float, float]], *, noise: float
) -> AsyncIterator[SimulatedSensors]:
    """Sensors at points [m] of the far end whose control socket this is; raises LinkError."""
    try:
        reader, writer = await asyncio.open_unix_connection(str(control), limit=_LINE_MAX)
    except OSError as error:
        raise LinkError(
            f"no simulated plate listens at {control} ({error.strerror or error}); start `era sim "
            f"RIG ... --control {control}`, or give measured responses with --measured FILE"
        ) from error
    try:
        sensors = SimulatedSensors(reader, writer, np.array(points, dtype=float))
        await sensors.begin(noise=noise)
        yield sensors
    finally:
        writer.close()
        with contextlib.suppress(OSError):
            await writer.wait_closed()
