"""Localization table: the data for patterns that one finger feels and others do not.

It contains the modes of a plate on a sampling grid. Modes give the fields of the ERAs at all drive
frequencies, with any fingers on the plate and for any plate within the rig's uncertainty, so that
any fingertips can be queried in any drive mode. The table itself has no drive mode;
`LocalizationTable.drive_mode` is the default of a query.

Lagrange polynomials over six points of the raster (quintic) at a spacing of a twentieth of the
shortest bending wavelength interpolate a field within 1e-4. The points of a fingertip are then one
small matrix product, for any mesh.
"""

import math
from array import array
from collections.abc import Iterable, Sequence
from ctypes import c_void_p
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import chain
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from model.arrays import (
    Complex64Array,
    ComplexArray,
    Float32Array,
    FloatArray,
    IntArray,
    Point,
    lattice,
)
from model.compiled.kernels import GivenRaster, kernels, run_kernel
from model.ensemble.attached_plate import (
    AttachedPlate,
    PlateOnEras,
    at_harmonics,
    attach,
    with_places,
)
from model.ensemble.draws import EXACT_CLOCKS, JUDGING_DRAWS, PROMISED_DRAWS, ClockErrors
from model.ensemble.kernel_plates import touch
from model.ensemble.touched_plate import TouchedPlate
from model.errors import InputError
from model.finger import (
    FINE_POINTS,
    FINGERTIP_RADIUS,
    FIVE_AND_FINE,
    FIVE_POINTS,
    GAUSS_LEGENDRE,
    Grid,
    decibels,
    detection_threshold,
    fingertips_on,
    highest_known,
    is_background,
    sensitivities,
)
from model.reduction.reduced_plate import ReducedPlate
from model.rig.rig import Uncertainty, fingerprint_of
from model.spectral.plate_mesh import PlateMesh
from model.structure.attachments import PointLoad, footprints_of
from model.structure.exciter import Actuator, Exciter
from model.structure.fingertips import Fingertip, fingertip_loads, object_load
from model.structure.footprints import mean_over
from model.structure.modal_elasticity import Dispersion
from model.structure.plate import Plate
from model.switched_patterns import highest_levels
from model.transients.excursions import MagnetMotions, Swing, share_along
from model.transients.time_response import PlateInTime, plate_in_time
from model.vibration import Excitation, base_amplitudes
from registry.limits import GuardLimits

POINTS_PER_WAVELENGTH = 20
MAX_SPACING, MIN_SPACING = 0.008, 0.003  # m
PATCH = 6  # points along a side of an interpolation, at least

_OBJECT_PLACES = Grid(6, 5)
"""Cells whose centers are the positions of an object that the rig's uncertainty expects."""

OBJECT_FACTOR = 6.0
"""Factor on the mean square change of fields by an object, which is far larger near fingers and
ERAs.

Chosen so that about 80 % of the promises are kept (`benchmarks.promise everyday`).
"""


