"""Fingers on a table's plate: their forms to search, and what they feel on drawn plates."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from model.arrays import Complex64Array, Float32Array, IntArray, Point
from model.drive_modes import Forms
from model.ensemble.attached_plate import PlateOnEras
from model.ensemble.draws import Drawing, over_fingertips
from model.ensemble.touched_by_kernel import touch
from model.ensemble.touched_plate import FingertipAmplitudes, LoadedContacts, TouchedPlate, outer
from model.table.raster import FingertipShapes
from model.table.table import LocalizationTable, read_fingertips

MAX_FINGERS_BY_POINT = 4
"""Quiet fingers up to which the points of each are looked at one by one in a search."""

CENTRE_AND_RIM, CENTRE_AND_FOUR = np.array([0, *range(9, 21)]), np.array([0, 9, 12, 15, 18])
"""Of the fine points of a fingertip, those between which no null hides, and a few of them."""

MAX_VARIANCE_FINE = 0.005
"""Variance of an ERA's gain up to which nulls are so deep that few points do not show them."""


@dataclass(frozen=True, eq=False)
class FingersOnPlate:
    """The plate of a table with k fingers on it, and the shapes under these.

    at_harmonics: the same at twice the table's frequencies; None where ERAs have no harmonics.
    """

    table: LocalizationTable
    tips: FingertipShapes
    touched: TouchedPlate
    at_harmonics: TouchedPlate | None

    @classmethod
    def of(
        cls,
        table: LocalizationTable,
        places: Sequence[Point],
        loads: tuple[float, ...],
        *,
        by_kernel: bool = True,
    ) -> "FingersOnPlate":
        """Put fingers at places [m] on a table's plate.

        loads: of each relative to the rig's fingertip, empty for 1.
        """
        if by_kernel:
            tips = read_fingertips(table, places)
        else:
            tips = table.raster.fingertips(np.array(places), table.shapes)
        centres = tips.few[:, 0]

        def touched(on: PlateOnEras) -> TouchedPlate:
            if by_kernel:
                return touch(on, centres, loads, table.clocks)
            stiffness = on.plate.finger_stiffness(len(centres), loads)
            return TouchedPlate(on, centres, stiffness, table.clocks)

        has_harmonics = table.uncertainty.harmonic > 0
        twice = touched(table.at_harmonics) if has_harmonics else None
        return cls(table, tips, touched(table.on_eras), twice)

    def forms(self, rows: IntArray, *, with_fine: bool) -> "FingerForms":
        """What the fingers have of the ERAs at rows (f,) of the table's frequencies.

        with_fine: at their fine points, too.
        """
        tips, fine = self.tips, self.tips.fine if with_fine else None
        power = self.table.search_error_power
        return FingerForms(
            self, rows, self.touched.forms(rows, tips.few, tips.few_weights, power, fine)
        )

    def drawn(
        self, by: Drawing, rows: IntArray, weights: Complex64Array, *, with_powers: bool = False
    ) -> FingertipAmplitudes:
        """What tones at rows (m,) of weights (m, n) do at all fine points on drawn plates."""
        points, table = self.tips.fine.reshape(-1, self.tips.fine.shape[2]), self.table
        given = points, self.tips.fine_weights, table.error_power, table.thresholds
        return self.touched.drawn(by, rows, weights, *given, with_powers=with_powers)

    def felt(
        self, by: Drawing, rows: IntArray, weights: Complex64Array, owners: IntArray
    ) -> tuple[Float32Array, Float32Array]:
        """Mean amplitude over each fingertip, and power at its loudest point, of c drives.

        With the second harmonics in the latter.

        owners (m,): the drive of each tone, ascending; both (c, k, 1 + d).
        """
        starts = np.flatnonzero(np.diff(owners, prepend=-1))
        harmonics = np.add.reduceat(self.harmonics(by, rows, weights), starts)
        if len(rows) == 1 + owners[-1]:
            sensed = self.drawn(by, rows, weights)
            return sensed.means, sensed.loudest + harmonics
        power = self.powers(by, rows, weights).reshape(len(rows), -1, 1 + by.count)
        means, loudest = over_fingertips(np.add.reduceat(power, starts), self.tips.fine_weights)
        return means, loudest + harmonics

    def harmonics(self, by: Drawing, rows: IntArray, weights: Complex64Array) -> Float32Array:
        """Squared amplitude to threshold of second harmonics at fingers, (m, k, 1 + d).

        To `compared_harmonic_thresholds`.
        """
        if self.at_harmonics is None:
            return np.zeros((len(rows), len(self.tips.few), 1 + by.count), dtype=np.float32)
        tips, threshold = self.tips, self.table.compared_harmonic_thresholds[rows]
        found = self.at_harmonics.harmonics(by, rows, weights, tips.few, tips.few_weights)
        return np.asarray(found / np.square(threshold)[:, None, None])

    def powers(self, by: Drawing, rows: IntArray, weights: Complex64Array) -> Float32Array:
        """Squared amplitudes to threshold of tones at fine points, (m, k, p, 1 + d)."""
        found = self.drawn(by, rows, weights, with_powers=True).powers
        return np.asarray(found).reshape(len(rows), *self.tips.fine_weights.shape, -1)


