"""Sensors on the plate while it is driven: those of a simulated one, by its control socket."""

import asyncio
from abc import ABC, abstractmethod
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from pathlib import Path

import numpy as np

from controller.plate_control import PlateControl
from drivers.errors import LinkError
from model.arrays import ComplexArray, FloatArray

_VERSION = 2
_VIRTUAL_BEAT = 0.2  # s; of the 0.25 s that amplifiers wait; virtual time is never late


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

    def __init__(self, plate: PlateControl, points: FloatArray) -> None:
        self._plate = plate
        self._is_virtual = False
        self.points = points
        self.names = tuple(f"P{number}" for number in range(1, len(points) + 1))

    async def begin(self, *, noise: float) -> None:
        """Place the sensors; noise [m/s²/√Hz]. LinkError for a far end that does not know any."""
        hello = await self._plate.ask({"op": "hello"})
        if hello.get("version", 0) < _VERSION:
            raise LinkError(
                "the simulated plate is of an older version, without sensors; end it and start the "
                "`era sim` of this version"
            )
        self._is_virtual = hello["clock"] == "virtual"
        if self._is_virtual:
            self.beat = _VIRTUAL_BEAT
        sensors = {
            name: {"at_m": point, "noise_m_s2_rthz": noise}
            for name, point in zip(self.names, self.points.tolist(), strict=True)
        }
        await self._plate.ask({"op": "sensors", "sensors": sensors})

    async def wait(self, seconds: float) -> None:
        """Let time pass [s]: the clock's, or the far end's where that is virtual."""
        if self._is_virtual:
            await self._plate.ask({"op": "step", "seconds": seconds})
        else:
            await asyncio.sleep(seconds)

    async def time(self) -> float:
        """The plate's time [s]."""
        return float((await self._plate.ask({"op": "state"}))["time_s"])

    async def tone(self, frequency: float, *, since: float, until: float) -> ComplexArray:
        """Complex amplitudes (s,) [m/s²] of a tone [Hz] over a window [s]."""
        heard = await self._plate.ask(
            {"op": "tones", "since_s": since, "until_s": until, "frequencies_hz": [frequency]}
        )
        found = [heard["sensors"][name] for name in self.names]
        return np.array([each["real_m_s2"][0] + 1j * each["imag_m_s2"][0] for each in found])


@asynccontextmanager
async def simulated_sensors(
    control: Path, points: Sequence[tuple[float, float]], *, noise: float
) -> AsyncIterator[SimulatedSensors]:
    """Sensors at points [m] of the far end whose control socket this is; raises LinkError."""
    remedy = (
        f"start `era sim RIG ... --control {control}`, or give measured responses with "
        "--measured FILE"
    )
    plate = PlateControl(control, remedy=remedy)
    try:
        sensors = SimulatedSensors(plate, np.array(points, dtype=float))
        await sensors.begin(noise=noise)
        yield sensors
    finally:
        await plate.close()
