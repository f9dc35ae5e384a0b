"""Capabilities of the open amplifiers of a rig together, in the terms of the table.

A set takes its onset with it, so a touch waits for that; its ending follows in a set of its own,
which takes no longer. The knots that the wires carry in time are arithmetic, done once when the
amplifiers are open.
"""

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Self

from controller.play.pieces import MAX_STEP
from drivers.host.amplifier import Amplifier
from drivers.host.line import Line
from drivers.protocol.definition import MAX_WORDS, QUANTITIES
from model.answer.answer import Layer, Limits, amplitudes_of
from model.drive_modes import DRIVE_MODES, playable_drive_modes
from model.errors import InputError
from model.rig.rig import Rig
from model.table.table import LocalizationTable
from model.transients.base_motion import KNOT_STEP
from model.transients.knots import ENDING_KNOTS, ONSET_KNOTS

MAX_SET_TIME, MAX_PIECE_TIME = 0.010, 0.020
"""How long [s] a set may take on its wire, so that its onset does not delay a touch, and one that
continues a course, for which a touch may have to wait."""

_FREQUENCY, _LEVEL, _RAMP = (QUANTITIES[name] for name in ("frequency", "level", "ramp"))
_PHASE_STEP = QUANTITIES["phase_step"]
_STEP = QUANTITIES["envelope_step"]
_LAYER_WORDS, _COMMAND_WORDS, _ENVELOPE_WORDS, _KNOT_WORDS = 3, 4, 2, 2
_PART_WORDS = 3  # of a message: session, token, part


@dataclass(frozen=True, slots=True)
class EnvelopeSupport:
    """Knots of an onset and of an ending that every channel may have; 0: ramps."""

    onset_knots: int
    ending_knots: int = 0


RAMPS_ONLY = EnvelopeSupport(0)
"""Support of ramps only."""


@dataclass(frozen=True)
class PlaybackCapabilities:
    """Capabilities that all amplifiers of a rig share.

    drive_mode: of the questions to the table; playable: the drive modes that every amplifier can
    play; limits: of a drive; envelope_support: knots that every amplifier plays; ramp_max [s];
    layers: contents at once; course_knots: of a piece of a course, 0: ramps.
    """

    drive_mode: str
    playable: tuple[str, ...]
    limits: Limits
    envelope_support: EnvelopeSupport
    ramp_max: float = math.inf
    layers: int = 1
    course_knots: int = 0

    def left_by(self, layers: Sequence[Layer], table: LocalizationTable) -> Self:
        """Return what layers leave of the limits, their peaks together."""
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
    """Return what the open amplifiers of a rig, by name, can play.

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
            f"drive mode must be one that all amplifiers play ({', '.join(playable)}), got "
            f"{drive_mode}; leave it out for the best"
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
    """Return what the amplifiers of a rig, by name, allow as they were identified last."""
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
    """Return what all open amplifiers, by name, play, and their wires carry within 10 ms."""
    knots, onset, ending = _knots(rig, amplifiers), ONSET_KNOTS - 1, ENDING_KNOTS - 1
    return EnvelopeSupport(min(knots, onset), ending if knots >= ending else 0)


def _knots(
    rig: Rig,
    amplifiers: Mapping[str, Amplifier],
    *,
    within: float = MAX_SET_TIME,
    step: float = KNOT_STEP,
) -> int:
    """Return how many knots all open amplifiers play, and their wires carry within a time [s].

    step [s]: the longest between two of them.
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
    """Return how many knots an envelope of an amplifier may have.

    In steps from that of the model to a longest one, max_step [s].
    """
    can = amplifier.ledger.capabilities
    low, high = (_STEP.from_wire(can[f"envelope_step_{end}"]) for end in ("min", "max"))
    return int(can["knots"]) if low <= KNOT_STEP <= max_step <= high else 0


def _knots_on(line: Line, channels: list[int], within: float) -> int:
    """Return the knots of each channel that a line carries in time, for its amplifiers' sets."""
    takes = line.wire.transit(MAX_WORDS)
    if takes <= 0:
        return int(QUANTITIES["knots"].maximum)
    return _knots_in(int(MAX_WORDS * within / takes), channels)


def _knots_in(words: int, channels: list[int]) -> int:
    """Return the knots of each channel for which a number of words suffices."""
    parts = -(-words // MAX_WORDS)
    heads = len(channels) * _LAYER_WORDS + max(parts, len(channels)) * _PART_WORDS
    each = _COMMAND_WORDS + _ENVELOPE_WORDS
    return int((words - heads - sum(channels) * each) // (_KNOT_WORDS * sum(channels)))
