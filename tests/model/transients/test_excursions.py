"""Magnets and exciters in time: by hand for rigid plates, by SciPy and in the frequency domain.

Also bases that move along samples, and the kernel of knots against numpy.
"""

import math
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import StateSpace, lsim

from cases import shortly
from kit.plates import exciter_rig, make_paper_rig
from model.answer.envelope import swings_of_pulse
from model.reduction.free_plate import solve_free_plate
from model.reduction.reduced_plate import reduce_free_plate, reduce_plate
from model.reduction.supported_plate import modal_matrices, supported_modes
from model.rig.rig import Channel, Rig, Uncertainty
from model.rig.rig_file import load_rig
from model.rig.rig_writing import change_rig
from model.structure.attachments import footprints_of
from model.structure.exciter import Exciter
from model.structure.fingertips import Fingertip, FingertipLoad, fingertip_loads
from model.structure.statics import rigid_body_frequencies
from model.table.table_file import build_table
from model.transients.base_motion import shaped
from model.transients.excursions import (
    CLICKS_APART,
    MagnetMotions,
    Swing,
    excursions_of,
    magnets_of,
    motions_along,
    relative_motions,
)
from model.transients.knots import (
    steady_states,
)
from model.transients.reach import reach_of
from model.transients.shaping import Shaper, Transients
from model.transients.time_response import (
    PlateInTime,
    enveloped_accelerations,
    from_rest,
    plate_in_time,
)
from model.vibration import Tone
from processes.sound_cards import STEP, Magnets


def test_magnets_on_a_board_as_light_as_they_are() -> None:
    """Four of 109 g on 411 g of stiff board that heaves: two masses on a spring, driven between.

    At (M + m) / M m the resonance is 1.4 times as high as on a board that is held, where at 40 Hz
    all in phase move their magnets ten times as far.
    """
    rig = exciter_rig("type: DAEX25FHE-4, coil_mass: 0, power: 1 W, stiffness: 3189, damping: 0.76")
    plate, (length, width) = rig.plate, (0.3, 0.23)
    corners = [(0.0, 0.0), (length, 0.0), (length, width), (0.0, width)]
    eras = tuple(replace(era, x=x, y=y) for era, (x, y) in zip(rig.eras, corners, strict=True))
    stiff = replace(plate, material=replace(plate.material, E=1e13))
    rig = replace(rig, plate=stiff, eras=eras, masses=())
    free = solve_free_plate(stiff, rig.mesh, frequency_max=300.0)
    frequencies = np.array([30.0, 39.0, 55.0, 90.0])
    found = np.abs(relative_motions(rig, free, frequencies).sum(axis=1))
    exciter = eras[0]
    assert isinstance(exciter, Exciter)
    w = 2 * math.pi * frequencies
    current = exciter.voltage / (4.4 + 1j * w * 1e-4)
    back = 1j * w * (0.76 + 3.63**2 / (4.4 + 1j * w * 1e-4))
    reduced = 0.10929 * (stiff.mass / 4) / (0.10929 + stiff.mass / 4)
    expected = np.abs(3.63 * current / (3189 + back - w**2 * reduced))
    for number in range(4):
        assert found[:, number] == pytest.approx(expected, rel=0.01)


@pytest.mark.long
def test_excursion_within_the_frequencies_of_a_rig() -> None:
    """By its level: half of it is half as far, and from a frequency on all are within."""
    rig = exciter_rig("type: DAEX13-4SM, power: 1 W", frequency="[60, 300]")
    full, half = (
        excursions_of(replace(rig, limits=replace(rig.limits, level=level))) for level in (1.0, 0.5)
    )
    assert half.largest == pytest.approx(full.largest / 2)
    assert full.passed.all()
    assert 60 < half.allowed < full.allowed < 300
    narrow = replace(rig, limits=replace(rig.limits, frequency_min=full.allowed))
    assert not excursions_of(narrow).passed.any()


