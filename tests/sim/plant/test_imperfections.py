"""Excitations on the plate in time: by hand, in the frequency domain, and with imperfections.

Bases move as voices say, late and wrong in gain and phase, as seen from the plate.
"""

import cmath
import math
import random
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from drivers.playing import AmplifierTone, Playback
from drivers.protocol.sets import Command, Envelope, LayerSet
from kit.plates import FINGERTIP, lock_in
from kit.plates import motion_of as sampled
from model.answer.answer import Layer
from model.answer.stimulus import Placement, Stimulus, together
from model.arrays import FloatArray
from model.errors import InputError
from model.reduction.reduced_plate import ReducedPlate
from model.rig.rig import Channel, Rig, Uncertainty
from model.structure.attachments import PointLoad
from model.structure.fingertips import Fingertip
from model.transients.base_motion import BaseEnvelope, shaped
from model.transients.shaping import Transients
from model.transients.time_response import plate_in_time
from model.vibration import Tone as VibrationTone
from processes.firmware_machine import arm_bench, keep_alive, play
from sim.amplifier.amplifier_clock import StraightClock
from sim.bench.bench import Bench
from sim.plant.era_motions import motion_of
from sim.plant.excited_plate import play as play_excitation
from sim.plant.fingers import FingerRecord, PlateFingers, measure_vibration
from sim.plant.imperfections import (
    ChannelErrors,
    Imperfections,
    PlateErrors,
    draw_imperfections,
)

AT = (0.08, 0.06)
PERFECT = Imperfections()
EXACT = StraightClock(0.0, 0.0, 1.0)


