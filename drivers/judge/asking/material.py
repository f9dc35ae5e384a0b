"""What an amplifier states and can play, and the rows of a check: what is sent in turn.

Capabilities are read beyond their ranges too, and which of them cannot be so.
"""

import math
from collections.abc import Awaitable, Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, TypeAlias

from drivers.judge.asking.client import Unusable, require
from drivers.protocol.definition import (
    FEATURES,
    MESSAGES,
    QUANTITIES,
    capability_ranges,
    has_feature,
)
from drivers.protocol.records import Field, Number, Record, Values
from drivers.protocol.records import Rows as RowsOf
from drivers.protocol.sets import Command, Envelope, LayerSet


@dataclass(frozen=True, slots=True)
class Send:
    """A request by its values, the session that is held unless one is given, or by raw words.

    layers: of a set, which is sent in its parts. codes: one of which must be the answer, an empty
    one: carried out. channels: one of which a refusal must name.
    """

    name: str
    raw: Sequence[int] | None
    values: Values
    layers: tuple[LayerSet, ...]
    codes: tuple[str, ...]
    channels: tuple[int | None, ...]


Row: TypeAlias = "LayerSet | Send | float | Callable[[], Awaitable[object]] | Sequence[Row]"
"""A layer that plays, a request, a pause [s] in which the watchdog is fed, what is awaited, or a
course: rows that begin at rest, armed, and are followed until all is settled."""
Rows: TypeAlias = Sequence[Row]


def send(
    name: str,
    *,
    raw: Sequence[int] | None = None,
    code: str | tuple[str, ...] = "",
    channels: tuple[int | None, ...] = (None,),
    layers: tuple[LayerSet, ...] = (),
    **values: Any,
) -> Send:
    """Make a request that must be carried out, or refused with a code."""
    return Send(name, raw, values, layers, (code,) if isinstance(code, str) else code, channels)


def play(*layers: LayerSet, now: int = 1, **values: Any) -> Send:
    """Make a set that plays at once; values: token, session, code, as of `send`."""
    return send("Set", layers=layers, now=now, **values)


stage = partial(play, now=0)
"""Makes a set that is staged."""


_WORD = 0xFFFF


def _unlimited(field: Field) -> Field:
    """Return a field whose numbers, but that of channels, may be any."""
    if isinstance(field, RowsOf):
        return replace(field, record=Record(*map(_unlimited, field.record.fields)))
    if isinstance(field, Number) and field.name != "channels":
        lowest = int(field.is_added)  # 0: not stated
        return replace(field, quantity=replace(field.quantity, minimum=lowest, maximum=_WORD))
    return field


_REPLY = MESSAGES["GetCaps"].reply
(_LIMITS,) = (field.record for field in _REPLY.fields if isinstance(field, RowsOf))
STATED = Record(*map(_unlimited, _REPLY.fields))
"""The reply to GetCaps; a number may be any word, of which those that are wrong are found."""


def _ranges(can: Values) -> Iterator[tuple[str, int, int, int]]:
    """Yield each number with its name, between the least and the most that it may be."""
    rows = [(_REPLY, can), *((_LIMITS, one) for one in can["limits"])]
    for record, row in rows:
        for field in record.fields:
            if isinstance(field, Number) and row[field.name] is not None:
                name = field.name if record is _REPLY else "limits"
                yield name, field.quantity.minimum, row[field.name], field.quantity.maximum
    yield from capability_ranges(can)
    yield "features", 0, can["features"], (1 << len(FEATURES)) - 1
    for one in can["limits"]:
        low, high = one["frequency_min"], one["frequency_max"]
        yield "limits", can["frequency_min"], low, high
        yield "limits", low, high, can["frequency_max"]
        yield "limits", 1, one["level_max"], can["level_max"]


class Capabilities(dict[str, Any]):
    """Capabilities by name; wrong: what each must be that cannot be so, and what is stated.

    Raises Unusable for one of those, so that what does not ask for it goes on.
    """

    def __init__(self, stated: Values) -> None:
        super().__init__(stated)
        self.wrong: dict[str, tuple[str, int]] = {}
        for name, low, seen, high in _ranges(stated):
            if not low <= seen <= high:
                self.wrong.setdefault(name, (f"{low} to {high}", seen))

    def __getitem__(self, name: str) -> Any:
        """Return a capability."""
        if name in self.wrong:
            must, seen = self.wrong[name]
            raise Unusable(f"its {name} must be {must}, got {seen}")
        return super().__getitem__(name)


FULL = QUANTITIES["level"].per_unit


