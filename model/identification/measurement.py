"""Responses that were measured on a rig in place, with their errors and repetitions."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from pkgutil import resolve_name
from typing import Self

import numpy as np
from numpy.typing import NDArray

from model.arrays import ComplexArray, FloatArray
from model.errors import InputError
from model.identification.forward import Sensor
from model.processes import Progress
from model.rig.rig import Rig

NONLINEAR = 0.02
"""Relative difference of responses at two levels beyond which a plate is not linear."""

DRIFTED = 0.01
"""Relative difference of the first tone, played last again, beyond which a plate has changed."""

_FLOOR = 0.1  # of a sensor's rms: where its error no longer falls with the response


@dataclass(frozen=True, eq=False)
class Repeat:
    """One tone measured twice: frequency [Hz], responses at all sensors (s,) [1/s²].

    era: name of the one that played it, or of several that did together.
    """

    era: str
    frequency: float
    values: ComplexArray
    repeated: ComplexArray


@dataclass(frozen=True, eq=False)
class Measurement:
    """Responses of s sensors to n ERAs, at some of their paths and frequencies.

    frequencies (f,) [Hz], ascending; values (f, s, n): acceleration per base displacement at full
    gain [1/s²], phases as exp(+i omega t), NaN where not measured; std (f, s, n): of the real and
    of the imaginary part. half_level: tones repeated at half the level, per base displacement as
    well; at_end: the first tones, played last again; of both those that are loud beside noise,
    which nothing is allowed for. clock_errors: of the amplifiers that played and heard, by name, as
    their lines and they state, rms [s]; empty where all have one clock. drives_lag: whether bases
    follow what was played with an unknown lag, as actuators do behind an amplifier of voltage.
    """

    sensors: tuple[Sensor, ...]
    frequencies: FloatArray
    values: ComplexArray
    std: FloatArray
    half_level: tuple[Repeat, ...] = ()
    at_end: tuple[Repeat, ...] = ()
    drives_lag: bool = False
    clock_errors: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Refuse values without an error, none at all, and frequencies in another order."""
        if not (np.diff(self.frequencies) > 0).all():
            raise InputError("measurement: frequencies must ascend, each once")
        if not self.known.any():
            raise InputError("a measurement must have values, got none")
        std = self.std[self.known]
        if not (std > 0).all() or not np.isfinite(std).all():
            raise InputError(f"measurement: std must be above zero, got {std.min():g}")

    @classmethod
    def of(
        cls,
        sensors: Sequence[Sensor],
        frequencies: FloatArray,
        values: ComplexArray,
        *,
        noise: float = 0.01,
    ) -> Self:
        """Of responses (f, s, n) [1/s²] at frequencies (f,) [Hz], NaN where not measured.

        noise: error of each part, relative to a response and to a tenth of its sensor's root mean
        square together: never relative alone, since a response may vanish.
        """
        squares = np.where(np.isfinite(values), np.abs(values), 0.0) ** 2
        count = np.isfinite(values).sum(axis=(0, 2))[:, None]
        rms2 = squares.sum(axis=(0, 2))[:, None] / np.maximum(count, 1)
        std = noise * np.sqrt(squares + _FLOOR**2 * rms2)
        return cls(tuple(sensors), np.asarray(frequencies), np.asarray(values), std)

    @cached_property
    def known(self) -> NDArray[np.bool_]:
        """Which responses were measured, (f, s, n)."""
        return np.isfinite(self.values)

    @property
    def count(self) -> int:
        """Number of values."""
        return int(self.known.sum())

    @cached_property
    def tone_rms(self) -> FloatArray:
        """Root mean square of the values at each tone, (f, 1, 1) [1/s²]."""
        squares = np.where(self.known, np.abs(self.values) ** 2, 0.0)
        count = self.known.sum(axis=(1, 2), keepdims=True)
        return np.asarray(np.sqrt(squares.sum(axis=(1, 2), keepdims=True) / np.maximum(count, 1)))

    def part(self, kept: NDArray[np.bool_]) -> Self:
        """Some of the values (f, s, n)."""
        return replace(self, values=np.where(kept, self.values, np.nan))

    def check(self) -> None:
        """Raise InputError for a plate that was not linear or has changed meanwhile."""
        for repeats, limit, cause in (
            (self.half_level, NONLINEAR, "at half the level; measure at a lower level"),
            (self.at_end, DRIFTED, "at the end; wait until the plate has settled, measure again"),
        ):
            for repeat in repeats:
                size = np.linalg.norm(repeat.values)
                difference = np.linalg.norm(repeat.repeated - repeat.values) / size
                if not difference <= limit:
                    raise InputError(
                        f"response to ERA {repeat.era} at {repeat.frequency:g} Hz must stay within "
                        f"{100 * limit:g} %, got {100 * difference:.1f} % {cause}"
                    )


"""Called with what is done and all."""


@dataclass(frozen=True, eq=False)
class MeasuredPlate:
    """A measurement with how it came about.

    level: of what played, 0..1 of full stroke, and duration [s], None for not known; sensors: the
    ones used, for programs; notes: lines for people; details: keys and values for programs.
    """

    measurement: Measurement
    level: float | None
    duration: float | None
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


_MEASURER = "sim.desk.measuring.plate_measurement:measure_plate"
"""By name: this package does not import the one beside it."""


def measure_by_device(rig: Rig, settings: DeviceSettings, *, progress: Progress) -> MeasuredPlate:
    """Measure a plate by a sound card; raises InputError, LinkError."""
    found: MeasuredPlate = resolve_name(_MEASURER)(rig, settings, progress=progress)
    return found
