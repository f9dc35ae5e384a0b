"""A table's plate with the fingers of a question on it."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import accumulate

import numpy as np

from model.arrays import Complex64Array, Float32Array, IntArray
from model.drive_modes.forms import Forms, Weights
from model.ensemble.draws import Drawing
from model.ensemble.measures import Felt, felt, felt_at
from model.ensemble.touched_plate import LoadedContacts, TouchedPlate, gram, outer
from model.table.pulse_gains import PulseResponses
from model.table.question import Question
from model.table.raster import FingertipShapes
from model.transients.onset import RINGING_TIMES, RampedRinging

MAX_FINGERS_BY_POINT = 4
"""Quiet fingers up to which the points of each are looked at one by one in a search."""

CENTRE_AND_RIM, CENTRE_AND_FOUR = np.array([0, *range(9, 21)]), np.array([0, 9, 12, 15, 18])
"""Of the fine points of a fingertip, those between which no null hides, and a few of them."""

MAX_VARIANCE_FINE = 0.005
"""Variance of an ERA's gain up to which nulls are so deep that few points do not show them."""


@dataclass(frozen=True, eq=False)
class FingersOnPlate:
    """Fields, expected powers and drawn plates at fingers, some of which are targets, some quiet.

    touched: the table's plate with k fingers on it; rows (f,): of its frequencies; tips: of the
    fingers; threshold (all,) [m/s²], error_power (all, eras): mean square of the discretisation
    error of each ERA's field, at all of the plate's frequencies; contacts: at the rows; targets,
    quiet: indices of fingers; wanted: amplitude to threshold of the targets.
    """

    touched: TouchedPlate
    rows: IntArray
    tips: FingertipShapes
    threshold: Float32Array
    error_power: Float32Array
    contacts: LoadedContacts
    targets: IntArray
    quiet: IntArray
    wanted: float

    @classmethod
    def of(
        cls,
        touched: TouchedPlate,
        tips: FingertipShapes,
        question: Question,
        rows: IntArray,
        *,
        threshold: Float32Array,
        error_power: Float32Array,
    ) -> "FingersOnPlate":
        """Fingers of a question that touch a plate, targets first; at its frequencies by row.

        threshold (all,) [m/s²], at all of them.
        """
        t, fingers = len(question.targets), np.arange(len(tips.few))
        fine = tips.fine if len(question.quiet) <= MAX_FINGERS_BY_POINT else None
        return cls(
            touched,
            rows,
            tips,
            threshold,
            error_power,
            touched.forms(rows, tips.few, tips.few_weights, error_power, fine),
            fingers[:t],
            fingers[t:],
            10 ** (question.level_db_sl / 20),
        )

    def for_targets(
        self, targets: Sequence[int], quiet: Sequence[int], *, level_db_sl: float
    ) -> "FingersOnPlate":
        """The same fingers on the plate with other targets, all at one level."""
        return replace(
            self,
            targets=np.array(targets),
            quiet=np.array(quiet, dtype=int),
            wanted=10 ** (level_db_sl / 20),
        )

    def forms(self, background: Complex64Array | None) -> Forms:
        """Forms to search, by quiet fingertip.

        background (f, eras, eras): mean power of the rest of the plate, for no quiet finger.
        """
        contacts, targets = self.contacts, self.targets
        fields, weights = contacts.fields.take(targets, axis=1), self.tips.few_weights[targets]
        mean = (weights[:, None] @ fields)[:, :, 0]
        by_target = np.asarray(mean.swapaxes(0, 1))
        # What the field differs over a target is no uncertainty of its level.
        expected = contacts.uncertain.take(targets, axis=1) + outer(mean)
        power = expected.swapaxes(0, 1)
        quiet = (
            contacts.power.take(self.quiet, axis=1)
            if background is None
            else self._expected(background)[:, None]
        )
        threshold = self.threshold.take(self.rows)
        found = Forms(by_target, power, quiet, threshold, self.wanted)
        is_deep = self.touched.on.plate.gain_variance < MAX_VARIANCE_FINE
        if background is not None or not is_deep or len(self.quiet) > MAX_FINGERS_BY_POINT:
            return found
        return replace(found, few=self._few_fields, fine=self._fine_fields)

    @cached_property
    def _few_fields(self) -> Complex64Array:
        """Fields at the few points of the quiet fingers, each times the root of its weight."""
        weights = self.tips.few_weights[self.quiet]
        return self.contacts.fields.take(self.quiet, axis=1) * np.sqrt(weights[:, :, None])

    @cached_property
    def _fine_fields(self) -> Complex64Array:
        """Fields of each ERA at the fine points of the quiet fingers, (f, q, p, n)."""
        found = self.contacts.fine_fields
        if found is None:
            raise AssertionError("fine points must be given")
        return found.take(self.quiet, axis=1)

    def forms_over(self, ringing: RampedRinging) -> Forms:
        """Forms to search for a short effect, by quiet fingertip; its level is the nominal one.

        A target counts by the mean of its demodulated acceleration over the duration, a quiet
        fingertip by its power, that after the end included. Ringing is that of the plate without
        fingers.
        """
        contacts, points = self.contacts, self.tips.few.reshape(-1, self.tips.few.shape[2])
        f, k, p, n = contacts.fields.shape
        real, imaginary = ringing.parts.reshape(2, -1, points.shape[1]) @ points.T
        parts = (real + 1j * imaginary).reshape(f, n, -1, k, p).transpose(0, 3, 2, 4, 1)
        over = parts + ringing.envelope[:, None, None] * contacts.fields[:, :, None]
        return self._over(self.forms(None), contacts.fields, over, RINGING_TIMES)

    def forms_during(self, responses: PulseResponses) -> Forms:
        """Forms as `forms_over` at the rows of responses, of the plate with the fingers on it."""
        over = responses.values[:, :, :-1].transpose(0, 3, 2, 4, 1).astype(np.complex64)
        fields = self.contacts.fields.take(responses.rows, axis=0)
        return self._over(self.forms(None).at(responses.rows), fields, over, responses.count)

    def _over(
        self, steady: Forms, fields: Complex64Array, over: Complex64Array, count: int
    ) -> Forms:
        """Forms from steady fields (f, k, p, n), and fields over an effect (f, k, times, p, n).

        count: times until its end.
        """
        targets, quiet, (f, _, _, _, n) = self.targets, self.quiet, over.shape
        weights = self.tips.few_weights
        mean = (over[:, targets, :count].mean(axis=2) * weights[targets, :, None]).sum(axis=2)
        scale = np.sqrt(weights[quiet])[:, None, :, None]
        lasting, during = (
            (each[:, quiet] * scale / np.float32(math.sqrt(length))).reshape(f, len(quiet), -1, n)
            for each, length in ((fields[:, :, None], 1), (over, count))
        )
        return replace(
            steady,
            targets=mean.swapaxes(0, 1),
            quiet=np.ascontiguousarray(steady.quiet + gram(during) - gram(lasting)),
            level_margin=0.0,
            few=None,
            fine=None,
        )

    def by_point(self, forms: Forms, rows: IntArray, points: IntArray = CENTRE_AND_RIM) -> Forms:
        """Forms, at rows (n,) of the plate's frequencies, by point of every quiet fingertip.

        points (p,): by index, of the fine ones. What is uncertain counts by the fingertip's mean.
        """
        n = forms.era_count
        at_points = self._fine_fields[np.ix_(rows, np.arange(len(self.quiet)), points)]
        uncertain = self.contacts.uncertain[np.ix_(rows, self.quiet)]
        quiet = uncertain[:, :, None] + outer(at_points)
        return replace(forms, quiet=quiet.reshape(len(rows), -1, n, n), few=None, fine=None)

    def felt(self, drives: Sequence[Weights], by: Drawing) -> Felt:
        """What is felt of drives on drawn plates; the fingers' targets must come first."""
        each = [drive.tones() for drive in drives]
        starts = np.array([0, *accumulate(map(len, each))][:-1])
        rows = self.rows.take([index for tones in each for index, _ in tones])
        tips, threshold = self.tips, self.threshold
        sensed = self.touched.drawn(
            by,
            rows,
            np.array([weights for tones in each for _, weights in tones]),
            tips.fine.reshape(-1, tips.fine.shape[2]),
            tips.fine_weights,
            self.error_power,
            threshold,
            with_powers=len(starts) < len(rows),
        )
        if sensed.powers is None:
            return felt_at(sensed.means, sensed.loudest, len(self.targets))
        power = sensed.powers * (threshold.take(rows) ** 2)[:, None, None]
        targets = len(self.targets)
        return felt(power, threshold.take(rows), starts, tips.fine_weights, targets)

    def _expected(self, background: Complex64Array) -> Complex64Array:
        """The mean power under errors of the gains, (f, eras, eras)."""
        expected = background.copy()
        diagonal = expected.reshape(len(expected), -1)[:, :: expected.shape[1] + 1]
        diagonal *= 1 + np.float32(self.touched.on.plate.gain_variance)
        return expected
