"""Localization table: the data for patterns that one finger feels and others do not.

It contains the modes of a plate on a sampling grid. Modes give the fields of the ERAs at all drive
frequencies, with any fingers on the plate and for any plate within the rig's uncertainty, so that
any fingertips can be queried in any drive mode. The table itself has no drive mode;
`LocalizationTable.drive_mode` is the default of a query.

The data are in `model.table.record`. Everything else is derived from them when it is first needed,
and kept.
"""

import math
from collections.abc import Iterable, Sequence
from functools import cached_property

import numpy as np

from model.arrays import Complex64Array, Float32Array, FloatArray, Point
from model.ensemble.attached_plate import AttachedPlate, PlateOnEras, at_harmonics, attach
from model.ensemble.draws import JUDGING_DRAWS, PROMISED_DRAWS
from model.ensemble.kernel_plates import touch
from model.finger import (
    Grid,
    decibels,
    detection_threshold,
    highest_known,
    is_background,
    sensitivities,
)
from model.reduction.reduced_plate import ReducedPlate
from model.structure.fingertips import fingertip_loads
from model.switched_patterns import highest_levels
from model.table.error_power import field_errors, mean_square_over_plate, with_position_errors
from model.table.record import TableRecord
from model.transients.excursions import MagnetMotions, Swing, share_along
from model.transients.plate_in_time import PlateInTime, plate_in_time
from model.vibration import Excitation, base_amplitudes
from registry.limits import GuardLimits

DEFAULT_FREQUENCIES = np.arange(40.0, 501.0, 10.0)
"""Drive frequencies [Hz] of a table by default, the paper's among them.

Steps of 2 Hz would promise 0.1 to 0.2 dB more and take twice as long.
"""

PAPER_GRID = Grid(12, 9)

BACKGROUND_CELL = 0.0254
"""Side [m] of the cells at whose centers the power around targets is computed, from the founding
paper.

Cells tile the plate, so their number n along a side is rounded: cells are up to 1 / (2 n) larger or
smaller.
"""

CELLS_PER_WAVELENGTH = 4
"""Minimum number of cells for each bending wavelength, up to the same rounding."""


def default_drive_frequencies(limits: GuardLimits) -> FloatArray:
    """Drive frequencies of a table by default: 40 to 500 Hz within the rig's limits, (f,) [Hz].

    Steps of 10 Hz from the lowest limit if this range is empty.
    """
    low, high = limits.frequency_min, limits.frequency_max
    first, past = np.searchsorted(DEFAULT_FREQUENCIES, [low, np.nextafter(high, np.inf)])
    within = DEFAULT_FREQUENCIES[first:past]
    return within if len(within) else np.arange(low, high + 1e-9, 10.0)


