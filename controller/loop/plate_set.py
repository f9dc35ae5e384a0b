"""What all amplifiers of a rig are to play: routed, and shaped where possible."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from controller.loop.envelopes import EnvelopeSupport, duration_of, thinned
from controller.loop.routing import LAYER, Drive, continues_any_tone, route, shaped
from drivers.contents import Layer
from model.rig.rig import Rig
from model.table.pattern import Pattern
from model.table.question import Question
from model.table.timing import Timing
from model.transients.base_motion import KNOT_STEP
from model.transients.knots import ONSET_KNOTS

FADE_RAMP = 0.020
"""Fade-out [s] under fingers that stay on the plate; a shorter one would feel like a tap."""


@dataclass(frozen=True)
class PlateSet:
    """The layer of every amplifier, by name; without layers all fall silent along `ramp` [s].

    plain: the same along its ramp, where an amplifier's ledger refuses its onset or ending; None
    without either.
    """

    layers: Mapping[str, Layer] = field(default_factory=dict)
    ramp: float = FADE_RAMP
    plain: "PlateSet | None" = None

    @property
    def is_silence(self) -> bool:
        """Whether all channels fall silent along the ramp, without endings."""
        return not self.layers

    @property
    def has_endings(self) -> bool:
        """Whether it ends along shaped endings."""
        return any(tone.ending for layer in self.layers.values() for tone in layer.tones)

    @property
    def settled_after(self) -> float:
        """Time [s] after the commit when the last fade or onset has ended."""
        tones = [tone for layer in self.layers.values() for tone in layer.tones]
        return max([self.ramp, *(duration_of(tone.onset) for tone in tones)])


class SetBuilder:
    """Builds the sets of one rig.

    timing: shapes patterns; None for ramps only. ramp_max [s]: of all amplifiers.
    """

    def __init__(
        self, rig: Rig, *, support: EnvelopeSupport, ramp_max: float, timing: Timing | None
    ) -> None:
        self._rig = rig
        self._support = support
        self._ramp_max = ramp_max
        self._timing = timing

    def replace(self, timing: Timing | None) -> None:
        """Shape by another timing from now on."""
        self._timing = timing

    def build_pattern(
        self,
        pattern: Pattern,
        question: Question,
        *,
        playing: Drive,
        valid_for: float,
        is_shaped: bool = True,
        lasts: float = math.inf,
    ) -> tuple[PlateSet, Pattern]:
        """Build the set of a pattern; returns it and the pattern as it is played.

        playing: what each ERA plays now; a tone that continues needs no onset. valid_for [s]: for
        how long it plays unless it is renewed. is_shaped: whether it may have an onset and an
        ending, which it has only if its first pulse lasts [s] until the onset is over.
        """
        ramp = min(pattern.ramp, self._ramp_max)
        layers = route(
            pattern.excitation, self._rig, ramp=ramp, playing=playing, valid_for=valid_for
        )
        ramp = max(layer.ramp for layer in layers.values())
        pattern = replace(pattern, ramp=ramp, onset=None, ending=None)
        plain = PlateSet(layers, ramp)
        has_onset = self._support.onset_knots > 0
        has_onset = has_onset and not continues_any_tone(pattern.excitation, playing)
        has_ending = self._support.ending_knots > 0 and lasts > KNOT_STEP * ONSET_KNOTS
        if self._timing is None or not is_shaped or not (has_onset or has_ending):
            return plain, pattern
        pattern = self._timing.with_envelopes(question, pattern, onset=has_onset, ending=has_ending)
        if pattern.onset:
            onset = thinned(pattern.onset, knots=self._support.onset_knots)
            pattern = replace(pattern, onset=onset)
        layers = shaped(layers, self._rig, onset=pattern.onset, ending=pattern.ending)
        return PlateSet(layers, ramp, plain), pattern

    def build_renewal(self, playing: PlateSet, *, valid_for: float) -> PlateSet:
        """Build the set that prolongs another for a time [s]."""
        layers = {
            name: Layer(LAYER, ramp=layer.ramp, valid_for=valid_for, renew=True)
            for name, layer in playing.layers.items()
        }
        return PlateSet(layers, playing.ramp)

    def build_end(self) -> PlateSet:
        """Build the set that ends every ERA along its ending."""
        ramp = min(FADE_RAMP, self._ramp_max)
        return PlateSet({name: Layer(LAYER, ramp=ramp) for name in self._rig.amplifiers}, ramp)
