"""A plate measured for its identification, and who measures it.

The controller measures by a rig's amplifiers, `sim` by a sound card.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from pkgutil import resolve_name
from typing import Protocol

from model.arrays import FloatArray
from model.identification.measurement import Measurement
from model.rig.rig import Rig

Progress = Callable[[int, int], None]
"""Called with what is done and all."""


@dataclass(frozen=True, eq=False)
class MeasuredPlate:
    """A measurement with how it came about.

    level: of what played, 0..1 of full stroke; duration [s]; sensors: the ones used, for programs;
    notes: lines for people; details: keys and values for programs.
    """

    measurement: Measurement
    level: float
    duration: float
    sensors: tuple[Mapping[str, object], ...]
    notes: tuple[str, ...]
    details: Mapping[str, object]


@dataclass(frozen=True, eq=False)
class DeviceSettings:
    """What `era rig identify --device` was given.

    sensors_file: of accelerometers; device: that plays and records; frequencies (f,) [Hz], level:
    None for the usual ones; periods: seconds of each run that count; seed: of the phases.
    """

    device: str
    sensors_file: Path
    frequencies: FloatArray | None
    level: float | None
    periods: int
    seed: int


class PlateMeasurer(Protocol):
    """Plays on all ERAs of a rig and measures its plate."""

    def __call__(self, rig: Rig, settings: DeviceSettings, *, progress: Progress) -> MeasuredPlate:
        """Raises InputError, LinkError."""


_MEASURER = "sim.measuring.plate_measurement:measure_plate"
"""By name: this package does not import the one beside it."""


def measure_by_device(rig: Rig, settings: DeviceSettings, *, progress: Progress) -> MeasuredPlate:
    """Measure a plate by a sound card."""
    measure: PlateMeasurer = resolve_name(_MEASURER)
    return measure(rig, settings, progress=progress)
