"""Sensors on the plate: those of a simulated one, over its control socket."""

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
_VIRTUAL_MAX_WAIT = 0.2  # s; watchdogs trip after 0.25 s, and virtual time is never late


class Sensors(ABC):
    """Sensors on a plate.

    names (s,); points (s, 2) [m]; max_wait [s]: longest wait between two heartbeats of amplifiers;
    is_virtual: whether the plate runs in virtual time.
    """

    names: tuple[str, ...]
    points: FloatArray
    max_wait: float = 0.05
    is_virtual: bool = False

    @abstractmethod
    async def wait(self, seconds: float) -> None:
        """Wait [s] by the clock of the plate."""

    @abstractmethod
    async def time(self) -> float:
        """Return the time of the plate [s]."""

    @abstractmethod
    async def tone(self, frequency: float, *, since: float, until: float) -> ComplexArray:
        """Return complex amplitudes (s,) [m/s²] of a tone [Hz] over a window of plate time [s]."""


class SimulatedSensors(Sensors):
    """Accelerometers on a simulated plate, read over its control socket."""

    def __init__(self, plate: PlateControl, points: FloatArray, *, is_virtual: bool) -> None:
        self._plate = plate
        self.is_virtual = is_virtual
        if is_virtual:
            self.max_wait = _VIRTUAL_MAX_WAIT
        self.points = points
        self.names = tuple(f"P{number}" for number in range(1, len(points) + 1))

    async def wait(self, seconds: float) -> None:
        """Wait [s]: by the event loop, or by stepping a plate in virtual time."""
        if self.is_virtual:
            await self._plate.request({"op": "step", "seconds": seconds})
        else:
            await asyncio.sleep(seconds)

    async def time(self) -> float:
        """Return the time of the plate [s]."""
        return float((await self._plate.request({"op": "state"}))["time_s"])

    async def tone(self, frequency: float, *, since: float, until: float) -> ComplexArray:
        """Return complex amplitudes (s,) [m/s²] of a tone [Hz] over a window [s]."""
        heard = await self._plate.request(
            {"op": "tones", "since_s": since, "until_s": until, "frequencies_hz": [frequency]}
        )
        found = [heard["sensors"][name] for name in self.names]
        return np.array([each["real_m_s2"][0] + 1j * each["imag_m_s2"][0] for each in found])


@asynccontextmanager
async def simulated_sensors(
    control: Path, points: Sequence[tuple[float, float]], *, noise: float
) -> AsyncIterator[SimulatedSensors]:
    """Place sensors at points [m] on the plate with this control socket; noise [m/s²/√Hz].

    Raises LinkError, also for a simulation that is too old for sensors.
    """
    remedy = (
        f"start `era sim RIG ... --control {control}`, or give measured responses with "
        "--measured FILE"
    )
    plate = PlateControl(control, remedy=remedy)
    try:
        hello = await plate.request({"op": "hello"})
        if hello.get("version", 0) < _VERSION:
            raise LinkError(
                f"version of the simulated plate must be at least {_VERSION} to have sensors; "
                "restart it with the `era sim` of this version"
            )
        sensors = SimulatedSensors(
            plate, np.array(points, dtype=float), is_virtual=hello["clock"] == "virtual"
        )
        placed = {
            name: {"at_m": point, "noise_m_s2_rthz": noise}
            for name, point in zip(sensors.names, sensors.points.tolist(), strict=True)
        }
        await plate.request({"op": "sensors", "sensors": placed})
        yield sensors
    finally:
        await plate.close()
