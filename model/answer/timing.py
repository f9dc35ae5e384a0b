"""Onset, ending and transient measures of patterns."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import partial

from model.answer.effect_level import EffectLevels
from model.answer.pattern import Pattern
from model.answer.question import Question
from model.arrays import FloatArray, Point
from model.table.raster_kernel import read_fingertips
from model.table.table import LocalizationTable
from model.transients.base_motion import Bases, ramped_ending, ramped_onset, shaped
from model.transients.measures import Transients
from model.transients.shaping import Shaper


class Timing:
    """Shapes and rates patterns on the plate of a table in time.

    Takes about ten milliseconds to make, and one more at the first use of each frequency.
    levels: of vibrations of limited duration.
    """

    def __init__(self, table: LocalizationTable, *, shaper: Shaper | None = None) -> None:
        self._table, self._eras = table, table.eras
        self.levels = EffectLevels(table)
        variance = table.uncertainty.gain_variance
        self._shaper = shaper or Shaper(
            table.in_time, gain_variance=variance, fingertips=partial(_few_points, table)
        )

    def following(self, table: LocalizationTable) -> "Timing":
        """The timing of a table that has followed its plate, with envelopes as shaped for this one.

        Nothing need be prepared anew.
        """
        return Timing(table, shaper=self._shaper)

    def prepare(self, frequencies: Iterable[float]) -> None:
        """Compute ahead what shaping needs at frequencies [Hz]."""
        for frequency in frequencies:
            self._shaper.prepare(frequency)

    def with_envelopes(
        self, question: Question, pattern: Pattern, *, onset: bool = True, ending: bool = True
    ) -> Pattern:
        """Add a shaped onset and ending, or one of them; takes some milliseconds.

        Without quiet fingers the onset keeps the rest of the plate quiet. Envelopes are those of
        the plate without fingers: solved with them they would win 1 to 1.5 dB of the contrast over
        the first 100 ms, and take 6 ms longer.
        """
        targets, quiet, tones = question.targets, question.quiet, pattern.excitation
        if onset:
            envelopes = self._shaper.onset(tones, targets=targets, quiet=quiet)
            pattern = replace(pattern, onset=envelopes)
        if ending:
            envelopes = self._shaper.ending(tones, targets=targets, quiet=quiet)
            pattern = replace(pattern, ending=envelopes)
        return pattern

    def with_transient_measures(self, question: Question, pattern: Pattern) -> Pattern:
        """Add contrast over the first 100 ms and residual vibration after the end.

        Onset and ending are the pattern's envelopes, or its ramp without any; the fingers are on
        the plate.
        """
        plate = self._table.in_time_under(question.contacts, question.loads)
        transients = Transients(plate)
        contrast = None
        if question.quiet:
            contrast = transients.contrast_db(
                self._onset(pattern), targets=question.targets, quiet=question.quiet
            )
        left = transients.residual_db(pattern.excitation, self._ending(pattern))
        return replace(pattern, transient_contrast_db=contrast, residual_db=left)

    def _onset(self, pattern: Pattern) -> Bases:
        if pattern.onset is None:
            return ramped_onset(pattern.excitation, self._eras, ramp=pattern.ramp)
        return shaped(pattern.onset, self._eras)

    def _ending(self, pattern: Pattern) -> Bases:
        if pattern.ending is None:
            return ramped_ending(pattern.excitation, self._eras, ramp=pattern.ramp)
        return shaped(pattern.ending, self._eras)


def _few_points(table: LocalizationTable, places: Sequence[Point]) -> tuple[FloatArray, FloatArray]:
    """Weights (k, p) of few points under fingertips, and their shapes (k, p, r)."""
    tips = read_fingertips(table, places)
    return tips.few_weights.astype(float), tips.few.astype(float)