def played(
    rig: Rig,
    imperfections: Imperfections,
    commands: Mapping[str, tuple[AmplifierTone, ...]],
    *,
    until: float = 1.0,
    stop: float | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Times [s] and acceleration [m/s²] in the middle of a finger, commands coming at 0.01 s."""
    bench = Bench(rig, now=0.0, imperfections=imperfections)
    bench.place_fingers({"a": AT}, now=0.0)
    for name, wanted in commands.items():
        arm_bench(bench, 2.0, now=0.0, name=name)
        play(bench, *wanted, now=0.01, name=name, ramp=0.02)
    if stop is not None:
        for name in commands:
            bench.exchange(name, "Stop", {"ramp": 10}, now=stop)
    keep_alive(bench, until)
    (record,) = bench.sample_fingers().felt(0.0, until).values()
    return record.times, record.accelerations[:, 0]


def phasor(times: FloatArray, samples: FloatArray, frequency: float, *, since: float) -> complex:
    """Complex amplitude of a frequency from a moment on, by least squares."""
    late = times >= since
    return complex(lock_in(times[late], samples[late], frequency))


def test_imperfections_apply_gain_and_phase(two_amplifiers: Rig) -> None:
    """One channel 20 % too strong and 10 degrees ahead: its share of the vibration is, alone."""
    errors = Imperfections({Channel("right", 1): ChannelErrors(1.2, math.radians(10))})
    shares: list[complex] = []
    for imperfections in (PERFECT, errors):
        for name, channel in (("left", 0), ("right", 1)):
            drive = {name: (AmplifierTone(channel, 110.0, 0.5),)}
            times, samples = played(two_amplifiers, imperfections, drive, until=3.0)
            shares.append(phasor(times, samples, 110.0, since=2.5))
    assert shares[2] == pytest.approx(shares[0], rel=1e-9)
    turned = 1.2 * np.exp(1j * math.radians(10)) * shares[1]
    assert abs(shares[3] - turned) < 1e-6 * abs(turned)


def test_imperfections_second_harmonic_is_another_tone(two_amplifiers: Rig) -> None:
    """A tenth of the motion at twice its frequency and phase, from its onset on, as if played."""
    share = cmath.rect(0.1, math.radians(40))
    errors = Imperfections({Channel("left", 0): ChannelErrors(harmonic=share)})
    drive = {"left": (AmplifierTone(0, 110.0, 0.5, 25.0), AmplifierTone(1, 170.0, 0.2))}
    _, distorted = played(two_amplifiers, errors, drive, until=0.2)
    _, plain = played(two_amplifiers, PERFECT, drive, until=0.2)
    _, harmonic = played(
        two_amplifiers,
        PERFECT,
        {"left": (AmplifierTone(0, 220.0, 0.05, 2 * 25.0 + 40.0),)},
        until=0.2,
    )
    largest = np.abs(harmonic).max()
    assert_allclose(distorted - plain, harmonic, rtol=0, atol=1e-3 * largest)
    assert largest > 0.05 * np.abs(plain).max()


def test_imperfections_skew_shifts_the_phase(two_amplifiers: Rig) -> None:
    """One amplifier 1 ms behind the other: at 110 Hz its share lags by 39.6 degrees."""
    drive = {"right": (AmplifierTone(0, 110.0, 0.5),)}
    skewed = Imperfections(delays={"right": 0.003, "left": 0.0015})
    shares = [
        phasor(*played(two_amplifiers, each, drive, until=3.0), 110.0, since=2.5)
        for each in (Imperfections(delays=dict.fromkeys(("left", "right"), 0.002)), skewed)
    ]
    lag = np.degrees(np.angle(shares[0] / shares[1]))
    assert lag == pytest.approx(360 * 110 * 0.001, abs=1e-4)


def test_imperfections_latency_keeps_the_order_of_commands(two_amplifiers: Rig) -> None:
    """Two sets within the latency: both are played, each as long as it was meant to be."""
    frequencies = []
    for latency in (0.0, 0.05):
        bench = Bench(
            two_amplifiers, now=0.0, imperfections=Imperfections(delays={"left": latency})
        )
        bench.place_fingers({"a": AT}, now=0.0)
        arm_bench(bench, 2.0, now=0.0, name="left")
        for token, (frequency, now) in enumerate([(110.0, 0.1), (170.0, 0.12)], start=1):
            play(bench, AmplifierTone(0, frequency, 0.5), now=now, name="left", token=token)
        bench.advance(0.4)
        windows = [(0.09, 0.0999), (0.1001, 0.1199), (0.1201, 0.15)]
        frequencies.append(
            [bench.felt(a + latency, b + latency)["a"].frequencies for a, b in windows]
        )
    assert frequencies[0] == [(), (110.0,), (170.0,)]
    assert frequencies[1] == frequencies[0]


def test_draw_imperfections_is_within_the_rigs_uncertainty(coarse_rig: Rig) -> None:
    """Over five hundred plates every parameter has the rig's deviations, none follows another."""
    std = Uncertainty(
        *(0.0, 0.0),
        thickness=0.01,
        stiffness=0.2,
        damping=1.3,
        fingertip=0.4,
        modulus=0.02,
        place=0.003,
        harmonic=0.1,
        supports=0.25,
    )
    foot = PointLoad(0.1, 0.08, stiffness=2e3, is_foot=True)
    rig = replace(coarse_rig, uncertainty=std, masses=(PointLoad(0.2, 0.1, mass=0.01), foot))
    drawn = [draw_imperfections(rig, seed=seed) for seed in range(500)]
    names = [era.name for era in coarse_rig.eras]
    found = np.array(
        [
            (
                one.plate.thickness,
                np.log(one.plate.loss_factor),
                np.log(one.plate.era_damping),
                *(one.plate.stiffness[name] for name in names),
                np.log(one.load_of("1", Fingertip()).stiffness / 1000),
                np.log(one.load_of("2", Fingertip()).phalanx_mass / 0.005),
                one.plate.modulus,
                *(1e2 * at for name in names for at in one.plate.places[name]),
                *(each.harmonic.real for each in one.channels.values()),
                *(each.harmonic.imag for each in one.channels.values()),
                np.log(one.plate.realised(rig).masses[1].stiffness / 2e3),
            )
            for one in drawn
        ]
    )
    centers = np.array([1, 0, 0, 1, 1, 1, 1, 0, 0, 1] + 17 * [0])
    spreads = np.array(
        [0.01, np.log(1.3), np.log(1.3), 0.2, 0.2, 0.2, 0.2, 0.4, 0.4, 0.02]
        + 8 * [0.3]
        + 8 * [0.1 * math.sqrt(0.5)]
        + [0.25]
    )
    assert_allclose(found.mean(axis=0), centers, atol=0.15 * spreads.max(), rtol=0.01)
    assert_allclose(found.std(axis=0), spreads, rtol=0.1)
    alike = np.corrcoef(found.T) - np.eye(len(spreads))
    assert np.abs(alike).max() < 0.2


def test_draw_imperfections_of_a_known_rig_has_none(coarse_rig: Rig) -> None:
    """Only its mesh differs: one as fine as any that a rig gets."""
    known = replace(coarse_rig, uncertainty=Uncertainty.none())
    drawn = draw_imperfections(known, seed=3)
    real = drawn.plate.realised(known)
    assert (real.plate, real.eras) == (known.plate, known.eras)
    assert drawn.load_of("1", FINGERTIP) == FINGERTIP
    assert real.mesh != known.mesh
    fine = replace(known, mesh=real.mesh)
    assert draw_imperfections(fine, seed=3).plate.mesh not in (None, real.mesh)


def test_imperfections_of_the_plate_are_those_of_another_rig(coarse_rig: Rig) -> None:
    """A thicker plate on a softer ERA, all damped more, vibrates as one that was built so."""
    errors = PlateErrors(
        thickness=1.03,
        modulus=0.97,
        loss_factor=1.5,
        era_damping=2.0,
        stiffness={"SE": 0.8},
        places={"SE": (-0.002, 0.001), "SW": (-0.001, 0.004)},
    )
    places = {"SE": (0.3028, 0.001), "SW": (0.0, 0.004)}  # none is off the plate
    built = replace(
        coarse_rig,
        plate=replace(coarse_rig.plate.scaled(modulus=0.97), thickness=0.001545, loss_factor=0.015),
        eras=tuple(
            replace(
                era,
                x=places.get(era.name, (era.x, era.y))[0],
                y=places.get(era.name, (era.x, era.y))[1],
                damping=2 * era.damping,
                stiffness=13_600.0 if era.name == "SE" else 17_000.0,
            )
            for era in coarse_rig.eras
        ),
    )
    drive = {"main": (AmplifierTone(0, 110.0, 0.5), AmplifierTone(1, 110.0, 0.5))}
    _, found = played(coarse_rig, Imperfections(plate=errors), drive)
    _, expected = played(built, PERFECT, drive)
    assert_allclose(found, expected, rtol=0, atol=1e-6 * np.abs(expected).max())
    _, nominal = played(coarse_rig, PERFECT, drive)
    assert np.abs(found - nominal).max() > 0.1 * np.abs(nominal).max()


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: ChannelErrors(gain=-0.1), "negative"),
        (lambda: ChannelErrors(phase=math.nan), "finite"),
        (lambda: Imperfections(delays={"left": -0.001}), "delay"),
        (lambda: Imperfections(delays={"left": math.inf}), "delay"),
    ],
)
def test_imperfections_refuse_invalid_values(make, words: str) -> None:
    """Negative gains and delays, and values that are not finite."""
    with pytest.raises(InputError, match=words):
        make()


