"""Responses that were measured on a rig in place, with their errors and repetitions."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import NDArray

from model.arrays import ComplexArray, FloatArray, IntArray
from model.errors import InputError
from model.identification.forward import Sensor

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
    """Values measured one by one, n of them.

    sensors: s of them; frequencies (n,) [Hz]; eras (n,): number of the driven ERA in the rig;
    at (n,): number of the sensor; values (n,): acceleration per base displacement at full gain
    [1/s²], phases as exp(+i omega t); std (n,): of the real and of the imaginary part. half_level:
    tones repeated at half the level, per base displacement as well; at_end: the first tones, played
    last again; of both those that are loud beside noise, which nothing is allowed for. drives_lag:
    whether bases follow what was played with an unknown lag, as actuators do behind an amplifier of
    voltage.
    """

    sensors: tuple[Sensor, ...]
    frequencies: FloatArray
    eras: IntArray
    at: IntArray
    values: ComplexArray
    std: FloatArray
    half_level: tuple[Repeat, ...] = ()
    at_end: tuple[Repeat, ...] = ()
    drives_lag: bool = False

    def __post_init__(self) -> None:
        """Refuse values that are not finite, without an error or of different count."""
        count = len(self.values)
        if count == 0:
            raise InputError("a measurement must have values, got none")
        for name in ("frequencies", "eras", "at", "values", "std"):
            column = getattr(self, name)
            if len(column) != count or not np.isfinite(column).all():
                raise InputError(f"measurement: {name} must be {count} finite numbers")
        if not (self.std > 0).all():
            raise InputError(f"measurement: std must be above zero, got {self.std.min():g}")

    @classmethod
    def of(
        cls,
        sensors: Sequence[Sensor],
        frequencies: FloatArray,
        values: ComplexArray,
        *,
        noise: float = 0.01,
    ) -> Self:
        """Of responses (f, s, eras) [1/s²] at frequencies (f,) [Hz], NaN where not measured.

        noise: error of each part, relative to a response and to a tenth of its sensor's root mean
        square together: never relative alone, since a response may vanish.
        """
        known = np.isfinite(values)
        squares = np.where(known, np.abs(values), 0.0) ** 2
        rms2 = squares.sum(axis=(0, 2)) / np.maximum(known.sum(axis=(0, 2)), 1)
        std = noise * np.sqrt(squares + _FLOOR**2 * rms2[:, None])
        row, at, era = np.nonzero(known)
        return cls(tuple(sensors), np.asarray(frequencies)[row], era, at, values[known], std[known])

    @cached_property
    def tones(self) -> FloatArray:
        """Frequencies without repetition, ascending (f,) [Hz]."""
        return np.unique(self.frequencies)

    @cached_property
    def rows(self) -> IntArray:
        """Which of the tones each value is of, (n,)."""
        return np.searchsorted(self.tones, self.frequencies)

    @cached_property
    def tone_rms(self) -> FloatArray:
        """Root mean square of the values at the tone of each value, (n,) [1/s²]."""
        squares = np.bincount(self.rows, np.abs(self.values) ** 2)
        return np.sqrt(squares / np.bincount(self.rows))[self.rows]

    def part(self, kept: NDArray[np.bool_]) -> Self:
        """Some of the values (n,)."""
        columns = ("frequencies", "eras", "at", "values", "std")
        return replace(self, **{name: getattr(self, name)[kept] for name in columns})

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
