"""What one layer of all amplifiers of a rig is to play: routed, and shaped where possible.

Excitations [m, rad] become tones of channels by the wiring of the rig, and envelopes integers of
the wire; `sim/bench` translates back by the same wiring. An onset of fewer knots follows the same
curve in longer steps, which keeps quiet fingers quieter than a ramp does down to a single knot; an
ending is sent whole or not at all. The last value of an envelope, the pattern itself or silence, is
that of the command and not among the knots on the wire.
"""

import math
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np

from controller.play.capabilities import EnvelopeSupport
from controller.play.pieces import Piece
from drivers.playing.contents import Layer, Tone
from drivers.protocol.definition import QUANTITIES
from drivers.protocol.sets import Envelope, LayerSet
from model import vibration as physics
from model.answer import answer
from model.answer.answer import FADE_RAMP
from model.answer.answer_report import Timing
from model.answer.stimulus import Placement
from model.errors import InputError
from model.rig.rig import Rig
from model.transients.base_motion import BaseEnvelope, Envelopes

Drive = Mapping[str, Tone]
"""What ERAs play, by name, without silent ones."""

PlateLayer = Mapping[str, Layer]
"""What one layer plays on every amplifier, by name."""

BESIDE_CLICK = 0.100
"""Fade-out [s] beside a short pulse, below which a shorter one would be felt with it."""

_STEP, _LEVEL, _PHASE = (QUANTITIES[name] for name in ("envelope_step", "level", "phase"))
_FREQUENCY = QUANTITIES["frequency"]
_DIGITS = 6  # of a step of the wire