def test_imperfections_refuse_unknown_channels(two_amplifiers: Rig) -> None:
    """A channel without an ERA and an amplifier that the rig does not have are named."""
    with pytest.raises(InputError, match="channel 7 of amplifier left"):
        Imperfections({Channel("left", 7): ChannelErrors()}).check(two_amplifiers)
    with pytest.raises(InputError, match="middle"):
        Bench(two_amplifiers, now=0.0, imperfections=Imperfections(delays={"middle": 0.001}))


STROKE = 1e-4


@pytest.mark.parametrize("late", [0.0, 0.003])
@pytest.mark.parametrize("seed", range(3))
def test_base_moves_by_its_voices(seed: int, late: float) -> None:
    """Fades, kept phases, envelopes and jumps of random sets, delayed or not: within 1e-16 m."""
    random_ = random.Random(seed)
    playback, now = Playback(1, 8), 0.0
    for token in range(1, 40):
        knots = tuple((random_.randrange(5000), random_.randrange(-9000, 9000)) for _ in range(3))
        onset = Envelope(20, knots) if random_.random() < 0.4 else None
        command = Command(
            *(0, random_.choice((2000, 3000)), random_.choice((0, 3000, 5000)), 4500),
            keep_phase=random_.random() < 0.5,
            onset=onset,
            ending=Envelope(10, knots[:2]),
        )
        ramp = random_.choice((0, 5, 30))
        playback.commit([LayerSet(random_.randrange(2), ramp, 0, (command,))], token, now)
        motion = motion_of(playback.all_voices[0], EXACT, stroke=STROKE, delay=late)
        for _ in range(5):
            now += random_.uniform(0.0005, 0.004)
            moved = sampled(motion, np.array([now + late]))[0]
            # The sum of sinusoids of the protocol.
            turned = (
                each.transition.at(now) * cmath.exp(2j * math.pi * each.frequency * now)
                for each in playback.all_voices[0]
            )
            expected = STROKE * sum(each.imag for each in turned)
            assert moved == pytest.approx(expected, abs=1e-16)


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
        FingerRecord(np.zeros((2, 2)), np.full(2, 0.5), times, samples), [110.0, 170.0]
    )
    np.testing.assert_allclose(felt.amplitude, [first, second], atol=0.03)
    np.testing.assert_allclose(felt.peak, np.abs(samples).max(axis=0), rtol=0.005)
    clean = measure_vibration(
        FingerRecord(np.zeros((2, 2)), np.full(2, 0.5), times, samples - ringing[:, None]),
        [110.0, 170.0],
    )
    np.testing.assert_allclose(clean.amplitude, [first, second], atol=1e-7)


