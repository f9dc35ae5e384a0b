"""Verification passes a true table and fails a changed one; plates drawn from tolerances."""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import kstest, truncnorm

from kit.direct_plate import direct_acceleration
from kit.outside_files import EXAMPLES
from kit.plates import (
    FREQUENCIES,
    SMALL_TABLE_HZ,
    contact_sets,
    make_paper_rig,
    small_table,
    smooth_rig,
)
from kit.set_table import only
from model.answer.answer import Layer
from model.answer.plan import query
from model.answer.stimulus import Placement
from model.fem import assemble
from model.finger import Grid, detection_threshold, fingertip_points, fingertip_weights
from model.reduction.free_plate import solve_free_plate
from model.rig.rig import Rig, Uncertainty
from model.rig.rig_file import load_rig
from model.structure.attachments import PointLoad
from model.structure.fingertips import FingertipLoad
from model.structure.sources import Source
from model.study.exact_plates import Plates, draw_plates, felt_on
from model.study.verification import PromiseCheck, Verification, verify_table
from model.table.table import LocalizationTable
from model.table.table_file import build_table, load_table, save_table
from model.vibration import base_amplitudes

# Verification


@pytest.fixture(scope="module")
def table() -> LocalizationTable:
    """A phased table, whose contrast is highest and most easily lost."""
    return small_table(drive_mode="phased")


@pytest.fixture(scope="module")
def verification(table: LocalizationTable, coarse_rig: Rig) -> Verification:
    """The verification of the true table."""
    return verify_table(table, coarse_rig, samples=4)


def test_verify_passes_a_true_table(verification: Verification) -> None:
    """Fields within 5e-5 of the direct solve, and answers with one to three quiet fingers.

    Contrasts in time and by the direct solve, which share nothing but the mesh, agree within 0.3 dB
    up to 25 dB.
    """
    assert verification.failed_count == 0
    assert verification.promise.kept_share == pytest.approx(0.9, abs=0.08)
    assert verification.promise.plate_count == 800
    fields, cells = verification.content
    assert fields.error < 5e-5
    assert cells.error < 2e-3  # the raster does not follow the mesh between its nodes
    checks = verification.answer_checks
    assert [len(check.placed.quiet) for check in checks] == [1, 2, 3, 1]
    assert max(check.direct_contrast_db for check in checks) > 15
    for check in checks:
        if check.direct_contrast_db < 25:
            assert check.contrast_in_time_db == pytest.approx(check.direct_contrast_db, abs=0.3)


def test_verify_passes_a_table_with_measured_gains_bolts_and_masses(
    coarse_rig: Rig, tmp_path: Path
) -> None:
    """They are in the table, its file, the direct solve and the plate in time."""
    gains = ((60.0, 0.8, 0.3), (250.0, 1.2, -0.5))
    measured = replace(coarse_rig.eras[0], gains=gains, bolt_mass=0.012)
    mass = PointLoad(0.1, 0.15, mass=0.06)
    rig = replace(coarse_rig, eras=(measured, *coarse_rig.eras[1:]), masses=(mass,))
    table = build_table(rig, frequencies=FREQUENCIES, grid=Grid(4, 3), drive_mode="phased")
    save_table(table, tmp_path / "t.npz")

    verification = verify_table(load_table(tmp_path / "t.npz", rig=rig), rig, samples=3)

    assert verification.failed_count == 0


@pytest.mark.parametrize(
    ("name", "factor"), [("shapes", 1.2), ("attachment_shapes", 1.05), ("omega", 1.05)]
)
def test_verify_fails_a_table_with_a_changed_array(
    table: LocalizationTable, coarse_rig: Rig, tmp_path: Path, name: str, factor: float
) -> None:
    """By a few percent, under a right checksum; answers fail too if much is changed."""
    values = getattr(table, name)
    changed = replace(table, **{name: (factor * values).astype(values.dtype)})
    save_table(changed, tmp_path / "t.npz")
    read = load_table(tmp_path / "t.npz", rig=coarse_rig)

    verification = verify_table(read, coarse_rig, samples=4 if name == "omega" else 1)

    assert [check.is_passed for check in verification.content] == [False, False]
    if name == "omega":
        assert False in [check.is_passed for check in verification.answer_checks]
        assert verification.failed_count >= 3


