"""Envelopes of a pattern in the slots of amplifiers, and whether the wires load them in time.

The onset and the ending of a channel have a slot each, the same for every pattern: a set takes its
envelopes with it, so a slot may be reloaded while they play. The last value of an envelope, the
pattern itself or silence, belongs to the command and is not among the knots on the wire.

A touch waits for its onset only. Endings follow once the onset is over: the same tones again, which
changes nothing that is felt, now with their endings.
"""

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Protocol

from drivers.command import Envelope, Knot
from drivers.protocol.messages import Capabilities
from drivers.protocol.wire_times import WireTimes
from model.rig.rig import Rig
from model.table.pattern import Pattern
from model.transients.envelope import KNOT_STEP
from model.transients.knots import ENDING_KNOTS, ONSET_KNOTS

MAX_LOADING_TIME = 0.010
"""How long [s] loading envelopes may delay a touch: a delay that varies by more is noticed between
presses, and a click of 40 ms must not wait as long as it lasts."""

SHAPING_TIME, EXCHANGE_TIME = 0.004, 0.0005
"""What shaping an onset takes [s], and an exchange beside its time on the wire: both measured."""

# Levels have steps of 1e-4 on the wire; smaller digits are rounding errors of the knot search.
_DIGITS = 9


@dataclass(frozen=True, slots=True)
class EnvelopeSupport:
    """Supported envelopes: onsets, endings, both or none."""

    onsets: bool
    endings: bool

    def __bool__(self) -> bool:
        """Whether there are any."""
        return self.onsets or self.endings


RAMPS_ONLY = EnvelopeSupport(onsets=False, endings=False)
"""Support of ramps only."""


class OpenAmplifier(Protocol):
    """The part of an open amplifier that decides what it can play."""

    @property
    def capabilities(self) -> Capabilities:
        """Its reported capabilities."""

    @property
    def bus(self) -> str | None:
        """Name of the bus that it shares, None without one."""

    @property
    def wire_times(self) -> WireTimes:
        """Durations on its wire."""


def envelope_support(
    rig: Rig, amplifiers: Mapping[str, OpenAmplifier], *, max_loading_time: float
) -> EnvelopeSupport:
    """Return what all amplifiers, by name, can play and load within `max_loading_time` [s].

    A touch waits while its onset is shaped and loaded; endings are loaded while it vibrates.
    """
    if max_loading_time <= 0:
        return RAMPS_ONLY
    return EnvelopeSupport(
        onsets=_fits(
            rig,
            amplifiers,
            knots=ONSET_KNOTS - 1,
            slots=1,
            max_loading_time=max_loading_time - SHAPING_TIME,
        ),
        endings=_fits(
            rig, amplifiers, knots=ENDING_KNOTS - 1, slots=2, max_loading_time=max_loading_time
        ),
    )


def onset_slots(rig: Rig) -> dict[str, int]:
    """Return the slot of every ERA's onset, by its name; from 1 on every amplifier."""
    counts: dict[str, int] = defaultdict(int)
    slots = {}
    for name, channel in rig.wiring.items():
        counts[channel.amplifier] += 1
        slots[name] = counts[channel.amplifier]
    return slots


def ending_slots(rig: Rig) -> dict[str, int]:
    """Return the slot of every ERA's ending, by its name, after those of the onsets."""
    wired = _wired(rig)
    return {
        name: slot + wired[rig.wiring[name].amplifier] for name, slot in onset_slots(rig).items()
    }


def wire_envelopes(pattern: Pattern, rig: Rig) -> dict[str, tuple[Envelope, ...]]:
    """Return the envelopes of a pattern to load, by amplifier; an empty tuple without any."""
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
    """Return the knot of a complex amplitude in strokes, its level rounded."""
    knot = Knot.from_phasor(value)
    return replace(knot, level=round(knot.level, _DIGITS))


def _wired(rig: Rig) -> dict[str, int]:
    """Count the wired channels of each amplifier."""
    counts = dict.fromkeys(rig.amplifiers, 0)
    for channel in rig.wiring.values():
        counts[channel.amplifier] += 1
    return counts


def _fits(
    rig: Rig,
    amplifiers: Mapping[str, OpenAmplifier],
    *,
    knots: int,
    slots: int,
    max_loading_time: float,
) -> bool:
    """Whether every amplifier plays an envelope of this many knots per ERA and loads it in time.

    slots: per channel.
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
        loading = amplifier.wire_times.loading(knots) + EXCHANGE_TIME
        busy[amplifier.bus or name] += wired * loading
    return max(busy.values(), default=0.0) <= max_loading_time
