"""Fades of a channel, by hand calculation."""

import cmath
import math
from itertools import pairwise

import numpy as np
import pytest

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
    motion = tone.motion(stroke=1e-4)
    for t in [1.0, 1.003, 1.0125, 1.0199, 1.02, 1.5]:
        gain = 1.0 if t >= 1.02 else 0.3 + 0.7 * (1 - math.cos(math.pi * (t - 1.0) / 0.02)) / 2
        expected = 0.5e-4 * gain * math.sin(2 * math.pi * 110 * (t - 0.95) + 0.7)
        assert motion_of(motion, np.array([t]))[0] == pytest.approx(expected, abs=1e-13)


def test_fade_with_zero_ramp_is_a_step() -> None:
    """Without a ramp the new tone is there at full level and the old one is gone."""
    playing = fade_to((), 1.0, ramp=0.0, frequency=100.0, amplitude=0.5)
    assert level_of(playing, 1.0) == 0.5
    assert fade_to(playing, 2.0, ramp=0.0) == ()


def test_fade_phase_with_and_without_keep_phase() -> None:
    """Only keep_phase at the same frequency leaves the phase running through a change of level."""

    def motion(playing: Output, t: float) -> float:
        parts = [part for tone in playing for part in tone.motion(stroke=1.0)]
        return float(motion_of(parts, np.array([t]))[0])

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
    terms = tone.motion(stroke=1e-4)
    assert [one.end for one in terms[:-1]] == [one.start for one in terms[1:]]
    assert (terms[0].start, terms[-1].end) == (start, math.inf)