def test_verify_compares_tones_of_two_frequencies_by_every_threshold_set() -> None:
    """The second answer of this sample has two frequencies, whose contrast depends on the set.

    Relative to the rig's own set, it is 0.2 dB higher than predicted for the worst set.
    """
    rig = load_rig(EXAMPLES / "tutorial_rig.yaml")
    table = build_table(rig, drive_mode="switched")
    rng = np.random.default_rng(0)
    nominal = draw_plates(rng, Uncertainty.none(), of=table, count=1, contact_count=3)

    _, check = verify_table(table, rig, samples=2).answer_checks

    (layer,) = query(table, check.placed).layers
    _, (contrast,) = felt_on(table, check.placed, layer.excitation, nominal)
    assert 20 * math.log10(contrast) > check.predicted_contrast_db + 0.2
    assert check.direct_contrast_db == pytest.approx(check.predicted_contrast_db, abs=0.02)
    assert check.is_passed


@pytest.mark.parametrize(
    ("kept_share", "answer_count", "is_passed"),
    [(0.79, 1, True), (0.65, 1, False), (0.79, 12, False), (0.81, 12, True)],
)
def test_promise_check_allows_the_spread_of_few_answers(
    kept_share: float, answer_count: int, is_passed: bool
) -> None:
    """By hand: 0.9 - 4 * 0.06 = 0.66 for one answer, 0.83 for twelve; never above 0.8."""
    assert PromiseCheck(kept_share, answer_count).is_passed is is_passed


# Drawn plates

TARGET = (0.09, 0.07)
QUIET = ((0.25, 0.18), (0.03, 0.19))
PLACES = (TARGET, *QUIET)
ON_FEET = replace(
    smooth_rig(),
    masses=(
        PointLoad(0.02, 0.03, stiffness=30e3, loss_factor=0.15, is_foot=True),
        PointLoad(0.2, 0.05, mass=0.03),
        PointLoad(0.27, 0.2, stiffness=20e3, damping=2.0, is_foot=True),
    ),
)


@cache
def table_on_feet() -> LocalizationTable:
    """Return the table of that rig."""
    return build_table(ON_FEET, frequencies=SMALL_TABLE_HZ)


INWARDS = np.array([[1.0, 0.5], [-1.0, 0.8], [-0.6, -1.2], [0.9, -0.7]])  # mm
THREE_PLATES = Plates(
    thickness=np.array([1.0, 1.02, 0.98]),
    loss=np.array([1.0, 2.0, 0.5]),
    damping=np.array([1.0, 0.5, 2.0]),
    stiffness=np.array([[1.0, 1.0, 1.0, 1.0], [0.9, 1.1, 1.0, 0.95], [1.1, 1.0, 0.92, 1.05]]),
    load=np.array([[1.0, 1.0, 1.0], [0.5, 2.0, 1.5], [1.8, 0.6, 1.0]]),
    gain=np.array(
        [[1, 1, 1, 1], [1.05, 0.96, 1.02, np.exp(0.1j)], [np.exp(-0.08j), 1, 0.93, 1]],
        dtype=complex,
    ),
    deviation=np.zeros((3, 3), dtype=complex),
    modulus=np.array([1.0, 0.96, 1.03]),
    places=1e-3 * np.array([0 * INWARDS, INWARDS, -0.5 * INWARDS]),
    harmonic=np.zeros((3, 4), dtype=complex),
    feet=np.array([[1.0, 1.0], [0.6, 1.4], [1.5, 0.8]]),
)
"""The nominal plate and two others."""


def drawn_eras(number: int) -> list[Source]:
    """Return the ERAs of a drawn plate."""
    plate = ON_FEET.plate
    eras: list[Source] = []
    for row, corner in enumerate(ON_FEET.eras):
        x, y = THREE_PLATES.places[number, row]
        varied = corner.varied(
            stiffness=THREE_PLATES.stiffness[number, row], damping=THREE_PLATES.damping[number]
        )
        inside_x = min(max(corner.x + x, 0.0), plate.length)
        inside_y = min(max(corner.y + y, 0.0), plate.width)
        eras.append(replace(varied, x=inside_x, y=inside_y))
    return eras


