"""Record of a localization table: the data in its file, and clock errors of the amplifiers."""

import math
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import NDArray

from model.arrays import ComplexArray, Float32Array, FloatArray, IntArray, Point
from model.ensemble.draws import EXACT_CLOCKS, ClockErrors
from model.errors import InputError
from model.finger import Grid
from model.rig.rig import Uncertainty, fingerprint_of
from model.spectral.plate_mesh import PlateMesh
from model.structure.attachments import PointLoad
from model.structure.exciter import Actuator
from model.structure.fingertips import Fingertip
from model.structure.modal_elasticity import Dispersion
from model.structure.plate import Plate
from model.table.raster import Raster

SAME_FREQUENCY = 1e-3
"""Difference [Hz] below which two frequencies are equal."""


@dataclass(frozen=True, eq=False)
class TableRecord:
    """Modes of a plate, its ERAs, and the rig's parameters that answers need."""

    plate: Plate
    eras: tuple[Actuator, ...]
    masses: tuple[PointLoad, ...]
    uncertainty: Uncertainty
    fingertip: Fingertip | None
    threshold: str
    promised_thresholds: tuple[str, ...]
    mesh: PlateMesh
    raster: Raster
    grid: Grid
    drive_mode: str
    """Default drive mode of a query."""
    code_version: str
    frequencies: FloatArray
    """Frequencies (f,) of the table [Hz]."""
    omega: FloatArray
    """Natural frequencies (r,) [rad/s] of the reduced free plate."""
    losses: FloatArray
    """Losses (r,) [rad²/s²] of each mode, in addition to the plate's loss factor."""
    dispersion_frequencies: FloatArray
    """Frequencies (k,) [Hz] of `dispersion`; k = 0 for none."""
    dispersion: ComplexArray
    """Change (k, r) [rad²/s²] of the plate's omega² with frequency
    (`model.structure.modal_elasticity`)."""
    attachment_shapes: FloatArray
    """Mode shapes (eras + masses, r) [1/sqrt(kg)] at ERAs and masses."""
    shapes: NDArray[np.float32]
    """Mode shapes (points, r) [1/sqrt(kg)] on the raster."""
    reference_mesh: PlateMesh
    discretization_error: FloatArray
    """Estimated relative L2 error (f,) of the fields over the raster (`model.vibration`), maximum
    over the ERAs."""
    clocks: ClockErrors = EXACT_CLOCKS
    """Clock errors of connected amplifiers, which are not stored in the file."""

    def __repr__(self) -> str:
        low, high = self.frequencies[[0, -1]]
        return (
            f"<LocalizationTable of {self.plate.length:g} x {self.plate.width:g} m on ERAs "
            f"{', '.join(era.name for era in self.eras)}, {low:g} to {high:g} Hz, "
            f"mode {self.drive_mode}>"
        )

    @property
    def fingerprint(self) -> str:
        """Fingerprint of the table's rig."""
        return fingerprint_of(self)

    @property
    def pattern_count(self) -> int:
        """Number of `switched` patterns of one or two ERAs."""
        era_count, frequency_count = len(self.eras), len(self.frequencies)
        return era_count * frequency_count + math.comb(era_count, 2) * frequency_count**2

    @property
    def threshold_sets(self) -> tuple[str, ...]:
        """Names (s,) of the threshold sets for promises, the set for levels first."""
        return tuple(dict.fromkeys((self.threshold, *self.promised_thresholds)))

    def with_clocks(self, clocks: ClockErrors) -> Self:
        """Return the table for amplifiers with clock errors; fast, since it shares all data.

        No cached property may depend on the clocks.
        """
        if clocks == self.clocks:
            return self
        table = copy(self)
        object.__setattr__(table, "clocks", clocks)
        return table

    def rows_of(self, frequencies: FloatArray) -> IntArray:
        """Return the rows (k,) of frequencies (k,) [Hz]; raises InputError for a frequency that is
        not in the table."""
        rows = np.abs(np.subtract.outer(frequencies, self.frequencies)).argmin(axis=1)
        for frequency, nearest in zip(frequencies.tolist(), self.frequencies[rows], strict=True):
            if not abs(frequency - nearest) <= SAME_FREQUENCY:
                raise InputError(
                    f"frequency of a tone must be in the table (nearest: {nearest:g} Hz), "
                    f"got {frequency:g} Hz; build a table with it: era table build "
                    "--frequencies"
                )
        return np.asarray(rows)

    def shapes_at(self, points: Sequence[Point] | FloatArray) -> FloatArray:
        """Return shapes of the reduced plate at points or footprints [m], (p, r)."""
        if not len(points):
            return np.empty((0, len(self.omega)))
        return self.raster.interpolated(self.shapes, np.array(points)).astype(float)

    @cached_property
    def mean_products(self) -> Float32Array:
        """Mean products of the shapes over the plate, (r, r)."""
        return mean_products(self.shapes[self.plate.covers(self.raster.points)])

    @property
    def modal_dispersion(self) -> Dispersion | None:
        """Change of the eigenvalues with frequency; None if they are constant."""
        if not len(self.dispersion_frequencies):
            return None
        return Dispersion(self.dispersion_frequencies, self.dispersion)


def mean_products(shapes: Float32Array) -> Float32Array:
    """Return mean products (r, r) of shapes (p, r) over the points."""
    return np.asarray(shapes.T @ shapes / np.float32(len(shapes)))
