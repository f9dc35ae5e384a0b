"""Onsets and endings predicted, against a stepping solver and against sampling."""

import math

import numpy as np
import pytest

from model.finger import fingertip_points
from model.transients.base_motion import BaseEnvelope, ramped_ending, ramped_onset
from model.transients.knots import hat_accelerations
from model.transients.shaping import SAMPLE_RATE, Transients
from model.vibration import Tone
from plates import make_plate_in_time, stepped_acceleration

STEP = 0.005


@pytest.fixture(scope="module")
def few_modes():
    """Rig and plate with modes for 100 Hz only, so that a stepping solver is quick."""
    return make_plate_in_time(frequency_max=100.0)


@pytest.fixture(scope="module")
def plate():
    """Rig and plate with modes for 500 Hz."""
    return make_plate_in_time()


def resting(_time: float) -> tuple[float, float]:
    """A base that does not move."""
    return 0.0, 0.0


def test_hat_response_equals_time_stepping(few_modes):
    """Closed form, back on its carrier, follows Runge-Kutta through rise, fall and ringing."""
    rig, plate = few_modes
    omega = 2 * math.pi * 90.0
    samples = 4
    hats = hat_accelerations(plate, omega, step=STEP, steps=6, samples=samples)
    times = STEP * (np.arange(len(hats)) + 0.5) / samples
    stroke = rig.eras[1].stroke

    def hat(t: float) -> tuple[float, float]:
        height = max(0.0, 1 - abs(t - STEP) / STEP)
        rise = 0.0 if t >= 2 * STEP else math.copysign(1 / STEP, STEP - t)
        sine, cosine = math.sin(omega * t), math.cos(omega * t)
        return stroke * height * sine, stroke * (rise * sine + height * omega * cosine)

    breaks = np.array([0, STEP, 2 * STEP, 6 * STEP])
    stepped = stepped_acceleration(plate, [resting, hat, resting, resting], times, breaks=breaks)
    found = (hats[:, 1] * np.exp(1j * omega * times)[:, None]).imag
    np.testing.assert_allclose(found, stepped, atol=1e-5 * np.abs(stepped).max())


def test_acceleration_equals_time_stepping(few_modes):
    """A ramped tone and an envelope at another frequency together follow Runge-Kutta."""
    rig, plate = few_modes
    envelope = BaseEnvelope(120.0, 0j, (3e-5 + 2e-5j, -1e-5j, 5e-5 + 0j))
    tone = Tone(70.0, 8e-5, 0.4)
    ramp = ramped_onset({"SW": tone}, rig.eras, ramp=0.01)
    bases = (ramp[0], (), envelope.terms(), ())

    def ramped(t: float) -> tuple[float, float]:
        omega, share = 2 * math.pi * tone.frequency, math.pi * min(t, 0.01) / 0.01
        gain = (1 - math.cos(share)) / 2
        slope = math.pi / 0.01 * math.sin(share) / 2
        angle = omega * t + tone.phase
        return (
            tone.amplitude * gain * math.sin(angle),
            tone.amplitude * (slope * math.sin(angle) + gain * omega * math.cos(angle)),
        )

    def knotted(t: float) -> tuple[float, float]:
        values = [0j, *envelope.knots, envelope.knots[-1]]
        piece = min(int(t / STEP), 3)
        slope = (values[piece + 1] - values[piece]) / STEP
        amplitude = values[piece] + slope * (t - piece * STEP)
        omega = 2 * math.pi * 120.0
        turn = np.exp(1j * omega * t)
        return (amplitude * turn).imag, ((slope + 1j * omega * amplitude) * turn).imag

    points = fingertip_points(0.07, 0.16, rig.plate)
    found = Transients(plate).acceleration(bases, points, duration=0.03)
    times = np.arange(len(found)) / SAMPLE_RATE
    breaks = np.array([0, 0.005, 0.01, 0.015, 0.03])
    stepped = stepped_acceleration(plate, [ramped, resting, knotted, resting], times, breaks=breaks)
    expected = stepped @ plate.reduced.at(points).T
    np.testing.assert_allclose(found, expected, atol=1e-5 * np.abs(expected).max())


def test_contrast_db_is_that_of_the_weakest_target(plate):
    """Contrast of an onset is that of the target which has less."""
    rig, in_time = plate
    onset = ramped_onset({"SW": Tone(180.0, 1e-4)}, rig.eras, ramp=0.02)
    *alone, both = (
        Transients(in_time).contrast_db(onset, targets=targets, quiet=[(0.25, 0.2)])
        for targets in ([(0.02, 0.02)], [(0.15, 0.11)], [(0.02, 0.02), (0.15, 0.11)])
    )
    assert abs(alone[0] - alone[1]) > 0.3
    assert both == pytest.approx(min(alone), abs=1e-9)


def test_residual_db_equals_sampled_plate(plate):
    """Root mean square over plate, 100 ms and four phases agrees with the closed form."""
    rig, in_time = plate
    transients = Transients(in_time)
    tone = Tone(110.0, 1e-4)
    ramp = 0.015
    x, y = np.meshgrid((np.arange(32) + 0.5) / 32, (np.arange(24) + 0.5) / 24)
    points = np.column_stack([x.ravel() * rig.plate.length, y.ravel() * rig.plate.width])
    left = steady = 0.0
    for phase in (0.0, math.pi / 2):  # the two make up the mean over all phases
        excitation = {"SE": Tone(tone.frequency, tone.amplitude, phase)}
        ending = ramped_ending(excitation, rig.eras, ramp=ramp)
        felt = transients.acceleration(ending, points, duration=ramp + 0.1, after=excitation)
        left += (felt[round(ramp * SAMPLE_RATE) :] ** 2).mean()
        steady += (
            transients.acceleration(
                ramped_onset(excitation, rig.eras, ramp=0.0), points, duration=0.1, after=excitation
            )
            ** 2
        ).mean()
    expected = 10 * math.log10(left / steady)
    found = transients.residual_db({"SE": tone}, ramped_ending({"SE": tone}, rig.eras, ramp=ramp))
    assert found == pytest.approx(expected, abs=0.1)
