"""Playback on the amplifiers of a rig: their joint capabilities, and the sets for each layer.

The capabilities of the open amplifiers are given in the terms of the table. A set includes its
onset, so a touch waits for that; its ending follows in a separate set, which takes no longer. The
number of knots that the wires carry in time is computed once, when the amplifiers are opened. The
assumed clock errors are updated if a clock is worse than assumed, or all are far better.

An envelope of a continuous effect is played in pieces. An amplifier plays a piece along straight
lines between its knots, and holds a second piece that waits for the end of the first. So pieces
follow each other without a gap if the host is late by at most half a piece. The first piece is
short, because a touch waits for it.

Excitations [m, rad] become tones of channels by the wiring of the rig, and envelopes integers of
the wire; `sim/bench` translates back by the same wiring. An onset of fewer knots follows the same
curve in longer steps, which keeps quiet fingers quieter than a ramp does down to a single knot; an
ending is sent whole or not at all. The last value of an envelope, the pattern itself or silence,
is in the command and not among the knots on the wire.
"""

import logging
import math
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from itertools import islice
from typing import Self

import numpy as np

from controller.play.intent import Pulse
from drivers.host.amplifier import Amplifier
from drivers.host.line import Line
from drivers.playing import AmplifierLayer, AmplifierTone
from drivers.protocol.definition import MAX_WORDS, QUANTITIES
from drivers.protocol.sets import Envelope, LayerSet
from model import vibration as physics
from model.answer import answer, stimulus
from model.answer.answer import Limits, amplitudes_of
from model.answer.answer_report import Timing
from model.answer.stimulus import Course, Placement
from model.drive_modes import DRIVE_MODES, playable_drive_modes
from model.ensemble.draws import EXACT_CLOCKS, MAX_HELD, ClockErrors
from model.errors import InputError
from model.rig.rig import Rig
from model.table.table import LocalizationTable
from model.transients import base_motion
from model.transients.base_motion import BaseEnvelope, Envelopes
from model.transients.knots import ENDING_KNOTS, ONSET_KNOTS
from registry import threads

MAX_SET_TIME = 0.010
"""Longest time [s] of a set on its wire, so that its onset does not delay a touch."""

MAX_PIECE_TIME = 0.020
"""Longest time [s] of a set that continues an envelope; a touch may have to wait for it."""

BESIDE_CLICK = 0.100
"""Fade-out [s] next to a short pulse; a shorter one would be felt with the pulse."""

PLAIN_STEP = 0.050
"""Time [s] of each ramp, and set, that replaces knots on amplifiers without them."""

HELD = 0.1
"""Time [s] after its last piece at which a layer ends on its own."""

_FIRST, _NEXT, _SHORTEST = 0.16, 0.32, 0.12  # s; of pieces; the last is used with few knots
_AMID = 0.020  # s; between knots of a first piece that leads there from something else

MAX_STEP = _SHORTEST / 2
"""Time [s] between the knots of an envelope with one knot."""

MARGIN = 1.25
"""Safety factor of the assumed clock errors."""

SETTLED = 10.0
"""Time [s] that a clock is synchronised before this is logged, with the number of losses."""

_FAR_BETTER = 2.0  # ratio to the assumed error

_FREQUENCY, _LEVEL, _PHASE = (QUANTITIES[name] for name in ("frequency", "level", "phase"))
_RAMP, _STEP = QUANTITIES["ramp"], QUANTITIES["envelope_step"]
_PHASE_STEP = QUANTITIES["phase_step"]
_LAYER_WORDS, _COMMAND_WORDS, _ENVELOPE_WORDS, _KNOT_WORDS = 3, 4, 2, 2
_PART_WORDS = 3  # words of a message: session, token, part
_DIGITS = 6  # decimals of a step on the wire
_ROUNDING = 1e-9  # s

Drive = Mapping[str, AmplifierTone]
"""Tones by ERA, without silent ones."""