@pytest.mark.parametrize(("amplifiers", "lower_db"), [(1, 6.02), (2, 3.01)])
def test_reach_falls_with_the_power_of_an_amplifier(amplifiers: int, lower_db: float) -> None:
    """Four ERAs that share a power of 1 play at half level, and two at 1 / sqrt(2)."""
    rig = make_paper_rig(12, 9)
    wiring = {
        era.name: Channel(f"amplifier{number % amplifiers}", number)
        for number, era in enumerate(rig.eras)
    }
    limits = replace(rig.limits, frequency_max=60.0)
    rig = replace(rig, wiring=wiring, limits=limits)
    limited = replace(rig, limits=replace(limits, power=1.0))
    free = solve_free_plate(rig.plate, rig.mesh, frequency_max=60.0)
    lower = reach_of(rig, free).least_db_sl - reach_of(limited, free).least_db_sl
    assert lower == pytest.approx(np.full(len(lower), lower_db), abs=0.01)


def board(rig: Rig, rng: np.random.Generator) -> Rig:
    """One within the uncertainty of a rig, whose feet and losses are as it says."""
    known, (modulus, damping) = rig.uncertainty, rng.standard_normal(2)
    by = 1 + math.hypot(known.modulus, 2 * known.thickness) * modulus
    material = replace(rig.plate.material, E=rig.plate.material.E * by)
    springs = 1 + known.stiffness * rng.standard_normal(len(rig.eras))
    by_era = zip(rig.eras, springs.tolist(), strict=True)
    eras = [era.varied(stiffness=by, damping=known.damping**damping) for era, by in by_era]
    return replace(rig, plate=replace(rig.plate, material=material), eras=tuple(eras))


@pytest.mark.parametrize("frequency", [90.0, 100.0])
def test_nine_of_ten_boards_stay_within_their_excursion(frequency: float) -> None:
    """At the share for a board that deviates; at that for one as modeled most do not.

    On boards drawn and integrated here, whose exciters jump in the phases that add.
    """
    rig = change_rig(load_rig(EXAMPLES / "weekend" / "rig.yaml"), limits={"frequency": [60, 300]})
    rng = np.random.default_rng(3)
    free = solve_free_plate(rig.plate, rig.mesh, frequency_max=300.0)
    exact = replace(rig, uncertainty=Uncertainty.none())
    known, counted = (magnets_of(each, free).shares(np.array([frequency])) for each in (exact, rig))
    turning = np.exp(2j * np.pi * frequency * STEP * np.arange(800))
    furthest = []
    for _ in range(16):
        solved, gains = Magnets(board(rig, rng)), 1 + rig.uncertainty.gain * rng.standard_normal(4)
        volts = rig.eras[0].full_level * np.diag(gains)[:, None] * turning[:, None]
        moved = sum(np.abs(solved.moved(each)) for each in volts)
        furthest.append(np.max(moved) / rig.eras[0].excursion)
    assert np.mean(known * np.array(furthest) <= 1) < 0.5
    assert np.mean(counted * np.array(furthest) <= 1) >= 0.8


RATE, COUNT, FINER = 5000.0, 400, 64


def chirp(times: np.ndarray) -> np.ndarray:
    """A burst from 60 to 400 Hz that comes and goes smoothly within 70 ms."""
    window = np.exp(-(((times - 0.04) / 0.009) ** 2))
    return np.asarray(window * np.sin(2 * np.pi * (60 * times + 2100 * times**2)))


