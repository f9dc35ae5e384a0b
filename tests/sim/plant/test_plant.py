"""The plate in time, against a linear system on straight lines, and its continuity."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.signal import lsim

from model.answer.answer import Layer
from model.answer.answer_report import Timing
from model.answer.stimulus import Placement
from model.arrays import FloatArray
from model.errors import InputError
from model.fem import Mesh
from model.finger import contrast_db, felt_part, fingertip_points, fingertip_weights
from model.reduction.reduced_plate import ReducedPlate, modal_matrices, reduce_plate
from model.rig.rig import Rig
from model.structure.attachments import Era, FingertipLoad
from model.structure.plate import Material, Plate
from model.table.table_file import build_table
from model.transients.base_motion import Term
from model.transients.shaping import ONSET_WINDOW
from plates import FINGERTIP, faded_base, make_paper_rig, resting, shaped_base
from set_table import only
from sim.plant.plant import Plant, SampledPlant

PLATE = Plate(0.3048, 0.2286, 0.0015, Material("aluminium", 70e9, 2700.0, 0.33), loss_factor=0.01)
CORNERS = [(0.0, 0.0), (0.3048, 0.0), (0.3048, 0.2286), (0.0, 0.2286)]
STROKE = 1e-4


def eras(damping: float = 3.46, bolt_mass: float = 0.02) -> list[Era]:
    """Four alike, one in each corner."""
    return [
        Era(name, x, y, 17000.0, damping, bolt_mass, STROKE)
        for name, (x, y) in zip("abcd", CORNERS, strict=True)
    ]


MESH = Mesh(16, 12, PLATE.length, PLATE.width)


@pytest.fixture(scope="module")
def reduced() -> ReducedPlate:
    """The paper's plate on a coarse mesh."""
    return reduce_plate(PLATE, MESH, np.array(CORNERS))


@pytest.mark.parametrize("damping", [3.46, 3000.0])
def test_plant_is_continuous_when_drives_change(reduced: ReducedPlate, damping: float) -> None:
    """Starting, replacing and ending a drive abruptly changes neither at that moment.

    With the larger damping some eigenvalues are real.
    """
    plant = Plant(reduced, eras(damping))
    assert (plant.loaded.plate.eigenvalues.imag == 0).any() == (damping > 1000)
    plant.set_input(0, [Term(0.0, 0.1, 700.0, STROKE * np.exp(0.7j), 3j * STROKE)])
    plant.skip(0.0345)
    before = plant.state
    plant.set_input(0, [Term(0.0345, np.inf, 1500.0, STROKE * 1j)])
    plant.set_input(3, [Term(0.0, np.inf, 900.0, -STROKE)])
    for old, new in zip(before, plant.state, strict=True):
        np.testing.assert_allclose(new, old, rtol=1e-6, atol=1e-9 * np.abs(old).max())
    plant.skip(0.05)
    before = plant.state
    plant.set_input(0, [])
    for old, new in zip(before, plant.state, strict=True):
        np.testing.assert_allclose(new, old, rtol=1e-6, atol=1e-9 * np.abs(old).max())


def test_plant_refuses_an_unsupported_plate(reduced: ReducedPlate) -> None:
    """Two ERAs leave the axis through them free to rotate."""
    with pytest.raises(InputError, match="supported"):
        Plant(reduced, eras()[:2])


@pytest.fixture(scope="module")
def rig() -> Rig:
    """The paper's plate; no two ERAs damp alike, one hardly at all."""
    paper = make_paper_rig(12, 9)
    unlike = zip(paper.eras, (0.1, 3.5, 10.0, 20.0), (0.0, 0.005, 0.01, 0.02), strict=True)
    return replace(paper, eras=tuple(replace(era, damping=c, bolt_mass=m) for era, c, m in unlike))


RATE = 48_000.0
PAIRS = (((0.06, 0.04), (0.22, 0.16)), ((0.15, 0.1), (0.28, 0.03)), ((0.25, 0.2), (0.05, 0.15)))
ABOVE = ((560.0, 0.3), (640.0, 0.2), (720.0, 0.4), (800.0, 0.25))
"""Resonance [Hz] and damping ratio of each actuator, as behind a sound card."""
WITHIN = ((180.0, 0.12), (260.0, 0.1), (340.0, 0.2), (420.0, 0.15))
"""The same with resonances among the frequencies that are played."""


def gain(frequencies: FloatArray, resonance: float, ratio: float) -> FloatArray:
    """Motion of a base by an output, as of a damped oscillator."""
    x = frequencies / resonance
    return np.asarray(1 / (1 - x**2 + 2j * ratio * x))


