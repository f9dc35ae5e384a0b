"""Playback of layers against curves of the protocol computed by hand, and invariants."""

import math
import random
from dataclasses import replace

import pytest

from drivers.playing import Playback, Voice
from drivers.protocol.sets import Command, Envelope, LayerSet

RAMP = 20  # ms
FULL = 10_000


def layer(number: int, *commands: Command, **other: int | bool) -> LayerSet:
    """A layer with a ramp of 20 ms that does not end."""
    return LayerSet(number, RAMP, int(other.pop("valid_for", 0)), commands, **other)  # type: ignore[arg-type]


def tone(channel: int = 0, frequency: int = 2000, level: int = 5000, **other: object) -> Command:
    """A tone of 100 Hz at half level unless told otherwise."""
    return Command(channel, frequency, level, 0, **other)  # type: ignore[arg-type]


def amplitudes(playback: Playback, time: float) -> list[complex]:
    """The amplitude of each voice of channel 0."""
    return [voice.transition.at(time) for voice in playback.all_voices[0]]


def slope_of(playback: Playback, time: float) -> float:
    """The steepest change of channel 0 from a time on."""
    return sum(voice.transition.slope(time) for voice in playback.all_voices[0])


def test_voice_that_has_faded_is_not_continued_however_seldom_time_advances() -> None:
    """Its onset to level 0 ended at 20 ms, before that of the channel for which a set waits."""
    playback = Playback(2, 8)
    short, long = Envelope(100, ((2000, 0),)), Envelope(200, ((2000, 0),))
    playback.commit([layer(0, tone(level=0, onset=short), tone(1, onset=long))], 1, 0.0)
    playback.commit([layer(0, tone(keep_phase=True), after=True)], 2, 0.01)
    playback.advance(1.0)
    assert [voice.began for voice in playback.all_voices[0]] == pytest.approx([0.04])


def test_tones_of_one_frequency_interfere_whenever_they_began() -> None:
    """By hand: 0.3, 0.4 i and -0.3 of 99.95 Hz add to 0.7 or less, however far apart they begin."""
    playback = Playback(1, 8)
    for number, (time, level, phase, sum_of_all) in enumerate(
        [(0.0, 3000, 0, 0.3), (1.2345, 4000, 9000, 0.5), (7.7777, 3000, 18000, 0.4)]
    ):
        one = Command(0, 1999, level, phase)
        playback.commit([LayerSet(number, 0, 0, (one,))], number + 1, time)
        assert playback.level(0, time) == pytest.approx(sum_of_all)
    other = Command(0, 2000, 1000, 0)
    playback.commit([LayerSet(3, 0, 0, (other,))], 4, 8.0)
    assert playback.level(0, 9.0) == pytest.approx(0.4 + 0.1)


def test_random_sets_never_jump_and_keep_their_bounds() -> None:
    """Whatever is committed, amplitudes move no faster than slopes and stay below `peak`."""
    chance = random.Random(4)
    for _ in range(60):
        playback = Playback(1, 8)
        time, token = 0.0, 0
        for _ in range(12):
            time += chance.choice((0.0007, 0.004, 0.013, 0.03))
            if chance.random() < 0.1:
                playback.silence(time, chance.choice((0.005, 0.05)))
            else:
                token += 1
                playback.commit([_random_layer(chance)], token, time)
            peak = sum(voice.transition.peak(time) for voice in playback.all_voices[0])
            slope = slope_of(playback, time)
            before = _field(playback.all_voices[0], time)
            for _ in range(12):
                later = time + chance.random() * 5e-4
                after = _field(playback.all_voices[0], later)
                assert playback.level(0, later) <= peak + 1e-9
                assert abs(after - before) <= slope * (later - time) + 1e-9


def _random_layer(chance: random.Random) -> LayerSet:
    knots = tuple((chance.randrange(FULL), chance.randrange(-9000, 9000)) for _ in range(3))
    shape = chance.choice((None, Envelope(chance.choice((5, 40)), knots)))
    command = tone(
        frequency=chance.choice((2000, 3000)),
        level=chance.randrange(FULL),
        keep_phase=chance.random() < 0.5,
        onset=shape,
        ending=chance.choice((None, shape)),
    )
    commands = (command,) if chance.random() < 0.8 else ()
    return layer(chance.randrange(3), *commands, valid_for=chance.choice((0, 9)))


def _field(voices: tuple[Voice, ...], time: float) -> complex:
    """The sum of all amplitudes, as if their tones stood still."""
    return sum((voice.transition.at(time) for voice in voices), 0j)


def test_fade_that_is_cut_short_is_as_fast_as_the_amplifier_can() -> None:
    """A raised cosine from 1 is steepest at pi/2 over its length: 157 ms at 10 full levels/s."""
    for slew, length in ((math.inf, 0.002), (10.0, math.pi / 20)):
        playback = Playback(1, 8, slew)
        playback.commit([layer(0, tone(level=FULL))], 1, 0.0)
        for n in range(9):
            played = replace(layer(0, tone(frequency=3000 + n)), ramp=1000)
            playback.commit([played], 2 + n, 1.0 + 1e-6 * n)
        first = playback.all_voices[0][0].transition
        assert first.end - first.start == pytest.approx(length, rel=1e-3)