def test_bursts_are_followed_as_scipy_integrates() -> None:
    """Two ERAs at once, one late and turned, a finger on the plate: to 1e-4 of the peak.

    SciPy is given the bases' motion and velocity 64 times as finely, joined by straight lines. With
    twice as many samples the plate moves the same, to 1e-7, as band-limited signals say no more.
    """
    rig = make_paper_rig(12, 9)
    tips = fingertip_loads(Fingertip(), [(0.1, 0.08)])
    reduced = reduce_plate(rig.plate, rig.mesh, footprints_of(rig.eras, (), tips))
    plate = plate_in_time(reduced, rig.eras, contacts=tips)
    points, driven = np.array([[0.1, 0.08], [0.25, 0.2]]), [0, 3]

    def bases(by: int) -> np.ndarray:
        times = np.arange(COUNT * by) / (RATE * by)
        return np.array([0.8 * chirp(times), -0.5 * chirp(times - 0.003)])

    def played(by: int) -> np.ndarray:
        signals, shapes = np.zeros((4, by * COUNT)), reduced.at(points)
        signals[driven] = bases(by)
        return from_rest(plate, signals, shapes, sample_rate=by * RATE, factors=np.ones(4))[::by]

    found, finer = played(1), played(2)
    np.testing.assert_allclose(found, finer, atol=1e-7 * np.abs(finer).max())

    M, C, K = modal_matrices(reduced, rig.eras, contacts=tips)
    r, inverse = len(M), np.linalg.inv(M)
    phi = np.pad(reduced.at(footprints_of(rig.eras)), ((0, 0), (0, 1)))[driven].T
    A = np.block([[np.zeros((r, r)), np.eye(r)], [-inverse @ K, -inverse @ C]])
    k, c = (
        np.array([getattr(rig.eras[n], key) for n in driven]) for key in ("stiffness", "damping")
    )
    B = np.vstack([np.zeros((r, 4)), inverse @ np.hstack([phi * k, phi * c])])
    shapes = np.pad(reduced.at(points), ((0, 0), (0, 1)))
    system = StateSpace(A, B, shapes @ A[r:], shapes @ B[r:])  # gives the acceleration
    moved, fine = bases(FINER).T * rig.eras[0].stroke, np.arange(COUNT * FINER) / (RATE * FINER)
    _, expected, _ = lsim(system, np.hstack([moved, np.gradient(moved, fine, axis=0)]), fine)
    np.testing.assert_allclose(found, expected[::FINER], atol=1e-4 * np.abs(expected).max())


EXAMPLES = Path(__file__).parents[3] / "examples"
POINTS = np.array([[0.05, 0.05], [0.15, 0.12], [0.28, 0.2]])
FINGER = FingertipLoad(0.11, 0.09, Fingertip())


def in_time(rig: Rig, *contacts: FingertipLoad) -> PlateInTime:
    """Its plate, reduced for all that acts on it."""
    free = solve_free_plate(rig.plate, rig.mesh, frequency_max=500.0)
    reduced = reduce_free_plate(free, footprints_of(rig.eras, rig.masses, [FINGER]))
    return plate_in_time(reduced, rig.eras, loads=rig.masses, contacts=contacts)


def lossless(keys: str) -> Rig:
    """A board that itself hardly loses, as losses of a plate differ in time off resonance."""
    rig = exciter_rig(keys, frequency="[40, 500]")
    gains = ((40.0, 1.0, 0.0), (500.0, 0.7, -0.5))
    eras = tuple(replace(era, gains=gains) for era in rig.eras)
    return replace(rig, plate=replace(rig.plate, loss_factor=1e-4), eras=eras)


@pytest.mark.parametrize(
    "keys", ["type: DAEX25FHE-4", "type: DAEX13-4SM", "type: DAEX25FHE-4, magnet: held"]
)
def test_settled_vibration_is_that_of_the_frequency_domain(keys: str) -> None:
    """Of each exciter alone, under a finger: within (omega L / R)² of the current, 0.6 %."""
    rig = lossless(keys)
    plate = in_time(rig, FINGER)
    free = solve_free_plate(rig.plate, rig.mesh, frequency_max=500.0)
    frequencies = np.array([40.0, 62.0, 90.0, 170.0, 330.0, 500.0])
    expected = free.acceleration(rig.eras, frequencies, POINTS, loads=(*rig.masses, FINGER))
    for frequency, fields in zip(frequencies, expected, strict=True):
        omega = 2 * math.pi * frequency
        states = steady_states(plate, omega)
        found = -(omega**2) * states @ (plate.shapes_at(POINTS) @ plate.displacement).T
        apart = np.linalg.norm(found - fields, axis=1) / np.linalg.norm(fields, axis=1)
        assert apart.max() < 6e-3