def drawn_loads(number: int, pressed: Sequence[float]) -> list[PointLoad | FingertipLoad]:
    """Return the masses, feet and fingers of a drawn plate.

    pressed: factor on the pulp and contact mass of each finger.
    """
    first_foot, mass, second_foot = ON_FEET.masses
    factors = THREE_PLATES.feet[number]
    loads: list[PointLoad | FingertipLoad] = [
        replace(first_foot, stiffness=factors[0] * first_foot.stiffness),
        mass,
        replace(second_foot, stiffness=factors[1] * second_foot.stiffness),
    ]
    for row, place in enumerate(PLACES):
        fingertip = ON_FEET.fingertip.scaled(pressed[row])
        weight = THREE_PLATES.load[number, row]
        loads.append(FingertipLoad(*place, fingertip.multiplied(weight)))
    return loads


def direct_contrast(
    layer: Layer, number: int, *, target_count: int = 1, pressed: Sequence[float] = (1, 1, 1)
) -> float:
    """Return the felt contrast [dB] of a drawn plate by the sparse direct solve.

    The weakest of the targets counts, and the loudest point of the quiet fingers.
    """
    nominal = ON_FEET.plate
    plate = replace(
        nominal.scaled(modulus=THREE_PLATES.modulus[number]),
        thickness=nominal.thickness * THREE_PLATES.thickness[number],
        loss_factor=nominal.loss_factor * THREE_PLATES.loss[number],
    )
    discs = [fingertip_points(*place, nominal) for place in PLACES]
    frequencies, bases = base_amplitudes(layer.excitation, ON_FEET.eras)
    unit_fields = direct_acceleration(
        assemble(plate, ON_FEET.mesh),
        drawn_eras(number),
        frequencies,
        np.concatenate(discs),
        loads=drawn_loads(number, pressed),
    )
    strokes = [corner.stroke for corner in ON_FEET.eras]
    weights = bases / strokes * THREE_PLATES.gain[number]
    amplitudes = np.abs(np.einsum("fe,fep->fp", weights, unit_fields))
    sensed = np.linalg.norm(amplitudes.T / detection_threshold(frequencies), axis=1)
    by_finger = sensed.reshape(len(PLACES), -1)
    means = []
    for values, place in zip(by_finger[:target_count], PLACES, strict=False):
        means.append(values @ fingertip_weights(*place, nominal))
    return 20 * math.log10(min(means) / by_finger[target_count:].max())


@pytest.mark.parametrize(
    ("target_count", "mode"),
    [(1, "switched"), (1, "phased"), (2, "switched")],
    ids=["1-switched", "1-phased", "2-switched"],
)
def test_felt_on_agrees_with_the_direct_solve(target_count: int, mode: str) -> None:
    """Thicker, softer, damped otherwise, misdriven, other fingers and feet: within 0.15 dB.

    So is the nominal contrast of an answer on the first of the plates, which is the nominal one.
    """
    placed = Placement(PLACES[:target_count], PLACES[target_count:])
    layer, sensation = only(table_on_feet(), placed, drive_mode=mode)

    _, contrasts = felt_on(table_on_feet(), placed, layer.excitation, THREE_PLATES)

    direct = [direct_contrast(layer, number, target_count=target_count) for number in range(3)]
    np.testing.assert_allclose(20 * np.log10(contrasts), direct, atol=0.15)
    assert np.ptp(direct) > 0.15
    assert sensation.contrast_db == pytest.approx(direct[0], abs=0.15)


def test_object_that_can_lie_anywhere_is_an_error_of_fields() -> None:
    """5 g: six times its mean square, over plates solved with the mass at each place, to 10 %."""
    rig = make_paper_rig(12, 9)
    uncertainty = replace(rig.uncertainty, foreign_mass=0.005)
    frequencies = np.array([60.0, 110.0, 180.0])
    table = build_table(rig, frequencies=frequencies)
    heavier = build_table(replace(rig, uncertainty=uncertainty), frequencies=frequencies)
    points = table.raster.points
    free = solve_free_plate(rig.plate, rig.mesh, frequency_max=180.0)
    without = free.acceleration(rig.eras, frequencies, points)
    mean_squares = []
    for x, y in Grid(6, 5).centers(rig.plate):
        load = PointLoad(x, y, mass=0.005)
        with_load = free.acceleration(rig.eras, frequencies, points, loads=[load])
        squares = np.abs(with_load - without) ** 2
        mean_squares.append(squares.mean(axis=2))

    power = heavier.field_error_power - table.field_error_power

    np.testing.assert_allclose(power, 6 * np.mean(mean_squares, axis=0), rtol=0.1)


