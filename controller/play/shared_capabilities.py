"""Capabilities that all open amplifiers of a rig share, in the terms of the table.

The number of knots that the wires carry in time is computed once, when the amplifiers are opened.
"""

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Self

from controller.play.routing import MAX_STEP
from drivers.host.amplifier import Amplifier
from drivers.host.line import Line
from drivers.protocol.definition import KNOT, LAYER, MAX_WORDS, QUANTITIES, SET_WORDS
from drivers.protocol.sets import command_words
from model import vibration as physics
from model.answer import answer
from model.answer.answer import Limits, amplitudes_of
from model.answer.answer_report import Timing
from model.answer.stimulus import Placement
from model.drive_modes import DRIVE_MODES, playable_drive_modes
from model.errors import InputError
from model.rig.rig import Rig
from model.table.table import LocalizationTable
from model.transients import base_motion
from model.transients.excursions import Swing
from model.transients.knots import ENDING_KNOTS, ONSET_KNOTS

MAX_SET_TIME = 0.010
"""Longest time [s] of a set on its wire, so that its onset does not delay a touch."""

MAX_PIECE_TIME = 0.020
"""Longest time [s] of a set that continues an envelope; a touch may have to wait for it."""

_MIN_AMPLITUDE = 1e-12  # m; left to an ERA that is fully used
_MIN_SHARE = 1e-9  # of power or excursion; left if it is fully used

_FREQUENCY = QUANTITIES["frequency"]
_LEVEL = QUANTITIES["level"]
_RAMP = QUANTITIES["ramp"]
_STEP = QUANTITIES["envelope_step"]
_PHASE_STEP = QUANTITIES["phase_step"]


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
    head_words = amplifier_count * LAYER.words + part_count * SET_WORDS
    knot_words = words - head_words - channel_count * command_words([0])
    return knot_words // (KNOT.words * channel_count)