class LocalizationTable(TableRecord):
    """Modes of a plate on its ERAs, and all other data that answers need."""

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

    def unit_fields(
        self, points: FloatArray, *, contacts: Sequence[Point] = (), loads: Sequence[float] = ()
    ) -> Complex64Array:
        """Acceleration [m/s²] at points (p, 2) [m] by each ERA alone at full stroke, (f, eras, p).

        Exciters play at `highest_drives`. contacts, loads: see `amplitudes`.
        """
        shapes = self.raster.interpolated(self.shapes, points)
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
        shapes = self.raster.interpolated(self.shapes, points)
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

    @cached_property
    def available_level_db_sl(self) -> FloatArray:
        """Highest level [dB SL] of any `switched` pattern at the center of each cell, (cells,)."""
        fields = self.unit_fields(self.cell_centers).transpose(2, 0, 1) / self.thresholds[:, None]
        return decibels(highest_levels(fields[:, None]).astype(float))

    def reachable_db_sl(self, points: FloatArray) -> FloatArray:
        """Highest level [dB SL] at points (p, 2) [m] with all ERAs at full amplitude, (f, p).

        Their phases make the fields add up at each point. On the nominal plate, without fingers.
        """
        highest = np.abs(self.unit_fields(points)).sum(axis=1)
        return decibels(highest / self.thresholds[:, None])

    @cached_property
    def cell_centers(self) -> FloatArray:
        """Centers of the grid's cells [m] that are on the plate, (cells, 2)."""
        centers = self.grid.centers(self.plate)
        return centers[self.plate.covers(centers)]

    @cached_property
    def thresholds(self) -> Float32Array:
        """Detection thresholds [m/s²] at all frequencies, (f,)."""
        return detection_threshold(self.frequencies, self.threshold).astype(np.float32)

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

        The lowest of all sets, relative to the set's threshold at the tone.
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
        return self._with_position_errors[0]

    @cached_property
    def _with_position_errors(self) -> tuple[PlateOnEras, FloatArray]:
        """`on_eras`, and the part of position errors that it does not include, (f, eras)."""
        counts = {JUDGING_DRAWS.thicknesses, PROMISED_DRAWS.thicknesses, PROMISED_DRAWS.bases}
        return with_position_errors(self, PlateOnEras.of(self.attached, *sorted(counts)))

    @cached_property
    def at_harmonics(self) -> PlateOnEras:
        """Same as `on_eras` at twice the drive frequencies, for the first of its thicknesses."""
        twice = self._attached(2 * self.frequencies)
        counts = {JUDGING_DRAWS.thicknesses, PROMISED_DRAWS.bases}
        driven = at_harmonics(twice, self.eras).driven_less(self.allowed_shares)
        return PlateOnEras.of(driven, *sorted(counts))

    @cached_property
    def field_error_power(self) -> Float32Array:
        """Mean square error (f, eras) over the plate, from discretization and the rig's
        uncertainty."""
        return field_errors(self, self.on_eras)

    @cached_property
    def error_power(self) -> Float32Array:
        """Mean square error of each ERA's field, (f, eras).

        `field_error_power`, and for exciters the part of position errors that stiffness errors do
        not cover.
        """
        position_errors = self._with_position_errors[1]
        return np.asarray(self.field_error_power + position_errors, dtype=np.float32)

    @cached_property
    def search_error_power(self) -> Float32Array:
        """`error_power` with second harmonics counted at the drive frequency, for searches.

        By the lowest threshold of all sets, like the promise.
        """
        if not self.uncertainty.harmonic:
            return self.error_power
        excess = self.thresholds / self.compared_harmonic_thresholds
        share = self.uncertainty.harmonic * excess[:, None]
        power = share**2 * mean_square_over_plate(self, self.at_harmonics.fields)
        return np.asarray(self.error_power + power, dtype=np.float32)

    @cached_property
    def _cell_fields(self) -> tuple[FloatArray, Complex64Array]:
        """Centers (p, 2) [m] of cells that tile the plate, and fields there (f, eras, p)."""
        wavelength = self.plate.bending_wavelength(float(self.frequencies[-1]))
        side = min(BACKGROUND_CELL, wavelength / CELLS_PER_WAVELENGTH)
        nx = min(max(round(self.plate.length / side), 1), 200)
        ny = min(max(round(self.plate.width / side), 1), 200)
        centers = Grid(nx, ny).centers(self.plate)
        centers = centers[self.plate.covers(centers)]
        return centers, self.unit_fields(centers)

    @cached_property
    def _whole_power(self) -> Complex64Array:
        """Power of the untouched plate, summed over all cells, (f, eras, eras)."""
        return _power(self._cell_fields[1])

    def background(self, targets: Sequence[Point]) -> Complex64Array:
        """Expected power of the untouched plate outside of the targets, (f, eras, eras).

        Includes clock errors, in addition to the nominal power.
        """
        centers, fields = self._cell_fields
        is_near = ~is_background(centers, targets)
        power = self._whole_power - _power(fields[:, :, is_near])
        mean = power / np.float32(np.sum(~is_near))
        shares = self.power_shares
        return mean if shares is None else mean * (1 + shares)

    @property
    def power_shares(self) -> Float32Array | None:
        """`ClockErrors.power_shares` at all frequencies."""
        return self.clocks.power_shares(self.frequencies)

    def _modal_fields(
        self, contacts: Sequence[Point], loads: Sequence[float] = ()
    ) -> Complex64Array:
        """Accelerations of the reduced coordinates due to each ERA at full stroke, (f, eras, r)."""
        if not contacts:
            return self.on_eras.fields
        centers = self.shapes_at(contacts).astype(np.float32)
        return touch(self.on_eras, centers, tuple(loads)).coordinates()


def _power(fields: Complex64Array) -> Complex64Array:
    """Power of fields (f, eras, p) summed over the points, (f, eras, eras)."""
    return np.asarray(fields.conj() @ fields.swapaxes(1, 2))
