"""The firmware beside the simulated amplifier: the same requests, replies and samples."""

import cmath
import math
import random
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from drivers.protocol.sets import Command, Envelope, LayerSet, pack_layers
from drivers.protocol.table import BY_NUMBER
from drivers.protocol.tokens import token_after
from firmware_pair import WIRES, Pair, Sent
from long_form import shortly
from moved_firmware import RATE, MovedFirmware
from sim.amplifier.contract import Amplifier

REQUESTS = 600
TOLERANCE = 3e-4  # of full level: 16-bit samples, and fixed point in up to 16 voices
# Where replies differ by rounding; supply and temperature are the boards' own.
ROUNDED = {"levels": 2, "watchdog_left": 1, "temperature": 9999, "voltage": 9999, "age": 2}
LIMITED = 4  # the flag: one is foreseen at a commit, the other seen in samples
BUILDS = {"-DSMALLEST": 4, **{f"-DCHANNELS={channels}": channels for channels in (4, 8, 16)}}
"""Options of the compiler, with the number of channels."""
NONSENSE = [*range(2, 14), *range(19, 40)]  # others depend on what is there besides
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


class Host:
    """A host that plays, stops, repeats and errs; draw: of everything."""

    def __init__(self, draw: random.Random, amplifier: Amplifier) -> None:
        self._draw = draw
        self._amplifier = amplifier
        self._channels, self._layers = (
            amplifier.capabilities[name] for name in ("channels", "layers")
        )
        self._token = 1
        self._session = 1

    def requests(self) -> Iterator[tuple[int, list[int]]]:
        """Yield number and words of the next requests."""
        draw, kind = self._draw, self._draw.random()
        if kind < 0.55:
            yield from self._set()
        elif kind < 0.8:
            yield 12, [self._session if draw.random() < 0.9 else 99]
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
            yield 11, [self._amplifier.latch if draw.random() < 0.8 else 7]
            yield 3, [self._session, 150]
        if draw.random() < 0.1:
            self._session += 1

    def _set(self) -> Iterator[tuple[int, list[int]]]:
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
        order = [*range(len(parts))]
        draw.shuffle(order)
        for index in [*order, *order[:1]] if draw.random() < 0.9 else order[1:]:
            bits = index << 8 | len(parts) << 1 | is_now
            yield 5, [self._session, self._token, bits, *parts[index]]
        if not is_now:
            yield 6, [self._session, self._token]
            yield 9, []


def like(amplifier: Amplifier, firmware: Sent) -> Amplifier:
    """Return a simulated amplifier with the capabilities of the firmware."""
    amplifier.capabilities = firmware.values()
    amplifier.restart(0.0)
    return amplifier


def differences(made: Sent, expected: Sent, number: int) -> list[str]:
    """Names of what differs; number: of the request, where the frame does not say it."""
    if made[:2] != expected[:2]:
        return [f"{made[:2]} for {expected[:2]}"]
    if made.number == 0:  # a register area
        made, expected = (each._replace(number=number) for each in (made, expected))
    if made.number not in (30, 31, *BY_NUMBER):
        return []
    ours, theirs = made.values(), expected.values()
    ours["flags"], theirs["flags"] = (each.get("flags", 0) & ~LIMITED for each in (ours, theirs))
    for row in (*ours.get("commands", []), *theirs.get("commands", [])):
        row["phase"] *= row["level"] > 0  # of no level there is none
    return [
        f"{name}: {ours[name]} for {theirs[name]}"
        for name in ours
        if not agree(name, ours[name], theirs[name])
    ]


def agree(name: str, ours: object, theirs: object) -> bool:
    """Whether values of a name are the same, or as good as."""
    if isinstance(ours, list) and isinstance(theirs, list):
        pairs = zip(ours, theirs, strict=True)
        return len(ours) == len(theirs) and all(agree(name, *each) for each in pairs)
    if isinstance(ours, dict) and isinstance(theirs, dict):
        return all(agree(each, ours[each], theirs[each]) for each in ours)
    if name in ROUNDED:
        assert isinstance(ours, int)
        assert isinstance(theirs, int)
        return abs(ours - theirs) <= ROUNDED[name]
    return ours == theirs


def value_at(amplifier: Amplifier, channel: int, time: float) -> float:
    """What it plays at a time [s]: Im[A(t) exp(2 pi i f (t - origin))], limited."""
    total = 0.0
    for voice in amplifier.playback.voices_of(channel):
        turned = cmath.exp(2j * math.pi * voice.frequency * (time - voice.origin))
        total += (voice.transition.at(time) * turned).imag
    return min(max(total, -1.0), 1.0)


@pytest.mark.parametrize("wire", WIRES)
@pytest.mark.parametrize("build", shortly(BUILDS, ["-DSMALLEST"]))
@pytest.mark.parametrize("seed", shortly(range(4), [0]))
def test_random_requests_have_the_same_replies_and_samples(
    wire: str, build: str, seed: int, moved: Callable[..., Path]
) -> None:
    """Sets in parts, commits, silence, stops and nonsense, every few milliseconds."""
    draw, channels = random.Random(seed), BUILDS[build]
    firmware = MovedFirmware(moved(build), channels=channels)
    amplifier = Amplifier("a", channels=channels)
    like(amplifier, Pair(firmware, Amplifier("b", channels=channels), "serial").ask(2, [])[0][0])
    pair = Pair(firmware, amplifier, wire)
    host = Host(draw, amplifier)
    for _ in range(REQUESTS):
        for number, words in host.requests():
            made, expected = pair.ask(number, words)
            assert len(made) == len(expected), (made, expected)
            for ours, theirs in zip(made, expected, strict=True):
                assert differences(ours, theirs, number) == [], (pair.time, number, words)
        check_samples(pair, draw, draw.choice([0, 1, 1, 2, 5, 10, 30, draw.choice([30, 400])]))


def check_samples(pair: Pair, draw: random.Random, wait: int) -> None:
    """Let a time [ms] pass, and compare some samples of every channel."""
    pair.firmware.samples()
    first, begin = round(pair.time * RATE), pair.moment - pair.time
    expected = {}
    for index in sorted(draw.sample(range(wait * RATE // 1000), min(3, wait))):
        at = (first + index) / RATE + begin
        pair.amplifier.tick(at)
        for channel in range(pair.amplifier.playback.channels):
            expected[index, channel] = value_at(pair.amplifier, channel, at)
    pair.time = round(pair.time + wait / 1000, 3)
    pair.firmware.move(pair.time)
    samples = pair.firmware.samples()
    off = {place: samples[place] - value for place, value in expected.items()}
    assert {place: each for place, each in off.items() if abs(each) > TOLERANCE} == {}, pair.time
