"""What fingers keep and what is made of it, on signals made by hand."""

import numpy as np
import pytest

from model.errors import InputError
from model.finger.fingertip import fingertip_points
from model.reduction.reduced_plate import ReducedPlate
from model.rig.rig import Rig
from sim.plant.fingers import Fingers, Record, measure_vibration


def flat_plate(rig: Rig) -> ReducedPlate:
    """A plate that can only move up and down."""
    return ReducedPlate(
        rig.plate, np.zeros(1), np.zeros(1), lambda points: np.ones((len(points), 1))
    )


def test_feel_separates_driven_frequencies() -> None:
    """Two tones and a transient at neither: the tones' own amplitudes, and the peak of all."""
    times = 51234.5 + np.arange(3000) / 10_000
    first = np.array([2.0, 0.5])
    second = np.array([0.3, 0.0])
    ringing = 0.4 * np.exp(-(times - times[0]) / 0.02) * np.sin(2 * np.pi * 163.3 * times)
    samples = (
        np.outer(np.sin(2 * np.pi * 110 * times + 1.0), first)
        + np.outer(np.cos(2 * np.pi * 170 * times - 2.0), second)
        + ringing[:, None]
    )
    felt = measure_vibration(
        Record(np.zeros((2, 2)), np.full(2, 0.5), times, samples), [110.0, 170.0]
    )
    np.testing.assert_allclose(felt.amplitude, [first, second], atol=0.03)
    np.testing.assert_allclose(felt.peak, np.abs(samples).max(axis=0), rtol=0.005)
    clean = measure_vibration(
        Record(np.zeros((2, 2)), np.full(2, 0.5), times, samples - ringing[:, None]), [110.0, 170.0]
    )
    np.testing.assert_allclose(clean.amplitude, [first, second], atol=1e-7)


def test_feel_without_frequencies() -> None:
    """Without a frequency there is a peak only."""
    felt = measure_vibration(
        Record(np.zeros((1, 2)), np.ones(1), np.arange(5.0), np.full((5, 1), -3.0)), []
    )
    assert felt.amplitude.shape == (0, 1)
    assert felt.peak == [3.0]


def test_fingers_felt_uses_the_last_position(coarse_rig: Rig) -> None:
    """Samples from before a move do not count, nor those outside the window."""
    fingers = Fingers(flat_plate(coarse_rig))
    fingers.place({"a": (0.1, 0.1), "b": (0.0, 0.0)})
    old = len(fingers.layout.points)
    assert old == 2 * 21
    fingers.record(np.array([1.0, 2.0]), np.ones((2, old)))
    fingers.place({"a": (0.2, 0.1), "b": (0.0, 0.0)})
    fingers.record(np.array([3.0, 4.0]), np.full((2, old), 5.0))
    felt = fingers.felt(1.5, 3.5)
    assert felt["a"].times.tolist() == [3.0]
    assert felt["b"].times.tolist() == [2.0, 3.0]
    assert felt["b"].accelerations[:, 0].tolist() == [1.0, 5.0]
    np.testing.assert_array_equal(felt["a"].points, fingertip_points(0.2, 0.1, coarse_rig.plate))
    assert fingers.felt(4.5, 5.0) == {}


def test_fingers_felt_until_lifted(coarse_rig: Rig) -> None:
    """One finger goes while another stays: both have their samples, each from its own time."""
    fingers = Fingers(flat_plate(coarse_rig))
    fingers.place({"a": (0.1, 0.1), "b": (0.2, 0.1)})
    fingers.record(np.array([1.0, 2.0]), np.ones((2, 42)))
    fingers.place({"b": (0.2, 0.1)})
    fingers.record(np.array([3.0]), np.ones((1, 21)))
    felt = fingers.felt(0.0, 4.0)
    assert felt["a"].times.tolist() == [1.0, 2.0]
    assert felt["b"].times.tolist() == [1.0, 2.0, 3.0]


def test_fingers_discard_old_samples(coarse_rig: Rig) -> None:
    """Ten seconds are kept, also of fingers that were lifted since."""
    fingers = Fingers(flat_plate(coarse_rig))
    fingers.place({"a": (0.1, 0.1)})
    fingers.record(np.array([0.0]), np.ones((1, 21)))
    fingers.record(np.array([6.0]), np.ones((1, 21)))
    fingers.place({})
    fingers.record(np.array([11.0]), np.ones((1, 0)))
    assert fingers.felt(-1.0, 20.0)["a"].times.tolist() == [6.0]


def test_fingers_off_the_plate_change_nothing(coarse_rig: Rig) -> None:
    """One finger beside the plate, and all of them stay where they were."""
    fingers = Fingers(flat_plate(coarse_rig))
    fingers.place({"a": (0.1, 0.1)})
    for bad in [(0.4, 0.1), (float("nan"), 0.1), (0.1, -1e-3)]:
        with pytest.raises(InputError, match="finger c"):
            fingers.place({"b": (0.2, 0.2), "c": bad})
    with pytest.raises(InputError, match="32"):
        fingers.place({str(k): (0.1, 0.1) for k in range(33)})
    assert fingers.layout.positions == {"a": (0.1, 0.1)}
