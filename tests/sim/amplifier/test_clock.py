"""The clock of a simulated amplifier against sums by hand: crystal, warm-up, rate, shift, moments.

2^32 steps in 20 s are 214 748 364.8 a second; a step of the high word is 20 s / 65536 = 305.18 us.
"""

import math
from fractions import Fraction

import pytest

from sim.amplifier.readings import AmplifierClock, Crystal

PER_SECOND = 214_748_364.8


def test_clock_goes_round_in_20_s() -> None:
    """A clock without errors shows a quarter of its span after 5 s, and again after 25."""
    clock = AmplifierClock()
    assert [clock.reading(time) for time in (0.0, 5.0, 20.0, 25.0)] == [0, 1 << 30, 0, 1 << 30]
    assert clock.seconds(25.0) == 25.0


def test_crystal_and_rate_multiply() -> None:
    """At +40 ppm the clock gains 40 us in a second; a rate of -400 words leaves 1.6 ns of them."""
    clock = AmplifierClock(Crystal(error=40e-6), since=100.0)
    assert clock.seconds(101.0) - 101.0 == pytest.approx(40e-6, abs=1e-10)
    clock.steer(-400, 101.0)
    # (1 + 4e-5) (1 - 4e-5) = 1 - 1.6e-9
    assert clock.seconds(111.0) - 111.0 == pytest.approx(40e-6 - 16e-9, abs=1e-10)
    assert clock.reading(111.0) == round((11.0 + 40e-6 - 16e-9) * PER_SECOND) % (1 << 32)


def test_warm_up_settles() -> None:
    """A warm-up of 1 ppm/s makes a crystal 10 (1 - 1/e) ppm fast after 10 s, 10 ppm in the end."""
    crystal = Crystal(warm_up=1e-6)
    clock = AmplifierClock(crystal)
    assert clock.straight(0.0).pace == 1.0
    assert clock.straight(10.0).pace - 1 == pytest.approx(10e-6 * (1 - math.exp(-1)), rel=1e-9)
    assert clock.straight(1000.0).pace - 1 == pytest.approx(10e-6, rel=1e-9)
    # The integral of 10 (1 - exp(-t / 10)) ppm over 10 s is 100 / e us.
    assert clock.seconds(10.0) - 10 == pytest.approx(100e-6 / math.e, abs=1e-11)


def test_steering_for_hours_adds_no_rounding() -> None:
    """Rates that change every 50 ms for three hours add up to the exact sum of fractions."""
    clock = AmplifierClock()
    rates = [(number * 7919) % 65535 - 32767 for number in range(216_000)]
    exact = Fraction(0)
    for number, rate in enumerate(rates):
        since, until = Fraction(number / 20), Fraction((number + 1) / 20)
        clock.steer(rate, number / 20)
        exact += (until - since) * (1 + Fraction(rate, 10_000_000))
    assert abs(Fraction(clock.seconds(10_800.0)) - exact) < Fraction(1, 10**11)


def test_shift_moves_the_high_word_on() -> None:
    """A shift of 3 moves the clock on by 3 steps of its high word, over its end too."""
    clock = AmplifierClock()
    clock.shift(3)
    assert clock.reading(0.0) == 0x0003_0000
    clock.shift(65_534)
    assert clock.reading(0.0) == 0x0001_0000


def test_clock_starts_again_with_its_supply() -> None:
    """After a restart the clock shows 0 and runs as fast as its crystal, which stays warm."""
    clock = AmplifierClock(Crystal(error=20e-6, warm_up=1e-6, ahead=7.0))
    assert clock.reading(0.0) == round(7 * PER_SECOND)
    clock.steer(1000, 1.0)
    clock.restart(500.0)
    assert clock.reading(500.0) == clock.rate == 0
    assert clock.seconds(501.0) == pytest.approx(1 + 30e-6, abs=1e-9)


@pytest.mark.parametrize("rate", [0, 500, -32768])
def test_moment_of_a_high_word(rate: int) -> None:
    """The clock has a high word from its moment on, and the one before just until then."""
    clock = AmplifierClock(Crystal(error=-50e-6, warm_up=1e-6, ahead=3.3), since=1e5)
    clock.steer(rate, 1e5 + 2)
    now = 1e5 + 2.5
    high = ((clock.reading(now) >> 16) + 1638) % 65536
    moment = clock.reaches(high, now)
    assert clock.reading(moment) >> 16 == high
    assert clock.reading(moment - 10e-9) >> 16 == high - 1
    # 1637 to 1638 steps of 20 s / 65536, by a clock that is at most 3.4 per mille fast or slow.
    assert 1637 * 20 / 65536 * 0.996 < moment - now < 1638 * 20 / 65536 * 1.004


def test_moment_of_a_clock_without_errors() -> None:
    """A high word of 0x4000 comes at 5 s, behind the end of a turn at 25 s, and at 5 s at once."""
    clock = AmplifierClock()
    assert clock.reaches(0x4000, 0.0) == pytest.approx(5.0, abs=1e-12)
    assert clock.reaches(0x4000, 6.0) == pytest.approx(25.0, abs=1e-11)
    assert clock.reaches(0x4000, 5.0) == 5.0
