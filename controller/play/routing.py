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
from drivers.protocol.sets import Command, Envelope, LayerSet
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
from model.transients.excursions import Swing
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

_FIRST_PIECE = 0.16  # s
_NEXT_PIECE = 0.32  # s
_SHORTEST_PIECE = 0.12  # s; used with few knots
_JOINING_STEP = 0.020  # s; between knots of a first piece that starts within its course

MAX_STEP = _SHORTEST_PIECE / 2
"""Time [s] between the knots of an envelope with one knot."""

MARGIN = 1.25
"""Safety factor of the assumed clock errors."""

SETTLED = 10.0
"""Time [s] that a clock is synchronized before this is logged, with the number of losses."""

_FAR_BETTER = 2.0  # ratio to the assumed error

_MIN_AMPLITUDE = 1e-12  # m; left to an ERA that is fully used
_MIN_SHARE = 1e-9  # of power or excursion; left if it is fully used

_FREQUENCY = QUANTITIES["frequency"]
_LEVEL = QUANTITIES["level"]
_PHASE = QUANTITIES["phase"]
_RAMP = QUANTITIES["ramp"]
_STEP = QUANTITIES["envelope_step"]
_PHASE_STEP = QUANTITIES["phase_step"]
_LAYER_WORDS = 3
_COMMAND_WORDS = 4
_ENVELOPE_WORDS = 2
_KNOT_WORDS = 2
_PART_WORDS = 3  # words of a message: session, token, part
_DIGITS = 6  # decimals of a step on the wire
_ROUNDING = 1e-9  # s

Drive = Mapping[str, AmplifierTone]
"""Tones by ERA, without silent ones."""

PlateLayer = Mapping[str, AmplifierLayer]
"""A layer on all amplifiers, by amplifier name."""

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
        limits = self.limits
        full_levels = table.full_levels
        drives = list[tuple[physics.Excitation, Sequence[Swing]]]()
        for layer in layers:
            drives += layer.drives
        used_amplitudes = amplitudes_of([excitation for excitation, _ in drives])
        levels = [amplitude / full_levels[name] for name, amplitude in used_amplitudes.items()]
        amplitudes = dict[str, float]()
        for name, highest in (limits.amplitudes or full_levels).items():
            amplitudes[name] = max(highest - used_amplitudes.get(name, 0.0), _MIN_AMPLITUDE)
        power = max(math.sqrt(limits.power) - math.hypot(*levels), _MIN_SHARE) ** 2
        excursion = max(limits.excursion - table.excursion_of(drives), _MIN_SHARE)
        spare = replace(limits, amplitudes=amplitudes, power=power, excursion=excursion)
        return replace(self, limits=spare)


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
    playable = _playable_by_all(amplifiers)
    if drive_mode is not None and drive_mode not in playable:
        raise InputError(
            f"drive mode must be supported by all amplifiers ({', '.join(playable)}), got "
            f"{drive_mode}; leave it out for the best mode"
        )
    capabilities = [amplifier.ledger.capabilities for amplifier in amplifiers.values()]
    return PlaybackCapabilities(
        drive_mode=drive_mode or playable[-1],
        playable=playable,
        limits=limits_of(rig, amplifiers),
        envelope_support=envelope_support(rig, amplifiers),
        ramp_max=min([_RAMP.from_wire(values["ramp_max"]) for values in capabilities]),
        layers=min([values["layers"] for values in capabilities]),
        course_knots=_knots(rig, amplifiers, within=MAX_PIECE_TIME, step=MAX_STEP),
    )


def _playable_by_all(amplifiers: Mapping[str, Amplifier]) -> tuple[str, ...]:
    """Return the drive modes that every amplifier can play."""
    playable = list(DRIVE_MODES)
    for amplifier in amplifiers.values():
        capabilities = amplifier.ledger.capabilities
        modes = playable_drive_modes(
            level_step=_LEVEL.from_wire(capabilities["level_step"]),
            phase_step=_PHASE_STEP.from_wire(capabilities["phase_step"]),
        )
        playable = [name for name in playable if name in modes]
    return tuple(playable)