PlateLayer = Mapping[str, AmplifierLayer]
"""Contents of one layer on all amplifiers, by amplifier name."""

_logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class EnvelopeSupport:
    """Envelopes supported by every channel."""

    onset_knots: int
    """Knots of an onset; 0: ramps."""
    ending_knots: int = 0
    """Knots of an ending; 0: ramps."""

    def shape(
        self,
        timing: Timing,
        placement: Placement,
        layer: answer.Layer,
        is_continued: bool,
        *,
        adds_ending: bool = True,
    ) -> answer.Layer:
        """Add the onset and the ending of a pattern, unless it has them; takes milliseconds.

        timing: shapes it; is_continued: whether it needs no onset; adds_ending: whether the ending
        is added, too.
        """
        has_onset = self.onset_knots > 0 and not is_continued
        has_ending = self.ending_knots > 0
        layer = replace(
            layer,
            onset=layer.onset if has_onset else None,
            ending=layer.ending if has_ending else None,
        )
        adds_onset = has_onset and layer.onset is None
        adds_ending = adds_ending and has_ending and layer.ending is None
        if not (adds_onset or adds_ending):
            return layer
        return timing.with_envelopes(layer, placement, onset=adds_onset, ending=adds_ending)


RAMPS_ONLY = EnvelopeSupport(0)


@dataclass(frozen=True)
class PlaybackCapabilities:
    """Capabilities that all amplifiers of a rig share."""

    drive_mode: str
    """Of the questions to the table."""
    playable: tuple[str, ...]
    """Drive modes that every amplifier can play."""
    limits: Limits
    """Of a drive."""
    envelope_support: EnvelopeSupport
    ramp_max: float = math.inf
    """Longest ramp [s]."""
    layers: int = 1
    """Maximum number of simultaneous contents."""
    course_knots: int = 0
    """Knots of a piece of an envelope; 0: ramps."""

    def left_by(self, layers: Sequence[answer.Layer], table: LocalizationTable) -> Self:
        """Return the capabilities with the limits that remain if all layers peak simultaneously."""
        drives = [each for layer in layers for each in layer.drives]
        taken, strokes = amplitudes_of([each for each, _ in drives]), table.full_levels
        levels = [amplitude / strokes[name] for name, amplitude in taken.items()]
        limits = self.limits
        left = replace(
            limits,
            amplitudes={
                name: max(highest - taken.get(name, 0.0), 1e-12)
                for name, highest in (limits.amplitudes or strokes).items()
            },
            power=max(math.sqrt(limits.power) - math.hypot(*levels), 1e-9) ** 2,
            excursion=max(limits.excursion - table.excursion_of(drives), 1e-9),
        )
        return replace(self, limits=left)


def playback_capabilities(
    rig: Rig, amplifiers: Mapping[str, Amplifier], *, drive_mode: str | None = None
) -> PlaybackCapabilities:
    """Return the capabilities of the open amplifiers of a rig, by name.

    drive_mode: None for the best that all can. Raises InputError for a drive mode that one cannot
    play, or a wired channel that its amplifier does not have.
    """
    for era, wired in rig.wiring.items():
        channels = amplifiers[wired.amplifier].ledger.capabilities["channels"]
        if wired.number >= channels:
            raise InputError(
                f"channel of ERA {era} must be 0 to {channels - 1} on amplifier "
                f"{wired.amplifier}, got {wired.number}; change its wiring in the rig file"
            )
    each = [
        playable_drive_modes(
            level_step=_LEVEL.from_wire(one.ledger.capabilities["level_step"]),
            phase_step=_PHASE_STEP.from_wire(one.ledger.capabilities["phase_step"]),
        )
        for one in amplifiers.values()
    ]
    playable = tuple(name for name in DRIVE_MODES if all(name in modes for modes in each))
    if drive_mode is not None and drive_mode not in playable:
        raise InputError(
            f"drive mode must be supported by all amplifiers ({', '.join(playable)}), got "
            f"{drive_mode}; leave it out for the best mode"
        )
    return PlaybackCapabilities(
        drive_mode=drive_mode or playable[-1],
        playable=playable,
        limits=limits_of(rig, amplifiers),
        envelope_support=envelope_support(rig, amplifiers),
        ramp_max=min(
            _RAMP.from_wire(one.ledger.capabilities["ramp_max"]) for one in amplifiers.values()
        ),
        layers=min(one.ledger.capabilities["layers"] for one in amplifiers.values()),
        course_knots=_knots(rig, amplifiers, within=MAX_PIECE_TIME, step=MAX_STEP),
    )


