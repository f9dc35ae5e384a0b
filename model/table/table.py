"""The localization table: patterns that one finger feels and others do not.

It holds the fields of the ERAs at all drive frequencies on a raster over the plate, so that any
fingertips can be queried in any drive mode; the modes of the plate there, from which the effect of
other stiffnesses, thicknesses and fingers follows; and the sources of the `switched` patterns at
the cells of a grid.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from model.arrays import Complex64Array, ComplexArray, FloatArray, IntArray
from model.drive_modes.exact_search import pattern_count
from model.drive_modes.fields import Fields
from model.drive_modes.sources import (
    magnitudes_of_sources,
    per_source,
    sums_of_sources,
)
from model.errors import InputError
from model.fem.plate_mesh import PlateMesh
from model.finger.contrast import is_background
from model.finger.grid import Grid
from model.finger.perception import decibels, detection_threshold
from model.rig.rig import physics_fingerprint
from model.rig.uncertainty import Uncertainty
from model.structure.actuator import Era
from model.structure.fingertip import Fingertip
from model.structure.plate import Plate
from model.structure.point_load import PointLoad
from model.table.pattern import ONSET_RAMP, Pattern
from model.table.pattern_choice import Candidates, OnsetContrast, choose_pattern
from model.table.question import MIN_LEVEL_DB_SL, Point, Question
from model.table.raster import Fingertips, Raster, ReducedOnRaster
from model.transients.onset import RampedOnsets
from model.transients.time_response import PlateInTime, plate_in_time
from model.vibration.excitation import Excitation
from model.vibration.peak import base_amplitudes
from registry.limits import GuardLimits

PAPER_FREQUENCIES = np.arange(60.0, 321.0, 10.0)
"""The 27 excitation frequencies [Hz]: 60 to 320 in steps of 10 holds every one the paper names."""

PAPER_GRID = Grid(12, 9)


def default_drive_frequencies(limits: GuardLimits) -> FloatArray:
    """Drive frequencies of a table by default: the paper's within the rig's limits, (f,) [Hz].

    Steps of 10 Hz from the lowest limit where that leaves none.
    """
    low, high = limits.frequency_min, limits.frequency_max
    first, past = np.searchsorted(PAPER_FREQUENCIES, [low, np.nextafter(high, np.inf)])
    within = PAPER_FREQUENCIES[first:past]
    return within if len(within) else np.arange(low, high + 1e-9, 10.0)


@dataclass(frozen=True, eq=False)
class LocalizationTable:
    """Fields of one plate on its ERAs, and what choosing among patterns needs.

    - drive_mode: default of a question
    - frequencies: (f,) [Hz]
    - acceleration: (points, f, eras) complex [m/s²] on the raster, each ERA alone at full stroke
    - omega: (r,) [rad/s], of the reduced free plate (`model.reduction.reduced_plate`)
    - attachment_shapes: (eras + masses, r) [1/sqrt(kg)], its shapes at ERAs and masses
    - shapes: (points, r) [1/sqrt(kg)], its shapes on the raster
    - cell_sources: (sources, cells) [m/s²], mean peak acceleration over each cell of the sources
      of `switched` patterns (`model.drive_modes.sources`)
    - discretisation_error: (f,), estimated relative L2 error of the fields over the raster
      (`model.vibration.discretisation`), maximum over the ERAs
    """

    plate: Plate
    eras: tuple[Era, ...]
    masses: tuple[PointLoad, ...]
    uncertainty: Uncertainty
    fingertip: Fingertip | None
    threshold: str
    mesh: PlateMesh
    raster: Raster
    grid: Grid
    drive_mode: str
    code_version: str
    frequencies: FloatArray
    acceleration: Complex64Array
    omega: FloatArray
    attachment_shapes: FloatArray
    shapes: NDArray[np.float32]
    cell_sources: NDArray[np.float32]
    reference_mesh: PlateMesh
    discretisation_error: FloatArray

    def __repr__(self) -> str:
        low, high = self.frequencies[[0, -1]]
        return (
            f"<LocalizationTable of {self.plate.length:g} x {self.plate.width:g} m on ERAs "
            f"{', '.join(era.name for era in self.eras)}, {low:g} to {high:g} Hz, "
            f"mode {self.drive_mode}>"
        )

    @property
    def fingerprint(self) -> str:
        """Fingerprint of the rig that this table is for."""
        return physics_fingerprint(
            self.plate,
            self.eras,
            masses=self.masses,
            uncertainty=self.uncertainty,
            fingertip=self.fingertip,
            threshold=self.threshold,
        )

    @property
    def pattern_count(self) -> int:
        """Number of `switched` patterns of one or two ERAs."""
        return pattern_count(len(self.eras), len(self.frequencies), eras_at_most=2)

    @property
    def cell_response(self) -> NDArray[np.float32]:
        """Mean peak acceleration over each cell of every `switched` pattern, (n, cells) [m/s²]."""
        return sums_of_sources(self.cell_sources.T, len(self.eras)).T

    def query(self, question: Question) -> Pattern:
        """Find the best pattern in a drive mode among those that reach a level at the targets.

        `switched` maximizes contrast, the other modes their robust score (`model.drive_modes`);
        with no quiet finger contrast is to the plate beyond 50 mm, root mean square. The pattern
        is then scaled to the level, which leaves contrast as it is. Raises InputError for contacts
        off the plate and for a level that cannot be reached.
        """
        question.check_on(self.plate)
        drive_mode = question.drive_mode_on(self.drive_mode, era_count=len(self.eras))
        low, high = question.frequencies
        playable = np.flatnonzero((self.frequencies >= low) & (self.frequencies <= high))
        if len(playable) == 0:
            raise InputError(
                f"frequencies of the table must include some from {low:g} to {high:g} Hz, which "
                f"these amplifiers play, got {self.frequencies[0]:g} to {self.frequencies[-1]:g} "
                "Hz; build a table with others: era table build --frequencies"
            )
        fingertips = self._fingertips(question)
        fields = self._fields(question, fingertips)
        if len(playable) < len(self.frequencies):
            fields = fields.at(playable)
        onset_contrast = self._onset_contrast(question, fingertips, playable)
        candidates = Candidates(self.eras, self.frequencies[playable], fields, onset_contrast)
        pattern = choose_pattern(question, drive_mode, candidates)
        return replace(pattern, threshold=self.threshold)

    def prepare(self, drive_mode: str | None = None) -> None:
        """Compute ahead what the first query in a drive mode needs."""
        centre = (self.plate.length / 2, self.plate.width / 2)
        for quiet in ((), ((0.0, 0.0),)):
            self.query(
                Question((centre,), quiet, level_db_sl=MIN_LEVEL_DB_SL, drive_mode=drive_mode)
            )
        if (drive_mode or self.drive_mode) != "switched":
            _ = self.onsets  # used only where several patterns are near the best

    def fields(self, question: Question) -> Fields:
        """Fields of the ERAs at the fingertips of a question, at all frequencies of the table."""
        return self._fields(question, self._fingertips(question))

    def _fields(self, question: Question, fingertips: Fingertips) -> Fields:
        found, ends = self._by_frequency(fingertips.read(self._values)), fingertips.ends
        count = len(question.targets)
        if question.quiet:
            quiet = found[:, :, ends[count - 1] :]
        else:
            quiet = self._cell_fields[:, :, is_background(self.cell_centres, question.targets)]
        return Fields(
            targets=tuple(
                np.ascontiguousarray(found[:, :, start:end] * gain)
                for start, end, gain in zip(
                    (0, *ends), ends[:count], _gains(question, fingertips), strict=False
                )
            ),
            quiet=np.ascontiguousarray(quiet),
            has_no_quiet_contacts=not question.quiet,
            threshold=self._threshold,
            wanted=10 ** (question.level_db_sl / 20),
        )

    def amplitudes(
        self, excitation: Excitation, points: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Frequencies (f,) [Hz] and peak acceleration at points (p, 2) [m] of the plate, (f, p).

        The excitation's frequencies must be the table's own.
        """
        frequencies, bases = base_amplitudes(excitation, self.eras)
        weights = (bases / [era.stroke for era in self.eras]).astype(np.complex64)
        rows = np.searchsorted(self.frequencies, frequencies)
        coherent = np.einsum("fe,pfe->pf", weights, self.acceleration[:, rows])
        found = self.raster.at(np.ascontiguousarray(coherent).view(np.float32), points)
        return frequencies, np.abs(found.view(np.complex64)).T.astype(float)

    def error_amplitude(self, frequency: float, base: ComplexArray) -> float:
        """Root mean square over the plate [m/s²] of the error of a tone's discretised field.

        frequency [Hz]: one of the table's; base (eras,): motion of the ERAs' bases [m]. The errors
        of the ERAs are taken as independent.
        """
        row = int(np.searchsorted(self.frequencies, frequency))
        weights = base / [era.stroke for era in self.eras]
        fields = np.linalg.norm(self.acceleration[:, row] * weights)
        return float(self.discretisation_error[row] * fields / math.sqrt(self.raster.point_count))

    def shapes_at(self, points: Sequence[Point]) -> FloatArray:
        """Shapes of the reduced plate at points [m] of it, (p, r)."""
        return self.raster.at(self.shapes, np.array(points)).astype(float)

    def shapes_at_fingertips(
        self, contacts: Sequence[Point]
    ) -> tuple[FloatArray, list[int], FloatArray]:
        """Shapes under fingertips (p, r), where the points of each one end, and their weights."""
        fingertips = self.raster.fingertips(np.array(contacts))
        return fingertips.read(self.shapes).astype(float), fingertips.ends, fingertips.means

    def drive_of(self, excitation: Excitation) -> dict[str, dict[str, float]]:
        """Frequency, level 0..1 of the stroke and phase of an excitation, by ERA."""
        strokes = {era.name: era.stroke for era in self.eras}
        return {
            name: {
                "frequency_hz": tone.frequency,
                "level": tone.amplitude / strokes[name],
                "phase_deg": math.degrees(tone.phase),
            }
            for name, tone in excitation.items()
        }

    @cached_property
    def available_level_db_sl(self) -> FloatArray:
        """Highest level [dB SL] of any `switched` pattern at the centre of each cell, (cells,)."""
        sources = magnitudes_of_sources(self._cell_fields)
        powers = (sources / per_source(self._threshold, len(self.eras))) ** 2
        # Cell by cell, since fine frequency steps make millions of patterns.
        maxima = [sums_of_sources(cell[None], len(self.eras)).max() for cell in powers.T]
        return decibels(np.sqrt(np.array(maxima, dtype=float)))

    @cached_property
    def cell_centres(self) -> FloatArray:
        """Centres of the grid's cells [m], (cells, 2)."""
        return self.grid.centres(self.plate)

    @cached_property
    def in_time(self) -> PlateInTime:
        """The plate on its ERAs in time."""
        reduced = ReducedOnRaster(self.plate, self.omega, self.raster, self.shapes)
        return plate_in_time(
            reduced, self.eras, loads=self.masses, attachment_shapes=self.attachment_shapes
        )

    @cached_property
    def onsets(self) -> RampedOnsets | None:
        """Plain ramps at the table's frequencies; None where too few ERAs support the plate."""
        try:
            return RampedOnsets(self.in_time, self.frequencies, ramp=ONSET_RAMP)
        except InputError:
            return None

    @cached_property
    def _threshold(self) -> NDArray[np.float32]:
        return detection_threshold(self.frequencies, self.threshold).astype(np.float32)

    @cached_property
    def _values(self) -> NDArray[np.float32]:
        """The fields as real numbers, a row for each raster point."""
        return self.acceleration.reshape(self.raster.point_count, -1).view(np.float32)

    @cached_property
    def _cell_fields(self) -> Complex64Array:
        """Fields at the centres of the cells, (f, eras, cells)."""
        return self._by_frequency(self.raster.at(self._values, self.cell_centres))

    def _fingertips(self, question: Question) -> Fingertips:
        """Fingertips of a question on the raster, targets first."""
        return self.raster.fingertips(np.array([*question.targets, *question.quiet]))

    def _onset_contrast(
        self, question: Question, fingertips: Fingertips, playable: IntArray
    ) -> OnsetContrast:
        """Contrast of plain ramps at the fingertips, by index among the playable frequencies."""

        def contrast(rows: IntArray, weights: Complex64Array) -> FloatArray | None:
            if self.onsets is None:
                return None
            shapes, ends = fingertips.read(self.shapes), fingertips.ends
            return self.onsets.contrast(
                playable[rows],
                weights,
                targets=[
                    shapes[start:end] * gain[:, None]
                    for start, end, gain in zip(
                        (0, *ends), ends, _gains(question, fingertips), strict=False
                    )
                ],
                quiet=shapes[ends[len(question.targets) - 1] :],
            )

        return contrast

    def _by_frequency(self, values: NDArray[np.float32]) -> Complex64Array:
        fields = values.view(np.complex64).reshape(len(values), len(self.frequencies), -1)
        return np.ascontiguousarray(fields.transpose(1, 2, 0))


def _gains(question: Question, fingertips: Fingertips) -> NDArray[np.float32]:
    """Factors (targets, p) that make the mean of a target's points its weighted one at its gain."""
    count = len(question.targets)
    means = fingertips.means[:count] * fingertips.means.shape[1]
    return np.asarray(means * np.array(question.gains)[:, None], dtype=np.float32)