def limits_of(rig: Rig, amplifiers: Mapping[str, Amplifier]) -> Limits:
    """Return the limits of a rig's amplifiers by name, as last identified."""
    limits = {name: amplifier.ledger.limits for name, amplifier in amplifiers.items()}
    lowest = max([_FREQUENCY.from_wire(values.frequency_min) for values in limits.values()])
    highest = min([_FREQUENCY.from_wire(values.frequency_max) for values in limits.values()])
    amplitudes = dict[str, float]()
    for era in rig.eras:
        amplifier_name = rig.wiring[era.name].amplifier
        level = _LEVEL.from_wire(limits[amplifier_name].level)
        amplitudes[era.name] = era.full_level * level
    return Limits(
        (lowest, highest),
        amplitudes,
        power=min([values.power for values in limits.values()]),
        slew=min([values.slew for values in limits.values()]),
    )


def envelope_support(rig: Rig, amplifiers: Mapping[str, Amplifier]) -> EnvelopeSupport:
    """Return the envelopes that all open amplifiers play and their wires carry within 10 ms."""
    knots = _knots(rig, amplifiers)
    onset_knots = min(knots, ONSET_KNOTS - 1)
    ending_knots = ENDING_KNOTS - 1
    return EnvelopeSupport(onset_knots, ending_knots if knots >= ending_knots else 0)


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
    channel_counts = defaultdict[str, int](int)
    for channel in rig.wiring.values():
        channel_counts[channel.amplifier] += 1
    if not channel_counts:
        return 0
    supported = list[int]()
    counts_by_line = defaultdict[Line, list[int]](list)
    for name, channel_count in channel_counts.items():
        amplifier = amplifiers[name]
        counts_by_line[amplifier.line].append(channel_count)
        supported.append(_knots_of(amplifier, step))
        supported.append(_knots_in(amplifier.ledger.capabilities["set_words"], [channel_count]))
    for line, line_counts in counts_by_line.items():
        supported.append(_knots_on(line, line_counts, within))
    return max(min(supported), 0)


def _knots_of(amplifier: Amplifier, max_step: float) -> int:
    """Return the maximum number of knots in an amplifier's envelope; 0 without the required steps.

    The required steps range from the model's step to max_step [s].
    """
    capabilities = amplifier.ledger.capabilities
    shortest = _STEP.from_wire(capabilities["envelope_step_min"])
    max_step_allowed = _STEP.from_wire(capabilities["envelope_step_max"])
    has_steps = shortest <= base_motion.KNOT_STEP <= max_step <= max_step_allowed
    return int(capabilities["knots"]) if has_steps else 0


def _knots_on(line: Line, channels: list[int], within: float) -> int:
    """Return the number of knots per channel that a line carries within a time [s].

    channels: number of channels of each of its amplifiers; each amplifier gets a set.
    """
    message_time = line.wire.transit(MAX_WORDS)
    if message_time <= 0:
        return int(QUANTITIES["knots"].maximum)
    return _knots_in(int(MAX_WORDS * within / message_time), channels)