def limits_of(rig: Rig, amplifiers: Mapping[str, Amplifier]) -> Limits:
    """Return the limits of a rig's amplifiers by name, as last identified."""
    limits = {name: one.ledger.limits for name, one in amplifiers.items()}
    levels = {name: _LEVEL.from_wire(one.level) for name, one in limits.items()}
    return Limits(
        (
            max(_FREQUENCY.from_wire(one.frequency_min) for one in limits.values()),
            min(_FREQUENCY.from_wire(one.frequency_max) for one in limits.values()),
        ),
        {era.name: era.full_level * levels[rig.wiring[era.name].amplifier] for era in rig.eras},
        power=min(one.power for one in limits.values()),
        slew=min(one.slew for one in limits.values()),
    )


def envelope_support(rig: Rig, amplifiers: Mapping[str, Amplifier]) -> EnvelopeSupport:
    """Return the envelopes that all open amplifiers play and their wires carry within 10 ms."""
    knots, onset, ending = _knots(rig, amplifiers), ONSET_KNOTS - 1, ENDING_KNOTS - 1
    return EnvelopeSupport(min(knots, onset), ending if knots >= ending else 0)


def _knots(
    rig: Rig,
    amplifiers: Mapping[str, Amplifier],
    *,
    within: float = MAX_SET_TIME,
    step: float = base_motion.KNOT_STEP,
) -> int:
    """Return the number of knots that all open amplifiers and wires support within a time [s].

    step: longest time [s] between two knots.
    """
    wired: dict[str, int] = defaultdict(int)
    for channel in rig.wiring.values():
        wired[channel.amplifier] += 1
    by_line: dict[Line, list[str]] = defaultdict(list)
    for name in wired:
        by_line[amplifiers[name].line].append(name)
    carried = [
        _knots_on(line, [wired[name] for name in names], within) for line, names in by_line.items()
    ]
    carried += [
        _knots_in(amplifiers[name].ledger.capabilities["set_words"], [count])
        for name, count in wired.items()
    ]
    each = min([_knots_of(amplifiers[name], step) for name in wired], default=0)
    return min(max(min(carried, default=0), 0), each)


def _knots_of(amplifier: Amplifier, max_step: float) -> int:
    """Return the maximum number of knots in an amplifier's envelope; 0 without the required steps.

    The required steps range from the model's step to max_step [s].
    """
    capabilities = amplifier.ledger.capabilities
    low, high = (_STEP.from_wire(capabilities[f"envelope_step_{end}"]) for end in ("min", "max"))
    return int(capabilities["knots"]) if low <= base_motion.KNOT_STEP <= max_step <= high else 0


def _knots_on(line: Line, channels: list[int], within: float) -> int:
    """Return the number of knots per channel that a line carries within a time [s].

    channels: number of channels of each of its amplifiers; each amplifier gets a set.
    """
    takes = line.wire.transit(MAX_WORDS)
    if takes <= 0:
        return int(QUANTITIES["knots"].maximum)
    return _knots_in(int(MAX_WORDS * within / takes), channels)