def test_envelopes_lead_to_the_settled_vibration() -> None:
    """A finger held by its forces on the plate without it: the last row, all exciters at once."""
    rig = lossless("type: DAEX25CT-4")
    plate, weights = in_time(rig), np.array([1.0, 0.3j, -0.5, 0.8])
    free = solve_free_plate(rig.plate, rig.mesh, frequency_max=500.0)
    fields = free.acceleration(rig.eras, np.array([90.0]), POINTS, loads=(*rig.masses, FINGER))
    found = enveloped_accelerations(
        plate,
        weights * [era.full_level for era in rig.eras],
        90.0,
        points=plate.reduced.at(POINTS),
        fingers=[(plate.reduced.at(np.array([[0.11, 0.09]]))[0], FINGER.fingertip)],
        envelope=np.hanning(60),
        step=0.002,
    )
    assert found[-1] == pytest.approx(weights @ fields[0], rel=5e-3)


def test_lowest_modes_are_those_of_a_board_and_magnets_worked_out() -> None:
    """A stiff board and four magnets that heave: two masses on two springs, by their determinant.

    Statically a free magnet is a weight, and holds nothing.
    """
    rig = exciter_rig("type: DAEX25FHE-4, coil_mass: 0, resonance: 27.2, resonance_is: mounted")
    stiff = replace(rig.plate, material=replace(rig.plate.material, E=1e13))
    board, magnets, foam = stiff.mass, 4 * 0.10929, 4 * 2000.0
    k = magnets * (2 * math.pi * 27.2) ** 2
    a, b, c = board * magnets, -(k * (board + magnets) + foam * magnets), k * foam
    heaves = np.sqrt(np.roots([a, b, c])) / (2 * math.pi)
    modes = supported_modes(
        in_time(replace(rig, plate=stiff)).reduced, rig.eras, loads=rig.masses, frequency_max=100.0
    )
    center = np.abs(modes.at(np.array([[0.15, 0.115]]))[0])
    found = modes.natural_frequencies[center > 0.3 * center.max()]
    assert found[[0, -1]] == pytest.approx(sorted(heaves.real), rel=0.02)
    rigid = rigid_body_frequencies(stiff, rig.eras, loads=rig.masses)
    assert rigid[0] == pytest.approx(math.sqrt(foam / (board + magnets)) / (2 * math.pi), rel=0.02)


VARIANCE = 0.05**2 + np.radians(5) ** 2


@pytest.mark.parametrize("rig", shortly(["paper_plate", "eight_eras", "table"], ["eight_eras"]))
def test_onsets_and_endings_do_what_those_of_numpy_do(rig, without_kernels):
    """Contrast of onsets within 0.02 dB, what is left after endings within 0.2, on rigs.

    At a fifth of the stroke and at all of it; against no, one and three quiet fingers.
    """
    table = build_table(load_rig(EXAMPLES / f"{rig}.yaml"), frequencies=np.array([130.0]))
    shaper = Shaper(table.in_time, gain_variance=VARIANCE)
    transients = Transients(table.in_time)
    rng = np.random.default_rng(7)
    size = np.array([table.plate.length, table.plate.width])
    cases = []
    for quiet, level in product([0, 1, 3], [0.2, 1.0]):
        places = [tuple(each) for each in (size * rng.uniform(0.1, 0.9, (1 + quiet, 2))).tolist()]
        weights = rng.standard_normal((len(table.eras), 2)) @ [1, 1j]
        weights *= level / np.abs(weights).max()
        tones = {
            era.name: Tone.from_phasor(130.0, complex(era.stroke * w))
            for era, w in zip(table.eras, weights, strict=True)
        }
        cases.append((places, tones))

    def measured():
        found = []
        for (target, *quiet), tones in cases:
            onset = shaped(shaper.onset(tones, targets=[target], quiet=quiet), table.eras)
            ending = shaped(shaper.ending(tones, targets=[target], quiet=quiet), table.eras)
            others = quiet or [tuple((size - target).tolist())]
            contrast = transients.contrast_db(onset, targets=[target], quiet=others)
            found.append((contrast, transients.residual_db(tones, ending)))
        return np.array(found)

    by_kernel = measured()
    without_kernels()
    apart = np.abs(by_kernel - measured()).max(axis=0)
    assert (apart < [0.02, 0.2]).all()
    assert apart.max() > 0  # two ways indeed


