"""How many knots of an onset the wires carry in time, and envelopes in integers of the wire.

A set takes its onset and its ending with it, so a touch waits for them. The knots that fit are
arithmetic from the wires, done once when the amplifiers are open. An onset of fewer knots follows
the same curve in longer steps, which keeps quiet fingers quieter than a ramp does down to a single
knot; an ending is sent whole or not at all. The last value of an envelope, the pattern itself or
silence, is that of the command and not among the knots on the wire.
"""

import math
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import islice

import numpy as np

from drivers.host.amplifier import Amplifier
from drivers.host.line import Line
from drivers.protocol.sets import Envelope
from drivers.protocol.table import MAX_WORDS, QUANTITIES
from model.rig.rig import Rig
from model.transients.base_motion import KNOT_STEP, BaseEnvelope, Envelopes
from model.transients.knots import ENDING_KNOTS, ONSET_KNOTS

MAX_SET_TIME = 0.010
"""How long [s] a set may take on its wire, so that its onset does not delay a touch."""

_LAYER_WORDS, _COMMAND_WORDS, _ENVELOPE_WORDS, _KNOT_WORDS = 3, 4, 2, 2
_PART_WORDS = 3  # of a message: session, token, part
_STEP, _LEVEL, _PHASE = (QUANTITIES[name] for name in ("envelope_step", "level", "phase"))
_DIGITS = 6  # of a step of the wire
_LEAST_ONSET = 5  # knots that an ending must leave


@dataclass(frozen=True, slots=True)
class EnvelopeSupport:
    """Knots of an onset and of an ending that every channel may have; 0: ramps."""

    onset_knots: int
    ending_knots: int = 0


RAMPS_ONLY = EnvelopeSupport(0)
"""Support of ramps only."""


def envelope_support(rig: Rig, amplifiers: Mapping[str, Amplifier]) -> EnvelopeSupport:
    """Return what all open amplifiers, by name, play, and their wires carry within 10 ms."""
    wired: dict[str, int] = defaultdict(int)
    for channel in rig.wiring.values():
        wired[channel.amplifier] += 1
    by_line: dict[Line, list[str]] = defaultdict(list)
    for name in wired:
        by_line[amplifiers[name].line].append(name)
    carried = [_knots_on(line, [wired[name] for name in names]) for line, names in by_line.items()]
    carried += [
        _knots_in(amplifiers[name].capabilities["set_words"], [count])
        for name, count in wired.items()
    ]
    each = min(map(_knots_of, (amplifiers[name] for name in wired)), default=0)
    knots, onset, ending = max(min(carried, default=0), 0), ONSET_KNOTS - 1, ENDING_KNOTS - 1
    if each < ending or knots < ending + _LEAST_ONSET:
        ending = 0
    return EnvelopeSupport(min(knots - ending, each, onset), ending)


def _knots_of(amplifier: Amplifier) -> int:
    """Return how many knots an envelope of an amplifier may have, in the steps of the model."""
    can = amplifier.capabilities
    low, high = (_STEP.from_wire(can[f"envelope_step_{end}"]) for end in ("min", "max"))
    return int(can["knots"]) if low <= KNOT_STEP <= high else 0


def _knots_on(line: Line, channels: list[int]) -> int:
    """Return the knots of each channel that a line carries in time, for its amplifiers' sets."""
    takes = line.wire.transit(MAX_WORDS)
    if takes <= 0:
        return int(QUANTITIES["knots"].maximum)
    return _knots_in(int(MAX_WORDS * MAX_SET_TIME / takes), channels)


def _knots_in(words: int, channels: list[int]) -> int:
    """Return the knots of each channel for which a number of words suffices."""
    parts = -(-words // MAX_WORDS)
    heads = len(channels) * _LAYER_WORDS + max(parts, len(channels)) * _PART_WORDS
    each = _COMMAND_WORDS + 2 * _ENVELOPE_WORDS
    return int((words - heads - sum(channels) * each) // (_KNOT_WORDS * sum(channels)))


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
