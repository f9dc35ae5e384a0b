"""A table's plate with the fingers of a question on it."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import accumulate

import numpy as np

from model.arrays import Complex64Array, Float32Array, FloatArray, IntArray
from model.drive_modes.forms import Forms, Weights
from model.ensemble.attached_plate import AttachedPlate
from model.ensemble.contact_forms import LoadedContacts, gram, load_contacts
from model.ensemble.draws import Draws, draw
from model.ensemble.measures import Felt, Fingertips, felt
from model.ensemble.thickness import responses_of_thicknesses, thickness_nodes
from model.ensemble.tone_responses import NOMINAL, Tones, drawn_changes, tone_responses
from model.table.fingertip_shapes import FingertipShapes
from model.table.pulse_gains import PulseResponses
from model.table.question import Question
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

    tips: of k fingers; threshold (f,) [m/s²]; error_power (f, eras): mean square of the
    discretisation error of each ERA's field; loads (k,): of the fingers, as of a question; targets,
    quiet: indices of fingers; gains: factors on the fields of the targets that make all levels the
    same; wanted: their amplitude to threshold.
    """

    plate: AttachedPlate
    tips: FingertipShapes
    threshold: Float32Array
    error_power: Float32Array
    loads: tuple[float, ...]
    contacts: LoadedContacts
    targets: IntArray
    quiet: IntArray
    gains: Float32Array
    wanted: float

    @classmethod
    def of(
        cls,
        plate: AttachedPlate,
        tips: FingertipShapes,
        question: Question,
        *,
        threshold: Float32Array,
        error_power: Float32Array,
    ) -> "FingersOnPlate":
        """Put the fingers of a question on a plate, targets first."""
        t, loads = len(question.targets), question.loads
        fingers = np.arange(len(tips.few))
        contacts = load_contacts(plate, tips.few, tips.few_weights, error_power, loads)
        return cls(
            plate,
            tips,
            threshold,
            error_power,
            loads,
            contacts,
            fingers[:t],
            fingers[t:],
            np.array(question.gains, dtype=np.float32),
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
            gains=np.ones(len(targets), dtype=np.float32),
            wanted=10 ** (level_db_sl / 20),
        )

    def forms(self, background: Complex64Array | None) -> Forms:
        """Forms to search, by quiet fingertip.

        background (f, eras, eras): mean power of the rest of the plate, for no quiet finger.
        """
        contacts, gains, targets = self.contacts, self.gains, self.targets
        fields, weights = contacts.fields.take(targets, axis=1), self.tips.few_weights[targets]
        mean = (weights[:, None] @ fields)[:, :, 0]
        by_target = np.asarray(mean.swapaxes(0, 1) * gains[:, None, None])
        # What the field differs over a target is no uncertainty of its level.
        few = gram(fields * np.sqrt(weights[:, :, None]))
        expected = contacts.power.take(targets, axis=1) - few + gram(mean[:, :, None])
        power = expected.swapaxes(0, 1) * (gains**2)[:, None, None, None]
        quiet = (
            contacts.power.take(self.quiet, axis=1)
            if background is None
            else self._expected(background)[:, None]
        )
        found = Forms(by_target, power, quiet, self.threshold, self.wanted)
        is_deep = self.plate.gain_variance < MAX_VARIANCE_FINE
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
        contacts, plate, fine = self.contacts, self.plate, self.tips.fine[self.quiet]
        f, a, n = contacts.forces.shape
        by_attachment = np.ascontiguousarray(contacts.forces.transpose(1, 0, 2)).reshape(a, -1)
        modal = (contacts.shapes.T @ by_attachment.view(np.float32)).view(np.complex64)
        modal = (
            modal.reshape(-1, f, n) * (plate.receptance * plate.minus_omega2[:, None]).T[..., None]
        )
        rows = np.ascontiguousarray(modal).reshape(len(modal), -1).view(np.float32)
        found = (fine.reshape(-1, fine.shape[2]) @ rows).view(np.complex64).reshape(-1, f, n)
        return np.ascontiguousarray(found.swapaxes(0, 1)).reshape(f, *fine.shape[:2], n)

    def forms_over(self, ringing: RampedRinging) -> Forms:
        """Forms to search for a short effect, by quiet fingertip; its level is that as modelled.

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
            targets=np.asarray(mean.swapaxes(0, 1) * self.gains[:, None, None]),
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
        power = self.contacts.power[np.ix_(rows, self.quiet)]
        uncertain = power - gram(self._few_fields.take(rows, axis=0))
        quiet = uncertain[:, :, None] + gram(at_points[:, :, :, None])
        return replace(forms, quiet=quiet.reshape(len(rows), -1, n, n), few=None, fine=None)

    def respond(self, drives: Sequence[Weights]) -> "DriveResponses":
        """Responses of the fingertips to drives."""
        plate, tips = self.plate, self.tips
        each = [drive.tones() for drive in drives]
        ends = list(accumulate(len(tones) for tones in each))
        tones = Tones(
            np.array([index for tones in each for index, _ in tones]),
            np.array([weights for tones in each for _, weights in tones]),
        )
        points = tips.fine.reshape(-1, tips.fine.shape[-1])
        error = self.error_power.take(tones.frequencies, axis=0) * np.abs(tones.weights) ** 2
        return DriveResponses(
            tone_responses(plate, self.contacts, tones, points),
            np.sqrt(np.add.reduce(error, axis=1)),
            self.threshold.take(tones.frequencies),
            np.array([0, *ends[:-1]]),
            np.array(ends),
            Fingertips(tips.fine_weights, self.gains),
            plate,
            self.contacts,
            tones,
            points,
            self.loads,
        )

    def _expected(self, background: Complex64Array) -> Complex64Array:
        """The mean power under errors of the gains, (f, eras, eras)."""
        expected = background.copy()
        diagonal = expected.reshape(len(expected), -1)[:, :: expected.shape[1] + 1]
        diagonal *= 1 + np.float32(self.plate.gain_variance)
        return expected


@dataclass(frozen=True, eq=False)
class DriveResponses:
    """Responses of the fingertips' points to the tones of drives.

    values (m, k p, columns): of `tone_responses`; error (m,): root mean square of the
    discretisation error of each tone's field; threshold (m,) [m/s²]; starts, ends (c,): ranges of
    the drives' tones; points (k p, r): shapes; loads (k,): of the fingers, as of a question.
    """

    values: Complex64Array
    error: Float32Array
    threshold: Float32Array
    starts: IntArray
    ends: IntArray
    fingertips: Fingertips
    plate: AttachedPlate
    contacts: LoadedContacts
    tones: Tones
    points: Float32Array
    loads: tuple[float, ...]

    def of(self, drive: int) -> "DriveResponses":
        """Responses to one of the drives, by index."""
        start, end = self.starts[drive], self.ends[drive]
        return replace(
            self,
            values=self.values[start:end],
            error=self.error[start:end],
            threshold=self.threshold[start:end],
            starts=np.zeros(1, dtype=int),
            ends=np.array([end - start]),
            tones=Tones(self.tones.frequencies[start:end], self.tones.weights[start:end]),
        )

    def drawn(self, *, count: int, seed: int, thicknesses: int) -> Float32Array:
        """Squared amplitudes on the plate as modelled, and on drawn ones, (m, k p, 1 + count).

        thicknesses: how many the drawn plates have. All else that is uncertain changes their
        responses as on the plate as modelled, in proportion.
        """
        draws, nodes = self._draws(count, seed, thicknesses)
        return draws.power(draws.accelerations(self.values, self._at_nodes(nodes)), self.error)

    def promised(self, *, count: int, seed: int, thicknesses: int, bases: int) -> Float32Array:
        """As `drawn`, but all else that is uncertain acts on a thickness as it does there.

        bases: thicknesses at which its changes are computed, each for as many drawn plates.
        """
        if not self.plate.thickness:
            return self.drawn(count=count, seed=seed, thicknesses=0)
        draws, nodes = self._draws(count, seed, thicknesses)
        tones, m, columns = self.tones, len(self.tones.frequencies), self.values.shape[2]
        plates = self.plate.of_thicknesses(thickness_nodes(bases), tones.frequencies)
        centres = self.contacts.shapes[self.plate.stiffness.shape[1] :, None]
        contacts = load_contacts(
            plates,
            centres,
            np.ones(centres.shape[:2], dtype=np.float32),
            np.zeros((m * bases, self.plate.era_count), dtype=np.float32),  # of forms, not needed
            self.loads,
        )
        factors = draws.factors[:columns, 1:].reshape(columns, bases, -1).swapaxes(0, 1)
        changes = drawn_changes(
            plates,
            contacts,
            Tones(np.arange(m * bases), tones.weights.repeat(bases, axis=0)),
            self.points,
            np.tile(factors, (m, 1, 1)),
        ).reshape(len(self.points), m, count)
        nominal = self._at_nodes(nodes).repeat(count // len(nodes), axis=2)
        plates_drawn = nominal + changes.swapaxes(0, 1)
        found = np.concatenate([self.values[:, :, NOMINAL, None], plates_drawn], axis=2)
        return draws.power(found, self.error)

    def felt(self, power: Float32Array) -> Felt:
        """Measures of the drives where the fingers' targets come first, (c, plates)."""
        return felt(power, self.threshold, self.starts, self.fingertips)

    def _draws(self, count: int, seed: int, thicknesses: int) -> tuple[Draws, FloatArray]:
        """Drawn plates, and the deviations of their thickness, none where it is certain."""
        plate = self.plate
        thicknesses = thicknesses if plate.thickness > 0 else 0
        draws = draw(
            plate.era_count,
            len(self.fingertips.weights),
            count=count,
            seed=seed,
            gain=plate.gain,
            phase=plate.phase,
            thicknesses=thicknesses,
        )
        return draws, thickness_nodes(thicknesses) if thicknesses else np.empty(0)

    def _at_nodes(self, nodes: FloatArray) -> Complex64Array:
        """Nominal responses at thicknesses, (m, k p, thicknesses)."""
        return responses_of_thicknesses(self.plate, self.contacts, self.tones, self.points, nodes)
