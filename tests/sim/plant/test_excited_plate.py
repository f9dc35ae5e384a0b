"""An excitation played on the plate in time, against the frequency domain and by hand."""

import math
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.direct_plate import direct_acceleration
from model.answer.answer import Layer
from model.answer.stimulus import Placement, Stimulus, together
from model.errors import InputError
from model.fem import assemble
from model.finger import (
    detection_threshold,
    fingertip_points,
    fingertip_weights,
    mean_level_db_sl,
    sensation_level,
)
from model.reduction.reduced_plate import ReducedPlate
from model.rig.rig import Rig
from model.structure.attachments import Fingertip, FingertipLoad
from model.transients.base_motion import BaseEnvelope, shaped
from model.transients.shaping import Transients
from model.transients.time_response import plate_in_time
from model.vibration import Tone
from sim.plant.excited_plate import Playback, Vibration, play
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


TARGET, QUIET = (0.10, 0.03), (0.22, 0.16)
FINGERS = Placement((TARGET,), (QUIET,))
HEAVY = Fingertip(stiffness=5000.0, damping=20.0, contact_mass=0.005)
EXCITATION = {"SW": Tone(110.0, 1e-5), "NE": Tone(250.0, 5e-6, math.pi / 2)}


def steady(rig: Rig, place: tuple[float, float], *loads: FingertipLoad) -> np.ndarray:
    """Amplitudes (2, p) [m/s²] under a fingertip at 110 and 250 Hz, by a direct solve."""
    points = fingertip_points(*place, rig.plate)
    frequencies = np.array([110.0, 250.0])
    unit = direct_acceleration(
        assemble(rig.plate, rig.mesh), rig.eras, frequencies, points, loads=loads
    )
    return np.abs([0.1 * unit[0, 0], 0.05 * unit[1, 2]])  # SW and NE, of 100 µm


@pytest.mark.parametrize(
    ("fingertip", "pressed"), [(None, ()), (HEAVY, ()), (HEAVY, (0.5, 2.0)), (None, (0.5, 2.0))]
)
def test_playback_steady_measures_agree_with_the_frequency_domain(
    coarse_rig: Rig, reduced: ReducedPlate, fingertip: Fingertip | None, pressed: tuple[float, ...]
) -> None:
    """Level and contrast by a direct solve, within 0.1 dB, fingers that load the plate or not."""
    rig = replace(coarse_rig, fingertip=fingertip)
    fingers = replace(FINGERS, loads=pressed)
    played = play(rig, reduced, [Layer(EXCITATION)], together(fingers, Stimulus()), duration=None)
    tips = [fingertip.scaled(each) for each in pressed or (1, 1)] if fingertip else []
    loads = [FingertipLoad(*at, tip) for at, tip in zip((TARGET, QUIET), tips, strict=False)]
    at_target, at_quiet = (steady(coarse_rig, at, *loads) for at in (TARGET, QUIET))
    weights = fingertip_weights(*TARGET, coarse_rig.plate)
    level = mean_level_db_sl(np.array([110.0, 250.0]), at_target, weights)
    quiet_level = sensation_level(np.array([110.0, 250.0]), at_quiet).max()
    assert played.level_db_sl == pytest.approx(level, abs=0.1)
    assert played.contrast_db == pytest.approx(level - quiet_level, abs=0.1)
    free = mean_level_db_sl(np.array([110.0, 250.0]), steady(coarse_rig, TARGET), weights)
    assert (abs(level - free) > 1) is (fingertip is not None)


def test_playback_measures_of_several_targets() -> None:
    """Of made-up records: means over targets, the loudest quiet point, the lesser target."""
    times = np.arange(1, 10_001) / 10_000
    points = np.zeros((2, 2))

    def record(*amplitudes: float) -> Record:
        wave = np.sin(2 * np.pi * 100 * times)
        early = np.where(times <= 0.1, 0.5, 1.0)  # half as strong while it starts
        return Record(
            points, np.full(2, 0.5), times, (wave * early)[:, None] * np.array(amplitudes)
        )

    quiet = record(0.1, 0.2)
    quiet.accelerations[:1000] *= 10.0  # louder while it starts
    at_targets = record(3.0, 5.0), record(2.0, 2.0)
    vibration = Vibration((100.0,), (0, 1), (*at_targets, quiet))
    played = Playback((vibration,), settled=0.1)
    assert played.contrast_db == pytest.approx(20 * math.log10(2 / 0.2), abs=1e-6)
    assert played.transient_contrast_db == pytest.approx(20 * math.log10(1.0 / 1.0), abs=0.01)
    assert played.quiet_level_db_sl is not None
    assert played.level_db_sl - played.quiet_level_db_sl == pytest.approx(20.0, abs=1e-6)
    alone = Playback((Vibration((100.0,), (0,), at_targets[:1]),), settled=0.1)
    assert (alone.contrast_db, alone.transient_contrast_db, alone.quiet_level_db_sl) == (None,) * 3


def test_playback_with_an_onset_envelope(coarse_rig: Rig, reduced: ReducedPlate) -> None:
    """What fingertips go through is what another solution in time says, the model's own."""
    excitation = {"SW": Tone(110.0, 1e-5)}
    onset = {
        "SW": BaseEnvelope(110.0, 2e-6, (4e-6j, -1e-5, 1e-5)),
        "NE": BaseEnvelope(110.0, 0, (5e-6, 0)),
    }
    rig = replace(coarse_rig, fingertip=None)
    layer = Layer(excitation, onset=onset)
    played = play(rig, reduced, [layer], together(FINGERS, Stimulus()), duration=None)
    assert played.settled == pytest.approx(0.015)
    transients = Transients(plate_in_time(reduced, coarse_rig.eras))
    for record in (*played.targets, *played.quiet):
        other = transients.acceleration(shaped(onset, coarse_rig.eras), record.points, duration=0.2)
        every = 2000  # Hz, of which both sampling rates are multiples
        here = record.accelerations[4:2000:5][:-1]
        np.testing.assert_allclose(record.times[4:2000:5][:-1] * every, np.arange(1, 400))
        np.testing.assert_allclose(here, other[4::4], atol=1e-6 * np.abs(other).max())


@pytest.mark.parametrize(
    ("fingers", "duration", "says"),
    [
        (FINGERS, 0.3, "duration"),
        (FINGERS, math.nan, "duration"),
        (FINGERS, 11.0, "duration"),
        (Placement(((8.0, 6.0),)), 1.0, "plate"),
    ],
)
def test_playback_refuses_invalid_input(
    coarse_rig: Rig, reduced: ReducedPlate, fingers: Placement, duration: float, says: str
) -> None:
    """Times in which nothing settles or that fill the memory, and fingers beside the plate."""
    with pytest.raises(InputError, match=says):
        play(
            coarse_rig,
            reduced,
            [Layer(EXCITATION)],
            together(fingers, Stimulus()),
            duration=duration,
        )


def test_playback_reads_steady_measures_at_the_end() -> None:
    """Ten times as much until a quarter of a second before the end does not count."""
    times = np.arange(10_000) / 10_000.0
    tone = np.where(times < 0.75, 10.0, 1.0) * np.sin(2 * np.pi * 100.0 * times)
    record = Record(np.array([[0.1, 0.1]]), np.ones(1), times, tone[:, None])
    playback = Playback((Vibration((100.0,), (0,), (record,)),), settled=0.04)
    expected = -20 * np.log10(detection_threshold(np.array([100.0]))[0])
    assert playback.level_db_sl == pytest.approx(expected, abs=0.01)
