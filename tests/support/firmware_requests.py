"""Random requests of a host: sets in parts, commits, silence, stops and nonsense."""

import random
from collections.abc import Iterator

from drivers.protocol.records import Values
from drivers.protocol.sets import Command, Envelope, LayerSet, pack_layers, token_after

NONSENSE = [*range(2, 14), *range(19, 40)]  # others depend on what is there besides
MOMENTS = 128
"""Steps of the clock's high word in which whole numbers of samples pass, at 16 kHz."""
FREQUENCIES = (2000, 2600, 2605, 5000)  # 0.05 Hz


def knots(draw: random.Random) -> Envelope:
    """An envelope whose steps are whole samples."""
    count = draw.choice([0, 1, 2, 5])
    phases = (draw.randint(-18000, 17999) for _ in range(count))
    return Envelope(
        10 * draw.randint(1, 4), tuple((draw.randint(0, 2000), each) for each in phases)
    )


def command(draw: random.Random, channel: int) -> Command:
    """A command that is seldom out of range."""
    shapes = (knots(draw) if draw.random() < 0.3 else None for _ in range(2))
    frequency = draw.choice(FREQUENCIES) if draw.random() < 0.98 else 100
    level = draw.choice([0, 500, 1000, 2000]) if draw.random() < 0.98 else 10000
    flags = draw.random() < 0.5, draw.random() < 0.2
    return Command(channel, frequency, level, draw.randint(-18000, 17999), *flags, *shapes)


def layer(draw: random.Random, number: int, channels: int) -> LayerSet:
    """A layer: commands, silence or a renewal."""
    numbers = [each for each in range(channels) if draw.random() < 2 / channels]
    if draw.random() < 0.02:
        numbers.append(15)
    commands = tuple(command(draw, each) for each in dict.fromkeys(numbers))
    ramp, valid_for = draw.choice([0, 1, 5, 40]), draw.choice([0, 0, 0, 10, 20, 90])
    is_after = bool(commands) and draw.random() < 0.3
    is_renewal = not commands and draw.random() < 0.5
    return LayerSet(number, ramp, valid_for, commands, is_after, is_renewal)


class RandomHost:
    """A host that plays, stops, repeats and errs; draw: of everything."""

    def __init__(self, draw: random.Random, capabilities: Values) -> None:
        self._draw = draw
        self._channels, self._layers = (capabilities[name] for name in ("channels", "layers"))
        self._token = 1
        self._session = 1

    def requests(self, latch: int, clock: int) -> Iterator[tuple[int, list[int]]]:
        """Yield number and words of the next requests; latch, clock: those of the amplifier."""
        draw, kind = self._draw, self._draw.random()
        if kind < 0.55:
            yield from self._set(clock >> 16)
        elif kind < 0.8:
            yield 12, [self._session if draw.random() < 0.9 else 99, 0]
            yield 13, [draw.randint(0, 8)]
        elif kind < 0.9:
            yield draw.choice([2, 9, 10, 13]), [draw.randint(0, 3)] * draw.randint(0, 1)
        elif kind < 0.94:
            yield 7, [self._session, draw.choice([0, 3, 30])]
        elif kind < 0.97:
            yield draw.choice([4, 8]), [draw.choice([0, 2, 30])]
        else:
            length = draw.randint(0, 5)
            yield draw.choice(NONSENSE), [draw.choice([0, 1, 2, 300, 65535]) for _ in range(length)]
        if draw.random() < 0.2:
            yield 11, [latch if draw.random() < 0.8 else 7]
            yield 3, [self._session, 150, MOMENTS * draw.randint(0, 511)]
        if draw.random() < 0.1:
            self._session += 1

    def _set(self, high: int) -> Iterator[tuple[int, list[int]]]:
        draw = self._draw
        if draw.random() < 0.9:
            self._token = token_after(self._token)
        numbers = draw.sample(range(self._layers), draw.choice([1, 1, 2, 4]))
        if draw.random() < 0.02:
            numbers.append(self._layers)
        stream = pack_layers(layer(draw, each, self._channels) for each in numbers)
        parts: list[list[int]] = []
        while stream or not parts:
            length = draw.randint(1, 117)
            parts.append(stream[:length])
            stream = stream[length:]
        is_now = draw.random() < 0.4
        last = len(parts) - 1
        others = [each for each in range(last) if draw.random() < 0.97]
        if draw.random() < 0.3:
            draw.shuffle(others)
        for index in [*others, *draw.choices(range(last + 1), k=draw.choice([0, 0, 0, 2])), last]:
            bits = index << 8 | len(parts) << 1 | is_now
            yield 5, [self._session, self._token, bits, *parts[index]]
        if not is_now:
            ahead = MOMENTS * draw.randint(1, 11) - high % MOMENTS
            at = high + draw.choice([0, 0, -300, 2000, ahead if ahead > 2 else 0])
            yield 6, [self._session, self._token, at % 65536]
            yield 9, []