def driven_by(rig: Rig, pattern: Layer, times: FloatArray) -> FloatArray:
    """What an onset would move the bases by, (n, eras) [m], if they followed at once."""
    bases = np.zeros((len(times), len(rig.eras)))
    for number, era in enumerate(rig.eras):
        if pattern.onset and era.name in pattern.onset:
            envelope = pattern.onset[era.name]
            amplitude, frequency = envelope.amplitude(times), envelope.frequency
        elif not pattern.onset and era.name in pattern.excitation:
            tone = pattern.excitation[era.name]
            rise = (1 - np.cos(np.pi * np.clip(times / pattern.ramp, 0, 1))) / 2
            amplitude, frequency = rise * tone.phasor, tone.frequency
        else:
            continue
        bases[:, number] = (amplitude * np.exp(2j * np.pi * frequency * times)).imag
    return bases


@pytest.mark.parametrize("actuators", [ABOVE, WITHIN])
@pytest.mark.parametrize("is_shaped", [True, False])
def test_contrast_of_an_onset_behind_actuators_that_lag(
    coarse_rig: Rig, is_shaped: bool, actuators: tuple[tuple[float, float], ...]
) -> None:
    """That of their equation of motion within 1 dB of the one that gains predict, on one plate.

    But for a shaped onset through resonances that are played, which loses up to 6 dB.
    """
    rows = np.arange(30.0, 521.0, 5.0)
    eras = tuple(
        replace(
            era,
            gains=tuple(
                zip(rows, abs(gain(rows, *each)), np.angle(gain(rows, *each)), strict=True)
            ),
        )
        for era, each in zip(coarse_rig.eras, actuators, strict=True)
    )
    rig = replace(coarse_rig, eras=eras, fingertip=None)
    table = build_table(rig, frequencies=np.arange(80.0, 401.0, 40.0))
    timing = Timing(table)
    times = (np.arange(round(ONSET_WINDOW * RATE)) + 1) / RATE
    for target, quiet in PAIRS:
        placed = Placement((target,), (quiet,))
        layer, _ = only(table, placed, 15.0)
        pattern = timing.with_envelopes(layer, placed, onset=is_shaped, ending=False)
        predicted = timing.transient_contrast_db(pattern, placed)
        bases = driven_by(rig, pattern, times)
        for number, (resonance, ratio) in enumerate(actuators):
            omega = 2 * np.pi * resonance
            system = ([omega**2], [1, 2 * ratio * omega, omega**2])
            _, moved, _ = lsim(system, np.append(0.0, bases[:, number]), np.append(0.0, times))
            bases[:, number] = moved[1:]
        plant = Plant(table.in_time.reduced, coarse_rig.eras)
        discs = [fingertip_points(*at, rig.plate) for at in (target, quiet)]
        felt = SampledPlant(plant, rate=RATE).advance(
            bases, shapes=plant.reduced.at(np.concatenate(discs))
        )
        peaks = np.split(np.abs(felt_part(felt, RATE)).max(axis=0), [len(discs[0])])
        weights = [fingertip_weights(*target, rig.plate)]
        lost = predicted - contrast_db(peaks[:1], peaks[1], weights)
        assert -1 < lost < (6 if is_shaped and actuators is WITHIN else 1)


BASES = (
    faded_base(STROKE, 110.0, 0.3, rise=(0.0, 0.02), fall=(0.07, 0.08)),
    faded_base(0.7 * STROKE, 250.0, -1.0, rise=(0.01, 0.03), fall=(0.09, 0.1)),
    shaped_base(STROKE, 171.0, start=0.002, step=0.005, knots=(0, 0.5, 0.8j, -0.3, 0)),
)
PLACES = ((0.11, 0.07), (0.25, 0.15), (0.3048, 0.1))
ONE, THREE = resting(PLACES[0]), resting(*PLACES)


def vibrating(reduced: ReducedPlate, rig: Rig, *, until: float = 0.05) -> Plant:
    """A plate that three bases move, at a moment [s]."""
    plant = Plant(reduced, rig.eras)
    for number, base in enumerate(BASES):
        plant.set_input(number, base.terms)
    plant.skip(until)
    return plant


def on_the_mesh(plant: Plant) -> tuple[FloatArray, FloatArray]:
    """Displacement and velocity at all nodes."""
    plate = plant.reduced.plate
    shapes = plant.reduced.at(Mesh(12, 9, plate.length, plate.width).nodes)
    q, v = (part[: shapes.shape[1]] for part in plant.state)
    return shapes @ q, shapes @ v


def phalanges(plant: Plant) -> dict[str, FloatArray]:
    """Displacement and velocity of each contact's phalanx."""
    last = np.transpose(plant.state)[len(plant.reduced.omega) :]
    return dict(zip(plant.contacts, last, strict=True))


def stored(plant: Plant, rig: Rig) -> float:
    """Energy [J] of the plate on springs at rest: its motion, its bending, and its springs."""
    r = len(plant.reduced.omega)
    q, v = (part[:r] for part in plant.state)
    M, _, K = modal_matrices(plant.reduced, rig.eras)
    return float(q @ K @ q + v @ M @ v) / 2


