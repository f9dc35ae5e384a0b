"""Magnets and exciters in time: by hand for rigid plates, by SciPy and in the frequency domain."""

import math
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lsim

from cases import shortly
from kit.magnets import STEP, Magnets
from kit.plates import exciter_rig, make_paper_rig
from model.answer.envelope import swings_of_pulse
from model.reduction.free_plate import solve_free_plate
from model.reduction.reduced_plate import reduce_free_plate
from model.reduction.supported_plate import supported_modes
from model.rig.rig import Channel, Rig, Uncertainty
from model.rig.rig_file import load_rig
from model.rig.rig_writing import change_rig
from model.structure.attachments import footprints_of
from model.structure.fingertips import Fingertip, FingertipLoad
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
)
from model.transients.knots import (
    steady_states,
)
from model.transients.plate_in_time import PlateInTime, plate_in_time
from model.transients.reach import reach_of
from model.transients.shaping import Shaper, Transients
from model.vibration import Tone

EXAMPLES = Path(__file__).parents[3] / "examples"


def stiff_board(rig: Rig, **material: float) -> Rig:
    """The rig with a board that does not bend."""
    stiff = replace(rig.plate.material, E=1e13, **material)
    return replace(rig, plate=replace(rig.plate, material=stiff))


# Excursions of magnets


@pytest.mark.long
def test_excursion_within_the_frequencies_of_a_rig() -> None:
    """Half the level moves magnets half as far; high frequencies are within the excursion."""
    rig = exciter_rig("type: DAEX13-4SM, power: 1 W", frequency="[60, 300]")
    half_level = replace(rig.limits, level=0.5)

    full = excursions_of(rig)
    half = excursions_of(replace(rig, limits=half_level))
    narrow_limits = replace(rig.limits, frequency_min=full.allowed)
    narrow = excursions_of(replace(rig, limits=narrow_limits))

    assert half.largest == pytest.approx(full.largest / 2)
    assert full.passed.all()
    assert 60 < half.allowed < full.allowed < 300
    assert not narrow.passed.any()


def varied_board(rig: Rig, rng: np.random.Generator) -> Rig:
    """A board drawn within the tolerances of a rig, with its feet and losses."""
    uncertainty = rig.uncertainty
    stiffness_deviation, damping_deviation = rng.standard_normal(2)
    spread = math.hypot(uncertainty.modulus, 2 * uncertainty.thickness)
    stiffness = 1 + spread * stiffness_deviation
    material = replace(rig.plate.material, E=rig.plate.material.E * stiffness)
    damping = uncertainty.damping**damping_deviation
    springs = 1 + uncertainty.stiffness * rng.standard_normal(len(rig.eras))
    eras = []
    for era, spring in zip(rig.eras, springs.tolist(), strict=True):
        eras.append(era.varied(stiffness=spring, damping=damping))
    return replace(rig, plate=replace(rig.plate, material=material), eras=tuple(eras))


@pytest.mark.parametrize("frequency", shortly([90.0, 100.0], [100.0]))
def test_nine_of_ten_boards_stay_within_their_excursion(frequency: float) -> None:
    """At the level for a board with tolerances; at the level for the nominal board most do not.

    The boards are drawn and integrated here; exciters start in the phases that add.
    """
    rig = change_rig(load_rig(EXAMPLES / "weekend" / "rig.yaml"), limits={"frequency": [60, 300]})
    exact_rig = replace(rig, uncertainty=Uncertainty.none())
    free = solve_free_plate(rig.plate, rig.mesh, frequency_max=300.0)
    exciter = rig.eras[0]
    rng = np.random.default_rng(3)
    times = STEP * np.arange(800)
    carrier = np.exp(2j * np.pi * frequency * times)

    level = magnets_of(rig, free).shares(np.array([frequency]))
    nominal_level = magnets_of(exact_rig, free).shares(np.array([frequency]))
    excursions = np.empty((16, 1))
    for board_number in range(len(excursions)):
        magnets = Magnets(varied_board(rig, rng))
        gain_errors = rig.uncertainty.gain * rng.standard_normal(4)
        gains = np.diag(1 + gain_errors)
        volts = exciter.full_level * carrier[:, None] * gains[:, None]
        motions = [np.abs(magnets.moved(era_volts)) for era_volts in volts]
        largest_motion = np.sum(motions, axis=0).max()
        excursions[board_number] = largest_motion / exciter.excursion

    assert np.mean(nominal_level * excursions <= 1) < 0.5
    assert np.mean(level * excursions <= 1) >= 0.8


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
    limited_rig = replace(rig, limits=replace(limits, power=1.0))
    free = solve_free_plate(rig.plate, rig.mesh, frequency_max=60.0)

    reach = reach_of(rig, free).least_db_sl
    limited_reach = reach_of(limited_rig, free).least_db_sl

    assert reach - limited_reach == pytest.approx(np.full(len(reach), lower_db), abs=0.01)