@dataclass(frozen=True)
class Raster:
    """nx by ny points over length by width [m], the edges included; numbered along x first."""

    nx: int
    ny: int
    length: float
    width: float

    def __post_init__(self) -> None:
        """Check the number of points."""
        if not (PATCH <= self.nx <= 5000 and PATCH <= self.ny <= 5000):
            raise InputError(
                f"raster must have {PATCH} to 5000 points a side, got {self.nx}x{self.ny}"
            )

    @classmethod
    def for_plate(cls, plate: Plate, *, frequency_max: float) -> "Raster":
        """Raster for bending waves up to a frequency [Hz]."""
        wanted = plate.bending_wavelength(frequency_max) / POINTS_PER_WAVELENGTH
        spacing = min(max(wanted, MIN_SPACING), MAX_SPACING)
        nx = max(PATCH, math.ceil(plate.length / spacing) + 1)
        ny = max(PATCH, math.ceil(plate.width / spacing) + 1)
        return cls(nx, ny, plate.length, plate.width)

    @property
    def point_count(self) -> int:
        """Number of points."""
        return self.nx * self.ny

    @cached_property
    def x(self) -> FloatArray:
        """Positions of the columns [m], (nx,)."""
        return np.linspace(0, self.length, self.nx)

    @cached_property
    def y(self) -> FloatArray:
        """Positions of the rows [m], (ny,)."""
        return np.linspace(0, self.width, self.ny)

    @cached_property
    def points(self) -> FloatArray:
        """Positions [m], (point_count, 2)."""
        return lattice(self.x, self.y)

    def fingertips(self, centers: FloatArray, values: Float32Array) -> "FingertipShapes":
        """Values (point_count, r) at the fingertips centered at (k, 2) [m] on the plate."""
        points, weights = fingertips_on(
            centers, length=self.length, width=self.width, rule=FIVE_AND_FINE
        )
        index, interpolation = self._patches(centers, points)
        shapes = interpolation @ values.take(index, axis=0)
        few, fine = weights.astype(np.float32)
        return FingertipShapes(
            np.ascontiguousarray(shapes[:, :_FEW]),
            np.ascontiguousarray(shapes[:, _FEW:]),
            few[:, :_FEW],
            fine[:, _FEW:],
        )

    def at(self, values: Float32Array, points: FloatArray) -> Float32Array:
        """Return values (point_count, c) at points [m] (n, 2) of the plate: (n, c).

        At footprints (n, 3), the means over their discs.
        """
        if points.shape[1] == 3:
            field_at = partial(self.at, values)
            return mean_over(field_at, points, length=self.length, width=self.width).astype(
                np.float32
            )
        index, weights = self._patches(points, points[:, None, :])
        return np.asarray((weights @ values[index])[:, 0])

    @cached_property
    def patch(self) -> tuple[int, int]:
        """Points along the sides of a patch that holds a fingertip."""
        count, spacing = self._points
        wide = np.ceil(2 * FINGERTIP_RADIUS / spacing).astype(int) + 2
        side_x, side_y = np.minimum(np.maximum(PATCH, wide), count).tolist()
        return side_x, side_y

    @cached_property
    def _points(self) -> tuple[IntArray, FloatArray]:
        """Number of points along x and y, and their spacing [m]."""
        count = np.array([self.nx, self.ny])
        return count, np.array([self.length, self.width]) / (count - 1)

    @cached_property
    def _patch_index(self) -> IntArray:
        """Numbers of a patch's points, counted from its lowest, (patch,)."""
        side_x, side_y = self.patch
        return np.asarray((np.arange(side_y)[:, None] * self.nx + np.arange(side_x)).ravel())

    @cached_property
    def _lagrange(self) -> FloatArray:
        """Coefficients of a patch's Lagrange polynomials along x and y, for powers of -1..1.

        (2, 1, powers, powers); the shorter side's are padded with zeros.
        """
        side = self.patch
        coefficients = np.zeros((2, 1, max(side), max(side)))
        for axis, count in enumerate(side):
            powers = np.vander(np.linspace(-1, 1, count), increasing=True)
            coefficients[axis, 0, :count, :count] = np.linalg.inv(powers)
        return coefficients

    def _patches(self, centers: FloatArray, points: FloatArray) -> tuple[IntArray, Float32Array]:
        """Raster points around centers (k, 2), and their weights at points (k, p, 2) nearby.

        (k, patch) and (k, p, patch).
        """
        (count, spacing), side = self._points, np.array(self.patch)
        start = np.rint(centers / spacing - (side - 1) / 2).astype(int)
        start = np.minimum(np.maximum(start, 0), count - side)
        local = (points / spacing - start[:, None]) * (2 / (side - 1)) - 1
        powers = np.vander(local.transpose(2, 0, 1).ravel(), max(side), increasing=True)
        along = powers.reshape(2, *points.shape[:2], -1) @ self._lagrange
        along_x, along_y = along.astype(np.float32)
        weights = along_y[:, :, : side[1], None] * along_x[:, :, None, : side[0]]
        index = (start[:, 1] * self.nx + start[:, 0])[:, None] + self._patch_index
        return index, weights.reshape(*points.shape[:2], -1)