def _knots_in(words: int, channels: list[int]) -> int:
    """Return the number of knots per channel that fit into a number of words."""
    amplifier_count = len(channels)
    channel_count = sum(channels)
    part_count = max(-(-words // MAX_WORDS), amplifier_count)
    head_words = amplifier_count * _LAYER_WORDS + part_count * _PART_WORDS
    channel_words = channel_count * (_COMMAND_WORDS + _ENVELOPE_WORDS)
    knot_words = words - head_words - channel_words
    return int(knot_words // (_KNOT_WORDS * channel_count))


class CountedClocks:
    """Clock errors of a rig's amplifiers as answers count them, so that promises hold.

    now: returns the error of each amplifier by name, rms [s], infinite if it is unknown.
    """

    def __init__(self, rig: Rig, now: Callable[[], Mapping[str, float]]) -> None:
        self._rig = rig
        self._now = now
        self._names = sorted(rig.channel_counts)
        self._counted = EXACT_CLOCKS
        self._losses = dict.fromkeys(self._names, 0)  # since last logged as synchronized
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
        present_errors = known or self._now()
        if self._is_other(present_errors):
            former_errors = self.errors
            self.errors = {name: MARGIN * present_errors[name] for name in self._names}
            era_names = [era.name for era in table.eras]
            self._counted = ClockErrors.of(era_names, self._rig.wiring, self.errors)
            self._note(former_errors)
        if self._held_since:
            self._log_settled()
        return table.with_clocks(self._counted)

    def _log_settled(self) -> None:
        """Log which clocks have been synchronized for long enough, with their losses before."""
        now = threads.now()
        for name, held_since in [*self._held_since.items()]:
            if now - held_since < SETTLED:
                continue
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

    def _note(self, former_errors: Mapping[str, float]) -> None:
        """Count losses; log once which amplifiers play contents of their own from now on.

        That is no warning when a line has just been opened, since no clock is known then.
        """
        level = logging.WARNING if former_errors else logging.INFO
        for name, error in self.errors.items():
            was_alone = former_errors.get(name, 0.0) > MAX_HELD
            if error <= MAX_HELD:
                if was_alone:
                    self._held_since[name] = threads.now()
            elif not was_alone:
                self._held_since.pop(name, None)
                if not self._losses[name]:
                    _logger.log(
                        level,
                        "amplifier %s: its clock is not held to the others', so its ERAs play "
                        "vibrations of their own; if that lasts, see its clock_error in era amp "
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
    step = PLAIN_STEP
    count = 1
    if knots:
        joins = is_first and since > 0
        shortest_step = _JOINING_STEP if joins else stimulus.COURSE_KNOT_STEP
        length = _FIRST_PIECE if is_first else _NEXT_PIECE
        max_count = min(knots + 1, round(length / shortest_step))
        step = max(shortest_step, _SHORTEST_PIECE / max_count)
        steps_left = min((pulse.duration - since) / step, max_count)
        count = max(math.ceil(steps_left - _ROUNDING), 2)
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
    drive: Drive = playing or {}
    if restarted is None:
        restarted = restarted_by(excitation, drive)
    strokes = rig.full_levels
    onsets, endings = on_wire(strokes, onset, ending)
    wired: dict[str, list[AmplifierTone]] = {name: [] for name in rig.amplifiers}
    largest_rise = 0.0
    for name, channel in rig.wiring.items():
        driven = excitation.get(name)
        shape = onsets.get(name)
        if driven is None:
            # An ERA that falls silent while others play skips its ending, which all end along.
            frequency = rig.limits.frequency_min
            if onset and shape:
                frequency = onset[name].frequency
            tone = AmplifierTone(
                channel.number, frequency, 0.0, 0.0, False, True, shape, endings.get(name)
            )
        else:
            phase = driven.phase  # the ledger rejects infinite phases and NaN
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
        # A rise of NaN, which the ledgers reject, changes nothing here.
        largest_rise = max(largest_rise, _rise(tone, drive.get(name)))
    ramp = max(ramp, largest_rise / rig.limits.slew)
    return {
        name: AmplifierLayer(number, tuple(tones), ramp, valid_for) for name, tones in wired.items()
    }


def _rise(tone: AmplifierTone, former_tone: AmplifierTone | None) -> float:
    """Return the largest change of level when a tone starts: from rest, or through a phase turn."""
    if former_tone is None or not tone.level or former_tone.frequency != tone.frequency:
        return tone.level
    return tone.level + former_tone.level


def restarted_by(excitation: physics.Excitation, playing: Drive) -> set[float]:
    """Return the frequencies [Hz] that restart at the commit because an ERA joins them.

    All ERAs with the same frequency must count its phase from the same moment, or their field
    changes.
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
    count = len(first.knots)
    new_count = knots + 1
    if count <= new_count:
        return envelopes
    duration = round(first.duration * _STEP.per_unit)  # in steps of the wire
    step = math.ceil(duration / new_count) / _STEP.per_unit
    times = np.minimum(step * np.arange(1, new_count + 1), first.duration)
    positions = times / first.step
    lower = np.minimum(positions.astype(int), count - 1)
    values = np.array([(envelope.start, *envelope.knots) for envelope in envelopes.values()])
    slopes = values[:, lower + 1] - values[:, lower]
    rows = values[:, lower] + slopes * (positions - lower)
    thin = dict[str, BaseEnvelope]()
    for (name, envelope), row in zip(envelopes.items(), rows.tolist(), strict=True):
        thin[name] = BaseEnvelope(envelope.frequency, envelope.start, tuple(row), step)
    return thin


def on_wire(strokes: Mapping[str, float], *groups: Envelopes | None) -> list[dict[str, Envelope]]:
    """Return groups of envelopes in integers of the wire; strokes [m] and envelopes are by ERA."""
    if not any(groups):
        return [{} for _ in groups]
    motions = list[complex]()
    units = list[float]()
    for envelopes in groups:
        for name, envelope in (envelopes or {}).items():
            inner_knots = envelope.knots[:-1]
            motions += inner_knots
            units += [strokes[name]] * len(inner_knots)
    shares = np.array(motions, dtype=complex) / units
    levels = np.rint(np.abs(shares) * _LEVEL.per_unit).astype(int)
    phases = np.rint(np.degrees(np.angle(shares)) * _PHASE.per_unit).astype(int)
    phases[phases > _PHASE.maximum] = _PHASE.minimum  # half a turn
    knots = zip(levels.tolist(), phases.tolist(), strict=True)
    wire_groups = list[dict[str, Envelope]]()
    for envelopes in groups:
        wire_envelopes = dict[str, Envelope]()
        for name, envelope in (envelopes or {}).items():
            step = math.ceil(round(envelope.step * _STEP.per_unit, _DIGITS))
            wire_knots = tuple(islice(knots, len(envelope.knots) - 1))
            wire_envelopes[name] = Envelope(step, wire_knots)
        wire_groups.append(wire_envelopes)
    return wire_groups


def tones_by_era(
    played: Mapping[str, Sequence[LayerSet]], rig: Rig, number: int = 0
) -> dict[str, AmplifierTone]:
    """Return the tones of a layer, by ERA; without silent ones."""
    commands = dict[tuple[str, int], Command]()
    for amplifier, layers in played.items():
        for layer in layers:
            if layer.layer != number:
                continue
            for command in layer.commands:
                if command.level > 0:
                    commands[amplifier, command.channel] = command
    tones = dict[str, AmplifierTone]()
    for name, channel in rig.wiring.items():
        driving = commands.get((channel.amplifier, channel.number))
        if driving is None:
            continue
        tones[name] = AmplifierTone(
            channel.number,
            driving.frequency / _FREQUENCY.per_unit,
            driving.level / _LEVEL.per_unit,
            driving.phase / _PHASE.per_unit,
        )
    return tones


def full_drive(excitation: physics.Excitation, rig: Rig) -> dict[str, AmplifierTone]:
    """Return the tones of an excitation at the share 1 of its course, by ERA."""
    layers = route(excitation, rig, ramp=0.0)
    tones = dict[str, AmplifierTone]()
    for name, channel in rig.wiring.items():
        if name not in excitation:
            continue
        for tone in layers[channel.amplifier].tones:
            if tone.channel == channel.number:
                tones[name] = tone
    return tones
