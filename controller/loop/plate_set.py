"""What one layer of all amplifiers of a rig is to play: routed, and shaped where possible."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

from controller.loop.envelopes import EnvelopeSupport, thinned
from controller.loop.routing import Drive, restarted_by, route
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
    """What one layer plays on every amplifier, by name.

    settled_after [s]: from the commit until the last fade or onset has ended; has_endings: whether
    it ends along shaped endings; is_shaped: whether it has any envelope, or leads along one.
    """

    layers: Mapping[str, Layer]
    settled_after: float
    has_endings: bool = False
    is_shaped: bool = False


@dataclass(frozen=True)
class SetBuilder:
    """Builds the sets of one rig.

    timing: shapes patterns; None for ramps only. ramp_max [s]: of all amplifiers.
    """

    rig: Rig
    support: EnvelopeSupport
    ramp_max: float
    timing: Timing | None

    def shape(
        self,
        question: Question,
        pattern: Pattern,
        is_continued: bool,
        *,
        is_ended: bool = True,
    ) -> Pattern:
        """Add the onset and the ending of a pattern, unless it has them; takes milliseconds.

        is_continued: whether it needs no onset; is_ended: whether it may have an ending.
        """
        has_onset = self.support.onset_knots > 0 and not is_continued
        has_ending = self.support.ending_knots > 0 and is_ended
        pattern = replace(
            pattern,
            onset=pattern.onset if has_onset else None,
            ending=pattern.ending if has_ending else None,
        )
        adds_onset = has_onset and pattern.onset is None
        adds_ending = has_ending and pattern.ending is None
        if self.timing is None or not (adds_onset or adds_ending):
            return pattern
        return self.timing.with_envelopes(question, pattern, onset=adds_onset, ending=adds_ending)

    def build_pattern(
        self,
        number: int,
        pattern: Pattern,
        question: Question,
        *,
        playing: Drive,
        valid_for: float,
        restarts: bool = False,
        is_shaped: bool = True,
        lasts: float = math.inf,
        among: int = 1,
    ) -> tuple[PlateSet, Pattern]:
        """Build the set of a pattern in a layer; returns it and the pattern as it is played.

        playing: what each ERA plays now in this layer; a tone that continues needs no onset, unless
        it restarts.
        valid_for [s]: for how long it plays unless it is renewed. is_shaped: whether it may have an
        onset and an ending, which it has only if its first pulse lasts [s] until the onset is over.
        among: layers that change at once, which share the time on the wires.
        """
        tones, ramp = pattern.excitation, min(pattern.ramp, self.ramp_max)
        onset = ending = None
        if is_shaped:
            restarted = restarted_by(tones, {} if restarts else playing)
            is_continued = not restarted.issuperset([tone.frequency for tone in tones.values()])
            is_ended = lasts > KNOT_STEP * ONSET_KNOTS
            pattern = self.shape(question, pattern, is_continued, is_ended=is_ended)
            onset, ending = pattern.onset, pattern.ending
            if onset:
                onset = thinned(onset, knots=max(1, self.support.onset_knots // among))
        layers = route(
            tones,
            self.rig,
            ramp=ramp,
            number=number,
            playing=playing,
            restarts=restarts,
            valid_for=valid_for,
            onset=onset,
            ending=ending,
        )
        ramp = next(iter(layers.values())).ramp
        pattern = replace(pattern, ramp=ramp, onset=onset, ending=ending)
        settled = max(ramp, next(iter(onset.values())).duration) if onset else ramp
        return PlateSet(layers, settled, bool(ending), bool(onset or ending)), pattern

    def plain(self, shaped: PlateSet) -> PlateSet:
        """Build a set along its ramp, where an amplifier's ledger refuses its envelopes."""
        layers: dict[str, Layer] = {}
        for name, layer in shaped.layers.items():
            if not layer.tones:
                return self.build_end(layer.number, has_endings=False)
            tones = [replace(tone, onset=None, ending=None) for tone in layer.tones]
            layers[name] = replace(layer, tones=tuple(tones))
        return PlateSet(layers, layer.ramp)

    def build_renewal(self, playing: PlateSet, *, valid_for: float) -> PlateSet:
        """Build the set that prolongs another for a time [s]."""
        layers = {
            name: Layer(layer.number, ramp=layer.ramp, valid_for=valid_for, renew=True)
            for name, layer in playing.layers.items()
        }
        return PlateSet(layers, playing.settled_after)

    def build_end(self, number: int, *, has_endings: bool) -> PlateSet:
        """Build the set that ends a layer along its endings, or along a ramp."""
        ramp = min(FADE_RAMP, self.ramp_max)
        if not has_endings:
            return PlateSet(route({}, self.rig, ramp=ramp, number=number), ramp)
        layers = {name: Layer(number, ramp=ramp) for name in self.rig.amplifiers}
        return PlateSet(layers, ramp, is_shaped=True)
