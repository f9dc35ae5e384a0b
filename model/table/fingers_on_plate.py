"""A table's plate with the fingers of a question on it."""

from collections.abc import Sequence

import numpy as np

from model.arrays import Complex64Array, Float32Array, IntArray
from model.drive_modes.forms import Forms, Weights
from model.ensemble.attached_plate import AttachedPlate
from model.ensemble.contact_forms import LoadedContacts, load_contacts
from model.ensemble.draws import Draws, draw
from model.ensemble.measures import Felt, Fingertips, felt
from model.ensemble.tone_responses import NOMINAL, Tones, tone_responses
from model.table import raster
from model.table.question import Question


class FingersOnPlate:
    """Fields, expected powers and drawn plates at the fingers of a question, targets first.

    error_power (f, eras): mean square of the discretisation error of each ERA's field.
    """

    def __init__(
        self,
        plate: AttachedPlate,
        tips: raster.Fingertips,
        shapes: Float32Array,
        question: Question,
        *,
        threshold: Float32Array,
        error_power: Float32Array,
    ) -> None:
        self._plate = plate
        self._question = question
        self._threshold = threshold
        self._error_power = error_power
        few, self._discs = tips.read(shapes)
        self._few_weights = tips.few_weights
        is_by_point = len(question.quiet) == 1
        self.contacts: LoadedContacts = load_contacts(
            plate, few, self._few_weights, error_power, is_by_point=is_by_point
        )
        self._gains = np.array(question.gains, dtype=np.float32)
        self._fingertips = Fingertips(tips.fine_weights, self._gains)

    def forms(self, background: Complex64Array | None) -> list[Forms]:
        """Forms to search, by quiet fingertip, and with one also by its points.

        background (f, eras, eras): mean power of the rest of the plate, for no quiet finger.
        """
        t = len(self._question.targets)
        contacts, gains = self.contacts, self._gains
        mean = (self._few_weights[:t, None] @ contacts.fields[:, :t])[:, :, 0]
        by_target = np.asarray(mean.swapaxes(0, 1) * gains[:, None, None])
        power = contacts.power[:, :t].swapaxes(0, 1) * (gains**2)[:, None, None, None]
        quiet = contacts.power[:, t:] if background is None else self._expected(background)[:, None]
        found = Forms(
            by_target,
            power,
            np.ascontiguousarray(quiet),
            self._threshold,
            10 ** (self._question.level_db_sl / 20),
        )
        if contacts.point_power is None:
            return [found]
        return [found, Forms(by_target, power, contacts.point_power, self._threshold, found.wanted)]

    def _expected(self, background: Complex64Array) -> Complex64Array:
        """The mean power under errors of the gains, (f, eras, eras)."""
        expected = background.copy()
        diagonal = expected.reshape(len(expected), -1)[:, :: expected.shape[1] + 1]
        diagonal *= 1 + np.float32(self._plate.gain_variance)
        return expected

    def nominal(self, drives: Sequence[Weights]) -> Felt:
        """Measures of drives on the plate as modelled, (c, 1)."""
        tones, starts = _tones_of(drives)
        return self._felt(tones, starts, self._responses(tones)[:, :, NOMINAL : NOMINAL + 1])

    def drawn(self, drives: Sequence[Weights], *, count: int, seed: int) -> Felt:
        """Measures of drives on drawn plates, (c, count)."""
        tones, starts = _tones_of(drives)
        responses = self._responses(tones) @ self._draws(count, seed).factors
        deviation = self._deviation(tones, self._draws(count, seed).deviations)
        if deviation is not None:
            responses += deviation
        return self._felt(tones, starts, responses)

    def _felt(self, tones: Tones, starts: IntArray, responses: Complex64Array) -> Felt:
        return felt(responses, self._threshold.take(tones.frequencies), starts, self._fingertips)

    def _responses(self, tones: Tones) -> Complex64Array:
        points = self._discs.reshape(-1, self._discs.shape[-1])
        return tone_responses(self._plate, self.contacts, tones, points)

    def _draws(self, count: int, seed: int) -> Draws:
        plate = self._plate
        return draw(
            plate.era_count,
            len(self._discs),
            count=count,
            seed=seed,
            gain=plate.gain,
            phase=plate.phase,
        )

    def _deviation(self, tones: Tones, deviations: Complex64Array) -> Complex64Array | None:
        """Deviations (m, k p, d) by the discretisation error."""
        power = self._error_power.take(tones.frequencies, axis=0)
        size = np.sqrt((power * np.abs(tones.weights) ** 2).sum(axis=1))
        each = np.repeat(deviations, self._discs.shape[1], axis=0)
        return np.asarray(size[:, None, None] * each, dtype=np.complex64)


def _tones_of(drives: Sequence[Weights]) -> tuple[Tones, IntArray]:
    """All tones of drives, one drive after the other, and where each begins."""
    each = [drive.tones() for drive in drives]
    starts = np.cumsum([0, *(len(tones) for tones in each)])[:-1]
    frequencies = np.array([index for tones in each for index, _ in tones])
    weights = np.array([weights for tones in each for _, weights in tones])
    return Tones(frequencies, weights), starts
