"""Fades of a channel, by hand calculation."""

import cmath
import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from driven_bases import motion_of
from sim.waveform import FadingTone, Output, ShapedTone, fade_to, level_of


def test_fade_follows_a_raised_cosine() -> None:
    """A quarter, half and three quarters into a 20 ms ramp the gain is as the cosine says."""
    playing = fade_to((), 1.0, ramp=0.02, frequency=100.0, amplitude=0.8)
    quarter = (1 - math.sqrt(0.5)) / 2
    for time, share in [(1.0, 0), (1.005, quarter), (1.01, 0.5), (1.015, 1 - quarter), (1.02, 1)]:
        assert level_of(playing, time) == pytest.approx(0.8 * share, abs=1e-12)
    ending = fade_to(playing, 2.0, ramp=0.02)
    assert level_of(ending, 2.005) == pytest.approx(0.8 * (1 - quarter))
    assert level_of(ending, 2.02) == 0


def test_base_motion_matches_the_faded_tone() -> None:
    """The exponentials add up to stroke x level x gain(t) x sin(2 pi f (t - origin) + phase)."""
    tone = FadingTone(110.0, cmath.rect(0.5, 0.7), 0.95, 1.0, 0.02, 0.3, 1.0)
    terms = tone.terms(stroke=1e-4)
    for t in [1.0, 1.003, 1.0125, 1.0199, 1.02, 1.5]:
        gain = 1.0 if t >= 1.02 else 0.3 + 0.7 * (1 - math.cos(math.pi * (t - 1.0) / 0.02)) / 2
        expected = 0.5e-4 * gain * math.sin(2 * math.pi * 110 * (t - 0.95) + 0.7)
        assert motion_of(terms, np.array([t]))[0] == pytest.approx(expected, abs=1e-13)


def test_fade_with_zero_ramp_is_a_step() -> None:
    """Without a ramp the new tone is there at full level and the old one is gone."""
    playing = fade_to((), 1.0, ramp=0.0, frequency=100.0, amplitude=0.5)
    assert level_of(playing, 1.0) == 0.5
    assert fade_to(playing, 2.0, ramp=0.0) == ()


def test_fade_phase_with_and_without_keep_phase() -> None:
    """Only keep_phase at the same frequency leaves the phase running through a change of level."""

    def motion(playing: Output, t: float) -> float:
        terms = [term for tone in playing for term in tone.terms(stroke=1.0)]
        return float(motion_of(terms, np.array([t]))[0])

    first = fade_to((), 0.0, ramp=0.0, frequency=110.0, amplitude=1.0)
    kept = fade_to(first, 1.0023, ramp=0.01, frequency=110.0, amplitude=0.5, keep_phase=True)
    fresh = fade_to(first, 1.0023, ramp=0.01, frequency=110.0, amplitude=0.5)
    other = fade_to(first, 1.0023, ramp=0.01, frequency=120.0, amplitude=0.5, keep_phase=True)
    t = 1.1
    assert motion(kept, t) == pytest.approx(0.5 * math.sin(2 * math.pi * 110 * t))
    assert motion(fresh, t) == pytest.approx(0.5 * math.sin(2 * math.pi * 110 * (t - 1.0023)))
    assert motion(other, t) == pytest.approx(0.5 * math.sin(2 * math.pi * 120 * (t - 1.0023)))
    # undisturbed in time: same tone again, no dip while one fades into the other
    same = fade_to(first, 1.0023, ramp=0.01, frequency=110.0, amplitude=1.0, keep_phase=True)
    for t in [1.0023, 1.004, 1.0073, 1.01]:
        assert motion(same, t) == pytest.approx(math.sin(2 * math.pi * 110 * t))
        assert level_of(same, t) == pytest.approx(1.0)


def test_level_adds_tones_of_one_frequency_coherently() -> None:
    """Set at other times and in other phases: the most that the base moves within a period."""
    first = fade_to((), 0.0, ramp=0.0, frequency=110.0, amplitude=cmath.rect(0.6, 0.4))
    playing = fade_to(first, 0.0013, ramp=0.5, frequency=110.0, amplitude=cmath.rect(0.9, -1.1))
    t = 0.2
    most = 0.0
    for share in range(1000):
        reported = [(tone.amplitude(t), t + share / 110_000 - tone.origin) for tone in playing]
        moved = sum((a * cmath.exp(2j * math.pi * 110 * since)).imag for a, since in reported)
        most = max(most, moved)
    assert level_of(playing, t) == pytest.approx(most, rel=1e-4)


def test_fade_interrupted_is_continuous() -> None:
    """A tone caught half faded in leaves from half; one fading out keeps its own, earlier end."""
    first = fade_to((), 0.0, ramp=0.02, frequency=100.0, amplitude=1.0)
    second = fade_to(first, 0.01, ramp=0.02, frequency=150.0, amplitude=1.0)
    assert level_of(second, 0.01) == pytest.approx(0.5)
    third = fade_to(second, 0.02, ramp=0.05)
    assert level_of(third, 0.02) == pytest.approx(level_of(second, 0.02))
    assert {tone.frequency: tone.silent_from for tone in third} == {
        100.0: pytest.approx(0.03),
        150.0: pytest.approx(0.07),
    }