@dataclass(frozen=True, eq=False)
class FingertipShapes:
    """Shapes (k, p, r) under k fingertips, and weights (k, p) of the points in a fingertip's mean.

    At few points for searches, and at fine ones for predictions; the center comes first.
    """

    few: Float32Array
    fine: Float32Array
    few_weights: Float32Array
    fine_weights: Float32Array


_EDGE = 0.05
"""Fraction of the plate's sides, at each end, where errors of exciters' fields do not count."""

DEFAULT_FREQUENCIES = np.arange(40.0, 501.0, 10.0)
"""Drive frequencies [Hz] of a table by default, the paper's among them.

Steps of 2 Hz would promise 0.1 to 0.2 dB more and take twice as long.
"""

PAPER_GRID = Grid(12, 9)

SAME_FREQUENCY = 1e-3
"""Difference [Hz] below which two frequencies are equal."""

BACKGROUND_CELL = 0.0254
"""Largest side [m] of the cells at whose centers the power around targets is computed, the same as
in the founding paper."""

CELLS_PER_WAVELENGTH = 4
"""Minimum number of cells for each bending wavelength."""


def default_drive_frequencies(limits: GuardLimits) -> FloatArray:
    """Drive frequencies of a table by default: 40 to 500 Hz within the rig's limits, (f,) [Hz].

    Steps of 10 Hz from the lowest limit if this range is empty.
    """
    low, high = limits.frequency_min, limits.frequency_max
    first, past = np.searchsorted(DEFAULT_FREQUENCIES, [low, np.nextafter(high, np.inf)])
    within = DEFAULT_FREQUENCIES[first:past]
    return within if len(within) else np.arange(low, high + 1e-9, 10.0)