@dataclass(frozen=True)
class SetBuilder:
    """Builds the sets of one rig; timing: shapes patterns; ramp_max [s]: of all amplifiers."""

    rig: Rig
    support: EnvelopeSupport
    ramp_max: float
    timing: Timing

    def shape(
        self,
        placement: Placement,
        layer: answer.Layer,
        is_continued: bool,
        *,
        adds_ending: bool = True,
    ) -> answer.Layer:
        """Add the onset and the ending of a pattern, unless it has them; takes milliseconds.

        is_continued: whether it needs no onset; adds_ending: whether the ending is added, too.
        """
        has_onset = self.support.onset_knots > 0 and not is_continued
        has_ending = self.support.ending_knots > 0
        layer = replace(
            layer,
            onset=layer.onset if has_onset else None,
            ending=layer.ending if has_ending else None,
        )
        adds_onset = has_onset and layer.onset is None
        adds_ending = adds_ending and has_ending and layer.ending is None
        if not (adds_onset or adds_ending):
            return layer
        return self.timing.with_envelopes(layer, placement, onset=adds_onset, ending=adds_ending)

    def build_pattern(
        self,
        number: int,
        layer: answer.Layer,
        placement: Placement,
        *,
        playing: Drive,
        valid_for: float,
        is_led: bool = False,
        is_shaped: bool = True,
        among: int = 1,
    ) -> tuple[PlateLayer, answer.Layer]:
        """Build the set of a pattern in a layer; returns it and the pattern as it is played.

        playing: what each ERA plays now in this layer; a tone that continues needs no onset, nor
        does one that is led along its ramp, though an ERA joins it.
        valid_for [s]: for how long it plays unless it is renewed. is_shaped: whether it may have an
        onset; its ending follows (`build_ending`). among: layers that change at once, which share
        the time on the wires.
        """
        tones, ramp = layer.excitation, min(layer.ramp, self.ramp_max)
        onset = None
        restarted = restarted_by(tones, playing)
        if is_shaped:
            is_continued = is_led or not restarted.issuperset(
                [tone.frequency for tone in tones.values()]
            )
            onset = self.shape(placement, layer, is_continued, adds_ending=False).onset
            if onset:
                onset = thinned(onset, knots=max(1, self.support.onset_knots // among))
        layers = route(
            tones,
            self.rig,
            ramp=ramp,
            number=number,
            playing=playing,
            restarted=restarted,
            valid_for=valid_for,
            onset=onset,
        )
        ramp = next(iter(layers.values())).ramp
        return layers, replace(layer, ramp=ramp, onset=onset, ending=None)

    def build_ending(
        self,
        number: int,
        layer: answer.Layer,
        placement: Placement,
        *,
        playing: Drive,
        valid_for: float,
    ) -> tuple[PlateLayer, answer.Layer]:
        """Build the set that gives an ending to a pattern, which plays on as it is.

        playing: what each ERA plays now in this layer; valid_for [s]: as of a pattern.
        """
        layer = self.shape(placement, layer, is_continued=True)
        layers = route(
            layer.excitation,
            self.rig,
            ramp=layer.ramp,
            number=number,
            playing=playing,
            restarted=frozenset(),
            valid_for=valid_for,
            ending=layer.ending,
        )
        return layers, layer

    def build_piece(
        self,
        number: int,
        layer: answer.Layer,
        piece: Piece,
        *,
        playing: Drive,
        valid_for: float,
        is_after: bool,
    ) -> tuple[PlateLayer, answer.Layer]:
        """Build the set of a piece of a course in a layer; returns it and what is played.

        It leads there from wherever its tones are, is_after: when the piece before has ended.
        playing: as of a pattern; valid_for [s]: from its start on.
        """
        tones, ramp = layer.excitation, min(FADE_RAMP, self.ramp_max)
        onset: dict[str, BaseEnvelope] | None = None
        if piece.has_knots:
            onset = {}
            for name, tone in tones.items():
                knots = tuple([share * tone.phasor for share in piece.shares])
                onset[name] = BaseEnvelope(tone.frequency, 0.0, knots, piece.step)
        layers = route(
            {
                n: replace(tone, amplitude=piece.shares[-1] * tone.amplitude)
                for n, tone in tones.items()
            },
            self.rig,
            ramp=ramp if onset else min(piece.step, self.ramp_max),
            number=number,
            playing=playing,
            restarted=frozenset(),
            valid_for=valid_for,
            onset=onset,
        )
        ramp = next(iter(layers.values())).ramp
        after = {name: replace(each, after=is_after) for name, each in layers.items()}
        return after, replace(layer, ramp=ramp, onset=onset, ending=None)

    def build_renewal(self, number: int, *, ramp: float, valid_for: float) -> PlateLayer:
        """Build the set that prolongs a layer, which fades along its ramp [s], for a time [s]."""
        layer = Layer(number, ramp=ramp, valid_for=valid_for, renew=True)
        return dict.fromkeys(self.rig.amplifiers, layer)

    def build_fall(
        self, number: int, excitation: physics.Excitation, *, ramp: float, playing: Drive
    ) -> PlateLayer:
        """Build the set by which a layer falls along a ramp [s] to below any threshold, and ends.

        Not to silence, on the way to which no later set could end it sooner, as under a finger that
        lifts. playing: what each ERA plays now in this layer.
        """
        least = _LEVEL.from_wire(1)
        faint = {
            name: replace(tone, amplitude=least * self.rig.full_levels[name])
            for name, tone in excitation.items()
        }
        ramp = min(ramp, self.ramp_max)
        return route(
            faint,
            self.rig,
            ramp=ramp,
            number=number,
            playing=playing,
            restarted=frozenset(),
            valid_for=ramp,
        )

    def build_end(self, number: int, ramp: float, *, has_endings: bool) -> PlateLayer:
        """Build the set that ends a layer along its endings, or along a ramp [s]."""
        if has_endings:
            return dict.fromkeys(self.rig.amplifiers, Layer(number, ramp=ramp))
        return route({}, self.rig, ramp=ramp, number=number)


def route(
    excitation: physics.Excitation,
    rig: Rig,
    *,
    ramp: float,
    number: int = 0,
    playing: Drive | None = None,
    restarted: Set[float] | None = None,
    valid_for: float = 0.0,
    onset: Envelopes | None = None,
    ending: Envelopes | None = None,
) -> dict[str, Layer]:
    """Return the layer of a number for every amplifier of the rig, by name.

    Every wired channel has a tone: level = amplitude / stroke, phase in degrees within half a turn,
    level 0 for an ERA that is not driven. ramp [s]: lengthened to the rig's slew limit, on all
    amplifiers alike. playing: what each ERA plays now in this layer (`tones_by_era`); a frequency
    keeps its phase unless it is among those restarted: by default what not all its ERAs play yet.
    valid_for [s]: of the layers. onset, ending: by ERA; an onset may lead an ERA that is not driven
    to silence. All other limits belong to the ledgers of the amplifiers. Raises InputError for an
    ERA that the rig does not have.
    """
    unknown = sorted(excitation.keys() - rig.wiring.keys())
    if unknown:
        raise InputError(
            f"pattern must drive ERAs of the rig, got {', '.join(unknown)}; build a table for this "
            "rig"
        )
    before: Drive = playing or {}
    restarted = restarted_by(excitation, before) if restarted is None else restarted
    strokes = rig.full_levels
    onsets, endings = on_wire(strokes, onset, ending)
    wired: dict[str, list[Tone]] = {name: [] for name in rig.amplifiers}
    for name, channel in rig.wiring.items():
        driven, was, shape = excitation.get(name), before.get(name), onsets.get(name)
        if driven is None:
            # Falling silent while others play, it skips its ending, which belongs to all together.
            frequency = onset[name].frequency if onset and shape else rig.limits.frequency_min
            tone = Tone(channel.number, frequency, 0.0, 0.0, False, True, shape, endings.get(name))
        else:
            phase = driven.phase  # not finite it stays so, and the ledger refuses it
            if math.isfinite(phase):
                phase = math.degrees(math.remainder(phase, math.tau))
            tone = Tone(
                channel.number,
                driven.frequency,
                level=driven.amplitude / strokes[name],
                phase=phase,
                keep_phase=driven.frequency not in restarted,
                onset=shape,
                ending=endings.get(name),
            )
        wired[channel.amplifier].append(tone)
        rise = tone.level  # from rest, or through zero to another phase
        if was is not None and rise and was.frequency == tone.frequency:
            rise += was.level
        least = rise / rig.limits.slew
        ramp = least if least > ramp else ramp  # ledgers refuse NaN
    return {name: Layer(number, tuple(tones), ramp, valid_for) for name, tones in wired.items()}


def tones_by_era(
    played: Mapping[str, Sequence[LayerSet]], rig: Rig, number: int = 0
) -> dict[str, Tone]:
    """Return what each ERA plays in the layer of a number, by name; without silent ones."""
    playing = {
        (amplifier, command.channel): command
        for amplifier, layers in played.items()
        for one in layers
        for command in one.commands
        if one.layer == number and command.level > 0
    }
    return {
        name: Tone(
            channel.number,
            command.frequency / _FREQUENCY.per_unit,
            command.level / _LEVEL.per_unit,
            command.phase / _PHASE.per_unit,
        )
        for name, channel in rig.wiring.items()
        if (command := playing.get((channel.amplifier, channel.number))) is not None
    }


def full_drive(excitation: physics.Excitation, rig: Rig) -> dict[str, Tone]:
    """Return what each ERA plays of an excitation at the share 1 of its course, by name."""
    layers = route(excitation, rig, ramp=0.0)
    return {
        name: tone
        for name, channel in rig.wiring.items()
        for tone in layers[channel.amplifier].tones
        if tone.channel == channel.number and name in excitation
    }


def restarted_by(excitation: physics.Excitation, playing: Drive) -> set[float]:
    """Return the frequencies [Hz] that restart at the commit, because an ERA joins them.

    All ERAs of one frequency must count its phase from one moment, or their field differs. Without
    any, all tones continue what ERAs play now.
    """
    restarted = set()
    for name, tone in excitation.items():
        if name not in playing or playing[name].frequency != tone.frequency:
            restarted.add(tone.frequency)
    return restarted


def thinned(envelopes: Envelopes, *, knots: int) -> Envelopes:
    """Return envelopes by ERA with at most so many knots beside the last value.

    Over the same time, in whole steps of the wire; all have as many knots and the same step.
    """
    first = next(iter(envelopes.values()))
    count, steps = len(first.knots), knots + 1
    if count <= steps:
        return envelopes
    step = math.ceil(round(first.duration * _STEP.per_unit) / steps) / _STEP.per_unit
    at = np.minimum(step * np.arange(1, steps + 1), first.duration) / first.step
    since = np.minimum(at.astype(int), count - 1)
    values = np.array([(each.start, *each.knots) for each in envelopes.values()])
    between = values[:, since] + (values[:, since + 1] - values[:, since]) * (at - since)
    return {
        name: BaseEnvelope(each.frequency, each.start, tuple(row), step)
        for (name, each), row in zip(envelopes.items(), between.tolist(), strict=True)
    }


def on_wire(strokes: Mapping[str, float], *several: Envelopes | None) -> list[dict[str, Envelope]]:
    """Return envelopes in integers of the wire; strokes [m]: by ERA, as envelopes are."""
    motions: list[complex] = []
    units: list[float] = []
    for envelopes in several:
        for name, one in envelopes.items() if envelopes else ():
            motions += one.knots[:-1]
            units += [strokes[name]] * (len(one.knots) - 1)
    each = np.array(motions, dtype=complex) / units
    levels = np.rint(np.abs(each) * _LEVEL.per_unit).astype(int)
    phases = np.rint(np.degrees(np.angle(each)) * _PHASE.per_unit).astype(int)
    phases[phases > _PHASE.maximum] = _PHASE.minimum  # half a turn
    knots = zip(levels.tolist(), phases.tolist(), strict=True)
    found: list[dict[str, Envelope]] = []
    for envelopes in several:
        found.append({})
        for name, one in envelopes.items() if envelopes else ():
            step = math.ceil(round(one.step * _STEP.per_unit, _DIGITS))
            found[-1][name] = Envelope(step, tuple(islice(knots, len(one.knots) - 1)))
    return found