def plates_on_feet(uncertainty: Uncertainty, count: int) -> Plates:
    """Return plates drawn from an uncertainty, for two contacts."""
    rng = np.random.default_rng(0)
    return draw_plates(rng, uncertainty, of=ON_FEET, count=count, contact_count=2)


def test_springs_of_drawn_plates_are_positive() -> None:
    """At the largest uncertainty they have the distribution of a normal number cut off at 0."""
    stiffness = plates_on_feet(replace(Uncertainty(), stiffness=0.5), 1000).stiffness

    assert stiffness.min() > 0
    expected = truncnorm(-2, np.inf, loc=1, scale=0.5)
    assert kstest(stiffness.ravel(), expected.cdf).pvalue > 0.01


def test_drawn_plates_have_the_spreads_of_the_uncertainty() -> None:
    """Normal numbers: of the logarithm for damping, loss, load and feet."""
    plates = plates_on_feet(replace(Uncertainty(), supports=0.3), 4000)

    deviations = {
        "gain": np.abs(plates.gain).std(),
        "phase": np.degrees(np.angle(plates.gain)).std(),
        "stiffness": plates.stiffness.std(),
        "thickness": plates.thickness.std(),
        "damping": np.log(plates.damping).std(),
        "loss": np.log(plates.loss).std(),
        "load": np.log(plates.load).std(),
        "modulus": plates.modulus.std(),
        "place": plates.places.std(),
        "harmonic": plates.harmonic.std(),
        "feet": np.log(plates.feet).std(),
    }
    expected = {
        "gain": 0.05,
        "phase": 5.0,
        "stiffness": 0.1,
        "thickness": 0.02,
        "damping": math.log(1.5),
        "loss": math.log(1.5),
        "load": 0.5,
        "modulus": 0.02,
        "place": 0.001,
        "harmonic": 0.01,
        "feet": 0.3,
    }
    assert deviations == pytest.approx(expected, rel=0.04)


KNOWN_DRIVES = replace(Uncertainty.none(), gain=0.01, phase_deg=1.0)
"""All is known but the drives, within 1 % and 1 degree."""


@pytest.mark.parametrize(
    ("uncertainty", "percentile", "quiet_count", "optimum_db"),
    [
        pytest.param(Uncertainty(), 10, 1, 16.1, marks=pytest.mark.long),
        pytest.param(Uncertainty(), 10, 2, 12.5, marks=pytest.mark.long),
        (Uncertainty(), 10, 3, 9.5),
        (KNOWN_DRIVES, 50, 1, 33.0),
        pytest.param(KNOWN_DRIVES, 50, 2, 18.0, marks=pytest.mark.long),
        pytest.param(KNOWN_DRIVES, 50, 3, 14.5, marks=pytest.mark.long),
    ],
)
def test_answers_reach_the_contrast_of_an_independent_optimum(
    uncertainty: Uncertainty, percentile: float, quiet_count: int, optimum_db: float
) -> None:
    """Medians over 20 contact sets, of contrasts that most or half of the plates reach.

    The optimum climbed the percentile itself, for other sets on another model of the same plate;
    medians over so few sets vary by a decibel.
    """
    rig = replace(smooth_rig(), uncertainty=uncertainty)
    table = build_table(rig, frequencies=SMALL_TABLE_HZ)
    rng = np.random.default_rng(8)
    contrasts_db = []

    for target, *quiet in contact_sets(20, fingers=1 + quiet_count, seed=100 + quiet_count):
        placed = Placement((target,), tuple(quiet))
        layer, _ = only(table, placed, drive_mode="phased")
        plates = draw_plates(rng, uncertainty, of=table, count=100, contact_count=1 + quiet_count)
        _, contrasts = felt_on(table, placed, layer.excitation, plates)
        contrasts_db.append(20 * math.log10(np.percentile(contrasts, percentile)))

    assert np.median(contrasts_db) == pytest.approx(optimum_db, abs=2.0)