# Motion of a single magnet along a level

# The exciter of 25 mm at 1 W, from its sheet: 27 Hz and a quality of 5 on a held coil.
STIFFNESS = 3189.2
DAMPING = 0.7553
MAGNET_MASS = 0.10929
FORCE_FACTOR = 3.63
RESISTANCE = 4.4
VOLTS = 3.0008


def magnets_on_a_heavy_board() -> MagnetMotions:
    """Four magnets on a board that weighs 240 times as much."""
    keys = "type: DAEX25FHE-4, power: 1 W, stiffness: 3189.2, damping: 0.7553, inductance: 0"
    rig = stiff_board(exciter_rig(keys), rho=3e5)
    return magnets_of(rig, solve_free_plate(rig.plate, rig.mesh, frequency_max=300.0))


def largest_motion(frequency: float, swing: Swing) -> float:
    """Largest |x| of M x'' + (c + Bl² / R) x' + k x = Bl V e(t) exp(i w t) / R."""
    ends = swing.step * np.arange(len(swing.shares))
    times = np.arange(0, ends[-1], 2e-4)
    envelope = np.interp(times, ends, swing.shares)
    carrier = np.exp(2j * math.pi * frequency * times)
    largest_force = FORCE_FACTOR * VOLTS / RESISTANCE
    force = largest_force * envelope * carrier
    damping = DAMPING + FORCE_FACTOR**2 / RESISTANCE
    oscillator = ([1.0], [MAGNET_MASS, damping, STIFFNESS])
    _, real_motion, _ = lsim(oscillator, force.real, times)
    _, imaginary_motion, _ = lsim(oscillator, force.imag, times)
    return float(np.hypot(real_motion, imaginary_motion).max())


def test_repeated_pulses_are_bounded_at_the_worst_repetition_rate() -> None:
    """The bound is the largest of trains with any pause, and 10 % above a single pulse."""
    magnets, frequency = magnets_on_a_heavy_board(), 40.0
    pulse, _ = swings_of_pulse(0.04, 0.01)
    single_pulse = replace(pulse, again=math.inf)
    trains = []
    for pause in range(60, 120, 4):
        starts = np.zeros(900)
        starts[0:500:pause] = 1
        shares = np.convolve(starts, pulse.shares)[:900]
        trains.append(Swing(tuple(shares.tolist()), 0.001))

    motions = motions_along(magnets.plate, magnets.rows, frequency, pulse)
    single_motions = motions_along(magnets.plate, magnets.rows, frequency, single_pulse)

    assert pulse.again == CLICKS_APART == 0.06
    largest = max(largest_motion(frequency, train) for train in trains)
    assert motions == pytest.approx([largest] * 4, rel=0.05)
    assert motions[0] > 1.1 * single_motions[0]


# The plate in time


POINTS = np.array([[0.05, 0.05], [0.15, 0.12], [0.28, 0.2]])
FINGER = FingertipLoad(0.11, 0.09, Fingertip())


def plate_with(rig: Rig, *contacts: FingertipLoad) -> PlateInTime:
    """The plate of a rig in time, reduced for all attachments and the finger."""
    free = solve_free_plate(rig.plate, rig.mesh, frequency_max=500.0)
    reduced = reduce_free_plate(free, footprints_of(rig.eras, rig.masses, [FINGER]))
    return plate_in_time(reduced, rig.eras, loads=rig.masses, contacts=contacts)


def lossless_board(keys: str) -> Rig:
    """A board of hardly any loss, since losses of a plate differ in time off resonance."""
    rig = exciter_rig(keys, frequency="[40, 500]")
    gains = ((40.0, 1.0, 0.0), (500.0, 0.7, -0.5))
    eras = tuple(replace(era, gains=gains) for era in rig.eras)
    return replace(rig, plate=replace(rig.plate, loss_factor=1e-4), eras=eras)


