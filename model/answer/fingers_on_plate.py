"""A table's plate with fingers on it: fields, forms for searches, and what fingers feel of tones.

`FingersOnPlate` puts fingers on the plate. `FingerForms` has the input of a search for tones.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from model.arrays import Complex64Array, Float32Array, IntArray, Point
from model.drive_forms import Forms, WeightedTones
from model.ensemble.attached_plate import PlateOnEras
from model.ensemble.draws import Drawing, over_fingertips
from model.ensemble.expected_power import outer
from model.ensemble.kernel_plates import touch
from model.ensemble.touched_plate import FingertipAmplitudes, LoadedContacts, TouchedPlate
from model.table.fingertip_shapes import FingertipShapes, fingertips_by_numpy, read_fingertips
from model.table.table import LocalizationTable

CENTER_AND_RIM = np.array([0, *range(9, 21)])
"""Indices of fine points of a fingertip, so close that no null fits between them."""

CENTER_AND_FOUR = np.array([0, 9, 12, 15, 18])
"""Indices of a few fine points of a fingertip."""

MAX_FINGERS_BY_POINT = 4
"""Maximum number of quiet fingers whose points a search considers individually."""

MAX_VARIANCE_FINE = 0.005
"""Variance of an ERA's gain below which nulls are so deep that few points do not show them."""


@dataclass(frozen=True, eq=False)
class DriveTones:
    """m tones of several drives or contents."""

    rows: IntArray
    """Row (m,) of each tone's frequency in the table."""
    weights: Complex64Array
    """Weights (m, n) of the ERAs."""
    owners: IntArray
    """Drive or content (m,) of each tone, by number."""

    @classmethod
    def of(cls, drives: Sequence[WeightedTones]) -> "DriveTones":
        """Join the tones of drives, in order."""
        rows = list[int]()
        weights = list[Complex64Array]()
        owners = list[int]()
        for number, drive in enumerate(drives):
            for row, tone_weights in drive:
                rows.append(row)
                weights.append(tone_weights)
                owners.append(number)
        return cls(np.array(rows), np.array(weights), np.array(owners))


@dataclass(frozen=True, eq=False)
class FingersOnPlate:
    """Plate of a table with k fingers on it."""

    table: LocalizationTable
    tips: FingertipShapes
    """Mode shapes under the fingers."""
    touched: TouchedPlate
    at_harmonics: TouchedPlate | None
    """Plate at twice the table's frequencies, None if ERAs have no harmonics."""

    @classmethod
    def of(
        cls,
        table: LocalizationTable,
        places: Sequence[Point],
        loads: tuple[float, ...],
        *,
        by_kernel: bool = True,
    ) -> "FingersOnPlate":
        """Put fingers at positions [m] on a table's plate.

        loads: relative to the rig's fingertip, empty for 1 each; by_kernel: whether to use C
        kernels.
        """
        read = read_fingertips if by_kernel else fingertips_by_numpy
        tips = read(table, places)
        centers = tips.few[:, 0]
        finger_count = len(centers)

        def touched(plate_on_eras: PlateOnEras) -> TouchedPlate:
            if by_kernel:
                return touch(plate_on_eras, centers, loads, table.clocks)
            plate = plate_on_eras.plate
            stiffness = plate.finger_stiffness(finger_count, loads)
            load_std = plate.load_stds(finger_count, loads)
            return TouchedPlate(plate_on_eras, centers, stiffness, load_std, table.clocks)

        has_harmonics = table.uncertainty.harmonic > 0
        at_harmonics = touched(table.at_harmonics) if has_harmonics else None
        return cls(table, tips, touched(table.on_eras), at_harmonics)

    def forms(self, rows: IntArray, *, with_fine: bool) -> "FingerForms":
        """Compute fields and expected powers at rows (f,) of the table's frequencies.

        with_fine: also at the fine points of fingertips.
        """
        tips = self.tips
        contacts = self.touched.forms(
            rows,
            tips.few,
            tips.few_weights,
            self.table.search_error_power,
            tips.fine if with_fine else None,
            tips.touch_steps,
        )
        return FingerForms(self, rows, contacts)

    def drawn(
        self,
        drawing: Drawing,
        rows: IntArray,
        weights: Complex64Array,
        *,
        with_powers: bool = False,
    ) -> FingertipAmplitudes:
        """Compute amplitudes at all fine points on drawn plates, for tones at rows (m,).

        weights (m, n): of the ERAs.
        """
        fine = self.tips.fine
        return self.touched.drawn(
            drawing,
            rows,
            weights,
            fine.reshape(-1, fine.shape[2]),
            self.tips.fine_weights,
            self.table.error_power,
            self.table.thresholds,
            touch_steps=self.tips.touch_steps,
            with_powers=with_powers,
        )

    def felt(self, drawing: Drawing, tones: DriveTones) -> tuple[Float32Array, Float32Array]:
        """Return mean amplitude over fingertips and power at the loudest points, for c drives.

        Both (c, k, 1 + d) relative to the threshold; the power includes second harmonics. The
        tones' drives ascend.
        """
        first_tones = np.flatnonzero(np.diff(tones.owners, prepend=-1))
        tone_harmonics = self.harmonics(drawing, tones.rows, tones.weights)
        harmonics = np.add.reduceat(tone_harmonics, first_tones)
        drive_count = 1 + tones.owners[-1]
        if len(tones.rows) == drive_count:
            amplitudes = self.drawn(drawing, tones.rows, tones.weights)
            return amplitudes.means, amplitudes.loudest + harmonics
        tone_powers = self.powers(drawing, tones.rows, tones.weights)
        by_point = tone_powers.reshape(len(tones.rows), -1, 1 + drawing.count)
        power = np.add.reduceat(by_point, first_tones)
        means, loudest = over_fingertips(power, self.tips.fine_weights)
        return means, loudest + harmonics

    def harmonics(self, drawing: Drawing, rows: IntArray, weights: Complex64Array) -> Float32Array:
        """Squared amplitude of second harmonics at fingers, (m, k, 1 + d).

        Relative to the table's `compared_harmonic_thresholds`.
        """
        tips = self.tips
        if self.at_harmonics is None:
            return np.zeros((len(rows), len(tips.few), 1 + drawing.count), dtype=np.float32)
        power = self.at_harmonics.harmonics(drawing, rows, weights, tips.few, tips.few_weights)
        thresholds = self.table.compared_harmonic_thresholds[rows]
        return np.asarray(power / np.square(thresholds)[:, None, None])

    def powers(self, drawing: Drawing, rows: IntArray, weights: Complex64Array) -> Float32Array:
        """Squared amplitudes of tones at fine points relative to the threshold, (m, k, p, 1 +
        d)."""
        powers = self.drawn(drawing, rows, weights, with_powers=True).powers
        return np.asarray(powers).reshape(len(rows), *self.tips.fine_weights.shape, -1)