@dataclass(frozen=True, eq=False)
class FingerForms:
    """Fields and expected powers at fingers, at rows (f,) of a table's frequencies."""

    fingers: FingersOnPlate
    rows: IntArray
    contacts: LoadedContacts

    def at(self, some: IntArray) -> "FingerForms":
        """Select some of the frequencies, by index (n,)."""
        of, fine = self.contacts, self.contacts.fine_fields
        contacts = LoadedContacts(
            of.fields[some],
            None if fine is None else fine[some],
            of.power[some],
            of.uncertain[some],
        )
        return replace(self, rows=self.rows[some], contacts=contacts)

    def of(
        self,
        targets: Sequence[int],
        others: Sequence[int],
        level_db_sl: float,
        background: Complex64Array | None = None,
    ) -> Forms:
        """Forms to search for fingers, by index, that are targets and others that are not.

        background (f, n, n): form of the rest of the plate, for no other finger.
        """
        targets, others = [*targets], [*others]
        contacts, tips, table = self.contacts, self.fingers.tips, self.fingers.table
        weights = tips.few_weights[targets]
        mean = (weights[:, None] @ contacts.fields[:, targets])[:, :, 0]
        # What the field differs over a target is no uncertainty of its level.
        expected = contacts.uncertain[:, targets] + outer(mean)
        found = Forms(
            mean.swapaxes(0, 1),
            expected.swapaxes(0, 1),
            contacts.power[:, others],
            table.thresholds.take(self.rows),
            10 ** (level_db_sl / 20),
        )
        variance = table.uncertainty.gain_variance
        if background is not None:
            rest = background.copy()
            rest.reshape(len(rest), -1)[:, :: rest.shape[1] + 1] *= 1 + np.float32(variance)
            return replace(found, quiet=rest[:, None])
        is_deep = variance < MAX_VARIANCE_FINE and len(others) <= MAX_FINGERS_BY_POINT
        if not is_deep or contacts.fine_fields is None:
            return found
        few = contacts.fields[:, others] * np.sqrt(tips.few_weights[others][:, :, None])
        return replace(found, few=few, fine=contacts.fine_fields[:, others])

    def by_point(
        self, forms: Forms, others: Sequence[int], points: IntArray = CENTRE_AND_RIM
    ) -> Forms:
        """Forms by point of every finger that is no target; points (p,): of the fine ones.

        What is uncertain counts by the fingertip's mean.
        """
        fine, n = np.asarray(self.contacts.fine_fields), forms.era_count
        quiet = self.contacts.uncertain[:, others, None] + outer(fine[:, others][:, :, points])
        found = replace(forms, quiet=quiet.reshape(len(fine), -1, n, n), few=None, fine=None)
        return found if forms.driven is None else found.among(forms.driven)