def test_fingers_off_the_plate_change_nothing(coarse_rig: Rig) -> None:
    """One finger beside the plate, and all of them stay where they were."""
    fingers = PlateFingers(flat_plate(coarse_rig))
    fingers.place({"a": (0.1, 0.1)})
    for bad in [(0.4, 0.1), (float("nan"), 0.1), (0.1, -1e-3)]:
        with pytest.raises(InputError, match="finger c"):
            fingers.place({"b": (0.2, 0.2), "c": bad})
    with pytest.raises(InputError, match="32"):
        fingers.place({str(k): (0.1, 0.1) for k in range(33)})
    assert fingers.layout.positions == {"a": (0.1, 0.1)}


TARGET, QUIET = (0.10, 0.03), (0.22, 0.16)
FINGERS = Placement((TARGET,), (QUIET,))
EXCITATION = {"SW": VibrationTone(110.0, 1e-5), "NE": VibrationTone(250.0, 5e-6, math.pi / 2)}


def test_playback_with_an_onset_envelope(coarse_rig: Rig, reduced: ReducedPlate) -> None:
    """What fingertips go through is what another solution in time says, the model's own."""
    excitation = {"SW": VibrationTone(110.0, 1e-5)}
    onset = {
        "SW": BaseEnvelope(110.0, 2e-6, (4e-6j, -1e-5, 1e-5)),
        "NE": BaseEnvelope(110.0, 0, (5e-6, 0)),
    }
    rig = replace(coarse_rig, fingertip=None)
    layer = Layer(excitation, onset=onset)
    played = play_excitation(rig, reduced, [layer], together(FINGERS, Stimulus()), duration=None)
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
        play_excitation(
            coarse_rig,
            reduced,
            [Layer(EXCITATION)],
            together(fingers, Stimulus()),
            duration=duration,
        )