@dataclass(frozen=True, eq=False)
class FingerForms:
    """Fields and expected powers at fingers, at rows (f,) of a table's frequencies."""

    fingers: FingersOnPlate
    rows: IntArray
    contacts: LoadedContacts

    def of(
        self,
        targets: Sequence[int],
        others: Sequence[int],
        level_db_sl: float,
        background: Complex64Array | None = None,
    ) -> Forms:
        """Return the forms of a search for targets and other fingers, both by index.

        background (f, n, n): form of the rest of the plate, used without other fingers.
        """
        targets = [*targets]
        others = [*others]
        contacts = self.contacts
        tips = self.fingers.tips
        table = self.fingers.table
        target_weights = tips.few_weights[targets]
        mean = (target_weights[:, None] @ contacts.fields[:, targets])[:, :, 0]
        # The field's variation over a target does not make its level uncertain.
        target_power = contacts.uncertain[:, targets] + outer(mean)
        # Harmonics are felt, but do not make a target's level uncertain.
        harmonic_power = (table.search_error_power - table.error_power)[self.rows, None]
        eras = np.arange(len(table.eras))
        target_power[..., eras, eras] -= harmonic_power
        forms = Forms(
            targets=mean.swapaxes(0, 1),
            target_power=target_power.swapaxes(0, 1),
            quiet=contacts.power[:, others],
            threshold=table.thresholds.take(self.rows),
            wanted=10 ** (level_db_sl / 20),
        )
        gain_variance = table.uncertainty.gain_variance(len(table.eras))
        if background is not None:
            rest_of_plate = background.copy()
            rest_of_plate[:, eras, eras] *= 1 + np.float32(gain_variance)
            return replace(forms, quiet=rest_of_plate[:, None])
        has_deep_nulls = gain_variance < MAX_VARIANCE_FINE
        if not has_deep_nulls or len(others) > MAX_FINGERS_BY_POINT or contacts.fine_fields is None:
            return forms
        root_weights = np.sqrt(tips.few_weights[others][:, :, None])
        few = contacts.fields[:, others] * root_weights
        return replace(forms, few=few, fine=contacts.fine_fields[:, others])

    def by_point(
        self, forms: Forms, others: Sequence[int], points: IntArray = CENTER_AND_RIM
    ) -> Forms:
        """Return forms in which each point of every other finger counts separately.

        points (p,): indices of fine points. Uncertainty counts by the mean over the fingertip.
        """
        fine_fields = np.asarray(self.contacts.fine_fields)
        nominal = outer(fine_fields[:, others][:, :, points])
        power = self.contacts.uncertain[:, others, None] + nominal
        quiet = power.reshape(len(fine_fields), -1, forms.era_count, forms.era_count)
        by_point = replace(forms, quiet=quiet, few=None, fine=None)
        if forms.driven is None:
            return by_point
        return by_point.among(forms.driven)