def _knots_in(words: int, channels: list[int]) -> int:
    """Return the number of knots per channel that fit into a number of words."""
    parts = -(-words // MAX_WORDS)
    heads = len(channels) * _LAYER_WORDS + max(parts, len(channels)) * _PART_WORDS
    each = _COMMAND_WORDS + _ENVELOPE_WORDS
    return int((words - heads - sum(channels) * each) // (_KNOT_WORDS * sum(channels)))


class CountedClocks:
    """Clock errors of a rig's amplifiers as answers count them, so that promises hold.

    now: returns the error of each amplifier by name, rms [s], infinite if it is unknown.
    """

    def __init__(self, rig: Rig, now: Callable[[], Mapping[str, float]]) -> None:
        self._rig, self._now = rig, now
        self._names = sorted(rig.channel_counts)
        self._counted = EXACT_CLOCKS
        self._losses = dict.fromkeys(self._names, 0)  # since last logged as synchronised
        self._held_since: dict[str, float] = {}  # not logged yet
        self.errors: dict[str, float] = {}
        """Assumed RMS errors [s] by name; empty if all ERAs are on one amplifier."""

    @property
    def known(self) -> Mapping[str, float]:
        """Current RMS errors [s] by name; empty if none are assumed."""
        return self._now() if self.errors else {}

    def counted_by(
        self, table: LocalizationTable, known: Mapping[str, float] | None = None
    ) -> LocalizationTable:
        """Return the table with the currently assumed clock errors; takes no time.

        known: the current errors, if already read.
        """
        if len(self._names) < 2:
            return table
        known = known or self._now()
        if self._is_other(known):
            before, errors = self.errors, {name: MARGIN * known[name] for name in self._names}
            eras = [era.name for era in table.eras]
            self._counted = ClockErrors.of(eras, self._rig.wiring, errors)
            self.errors = errors
            self._note(before)
        for name in [*self._held_since]:  # mostly none
            if threads.now() - self._held_since[name] >= SETTLED:
                _logger.info(
                    "amplifier %s: clock held to %.0f us for %.0f s, its ERAs play with the "
                    "others'; losses before: %d",
                    name,
                    1e6 * self.errors[name],
                    SETTLED,
                    self._losses[name],
                )
                self._losses[name] = 0
                del self._held_since[name]
        return table.with_clocks(self._counted)

    def is_one_lost(self, known: Mapping[str, float]) -> bool:
        """Whether a clock is no longer held to those with which its amplifier shares contents.

        known: the present errors.
        """
        for name, counted in self.errors.items():  # with each plan: no further calls
            if known[name] > counted and MARGIN * known[name] > MAX_HELD >= counted:
                return True
        return False

    def _is_other(self, known: Mapping[str, float]) -> bool:
        """Whether a clock is worse than counted, or far better."""
        for name, counted in self.errors.items():  # as often
            if known[name] > counted or known[name] * MARGIN * _FAR_BETTER < counted:
                return True
        return not self.errors

    def _note(self, before: Mapping[str, float]) -> None:
        """Count losses; log once which amplifiers play contents of their own from now on.

        That is no warning when a line has just been opened, since no clock is known then.
        """
        level = logging.WARNING if before else logging.INFO
        for name, error in self.errors.items():
            was_alone = before.get(name, 0.0) > MAX_HELD
            if error <= MAX_HELD:
                if was_alone:
                    self._held_since[name] = threads.now()
            elif not was_alone:
                self._held_since.pop(name, None)
                if not self._losses[name]:
                    _logger.log(
                        level,
                        "amplifier %s: its clock is not held to the others', so its ERAs play "
                        "contents of their own; if that lasts, see its clock_error in era amp "
                        "status",
                        name,
                    )
                self._losses[name] += 1


def piece_of(
    course: Course, pulse: Pulse, since: float, *, knots: int, is_first: bool
) -> tuple[float, list[float]]:
    """Return the piece of a course that is played from a time [s] after the start of its pulse on.

    A piece is a step [s] and values, the first a step after its start; a single value is a ramp.
    The envelope repeats until the pulse ends, at 0. knots: maximum of an envelope, 0 for ramps;
    is_first: whether the piece is the first of its layer.
    """
    if not knots:
        step, count = PLAIN_STEP, 1
    else:
        least = _AMID if is_first and since > 0 else stimulus.COURSE_KNOT_STEP
        count = min(knots + 1, round((_FIRST if is_first else _NEXT) / least))
        step = max(least, _SHORTEST / count)
        left = min((pulse.duration - since) / step, count)
        count = max(math.ceil(left - _ROUNDING), 2)
    times = since + step * np.arange(1, count + 1)
    shares = np.asarray(course.at(np.mod(times, course.duration)))
    shares[times > pulse.duration - _ROUNDING] = 0.0
    return step, shares.tolist()


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
) -> dict[str, AmplifierLayer]:
    """Return the layer of a number for every amplifier of the rig, by name.

    Every wired channel has a tone: level = amplitude / stroke, phase in degrees within half a turn,
    level 0 for an ERA that is not driven. ramp [s]: lengthened to the rig's slew limit, on all
    amplifiers alike. playing: tones in this layer now, by ERA (`tones_by_era`). restarted:
    frequencies that do not keep their phase; by default, frequencies not yet played by all their
    ERAs. valid_for [s]: of the layers. onset, ending: by ERA; an onset can lead an undriven ERA to
    silence. The ledgers of the amplifiers check all other limits. Raises InputError for an unknown
    ERA.
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
    wired: dict[str, list[AmplifierTone]] = {name: [] for name in rig.amplifiers}
    for name, channel in rig.wiring.items():
        driven, was, shape = excitation.get(name), before.get(name), onsets.get(name)
        if driven is None:
            # Falling silent while others play, it skips its ending, which belongs to all together.
            frequency = onset[name].frequency if onset and shape else rig.limits.frequency_min
            tone = AmplifierTone(
                channel.number, frequency, 0.0, 0.0, False, True, shape, endings.get(name)
            )
        else:
            phase = driven.phase  # not finite it stays so, and the ledger refuses it
            if math.isfinite(phase):
                phase = math.degrees(math.remainder(phase, math.tau))
            tone = AmplifierTone(
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
    return {
        name: AmplifierLayer(number, tuple(tones), ramp, valid_for) for name, tones in wired.items()
    }


def restarted_by(excitation: physics.Excitation, playing: Drive) -> set[float]:
    """Return the frequencies [Hz] that restart at the commit because an ERA joins them.

    All ERAs of one frequency must count its phase from the same moment, or their field changes.
    """
    return {
        tone.frequency
        for name, tone in excitation.items()
        if name not in playing or playing[name].frequency != tone.frequency
    }


def thinned(envelopes: Envelopes, *, knots: int) -> Envelopes:
    """Return envelopes, by ERA, with a limited number of knots before the last value.

    They take the same time, in whole steps of the wire, with equal step and number of knots.
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


def tones_by_era(
    played: Mapping[str, Sequence[LayerSet]], rig: Rig, number: int = 0
) -> dict[str, AmplifierTone]:
    """Return the tones of a layer, by ERA; without silent ones."""
    playing = {
        (amplifier, command.channel): command
        for amplifier, layers in played.items()
        for one in layers
        for command in one.commands
        if one.layer == number and command.level > 0
    }
    return {
        name: AmplifierTone(
            channel.number,
            command.frequency / _FREQUENCY.per_unit,
            command.level / _LEVEL.per_unit,
            command.phase / _PHASE.per_unit,
        )
        for name, channel in rig.wiring.items()
        if (command := playing.get((channel.amplifier, channel.number))) is not None
    }


def full_drive(excitation: physics.Excitation, rig: Rig) -> dict[str, AmplifierTone]:
    """Return the tones of an excitation at the share 1 of its course, by ERA."""
    layers = route(excitation, rig, ramp=0.0)
    return {
        name: tone
        for name, channel in rig.wiring.items()
        for tone in layers[channel.amplifier].tones
        if tone.channel == channel.number and name in excitation
    }
