"""Envelopes of a pattern as amplifiers keep them, and whether their wires have the time for it.

A channel's onset and ending have a slot each, the same for every pattern: a set takes its envelopes
with it, so a slot may be loaded anew while they play. What the table ends an envelope with, the
pattern itself or silence, is the command's own and not among the knots on the wire.

A touch waits for its onset only. Endings fit nothing before the onset is over, so they follow then:
the same tones again, which changes nothing that is felt, now with their brakes.
"""

import cmath
import math
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

from drivers.command import Envelope, Knot
from drivers.protocol.messages import Capabilities
from drivers.protocol.wire_times import WireTimes
from model.rig.rig import Rig
from model.table.pattern import Pattern
from model.transients.envelope import KNOT_STEP
from model.transients.knots import ENDING_KNOTS, ONSET_KNOTS

ENVELOPE_TIME = 0.030
"""How long [s] the loading of envelopes may hold up a touch: one that is felt within 50 ms is felt
at once, and what a shaped onset wins is worth no more."""

# A stroke is told in 1e-4 on the wire; below that lie only the roundings of the search for knots.
_DIGITS = 9


@dataclass(frozen=True, slots=True)
class Shaping:
    """Which envelopes are played: onsets, endings, none."""

    onsets: bool
    endings: bool

    def __bool__(self) -> bool:
        """Whether there are any."""
        return self.onsets or self.endings


PLAIN = Shaping(onsets=False, endings=False)
"""Ramps only."""


class Loading(Protocol):
    """What is to be known of an open amplifier."""

    @property
    def capabilities(self) -> Capabilities:
        """What it can play."""

    @property
    def bus(self) -> str | None:
        """Names the wire, where others may share it."""

    @property
    def wire_times(self) -> WireTimes:
        """How long things take on its wire."""


def shaping_of(rig: Rig, amplifiers: Mapping[str, Loading], *, within: float) -> Shaping:
    """What all amplifiers, by name, play, and that is loaded within a time [s]."""
    if within <= 0:
        return PLAIN
    return Shaping(
        onsets=_fits(rig, amplifiers, knots=ONSET_KNOTS - 1, slots=1, within=within),
        endings=_fits(rig, amplifiers, knots=ENDING_KNOTS - 1, slots=2, within=within),
    )


def onset_slots(rig: Rig) -> dict[str, int]:
    """The slot of every ERA's onset, by its name; from 1 on every amplifier."""
    counts: dict[str, int] = defaultdict(int)
    slots = {}
    for name, channel in rig.wiring.items():
        counts[channel.amplifier] += 1
        slots[name] = counts[channel.amplifier]
    return slots


def ending_slots(rig: Rig) -> dict[str, int]:
    """The slot of every ERA's ending, by its name, after those of the onsets."""
    wired = _wired(rig)
    return {
        name: slot + wired[rig.wiring[name].amplifier] for name, slot in onset_slots(rig).items()
    }


def wire_envelopes(pattern: Pattern, rig: Rig) -> dict[str, tuple[Envelope, ...]]:
    """The envelopes of a pattern to be loaded, by amplifier; none for one without."""
    loads: dict[str, list[Envelope]] = {name: [] for name in rig.amplifiers}
    for shapes, slots in (
        (pattern.onset, onset_slots(rig)),
        (pattern.ending, ending_slots(rig)),
    ):
        for name, envelope in (shapes or {}).items():
            stroke = rig.era(name).stroke
            loads[rig.wiring[name].amplifier].append(
                Envelope(
                    slot=slots[name],
                    step=envelope.step,
                    knots=tuple(_knot(value / stroke) for value in envelope.knots[:-1]),
                )
            )
    return {name: tuple(several) for name, several in loads.items()}


def _knot(value: complex) -> Knot:
    """A knot from a complex amplitude in strokes."""
    degrees = math.degrees(cmath.phase(value))
    return Knot(round(abs(value), _DIGITS), 180.0 if degrees == -180.0 else degrees)


def _wired(rig: Rig) -> dict[str, int]:
    """How many channels of each amplifier are wired."""
    counts = dict.fromkeys(rig.amplifiers, 0)
    for channel in rig.wiring.values():
        counts[channel.amplifier] += 1
    return counts


def _fits(
    rig: Rig, amplifiers: Mapping[str, Loading], *, knots: int, slots: int, within: float
) -> bool:
    """Whether an envelope for every ERA is played everywhere, and loaded in time.

    slots: how many each channel then has.
    """
    busy: dict[str, float] = defaultdict(float)
    for name, wired in _wired(rig).items():
        amplifier = amplifiers[name]
        caps = amplifier.capabilities
        if not (
            caps.envelope_knots >= knots
            and caps.envelope_slots >= slots * wired
            and caps.envelope_step_min <= KNOT_STEP <= caps.envelope_step_max
        ):
            return False
        busy[amplifier.bus or name] += wired * amplifier.wire_times.loading(knots)
    return max(busy.values(), default=0.0) <= within