def test_contacts_keep_displacement_and_velocity_continuous(
    coarse_rig: Rig, reduced: ReducedPlate
) -> None:
    """Fingers come, press harder, move and go: the whole plate goes on from where it is.

    So do the phalanges of fingers that stay; those of new fingers are at rest.
    """
    plant = vibrating(reduced, coarse_rig)
    harder = replace(FINGERTIP, stiffness=3000.0, damping=5.0, contact_mass=0.001)
    pressed = resting(PLACES[0], fingertip=harder)
    elsewhere = {"b": FingertipLoad(0.2, 0.2, FINGERTIP)}
    changes: list[Mapping[str, FingertipLoad]] = [
        ONE, THREE, THREE | pressed, pressed | elsewhere, elsewhere, {}
    ]  # fmt: skip
    for contacts in changes:
        plant.skip(plant.time + 0.0031)
        before, energy = on_the_mesh(plant), stored(plant, coarse_rig)
        resting_before = phalanges(plant)
        plant.set_contacts(contacts)
        assert plant.contacts == contacts
        for id, found in phalanges(plant).items():
            assert_allclose(found, resting_before.get(id, (0.0, 0.0)), rtol=1e-9, atol=1e-12)
        for old, new in zip(before, on_the_mesh(plant), strict=True):
            assert_allclose(new, old, rtol=0, atol=1e-9 * np.abs(old).max())
        assert stored(plant, coarse_rig) == pytest.approx(energy, rel=1e-9)


def test_contacts_drop_vectors_of_lifted_fingers(coarse_rig: Rig, reduced: ReducedPlate) -> None:
    """Half a second later the plate is as small as before, and nothing of it has jumped."""
    plant = Plant(reduced, coarse_rig.eras)
    plant.set_input(0, [Term(0.0, np.inf, 2 * np.pi * 207.0, STROKE)])
    plant.set_contacts(THREE)
    plant.skip(0.1)
    size = len(plant.reduced.omega)
    assert size == len(reduced.omega) + 9
    plant.set_contacts(ONE)
    assert len(plant.reduced.omega) == size
    plant.skip(0.6)
    before = on_the_mesh(plant)
    plant.set_contacts({})
    plant.set_contacts(ONE)
    assert len(plant.reduced.omega) == len(reduced.omega) + 3
    for old, new in zip(before, on_the_mesh(plant), strict=True):
        assert_allclose(new, old, rtol=0, atol=1e-4 * np.abs(old).max())


POINTS = np.array([[0.11, 0.07], [0.03, 0.2], [0.3, 0.02]])


def test_contacts_are_solved_once(
    coarse_rig: Rig, reduced: ReducedPlate, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A finger that taps on one spot again and again costs one solve, not one a tap."""
    plant = Plant(reduced, coarse_rig.eras)
    plant.set_contacts(ONE)
    plant.set_contacts({})
    monkeypatch.setattr("sim.plant.plant.plate_in_time", None)
    for _ in range(5):
        plant.skip(plant.time + 0.05)
        plant.set_contacts(ONE)
        plant.skip(plant.time + 0.05)
        plant.set_contacts({})


def test_plant_sampling_rate_may_change(coarse_rig: Rig, reduced: ReducedPlate) -> None:
    """Every tenth sample at 10 kHz is the sample at 1 kHz, also right after the other rate."""
    quick, mixed = (vibrating(reduced, coarse_rig) for _ in range(2))
    shapes = reduced.at(POINTS)
    _, expected = quick.advance(0.12, sample_rate=10_000.0, shapes=shapes)
    mixed.advance(0.07, sample_rate=10_000.0, shapes=shapes)
    times, found = mixed.advance(0.12, sample_rate=1000.0, shapes=shapes)
    assert len(times) == 50
    rows = np.round((times - 0.05) * 10_000).astype(int) - 1
    assert_allclose(found, expected[rows], rtol=0, atol=1e-9 * np.abs(expected).max())


def test_bases_given_as_samples_move_the_plate_as_their_formulas(
    coarse_rig: Rig, reduced: ReducedPlate
) -> None:
    """At 48 kHz, with fingers that come and go: of what skin can feel within 1 %."""
    rate = 48_000
    exact, followed = vibrating(reduced, coarse_rig, until=0.0), Plant(reduced, coarse_rig.eras)
    made = SampledPlant(followed, rate=rate)
    pieces = []
    for number, contacts in enumerate(({}, THREE, ONE)):
        for plant in (exact, followed):
            plant.set_contacts(contacts)
        made.follow()
        times = (np.arange(2400) + 1 + 2400 * number) / rate
        bases = np.zeros((len(times), len(coarse_rig.eras)))
        bases[:, :3] = [[base.motion(time)[0] for base in BASES] for time in times]
        shapes = exact.reduced.at(POINTS)
        samples = made.advance(bases, shapes=shapes)
        _, halfway = exact.advance(times[-1], sample_rate=2 * rate, shapes=shapes)
        pieces.append((samples, halfway[::2]))
    found, expected = (felt_part(np.concatenate(each), rate) for each in zip(*pieces, strict=True))
    assert_allclose(found, expected, rtol=0, atol=0.01 * np.abs(expected).max())