@pytest.mark.parametrize("ramp", [0.001, 0.02, 1.0])
def test_envelope_that_is_stopped_does_not_rise(ramp: float) -> None:
    """Of an ending that still rises: it falls from its present level, silent by the sooner end."""
    ending = ShapedTone(100.0, 0.0, 0.0, 0.01, (0.2 + 0j, 0.3 + 0j, 0.9 + 0j, 0.4 + 0j, 0j))
    stopped = fade_to((ending,), 0.01, ramp=ramp)
    levels = [level_of(stopped, 0.01 + 0.0005 * step) for step in range(100)]
    assert levels[0] == pytest.approx(0.3)
    assert all(here >= later for here, later in pairwise(levels))
    assert max(tone.silent_from for tone in stopped) == pytest.approx(0.01 + min(ramp, 0.03))


@pytest.mark.parametrize("start", [0.0, 1000.1, 23193.384082])
def test_pieces_of_a_shaped_tone_join(start: float) -> None:
    """One piece plays at any moment: there is no gap by rounding that a sample could fall into."""
    tone = ShapedTone(80.0, start, start, 0.005, tuple(0.01j * n for n in range(20)))
    terms = tone.terms(stroke=1e-4)
    assert [one.end for one in terms[:-1]] == [one.start for one in terms[1:]]
    assert (terms[0].start, terms[-1].end) == (start, math.inf)


@dataclass
class Voice:
    """An oscillator whose complex amplitude moves along a raised cosine."""

    frequency: float
    origin: float
    start: float
    ramp: float
    here: complex
    there: complex

    def at(self, time: float) -> complex:
        s = min((time - self.start) / self.ramp, 1.0) if self.ramp else 1.0
        return self.here + (self.there - self.here) * (1 - math.cos(math.pi * s)) / 2

    def sounds(self, time: float) -> bool:
        return self.there != 0 or time < self.start + self.ramp

    def value(self, time: float) -> float:
        turn = cmath.exp(2j * math.pi * self.frequency * (time - self.origin))
        return (self.at(time) * turn).imag if self.sounds(time) else 0.0

    def fade(self, time: float, ramp: float) -> None:
        if self.there != 0 or self.start + self.ramp > time + ramp:
            self.here, self.there, self.start, self.ramp = self.at(time), 0j, time, ramp


class Oscillators:
    """A channel as a small microcontroller plays it: two voices and a remainder, by the page."""

    def __init__(self) -> None:
        self.old: Voice | None = None
        self.new: Voice | None = None
        self.left = Voice(0.0, 0.0, 0.0, 0.0, 0j, 0j)

    def play(self, time: float, frequency: float, level: complex, ramp: float, keep: bool) -> None:
        voices = [one for one in (self.old, self.new) if one and one.sounds(time)]
        same = [one for one in voices if level and one.frequency == frequency]
        others = [one for one in voices if one not in same]
        for other in (*others, self.left):
            other.fade(time, ramp)
        if not level:
            return
        others = [one for one in others if one.sounds(time)]
        if len(others) == 2:  # no oscillator is free
            left = self.left.value(time) + others[0].value(time)
            self.left = Voice(0.0, time, time, 0.005, 1j * left, 0j)
        here, origin = 0j, time
        if same:
            origin = same[0].origin if keep and same[0].there else time
            turn = cmath.exp(2j * math.pi * frequency * (origin - same[0].origin))
            here = same[0].at(time) * turn
        self.old = others[-1] if others else None
        self.new = Voice(frequency, origin, time, ramp, here, level)

    def value(self, time: float) -> float:
        return sum(voice.value(time) for voice in (self.old, self.new, self.left) if voice)


SETS = st.tuples(
    st.sampled_from([0.0002, 0.003, 0.011, 0.2]),  # s; since the last
    st.sampled_from([90.0, 150.0, 210.0]),
    st.sampled_from([0j, 0.3 + 0j, cmath.rect(1.0, 2.0)]),
    st.sampled_from([0.0, 0.005, 0.04, 1.0]),
    st.booleans(),
)


@given(st.lists(SETS, min_size=3, max_size=12))
def test_output_is_that_of_two_oscillators(sets: list[tuple[float, float, complex, float, bool]]):
    """Whatever sets come how soon: an independent channel of two voices plays the same."""
    small, playing, now = Oscillators(), (), 0.0
    for pause, frequency, amplitude, ramp, keep in sets:
        now += pause
        small.play(now, frequency, amplitude, ramp, keep)
        playing = fade_to(
            playing, now, ramp=ramp, frequency=frequency, amplitude=amplitude, keep_phase=keep
        )
        assert len({tone.frequency for tone in playing} - {0.0}) <= 2
        for later in (0.0, 0.0011, 0.0027):
            played = [
                (tone.amplitude(now + later), tone.frequency, now + later - tone.origin)
                for tone in playing
            ]
            value = sum((a * cmath.exp(2j * math.pi * f * t)).imag for a, f, t in played)
            assert value == pytest.approx(small.value(now + later), abs=1e-9)


def test_set_during_a_fade_makes_no_jump() -> None:
    """A hundred sets in a second, ramps of one second: at most 2 pi f and the ramps per second."""
    playing: Output = ()

    def value(time: float) -> float:
        return sum(
            (t.amplitude(time) * cmath.exp(2j * math.pi * t.frequency * (time - t.origin))).imag
            for t in playing
        )

    for number in range(100):
        time = 0.01 * number
        before = value(time)
        playing = fade_to(playing, time, ramp=1.0, frequency=100.0 + number, amplitude=1.0)
        assert value(time) == pytest.approx(before, abs=1e-12)
        assert len(playing) <= 3