class Material:
    """What an amplifier can play.

    A capability is looked at where it is needed.
    """

    def __init__(self, can: Capabilities, level: float) -> None:
        self.can = can
        self._level = level
        self.channels = range(can["channels"])

    @property
    def layers(self) -> range:
        """The numbers of its layers."""
        return range(self.can["layers"])

    @cached_property
    def level(self) -> float:
        """Of driven channels, at most; Optional where it has none so low."""
        limits, step = [self.can, *self.can["limits"]], self.can["level_step"] / FULL
        level: float = min(self._level, *(one["level_max"] / FULL for one in limits))
        require(level >= step, f"its level_max of {level:g} is below its level_step of {step:g}")
        return level

    @cached_property
    def lowest(self) -> int:
        """The lowest frequency of every channel, in steps; Optional where they share none."""
        limits = [self.can, *self.can["limits"]]
        lowest = max(one["frequency_min"] for one in limits)
        require(lowest <= self.highest, "its channels have no frequency in common")
        return int(lowest)

    @cached_property
    def highest(self) -> int:
        """The highest frequency of every channel, in steps."""
        return int(min(one["frequency_max"] for one in (self.can, *self.can["limits"])))

    @cached_property
    def frequency(self) -> int:
        """The usual frequency, in steps."""
        ordinary = QUANTITIES["frequency"].to_wire(110.0)
        return min(max(ordinary, self.lowest), self.highest)

    @cached_property
    def other(self) -> int:
        """Another frequency, where there is one, in steps."""
        both = self.frequency + 800, self.lowest, self.highest
        return next(each for each in both if each <= self.highest)

    def has(self, feature: str) -> bool:
        """Whether it states a feature; empty: what all have."""
        return not feature or has_feature(self.can, feature)

    def require(self, feature: str) -> None:
        """Raise Optional where it does not state a feature."""
        require(self.has(feature), f"it states no {feature}")

    def require_knots(self) -> None:
        """Raise Optional where its envelopes have no knots."""
        require(self.can["knots"] > 0, "it has no knots")

    def tone(
        self,
        channel: int = 0,
        fraction: float = 1.0,
        phase: float = 0.0,
        *,
        frequency: int = 0,
        keep: bool = False,
        onset: Envelope | None = None,
        ending: Envelope | None = None,
    ) -> Command:
        """Make a command at a fraction of the test level; frequency in steps, 0 for the usual.

        Raises Optional for a level that the amplifier may round to 0.
        """
        level, step = round(fraction * self.level * FULL), self.can["level_step"]
        require(
            not 0 < level < step,
            f"its steps of level are coarser than {level / FULL:g}; see --level",
        )
        numbers = frequency or self.frequency, level, QUANTITIES["phase"].to_wire(phase)
        return Command(channel, *numbers, keep, onset=onset, ending=ending)

    def one(
        self, *commands: Command, level: float = 1.0, ramp: int = 0, valid_for: int = 0
    ) -> LayerSet:
        """Make what layer 0 is to play, by default the usual tone on channel 0."""
        tones = commands or [self.tone(0, level)]
        return layer(0, *tones, ramp=ramp, valid_for=valid_for)

    def whole(self) -> LayerSet:
        """Make the usual tone on all channels."""
        return layer(0, *map(self.tone, self.channels))

    def transitions(self, ramp: int) -> list[list[Send]]:
        """Make sets one after the other, amid which layers rise, fade, begin, end and wait."""
        slow = self.envelope(0.1, 0.25, 0.25, 0.25)
        tones = [self.beside(number, 0.25) for number in range(4)]
        begins = [replace(each, onset=slow) for each in tones]
        ends = [replace(each, ending=slow) for each in tones]
        other = self.beside(len(self.layers), 0.25)
        others = [layer(number, self.beside(number, 0.05)) for number in self.layers[4:]]
        changes = [
            layer(0, tones[0], ramp=ramp, valid_for=60_000),
            *(layer(1, ramp=ramp), layer(2, other, ramp=ramp), layer(3, tones[3], ramp=ramp)),
        ]
        shaped = layer(0, begins[0]), layer(1, ends[1]), layer(2, ends[2]), layer(3, begins[3])
        return [
            [play(layer(1, tones[1]), layer(2, tones[2]), *others), play(*changes)],
            [play(*shaped), play(layer(2), layer(3, other, after=True))],
        ]

    def envelope(self, step: float, *amplitudes: complex) -> Envelope:
        """Make an envelope of knots in fractions of the test level, or the nearest step [s].

        Of as many knots as there can be.
        """
        amplitudes = amplitudes[: self.can["knots"]]
        low, high = self.can["envelope_step_min"], self.can["envelope_step_max"]
        steps = min(max(QUANTITIES["envelope_step"].to_wire(step), low), high)
        phases = [math.degrees(math.atan2(each.imag, each.real)) for each in amplitudes]
        knots = [
            (round(abs(each) * self.level * FULL), QUANTITIES["phase"].to_wire(phase))
            for each, phase in zip(amplitudes, phases, strict=True)
        ]
        return Envelope(steps, tuple(knots))

    def beside(self, number: int, fraction: float) -> Command:
        """Make a tone on channel 0 that does not interfere with those of other layers."""
        return self.tone(0, fraction, frequency=self.apart(number))

    def near(self, number: int) -> int:
        """Return one of many frequencies, all alike where there is no room."""
        room = max(self.highest - self.frequency, 0)
        return int(self.frequency + min(max(10, self.can["frequency_step"]) * number, room))

    def apart(self, number: int) -> int:
        """Return a frequency of a layer of its own, so that layers do not interfere."""
        step = self.can["frequency_step"]
        above = self.frequency + max(40, step) * number
        highest = self.highest - (len(self.layers) - number) * step
        return int(max(min(above, highest), self.lowest))


def layer(
    number: int,
    *commands: Command,
    ramp: int = 0,
    valid_for: int = 0,
    after: bool = False,
    renew: bool = False,
) -> LayerSet:
    """Make what one layer is to play; ramp, valid_for in ms."""
    return LayerSet(number, ramp, valid_for, commands, after, renew)
