"""Motions of bases, fingers and imperfections of a simulated plate, as fingers measure them.

Channels are late and wrong in gain and phase; plates differ from their rigs.
"""

import cmath
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from drivers.playing import AmplifierTone
from kit.plates import FINGERTIP, lock_in
from model.answer.answer import Layer
from model.answer.stimulus import Placement, Stimulus, together
from model.arrays import FloatArray
from model.errors import InputError
from model.reduction.reduced_plate import ReducedPlate
from model.rig.rig import Channel, Rig, Uncertainty
from model.structure.attachments import PointLoad
from model.structure.fingertips import Fingertip
from model.vibration import Tone as VibrationTone
from sim.bench.bench import Bench
from sim.plant.excited_plate import play as play_excitation
from sim.plant.fingers import PlateFingers
from sim.plant.imperfections import (
    ChannelErrors,
    Imperfections,
    PlateErrors,
    draw_imperfections,
)
from tests.sim.armed_bench import arm_bench, keep_alive, play

FINGER = (0.08, 0.06)
PERFECT = Imperfections()


def record(
    rig: Rig,
    imperfections: Imperfections,
    drive: Mapping[str, Sequence[AmplifierTone]],
    *,
    duration: float,
) -> tuple[FloatArray, FloatArray]:
    """Return times [s] and the acceleration in the middle of a finger [m/s²].

    The tones are commanded at 0.01 s.
    """
    bench = Bench(rig, now=0.0, imperfections=imperfections)
    bench.place_fingers({"a": FINGER}, now=0.0)
    for name, tones in drive.items():
        arm_bench(bench, 2.0, now=0.0, name=name)
        play(bench, *tones, now=0.01, name=name, ramp=0.02)
    keep_alive(bench, duration)
    finger = bench.sample_fingers().felt(0.0, duration)["a"]
    return finger.times, finger.accelerations[:, 0]


def settled_amplitude(
    rig: Rig, imperfections: Imperfections, name: str, channel: int, frequency: float = 110.0
) -> complex:
    """Return the complex amplitude of a tone of one channel after 2.5 s, by least squares."""
    drive = {name: [AmplifierTone(channel, frequency, 0.5)]}
    times, samples = record(rig, imperfections, drive, duration=3.0)
    is_settled = times >= 2.5
    return complex(lock_in(times[is_settled], samples[is_settled], frequency))


def test_imperfections_apply_gain_and_phase(two_amplifiers: Rig) -> None:
    """A channel that is 20 % too strong and 10 degrees ahead changes its own share only."""
    phase = math.radians(10)
    errors = Imperfections({Channel("right", 1): ChannelErrors(1.2, phase)})

    correct = settled_amplitude(two_amplifiers, PERFECT, "right", 1)
    wrong = settled_amplitude(two_amplifiers, errors, "right", 1)
    assert wrong == pytest.approx(cmath.rect(1.2, phase) * correct, rel=1e-6)

    correct = settled_amplitude(two_amplifiers, PERFECT, "left", 0)
    unaffected = settled_amplitude(two_amplifiers, errors, "left", 0)
    assert unaffected == pytest.approx(correct, rel=1e-9)


def drawn_parameters(imperfections: Imperfections, rig: Rig) -> dict[str, float]:
    """Return all parameters that are drawn, logarithms of those that are factors."""
    plate = imperfections.plate
    parameters = {
        "thickness": plate.thickness,
        "modulus": plate.modulus,
        "loss factor": math.log(plate.loss_factor),
        "ERA damping": math.log(plate.era_damping),
        "fingertip 1": math.log(imperfections.load_of("1", Fingertip()).stiffness / 1000),
        "fingertip 2": math.log(imperfections.load_of("2", Fingertip()).phalanx_mass / 0.005),
        "foot": math.log(plate.realised(rig).masses[1].stiffness / 2e3),
    }
    for era in rig.eras:
        parameters[f"stiffness {era.name}"] = plate.stiffness[era.name]
        x, y = plate.places[era.name]
        parameters[f"x {era.name}"] = x
        parameters[f"y {era.name}"] = y
    for channel, errors in imperfections.channels.items():
        parameters[f"real {channel}"] = errors.harmonic.real
        parameters[f"imaginary {channel}"] = errors.harmonic.imag
    return parameters


SPREADS = {
    "thickness": (1.0, 0.01),
    "modulus": (1.0, 0.02),
    "loss factor": (0.0, math.log(1.3)),
    "ERA damping": (0.0, math.log(1.3)),
    "fingertip 1": (0.0, 0.4),
    "fingertip 2": (0.0, 0.4),
    "foot": (0.0, 0.25),
    "stiffness": (1.0, 0.2),
    "x": (0.0, 0.003),
    "y": (0.0, 0.003),
    "real": (0.0, 0.1 * math.sqrt(0.5)),
    "imaginary": (0.0, 0.1 * math.sqrt(0.5)),
}
"""Mean and standard deviation of each parameter, or of all whose names begin so."""


