"""Simulated actuators against samples of their voltage."""

import math

import numpy as np
import pytest

from model.arrays import FloatArray
from model.transients.base_motion import Term, terms_of
from registry.voltage import Law, VoltageDrive
from sim.plant.voltage import moved_by_voltage
from sim.waveform import FadingTone, ShapedTone

TIMES = np.arange(0.0, 0.1, 1e-4)
FLAT = ((1.0, 1.0, 0.0), (2000.0, 1.0, 0.0))


def sampled(terms: list[Term]) -> FloatArray:
    """The sum of terms, by their definition."""
    total = np.zeros(len(TIMES))
    for term in terms:
        tau = TIMES - term.start
        value = ((term.c0 + term.c1 * tau) * np.exp(1j * term.omega * tau)).imag
        total += np.where((tau >= 0) & (term.end > TIMES), value, 0.0)
    return total


@pytest.mark.parametrize("bias", [0.0, 0.3])
def test_square_of_a_cross_fade_is_that_of_its_samples(bias: float) -> None:
    """All sums and differences, while one tone fades out and another in; within 1e-12."""
    fading = FadingTone(55.0, 0.5 + 0.1j, 0.01, 0.01, 0.03, 1.0, 0.0)
    rising = FadingTone(90.0, 0.4j, 0.01, 0.01, 0.03, 0.0, 1.0)
    voltage = terms_of([*fading.motion(stroke=1.0), *rising.motion(stroke=1.0)])
    drive = VoltageDrive(FLAT, law=Law.QUADRATIC, bias=bias)
    expected = (bias + sampled(voltage)) ** 2 - bias**2
    found = sampled(moved_by_voltage(voltage, drive, stroke=1e-4))
    np.testing.assert_allclose(found, 1e-4 * expected, atol=1e-16)


def test_square_of_a_linear_transition() -> None:
    """In parts that are linear each: within 1/256 of the square of its change."""
    voltage = list(ShapedTone(55.0, 0.0, 0.0, 0.05, (0.5 + 0j, 0.1 + 0j)).motion(stroke=1.0))
    drive = VoltageDrive(FLAT, law=Law.QUADRATIC)
    found = sampled(moved_by_voltage(voltage, drive, stroke=1.0))
    np.testing.assert_allclose(found, sampled(voltage) ** 2, atol=0.4**2 / 4 / 64 * 1.001)


def test_two_halved_tones_beat() -> None:
    """Together they move at their sum and difference, as strongly as both: why one goes out first.

    sin(a) sin(b) twice: cos(a - b) - cos(a + b).
    """
    voltage = [Term(0.0, math.inf, 2 * math.pi * f, 0.5 + 0j) for f in (50.0, 80.0)]
    drive = VoltageDrive(FLAT, law=Law.QUADRATIC)
    terms = moved_by_voltage(voltage, drive, stroke=1.0)
    found = {round(abs(term.omega) / (2 * math.pi)): abs(term.c0) for term in terms if term.omega}
    assert found == pytest.approx({100: 0.125, 160: 0.125, 30: 0.25, 130: 0.25})


def test_each_part_passes_the_response_at_its_own_frequency() -> None:
    """With a bias: twice the bias at f, half the square at 2 f."""
    rows = ((50.0, 2.0, math.radians(-90.0)), (100.0, 0.5, 0.0))
    drive = VoltageDrive(rows, law=Law.QUADRATIC, bias=0.25)
    terms = moved_by_voltage([Term(0.0, math.inf, 100 * math.pi, 0.4 + 0j)], drive, stroke=1.0)
    found = {round(term.omega / (2 * math.pi)): term.c0 for term in terms if term.omega}
    assert found[50] == pytest.approx(2 * 0.25 * 0.4 * -2j)
    assert found[100] == pytest.approx(-0.5j * 0.4**2 * 0.5)