K, C, M, BL, R, VOLTS = 3189.2, 0.7553, 0.10929, 3.63, 4.4, 3.0008
"""Of the exciter of 25 mm at 1 W, from its sheet: 27 Hz and a quality of 5 on a held coil."""


def held() -> MagnetMotions:
    """Four on a board that weighs 240 times as much as their magnets."""
    keys = "type: DAEX25FHE-4, power: 1 W, stiffness: 3189.2, damping: 0.7553, inductance: 0"
    rig = exciter_rig(keys)
    heavy = replace(rig.plate.material, E=1e13, rho=3e5)
    rig = replace(rig, plate=replace(rig.plate, material=heavy))
    return magnets_of(rig, solve_free_plate(rig.plate, rig.mesh, frequency_max=300.0))


def by_hand(frequency: float, swing: Swing) -> float:
    """Largest |x| of M x'' + (c + Bl^2 / R) x' + k x = Bl V e(t) exp(i w t) / R."""
    ends = swing.step * np.arange(len(swing.shares))
    times = np.arange(0, ends[-1], 2e-4)
    level = BL * VOLTS / R * np.interp(times, ends, swing.shares)
    push, mass = level * np.exp(2j * math.pi * frequency * times), ([1.0], [M, C + BL**2 / R, K])
    parts = [lsim(mass, each, times)[1] for each in (push.real, push.imag)]
    return float(np.hypot(*parts).max())


@pytest.mark.parametrize("frequency", [40.0, 47.0])
def test_motion_along_a_level_that_swings_is_that_of_one_mass(frequency: float) -> None:
    """At the beat of drive and magnet the level moves it further than one that lasts."""
    magnets, times = held(), 0.01 * np.arange(61)
    wave = (1 - np.cos(2 * math.pi * (frequency - 27.2) * times)) / 2
    for shares in (wave, np.minimum(times / 0.01, 1)):
        swing = Swing(tuple(shares.tolist()), 0.01)
        found = motions_along(magnets.plate, magnets.rows, frequency, swing)
        assert found == pytest.approx([by_hand(frequency, swing)] * 4, rel=0.02)


def test_pulses_over_and_over_add_up_where_they_come_at_the_worst_pace() -> None:
    """The worst of trains whose pauses are tried one by one; a single one moves it less."""
    magnets, frequency = held(), 40.0
    single, _ = swings_of_pulse(0.04, 0.01)
    trains = []
    for pause in range(60, 120, 4):
        starts = np.zeros(900)
        starts[0:500:pause] = 1
        shares = np.convolve(starts, single.shares)[:900]
        trains.append(by_hand(frequency, Swing(tuple(shares.tolist()), 0.001)))
    assert single.again == CLICKS_APART == 0.06
    found, alone = (
        motions_along(magnets.plate, magnets.rows, frequency, each)
        for each in (single, replace(single, again=math.inf))
    )
    assert found == pytest.approx([max(trains)] * 4, rel=0.05)
    assert found[0] > 1.1 * alone[0]