@dataclass(frozen=True, eq=False)
class LocalizationTable:
    """Modes of a plate on its ERAs, and all other data that answers need."""

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
        eras, f = len(self.eras), len(self.frequencies)
        return eras * f + math.comb(eras, 2) * f**2

    def with_clocks(self, clocks: ClockErrors) -> "LocalizationTable":
        """Return the table for amplifiers with clock errors; fast, since it shares all data."""
        if clocks == self.clocks:
            return self
        table = replace(self, clocks=clocks)
        vars(table).update(vars(self) | vars(table))
        vars(table).pop("power_shares", None)
        return table

    def unit_fields(
        self, points: FloatArray, *, contacts: Sequence[Point] = (), loads: Sequence[float] = ()
    ) -> Complex64Array:
        """Acceleration [m/s²] at points (p, 2) [m] by each ERA alone at full stroke, (f, eras, p).

        Exciters play at `highest_drives`. contacts, loads: see `amplitudes`.
        """
        shapes = self.raster.at(self.shapes, points)
        return np.ascontiguousarray(self._modal_fields(contacts, loads) @ shapes.T)

    def amplitudes(
        self,
        excitation: Excitation,
        points: FloatArray,
        *,
        contacts: Sequence[Point] = (),
        loads: Sequence[float] = (),
    ) -> tuple[FloatArray, FloatArray]:
        """Frequencies (f,) [Hz] and peak acceleration at points (p, 2) [m] of the plate, (f, p).

        The excitation's frequencies must be the table's own. contacts: positions [m] of the fingers
        that load the plate; loads: their loads relative to the rig's fingertip, empty if all are 1.
        """
        frequencies, modal = self.driven(excitation, self._modal_fields(contacts, loads))
        shapes = self.raster.at(self.shapes, points)
        return frequencies, np.abs(modal @ shapes.T).astype(float)

    def driven(
        self, excitation: Excitation, fields: Complex64Array
    ) -> tuple[FloatArray, Complex64Array]:
        """Return the frequencies (k,) [Hz] of an excitation and its field.

        fields (f, eras, ...): of each ERA alone at full stroke.
        """
        frequencies, bases = base_amplitudes(excitation, self.eras)
        rows = self.rows_of(frequencies)
        weights = (bases / self.highest_drives[rows]).astype(np.complex64)
        return frequencies, (weights[:, None] @ fields[rows])[:, 0]

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
        return self.raster.at(self.shapes, np.array(points)).astype(float)

    @cached_property
    def full_levels(self) -> dict[str, float]:
        """Full level of each ERA by name: its stroke [m], or volts for an exciter."""
        return {era.name: era.full_level for era in self.eras}

    def drive_of(self, excitation: Excitation) -> dict[str, dict[str, float]]:
        """Frequency, level 0..1 of the stroke and phase of an excitation, by ERA."""
        return {
            name: {
                "frequency_hz": tone.frequency,
                "level": tone.amplitude / self.full_levels[name],
                "phase_deg": math.degrees(tone.phase),
            }
            for name, tone in excitation.items()
        }

    @cached_property
    def available_level_db_sl(self) -> FloatArray:
        """Highest level [dB SL] of any `switched` pattern at the center of each cell, (cells,)."""
        fields = self.unit_fields(self.cell_centers).transpose(2, 0, 1) / self.thresholds[:, None]
        return decibels(highest_levels(fields[:, None]).astype(float))

    @cached_property
    def cell_centers(self) -> FloatArray:
        """Centers of the grid's cells [m] that are on the plate, (cells, 2)."""
        centers = self.grid.centers(self.plate)
        return centers[self.plate.covers(centers)]

    @cached_property
    def in_time(self) -> PlateInTime:
        """The plate on its ERAs in the time domain, without fingers."""
        return self.in_time_under(())

    def in_time_under(self, contacts: Sequence[Point], loads: Sequence[float] = ()) -> PlateInTime:
        """Return the plate on its ERAs in the time domain, with fingers at contacts [m].

        Takes some milliseconds. loads: relative to the rig's fingertip, empty if all are 1.
        """
        fingers = fingertip_loads(self.fingertip, contacts, loads)
        shapes = self.shapes_at(contacts if fingers else ())
        return plate_in_time(
            ReducedPlate(self.plate, self.omega, self.losses, at=self.shapes_at),
            self.eras,
            loads=self.masses,
            contacts=fingers,
            attachment_shapes=np.vstack([self.attachment_shapes, shapes]),
        )

    @cached_property
    def thresholds(self) -> NDArray[np.float32]:
        """Detection thresholds [m/s²] at all frequencies, (f,)."""
        return detection_threshold(self.frequencies, self.threshold).astype(np.float32)

    @property
    def threshold_sets(self) -> tuple[str, ...]:
        """Names (s,) of the threshold sets for promises, the set for levels first."""
        return tuple(dict.fromkeys((self.threshold, *self.promised_thresholds)))

    @cached_property
    def sensitivities(self) -> Float32Array:
        """Factor of amplitudes relative to the thresholds of each set, compared with the first set,
        (s, f)."""
        factors = sensitivities(self.frequencies, self.threshold_sets, self.threshold)
        return factors.astype(np.float32)

    def levels_by_set(self, level_db_sl: float, excitation: Excitation) -> FloatArray:
        """Return the lowest level [dB SL] of an excitation for each threshold set, (s,)."""
        played = np.array([tone.frequency for tone in excitation.values()])
        factors = sensitivities(played, self.threshold_sets, self.threshold)
        return level_db_sl + decibels(factors.min(axis=1))

    @cached_property
    def harmonic_thresholds(self) -> Float32Array:
        """Detection thresholds [m/s²] at twice all frequencies, (f,).

        Infinite beyond the set's data (up to 1 kHz), where vibration cannot be felt.
        """
        twice = 2 * self.frequencies
        highest = highest_known(self.threshold)
        thresholds = detection_threshold(np.minimum(twice, highest), self.threshold)
        return np.where(twice <= highest, thresholds, np.inf).astype(np.float32)

    @cached_property
    def compared_harmonic_thresholds(self) -> Float32Array:
        """Thresholds at twice all frequencies for comparing candidates, (f,).

        The lowest of all sets, relative to the set's threshold at the tone; the search for weights
        uses the rig's own.
        """
        return np.asarray(self.harmonic_thresholds / self._harmonic_excess.max(axis=0))

    @cached_property
    def harmonic_sensitivities(self) -> Float32Array:
        """Same as `sensitivities`, for harmonics and `compared_harmonic_thresholds`, (s, f)."""
        excess = self._harmonic_excess
        return np.asarray(self.sensitivities * excess / excess.max(axis=0))

    @property
    def _harmonic_excess(self) -> Float32Array:
        """Excess of harmonics over their tones in each set relative to the first, (s, f).

        Beyond a set's data, its last threshold is used.
        """
        twice = np.minimum(2 * self.frequencies, min(map(highest_known, self.threshold_sets)))
        excess = sensitivities(twice, self.threshold_sets, self.threshold) / self.sensitivities
        return excess.astype(np.float32)

    @cached_property
    def modal_dispersion(self) -> Dispersion | None:
        """Change of the eigenvalues with frequency; None if they are constant."""
        if not len(self.dispersion_frequencies):
            return None
        return Dispersion(self.dispersion_frequencies, self.dispersion)

    @cached_property
    def attached(self) -> AttachedPlate:
        """The plate with its ERAs and masses at the drive frequencies, driven at
        `highest_drives`."""
        return self._attached(self.frequencies).driven_less(self.allowed_shares)

    @cached_property
    def allowed_shares(self) -> FloatArray:
        """Fraction of full level that all actuators can play together in any phases, (f,)."""
        if not self._is_limited:
            return np.ones(len(self.frequencies))
        return self.magnets.shares(self.frequencies)

    @cached_property
    def magnets(self) -> MagnetMotions:
        """Motions of its exciters' magnets."""
        return MagnetMotions.of(self.in_time, self.uncertainty, self.masses)

    @cached_property
    def _is_limited(self) -> bool:
        """Whether an excursion limits any of the actuators."""
        return any(math.isfinite(era.excursion) for era in self.eras)

    def excursion_of(self, drives: Iterable[tuple[Excitation, Sequence[Swing]]]) -> float:
        """Return the fraction of the magnets' excursion that drives use, added over drives.

        For each drive, the largest fraction of `allowed_shares`, or of its worst envelope; 0
        without a limit.
        """
        if not self._is_limited:
            return 0.0
        parts = dict[tuple[int, float], float]()
        for number, (excitation, swings) in enumerate(drives):
            for name, tone in excitation.items():
                share = float(np.interp(tone.frequency, self.frequencies, self.allowed_shares))
                for swing in swings:
                    share = min(share, share_along(self.magnets, tone.frequency, swing))
                key = number, tone.frequency
                part = tone.amplitude / self.full_levels[name] / share
                parts[key] = max(part, parts.get(key, 0.0))
        return sum(parts.values())

    @cached_property
    def highest_drives(self) -> FloatArray:
        """Largest amplitude of each actuator at each frequency, for weight 1, (f, eras)."""
        return np.asarray(self.allowed_shares[:, None] * [*self.full_levels.values()])

    def _attached(self, frequencies: FloatArray) -> AttachedPlate:
        return attach(
            self.plate,
            self.omega,
            self.losses,
            self.attachment_shapes,
            eras=self.eras,
            masses=self.masses,
            fingertip=self.fingertip,
            uncertainty=self.uncertainty,
            frequencies=frequencies,
            dispersion=self.modal_dispersion,
        )

    @property
    def on_eras(self) -> PlateOnEras:
        """The plate with its ERAs and masses eliminated, for all thicknesses that answers need."""
        return self._with_places[0]

    @cached_property
    def _with_places(self) -> tuple[PlateOnEras, FloatArray]:
        counts = {JUDGING_DRAWS.thicknesses, PROMISED_DRAWS.thicknesses, PROMISED_DRAWS.bases}
        plates = PlateOnEras.of(self.attached, *sorted(counts))
        if not self.uncertainty.place:
            return plates, np.zeros(plates.plate.forces.shape)
        by_field = [isinstance(era, Exciter) for era in self.eras]
        # Without the edges, which bend most, and where few fingers rest.
        points = self.raster.points
        inner = (np.abs(points / points[-1] - 0.5) < 0.5 - _EDGE).all(axis=1)
        shapes = self.shapes[inner & self.plate.covers(points)]
        gram = np.asarray(shapes.T @ shapes / np.float32(len(shapes)))
        return with_places(plates, self._shifts_of_eras, gram, by_field)

    @cached_property
    def at_harmonics(self) -> PlateOnEras:
        """Same as `on_eras` at twice the drive frequencies, for the first of its thicknesses."""
        twice = self._attached(2 * self.frequencies)
        counts = {JUDGING_DRAWS.thicknesses, PROMISED_DRAWS.bases}
        driven = at_harmonics(twice, self.eras).driven_less(self.allowed_shares)
        return PlateOnEras.of(driven, *sorted(counts))

    @cached_property
    def error_power(self) -> Float32Array:
        """Mean square error of each ERA's field, (f, eras).

        `field_error_power`, and for exciters the part of position errors that stiffness errors do
        not cover.
        """
        return np.asarray(self.field_error_power + self._with_places[1], dtype=np.float32)

    @cached_property
    def field_error_power(self) -> Float32Array:
        """Mean square error over the plate, from discretization and the rig's uncertainty.

        Includes the uncertainty's `field`, and an object of its `foreign_mass`, averaged over
        possible positions.
        """
        error = np.hypot(self.discretization_error, self.uncertainty.field)[:, None]
        fields = self.on_eras.fields
        power = error**2 * self._mean_square(fields)
        mass = self.uncertainty.foreign_mass
        if mass:
            stiffness = object_load(mass).dynamic_stiffness(self.attached.omega)
            D = stiffness.astype(np.complex64)[:, None]
            places = self.shapes_at(_OBJECT_PLACES.centers(self.plate)).astype(np.float32)
            for place in places[:, None]:
                loaded = TouchedPlate(self.on_eras, place, D, np.zeros(1, np.float32))
                change = self._mean_square(loaded.coordinates() - fields)
                power += change * (OBJECT_FACTOR / len(places))
        return np.asarray(power, dtype=np.float32)

    @property
    def _shifts_of_eras(self) -> FloatArray:
        """Change of the shapes at ERAs for a position error along x and along y, (n, 2, r)."""
        distance = self.uncertainty.place
        footprints = footprints_of(self.eras)
        ends = np.repeat(footprints[:, None, None], 4, axis=1).reshape(len(footprints), 2, 2, -1)
        for axis, side in enumerate(self.raster.points[-1]):
            ends[:, axis, :, axis] += [distance, -distance]
            ends[:, axis, :, axis].clip(0.0, side, out=ends[:, axis, :, axis])
        shapes = self.shapes_at(ends.reshape(-1, 3)).reshape(*ends.shape[:3], -1)
        apart = np.linalg.norm(ends[:, :, 0] - ends[:, :, 1], axis=-1, keepdims=True)
        return np.asarray((shapes[:, :, 0] - shapes[:, :, 1]) * (distance / apart))

    @cached_property
    def search_error_power(self) -> Float32Array:
        """`error_power` with second harmonics counted at the drive frequency, for searches."""
        if not self.uncertainty.harmonic:
            return self.error_power
        share = self.uncertainty.harmonic * (self.thresholds / self.harmonic_thresholds)[:, None]
        power = share**2 * self._mean_square(self.at_harmonics.fields)
        return np.asarray(self.error_power + power, dtype=np.float32)

    def _mean_square(self, fields: Complex64Array) -> FloatArray:
        """Mean square over the plate of fields in its coordinates (..., r), (...)."""
        return np.asarray(np.vecdot(fields, fields @ self._gram).real, dtype=float)

    @cached_property
    def _gram(self) -> Float32Array:
        shapes = self.shapes[self.plate.covers(self.raster.points)]
        return np.asarray(shapes.T @ shapes / np.float32(len(shapes)))

    @cached_property
    def _everywhere(self) -> tuple[FloatArray, Complex64Array, Complex64Array]:
        """Centers (p, 2) [m] of cells that tile the plate, fields there (f, eras, p), and power."""
        wavelength = self.plate.bending_wavelength(float(self.frequencies[-1]))
        side = min(BACKGROUND_CELL, wavelength / CELLS_PER_WAVELENGTH)
        nx = min(max(round(self.plate.length / side), 1), 200)
        ny = min(max(round(self.plate.width / side), 1), 200)
        points = Grid(nx, ny).centers(self.plate)
        points = points[self.plate.covers(points)]
        fields = self.unit_fields(points)
        return points, fields, _power(fields)

    def _modal_fields(
        self, contacts: Sequence[Point], loads: Sequence[float] = ()
    ) -> Complex64Array:
        """Accelerations of the reduced coordinates due to each ERA at full stroke, (f, eras, r)."""
        if not contacts:
            return self.on_eras.fields
        centers = self.shapes_at(contacts).astype(np.float32)
        return touch(self.on_eras, centers, tuple(loads)).coordinates()

    def background(self, targets: Sequence[Point]) -> Complex64Array:
        """Expected power of the untouched plate outside of the targets, (f, eras, eras).

        Includes clock errors, in addition to the nominal power.
        """
        points, fields, power = self._everywhere
        is_near = ~is_background(points, targets)
        mean = (power - _power(fields[:, :, is_near])) / np.float32(np.sum(~is_near))
        shares = self.power_shares
        return mean if shares is None else mean * (1 + shares)

    @cached_property
    def power_shares(self) -> Float32Array | None:
        """`ClockErrors.power_shares` at all frequencies."""
        return self.clocks.power_shares(self.frequencies)