@pytest.mark.parametrize("keys", ["type: DAEX13-4SM", "type: DAEX25FHE-4, magnet: held"])
def test_settled_vibration_is_that_of_the_frequency_domain(keys: str) -> None:
    """For each exciter alone, under a finger: within (omega L / R)² of the current, 0.6 %."""
    rig = lossless_board(keys)
    plate = plate_with(rig, FINGER)
    free = solve_free_plate(rig.plate, rig.mesh, frequency_max=500.0)
    frequencies = np.array([40.0, 62.0, 90.0, 170.0, 330.0, 500.0])
    at_points = plate.shapes_at(POINTS) @ plate.displacement

    expected = free.acceleration(rig.eras, frequencies, POINTS, loads=(*rig.masses, FINGER))
    settled = []
    for omega in 2 * math.pi * frequencies:
        settled.append(-(omega**2) * steady_states(plate, omega) @ at_points.T)

    differences = np.linalg.norm(settled - expected, axis=2)
    errors = differences / np.linalg.norm(expected, axis=2)
    np.testing.assert_allclose(errors, 0, atol=6e-3, err_msg="by frequency and exciter")


def test_lowest_modes_are_those_of_a_board_and_magnets_by_hand() -> None:
    """A stiff board and four magnets that heave: two masses on two springs, by their determinant.

    Statically a free magnet is a weight, and holds nothing.
    """
    keys = "type: DAEX25FHE-4, coil_mass: 0, resonance: 27.2, resonance_is: mounted"
    rig = stiff_board(exciter_rig(keys))
    board, magnets, foam = rig.plate.mass, 4 * 0.10929, 4 * 2000.0
    spring = magnets * (2 * math.pi * 27.2) ** 2
    quadratic, constant = board * magnets, spring * foam
    linear = -(spring * (board + magnets) + foam * magnets)
    squares = np.roots([quadratic, linear, constant])
    heaves = np.sqrt(squares.real) / (2 * math.pi)

    reduced = plate_with(rig).reduced
    modes = supported_modes(reduced, rig.eras, loads=rig.masses, frequency_max=100.0)
    rigid_frequencies = rigid_body_frequencies(rig.plate, rig.eras, loads=rig.masses)

    center_motion = np.abs(modes.at(np.array([[0.15, 0.115]]))[0])
    is_heave = center_motion > 0.3 * center_motion.max()
    heave_frequencies = modes.natural_frequencies[is_heave]
    assert heave_frequencies[[0, -1]] == pytest.approx(sorted(heaves), rel=0.02)
    static_heave = math.sqrt(foam / (board + magnets)) / (2 * math.pi)
    assert rigid_frequencies[0] == pytest.approx(static_heave, rel=0.02)


# The kernel of knots against numpy


@pytest.mark.parametrize("rig", shortly(["paper_plate", "eight_eras", "table"], ["eight_eras"]))
def test_onsets_and_endings_of_the_kernel_equal_those_of_numpy(rig, without_kernels):
    """Contrast of onsets within 0.02 dB, residuals of endings within 0.2 dB.

    At a fifth of the stroke and at all of it; with no, one and three quiet fingers.
    """
    table = build_table(load_rig(EXAMPLES / f"{rig}.yaml"), frequencies=np.array([130.0]))
    eras = table.eras
    shaper = Shaper(table.in_time, gain_variance=0.05**2 + np.radians(5) ** 2)
    transients = Transients(table.in_time)
    size = np.array([table.plate.length, table.plate.width])
    strokes = np.array([era.stroke for era in eras])

    def contrast_and_residual(quiet_count, level, rng):
        shares = rng.uniform(0.1, 0.9, (1 + quiet_count, 2))
        target, *quiet = map(tuple, size * shares)
        weights = rng.standard_normal((len(eras), 2)) @ [1, 1j]
        weights *= level / np.abs(weights).max()
        phasors = strokes * weights
        tones = {}
        for era, phasor in zip(eras, phasors.tolist(), strict=True):
            tones[era.name] = Tone.from_phasor(130.0, phasor)
        onset = shaped(shaper.onset(tones, targets=[target], quiet=quiet), eras)
        ending = shaped(shaper.ending(tones, targets=[target], quiet=quiet), eras)
        judged = quiet or [tuple(size - target)]
        contrast = transients.contrast_db(onset, targets=[target], quiet=judged)
        return contrast, transients.residual_db(tones, ending)

    def all_cases():
        rng = np.random.default_rng(7)
        cases = product([0, 1, 3], [0.2, 1.0])
        return np.array([contrast_and_residual(*case, rng) for case in cases])

    kernel_results = all_cases()
    without_kernels()
    numpy_results = all_cases()

    np.testing.assert_allclose(kernel_results[:, 0], numpy_results[:, 0], rtol=0, atol=0.02)
    np.testing.assert_allclose(kernel_results[:, 1], numpy_results[:, 1], rtol=0, atol=0.2)
    assert (kernel_results != numpy_results).any(), "the kernel was not replaced"