def test_drawn_imperfections_have_the_spread_of_the_rig(coarse_rig: Rig) -> None:
    """Over 500 plates every parameter has its standard deviation, and none follows another."""
    uncertainty = Uncertainty(
        0.0,
        0.0,
        thickness=0.01,
        stiffness=0.2,
        damping=1.3,
        fingertip=0.4,
        modulus=0.02,
        place=0.003,
        harmonic=0.1,
        supports=0.25,
    )
    mass = PointLoad(0.2, 0.1, mass=0.01)
    foot = PointLoad(0.1, 0.08, stiffness=2e3, is_foot=True)
    rig = replace(coarse_rig, uncertainty=uncertainty, masses=(mass, foot))
    plates = []
    for seed in range(500):
        plates.append(drawn_parameters(draw_imperfections(rig, seed=seed), rig))

    samples = np.array([list(plate.values()) for plate in plates]).T
    for name, values in zip(plates[0], samples, strict=True):
        kind = name if name in SPREADS else name.split()[0]
        mean, spread = SPREADS[kind]
        assert values.mean() == pytest.approx(mean, abs=0.15 * spread), name
        assert values.std() == pytest.approx(spread, rel=0.1), name
    correlations = np.corrcoef(samples)
    assert_allclose(correlations, np.eye(len(correlations)), atol=0.2)


def test_drawn_imperfections_without_uncertainty_change_the_mesh_only(coarse_rig: Rig) -> None:
    """The mesh becomes as fine as that of any rig, or coarser if it was as fine."""
    certain = replace(coarse_rig, uncertainty=Uncertainty.none())

    drawn = draw_imperfections(certain, seed=3)

    realized = drawn.plate.realised(certain)
    assert realized.plate == certain.plate
    assert realized.eras == certain.eras
    assert drawn.load_of("1", FINGERTIP) == FINGERTIP
    assert realized.mesh != certain.mesh
    fine = replace(certain, mesh=realized.mesh)
    assert draw_imperfections(fine, seed=3).plate.mesh not in (None, realized.mesh)


def test_imperfect_plate_vibrates_as_a_rig_that_was_built_so(coarse_rig: Rig) -> None:
    """The plate is thicker, ERA SE softer, two ERAs are displaced, and all damping is higher."""
    errors = PlateErrors(
        thickness=1.03,
        modulus=0.97,
        loss_factor=1.5,
        era_damping=2.0,
        stiffness={"SE": 0.8},
        places={"SE": (-0.002, 0.001), "SW": (-0.001, 0.004)},
    )
    softer_plate = coarse_rig.plate.scaled(modulus=0.97)
    plate = replace(softer_plate, thickness=0.001545, loss_factor=0.015)
    eras = {}
    for era in coarse_rig.eras:
        eras[era.name] = replace(era, damping=2 * era.damping)
    eras["SE"] = replace(eras["SE"], x=0.3028, y=0.001, stiffness=13_600.0)
    eras["SW"] = replace(eras["SW"], x=0.0, y=0.004)  # not off the plate
    built = replace(coarse_rig, plate=plate, eras=tuple(eras.values()))
    drive = {"main": [AmplifierTone(0, 110.0, 0.5), AmplifierTone(1, 110.0, 0.5)]}

    _, imperfect = record(coarse_rig, Imperfections(plate=errors), drive, duration=1.0)
    _, expected = record(built, PERFECT, drive, duration=1.0)

    assert_allclose(imperfect, expected, rtol=0, atol=1e-6 * np.abs(expected).max())
    _, nominal = record(coarse_rig, PERFECT, drive, duration=1.0)
    change = np.abs(imperfect - nominal).max()
    assert change > 0.1 * np.abs(nominal).max()


def test_imperfections_reject_unknown_channels(two_amplifiers: Rig) -> None:
    """A channel without an ERA and an amplifier that the rig lacks are named."""
    unknown_channel = Imperfections({Channel("left", 7): ChannelErrors()})
    with pytest.raises(InputError, match="channel 7 of amplifier left"):
        unknown_channel.check(two_amplifiers)
    unknown_amplifier = Imperfections(delays={"middle": 0.001})
    with pytest.raises(InputError, match="middle"):
        Bench(two_amplifiers, now=0.0, imperfections=unknown_amplifier)


@pytest.mark.parametrize("position", [(0.4, 0.1), (math.nan, 0.1), (0.1, -1e-3)])
def test_fingers_stay_where_they_are_when_one_is_off_the_plate(
    coarse_rig: Rig, position: tuple[float, float]
) -> None:
    """The error names the finger; more than 32 fingers are rejected as well."""
    zero = np.zeros(1)
    rigid = ReducedPlate(coarse_rig.plate, zero, zero, lambda points: np.ones((len(points), 1)))
    fingers = PlateFingers(rigid)
    fingers.place({"a": (0.1, 0.1)})

    with pytest.raises(InputError, match="finger c"):
        fingers.place({"b": (0.2, 0.2), "c": position})
    with pytest.raises(InputError, match="32"):
        fingers.place({str(number): (0.1, 0.1) for number in range(33)})

    assert fingers.layout.positions == {"a": (0.1, 0.1)}


FINGERS = Placement(((0.10, 0.03),), ((0.22, 0.16),))
"""A targeted and a quiet finger."""
EXCITATION = {"SW": VibrationTone(110.0, 1e-5)}


@pytest.mark.parametrize(
    ("fingers", "duration", "cause"),
    [
        (FINGERS, 0.3, "duration"),
        (FINGERS, math.nan, "duration"),
        (FINGERS, 11.0, "duration"),
        (Placement(((8.0, 6.0),)), 1.0, "plate"),
    ],
)
def test_playback_rejects_invalid_durations_and_fingers(
    coarse_rig: Rig, reduced: ReducedPlate, fingers: Placement, duration: float, cause: str
) -> None:
    """Nothing settles, the record fills the memory, or a finger is off the plate."""
    question = together(fingers, Stimulus())
    with pytest.raises(InputError, match=cause):
        play_excitation(coarse_rig, reduced, [Layer(EXCITATION)], question, duration=duration)
