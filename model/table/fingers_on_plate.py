"""A table's plate with the fingers of a question on it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import accumulate

import numpy as np

from model.arrays import Complex64Array, Float32Array, IntArray
from model.drive_modes.forms import Forms, Weights
from model.ensemble.attached_plate import AttachedPlate
from model.ensemble.contact_forms import LoadedContacts, load_contacts
from model.ensemble.draws import draw
from model.ensemble.measures import Felt, Fingertips, felt
from model.ensemble.tone_responses import Tones, tone_responses
from model.table.fingertip_shapes import FingertipShapes
from model.table.question import Question


class FingersOnPlate:
    """Fields, expected powers and drawn plates at the fingers of a question, targets first.

    threshold (f,) [m/s²]; error_power (f, eras): mean square of the discretisation error of each
    ERA's field.
    """

    def __init__(
        self,
        plate: AttachedPlate,
        tips: FingertipShapes,
        question: Question,
        *,
        threshold: Float32Array,
        error_power: Float32Array,
    ) -> None:
        self._plate, self._tips = plate, tips
        self._question = question
        self._threshold = threshold
        self._error_power = error_power
        self._contacts: LoadedContacts = load_contacts(
            plate, tips.few, tips.few_weights, error_power, question.loads
        )
        self._gains = np.array(question.gains, dtype=np.float32)

    def forms(self, background: Complex64Array | None) -> Forms:
        """Forms to search, by quiet fingertip.

        background (f, eras, eras): mean power of the rest of the plate, for no quiet finger.
        """
        t = len(self._question.targets)
        contacts, gains = self._contacts, self._gains
        mean = (self._tips.few_weights[:t, None] @ contacts.fields[:, :t])[:, :, 0]
        by_target = np.asarray(mean.swapaxes(0, 1) * gains[:, None, None])
        power = contacts.power[:, :t].swapaxes(0, 1) * (gains**2)[:, None, None, None]
        quiet = contacts.power[:, t:] if background is None else self._expected(background)[:, None]
        wanted = 10 ** (self._question.level_db_sl / 20)
        return Forms(by_target, power, np.ascontiguousarray(quiet), self._threshold, wanted)

    def by_point(self, forms: Forms, frequencies: IntArray) -> Forms:
        """Forms, at rows (n,) of the plate's frequencies, with every quiet point as a fingertip."""
        quiet = self._contacts.point_power(frequencies, first=len(self._question.targets))
        return replace(forms, quiet=quiet)

    def respond(self, drives: Sequence[Weights]) -> "DriveResponses":
        """Responses of the fingertips to drives."""
        plate, tips = self._plate, self._tips
        each = [drive.tones() for drive in drives]
        ends = list(accumulate(len(tones) for tones in each))
        tones = Tones(
            np.array([index for tones in each for index, _ in tones]),
            np.array([weights for tones in each for _, weights in tones]),
        )
        points = tips.fine.reshape(-1, tips.fine.shape[-1])
        error = self._error_power.take(tones.frequencies, axis=0) * np.abs(tones.weights) ** 2
        return DriveResponses(
            tone_responses(plate, self._contacts, tones, points),
            np.sqrt(np.add.reduce(error, axis=1)),
            self._threshold.take(tones.frequencies),
            np.array([0, *ends[:-1]]),
            np.array(ends),
            Fingertips(tips.fine_weights, self._gains),
            plate,
        )

    def _expected(self, background: Complex64Array) -> Complex64Array:
        """The mean power under errors of the gains, (f, eras, eras)."""
        expected = background.copy()
        diagonal = expected.reshape(len(expected), -1)[:, :: expected.shape[1] + 1]
        diagonal *= 1 + np.float32(self._plate.gain_variance)
        return expected


@dataclass(frozen=True, eq=False)
class DriveResponses:
    """Responses of the fingertips' points to the tones of drives.

    values (m, k p, columns): of `tone_responses`; error (m,): root mean square of the
    discretisation error of each tone's field; threshold (m,) [m/s²]; starts, ends (c,): ranges of
    the drives' tones.
    """

    values: Complex64Array
    error: Float32Array
    threshold: Float32Array
    starts: IntArray
    ends: IntArray
    fingertips: Fingertips
    plate: AttachedPlate

    def of(self, drive: int) -> "DriveResponses":
        """Responses to one of the drives, by index."""
        start, end = self.starts[drive], self.ends[drive]
        return DriveResponses(
            self.values[start:end],
            self.error[start:end],
            self.threshold[start:end],
            np.zeros(1, dtype=int),
            np.array([end - start]),
            self.fingertips,
            self.plate,
        )

    def drawn(self, *, count: int, seed: int) -> Felt:
        """Measures on the plate as modelled, and on drawn ones, (c, 1 + count)."""
        plate = self.plate
        draws = draw(
            plate.era_count,
            len(self.fingertips.weights),
            count=count,
            seed=seed,
            gain=plate.gain,
            phase=plate.phase,
        )
        power = draws.power(self.values, self.error)
        return felt(power, self.threshold, self.starts, self.fingertips)