def _power(fields: Complex64Array) -> Complex64Array:
    """Power of fields (f, eras, p) summed over the points, (f, eras, eras)."""
    return np.asarray(fields.conj() @ fields.swapaxes(1, 2))


_FEW, _FINE = len(FIVE_POINTS.points), len(FINE_POINTS.points)


def read_fingertips(table: LocalizationTable, places: Sequence[Point]) -> FingertipShapes:
    """Return shapes at fingertips centered at positions [m], with a C kernel if available."""
    compiled = kernels()
    if compiled is None:
        return table.raster.fingertips(np.array(places), table.shapes)
    raster, k = given_raster(table), len(places)
    centers = array("d", chain.from_iterable(places))
    sizes = (k, _FEW, raster.r), (k, _FINE, raster.r), (k, _FEW), (k, _FINE)
    results = [np.empty(size, dtype=np.float32) for size in sizes]
    pointers = [c_void_p(result.ctypes.data) for result in results]
    run_kernel(
        compiled.library.fingertips_stage,
        raster,
        c_void_p(centers.buffer_info()[0]),
        k,
        *pointers,
    )
    return FingertipShapes(*results)


def given_raster(table: LocalizationTable) -> GivenRaster:
    """Return the raster of a table as kernels read it, made once for each table."""
    cached = _given_rasters.get(table)
    if cached is not None:
        return cached
    raster = table.raster
    given = GivenRaster(raster.nx, raster.ny, *raster.patch, table.shapes.shape[1], _FEW, _FINE)
    given.length = raster.length
    given.width = raster.width
    given.radius = FINGERTIP_RADIUS
    given.point(
        points=FIVE_AND_FINE.points,
        weights=FIVE_AND_FINE.weights,
        nodes=GAUSS_LEGENDRE,
        shapes=table.shapes,
    )
    return _given_rasters.setdefault(table, given)


_given_rasters: WeakKeyDictionary[LocalizationTable, GivenRaster] = WeakKeyDictionary()
