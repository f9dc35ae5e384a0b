"""Onset, ending and transient measures of layers."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import partial

from model.answer.answer import Answer, Layer
from model.answer.fingers import Placement
from model.arrays import FloatArray, Point
from model.table.table import LocalizationTable, read_fingertips
from model.transients.base_motion import ramped_ending, ramped_onset, shaped
from model.transients.measures import Transients
from model.transients.shaping import Shaper


class Timing:
    """Shapes and rates layers on the plate of a table in time.

    Takes about ten milliseconds to make, and one more at the first use of each frequency.
    """

    def __init__(self, table: LocalizationTable, *, shaper: Shaper | None = None) -> None:
        self._table, self._eras = table, table.eras
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
        self, layer: Layer, placement: Placement, *, onset: bool = True, ending: bool = True
    ) -> Layer:
        """Add a shaped onset and ending, or one of them; takes some milliseconds.

        Without other fingers the onset keeps the rest of the plate quiet. Envelopes are those of
        the plate without fingers: solved with them they would win 1 to 1.5 dB of the contrast over
        the first 100 ms, and take 6 ms longer.
        """
        targets, quiet, tones = placement.targets, placement.quiet, layer.excitation
        if onset:
            envelopes = self._shaper.onset(tones, targets=targets, quiet=quiet)
            layer = replace(layer, onset=envelopes)
        if ending:
            envelopes = self._shaper.ending(tones, targets=targets, quiet=quiet)
            layer = replace(layer, ending=envelopes)
        return layer

    def shaped(self, found: Answer) -> Answer:
        """Add onsets and endings to all layers of an answer that was asked for them."""
        layers = [self.with_envelopes(each, found.placement(each)) for each in found.layers]
        both = [(each.onset, each.ending) for each in layers]
        return replace(found, envelopes=tuple(both))

    def transient_contrast_db(self, layer: Layer, placement: Placement) -> float | None:
        """Contrast over the first 100 ms [dB], along the onset or the ramp; None without others.

        The fingers are on the plate.
        """
        if not placement.quiet:
            return None
        if layer.onset is None:
            onset = ramped_onset(layer.excitation, self._eras, ramp=layer.ramp)
        else:
            onset = shaped(layer.onset, self._eras)
        targets, quiet = placement.targets, placement.quiet
        return self._under(placement).contrast_db(onset, targets=targets, quiet=quiet)

    def residual_db(self, layer: Layer, placement: Placement) -> float:
        """Residual vibration in the 100 ms after the end, relative to the steady one [dB]."""
        if layer.ending is None:
            ending = ramped_ending(layer.excitation, self._eras, ramp=layer.ramp)
        else:
            ending = shaped(layer.ending, self._eras)
        return self._under(placement).residual_db(layer.excitation, ending)

    def _under(self, placement: Placement) -> Transients:
        return Transients(self._table.in_time_under(placement.contacts, placement.loads))


def _few_points(table: LocalizationTable, places: Sequence[Point]) -> tuple[FloatArray, FloatArray]:
    """Weights (k, p) of few points under fingertips, and their shapes (k, p, r)."""
    tips = read_fingertips(table, places)
    return tips.few_weights.astype(float), tips.few.astype(float)
