"""Verification passes a true table and fails a changed one; promises hold on exact plates."""

import math
from dataclasses import replace
from functools import cache

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
    smooth_table,
)
from kit.set_table import only
from model.answer.plan import query
from model.answer.stimulus import Placement
from model.fem import assemble
from model.finger import Grid, detection_threshold, fingertip_points, fingertip_weights
from model.reduction.free_plate import solve_free_plate
from model.rig.rig import Uncertainty
from model.rig.rig_file import load_rig
from model.structure.attachments import PointLoad
from model.structure.fingertips import FingertipLoad
from model.study.exact_plates import Plates, draw_plates, felt_on
from model.study.verification import PromiseCheck, verify_table
from model.table.table_file import build_table, load_table, save_table
from model.vibration import base_amplitudes, tone_fields


@pytest.fixture(scope="module")
def verified(table, coarse_rig):
    """Verification of the table as it is."""
    return verify_table(table, coarse_rig, samples=4)


@pytest.fixture(scope="module")
def table():
    """Phased, where contrast is highest and most easily lost."""
    return small_table(drive_mode="phased")


def test_verify_passes_a_true_table(verified):
    """Fields within 5e-5 of the direct solve, and answers with one to three quiet fingers.

    Contrasts in time and by the direct solve, two ways that share nothing but the mesh, agree
    within 0.3 dB up to 25 dB.
    """
    assert verified.failed_count == 0
    assert verified.promise.kept_share == pytest.approx(0.9, abs=0.08)
    assert verified.promise.plate_count == 800
    fields, cells = verified.content
    assert fields.error < 5e-5
    assert cells.error < 2e-3  # the raster does not follow the mesh between its nodes
    assert [len(check.placed.quiet) for check in verified.answer_checks] == [1, 2, 3, 1]
    assert max(check.direct_contrast_db for check in verified.answer_checks) > 15
    for check in verified.answer_checks:
        if check.direct_contrast_db < 25:
            assert check.contrast_in_time_db == pytest.approx(check.direct_contrast_db, abs=0.3)


def test_verify_passes_a_table_with_measured_gains_bolts_and_masses(coarse_rig, tmp_path):
    """They are in the table, its file, the direct solve and the plate in time."""
    gains = ((60.0, 0.8, 0.3), (250.0, 1.2, -0.5))
    eras = (replace(coarse_rig.eras[0], gains=gains, bolt_mass=0.012), *coarse_rig.eras[1:])
    measured = replace(coarse_rig, eras=eras, masses=(PointLoad(0.1, 0.15, mass=0.06),))
    built = build_table(measured, frequencies=FREQUENCIES, grid=Grid(4, 3), drive_mode="phased")
    save_table(built, tmp_path / "t.npz")
    found = verify_table(load_table(tmp_path / "t.npz", rig=measured), measured, samples=3)
    assert found.failed_count == 0


def test_tolerances_follow_from_the_error_of_the_field(verified, coarse_rig, table):
    """By hand: 20 log10(1 + error / peak), of the target for its level, of both for contrast.

    The error is 2e-4 for the raster, 7e-3 for the fingers and (k s)²/8 for elements s = 25.4 mm of
    the first order, of the root mean square over the plate.
    """
    rigidity = 70e9 * 0.0015**3 / (12 * (1 - 0.33**2))
    matrices = assemble(coarse_rig.plate, coarse_rig.mesh)
    for check in verified.answer_checks:
        contacts = (*check.placed.targets, *check.placed.quiet)
        discs = [fingertip_points(*place, coarse_rig.plate) for place in contacts]
        weights = fingertip_weights(*contacts[0], coarse_rig.plate)
        points = np.vstack([*discs, Grid(8, 6).centers(coarse_rig.plate)])
        frequencies, fields = tone_fields(
            only(table, check.placed)[0].excitation,
            coarse_rig.eras,
            lambda f, points=points, contacts=contacts: direct_acceleration(
                matrices,
                coarse_rig.eras,
                f,
                points,
                loads=[FingertipLoad(*place, coarse_rig.fingertip) for place in contacts],
            ),
        )
        assert len(frequencies) == 1
        ends = np.cumsum([*map(len, discs)])
        target, *quiet, plate = np.split(np.abs(fields).sum(axis=0), ends)
        squared = 2700 * 0.0015 * (2 * np.pi * frequencies.max()) ** 2 / rigidity  # k^4
        error = (7.2e-3 + np.sqrt(squared) * 0.0254**2 / 8) * np.sqrt((plate**2).mean())
        at_target, at_quiet = (
            20 * np.log10(1 + error / peak)
            for peak in (target @ weights, np.concatenate(quiet).max())
        )
        assert check.level_tolerance_db == pytest.approx(0.01 + at_target, rel=1e-3)
        assert check.contrast_tolerance_db == pytest.approx(0.01 + at_target + at_quiet, rel=1e-3)


@pytest.mark.parametrize(
    ("name", "factor"), [("shapes", 1.2), ("attachment_shapes", 1.05), ("omega", 1.05)]
)
def test_verify_fails_changed_content(table, coarse_rig, tmp_path, name, factor):
    """A few per cent of anything, under a right checksum; answers as well where it is much."""
    old, path = getattr(table, name), tmp_path / "changed.npz"
    save_table(replace(table, **{name: (factor * old).astype(old.dtype)}), path)
    changed = load_table(path, rig=coarse_rig)
    found = verify_table(changed, coarse_rig, samples=4 if name == "omega" else 1)
    assert not any(check.is_passed for check in found.content)
    if name == "omega":
        assert not all(check.is_passed for check in found.answer_checks)
        assert found.failed_count >= 3


def test_verify_compares_tones_of_two_frequencies_by_every_threshold_set():
    """The second answer of this sample has two frequencies, whose contrast depends on the set.

    Relative to the rig's own set, it is 0.2 dB higher than predicted for the worst set.
    """
    rig = load_rig(EXAMPLES / "tutorial_rig.yaml")
    table = build_table(rig, drive_mode="switched")
    check = verify_table(table, rig, samples=2).answer_checks[1]
    (layer,) = query(table, check.placed).layers
    nominal = draw_plates(
        np.random.default_rng(0), Uncertainty.none(), of=table, count=1, contact_count=3
    )
    _, by_own_set = felt_on(table, check.placed, layer.excitation, nominal)
    assert 20 * np.log10(by_own_set[0]) > check.predicted_contrast_db + 0.2
    assert check.direct_contrast_db == pytest.approx(check.predicted_contrast_db, abs=0.02)
    assert check.is_passed


def test_springs_of_drawn_plates_are_positive():
    """At the largest uncertainty they have the distribution of a normal number cut off at 0."""
    known = replace(Uncertainty(), stiffness=0.5)
    plates = draw_plates(np.random.default_rng(0), known, of=ON_FEET, count=1000, contact_count=2)
    assert plates.stiffness.min() > 0
    expected = truncnorm(-2, np.inf, loc=1, scale=0.5)
    assert kstest(plates.stiffness.ravel(), expected.cdf).pvalue > 0.01


@pytest.mark.parametrize(
    ("kept_share", "answer_count", "is_passed"),
    [(0.79, 1, True), (0.65, 1, False), (0.79, 12, False), (0.81, 12, True)],
)
def test_promise_check_allows_few_answers_the_spread_of_one(kept_share, answer_count, is_passed):
    """By hand: 0.9 - 4 * 0.06 = 0.66 for one answer, 0.83 for twelve; never above 0.8."""
    assert PromiseCheck(kept_share, answer_count).is_passed is is_passed


TARGET, QUIET = (0.09, 0.07), ((0.25, 0.18), (0.03, 0.19))
ON_FEET = replace(
    smooth_rig(),
    masses=(
        PointLoad(0.02, 0.03, stiffness=30e3, loss_factor=0.15, is_foot=True),
        PointLoad(0.2, 0.05, mass=0.03),
        PointLoad(0.27, 0.2, stiffness=20e3, damping=2.0, is_foot=True),
    ),
)


@cache
def table_on_feet():
    """The table of that rig."""
    return build_table(ON_FEET, frequencies=SMALL_TABLE_HZ)


DISPLACED = np.array([[1.0, 0.5], [-1.0, 0.8], [-0.6, -1.2], [0.9, -0.7]])  # inwards

PLATES = Plates(
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
    places=1e-3 * np.array([np.zeros((4, 2)), DISPLACED, -0.5 * DISPLACED]),
    harmonic=np.zeros((3, 4), dtype=complex),
    feet=np.array([[1.0, 1.0], [0.6, 1.4], [1.5, 0.8]]),
)


def directly(rig, layer, number, *, targets=1, pressed=(1, 1, 1)):
    """Felt and acceleration contrast [dB] by the sparse direct solve of that plate.

    targets: how many of the places are; the weakest one counts. pressed: factor on the pulp and
    contact mass of each finger.
    """
    plate = replace(
        rig.plate.scaled(modulus=PLATES.modulus[number]),
        thickness=rig.plate.thickness * PLATES.thickness[number],
        loss_factor=rig.plate.loss_factor * PLATES.loss[number],
    )
    eras = [
        replace(
            era,
            x=min(max(era.x + x, 0.0), plate.length),
            y=min(max(era.y + y, 0.0), plate.width),
            stiffness=era.stiffness * k,
            damping=era.damping * PLATES.damping[number],
        )
        for era, k, (x, y) in zip(
            rig.eras, PLATES.stiffness[number], PLATES.places[number], strict=True
        )
    ]
    places = (TARGET, *QUIET)
    fingers = [
        FingertipLoad(*place, rig.fingertip.scaled(more).multiplied(factor))
        for place, more, factor in zip(places, pressed, PLATES.load[number], strict=True)
    ]
    masses = list(rig.masses)
    for foot, factor in zip((0, 2), PLATES.feet[number], strict=True):
        masses[foot] = replace(masses[foot], stiffness=factor * masses[foot].stiffness)
    discs = [fingertip_points(*place, rig.plate) for place in places]
    frequencies, bases = base_amplitudes(layer.excitation, rig.eras)
    unit = direct_acceleration(
        assemble(plate, rig.mesh),
        eras,
        frequencies,
        np.concatenate(discs),
        loads=[*masses, *fingers],
    )
    weights = bases / [era.stroke for era in rig.eras] * PLATES.gain[number]
    amplitudes = np.abs(np.einsum("fe,fep->fp", weights, unit))
    above = np.sqrt(((amplitudes.T / detection_threshold(frequencies)) ** 2).sum(axis=1))
    each = np.split(above, np.cumsum([len(disc) for disc in discs])[:-1])
    means = [
        here @ fingertip_weights(*place, rig.plate)
        for here, place in zip(each[:targets], places, strict=False)
    ]
    return 20 * np.log10(min(means) / np.concatenate(each[targets:]).max())


@pytest.mark.parametrize(
    ("targets", "mode", "loads"),
    [
        (1, "switched", ()),
        (1, "phased", ()),
        (2, "switched", ()),
        (1, "phased", (2.5, 0.4, 1.0)),
    ],
    ids=["1-switched", "1-phased", "2-switched", "pressed"],
)
def test_felt_on_agrees_with_the_direct_solve(targets, mode, loads):
    """Thicker, softer, damped otherwise, misdriven, other fingers and feet: within 0.15 dB.

    So is the nominal contrast of an answer on the first of the plates, which is the modeled one.
    Contrasts of fingers that press alike are off by more where these do not.
    """
    places, alike = (TARGET, *QUIET), (1, 1, 1)
    placed = Placement(places[:targets], places[targets:], loads)
    layer, predicted = only(table_on_feet(), placed, drive_mode=mode)
    _, contrast = felt_on(table_on_feet(), placed, layer.excitation, PLATES)
    solved, pressed_alike = (
        [directly(ON_FEET, layer, n, targets=targets, pressed=pressed) for n in range(3)]
        for pressed in (loads or alike, alike)
    )
    np.testing.assert_allclose(20 * np.log10(contrast), solved, atol=0.15)
    assert np.ptp(solved) > 0.15  # the plates do differ
    assert predicted.contrast_db == pytest.approx(solved[0], abs=0.15)
    assert not loads or np.abs(np.subtract(pressed_alike, solved)).max() > 0.2


def test_an_object_that_may_lie_anywhere_is_an_error_of_fields():
    """Of 5 g six times its mean square, over plates solved with the mass at each place, to 10 %."""
    rig = make_paper_rig(12, 9)
    expected = replace(rig, uncertainty=replace(rig.uncertainty, foreign_mass=0.005))
    frequencies = np.array([60.0, 110.0, 180.0])
    table, heavier = (build_table(each, frequencies=frequencies) for each in (rig, expected))
    free = solve_free_plate(rig.plate, rig.mesh, frequency_max=180.0)
    points = table.raster.points
    alone = free.acceleration(rig.eras, frequencies, points)
    changed = np.zeros(alone.shape[:2])
    for x, y in Grid(6, 5).centers(rig.plate):
        load = PointLoad(x, y, mass=0.005)
        beside = free.acceleration(rig.eras, frequencies, points, loads=[load])
        changed += (np.abs(beside - alone) ** 2).mean(axis=2) / 30
    found = heavier.field_error_power - table.field_error_power
    assert found == pytest.approx(6 * changed, rel=0.1)


def test_error_power_is_the_error_of_the_direct_field():
    """One ERA driven: its field over the plate by the direct solve, mean square, times it."""
    rig, table = smooth_rig(), smooth_table()
    frequency = float(table.frequencies[8])
    direct = direct_acceleration(
        assemble(rig.plate, rig.mesh), rig.eras, np.array([frequency]), table.raster.points
    )[0, 1]
    expected = table.discretization_error[8] ** 2 * (np.abs(direct) ** 2).mean()
    assert table.error_power[8, 1] == pytest.approx(expected, rel=1e-3)


def test_draw_plates_has_the_spreads_of_the_uncertainty():
    """Normal numbers: of the logarithm for damping, loss, load and feet."""
    known = replace(Uncertainty(), supports=0.3)
    plates = draw_plates(np.random.default_rng(0), known, of=ON_FEET, count=4000, contact_count=2)
    expected_stds = [
        (np.abs(plates.gain), 0.05),
        (np.degrees(np.angle(plates.gain)), 5.0),
        (plates.stiffness, 0.1),
        (plates.thickness, 0.02),
        (np.log(plates.damping), math.log(1.5)),
        (np.log(plates.loss), math.log(1.5)),
        (np.log(plates.load), 0.5),
        (plates.modulus, 0.02),
        (plates.places, 0.001),
        (plates.harmonic, 0.01),
        (np.log(plates.feet), 0.3),
    ]
    for values, std in expected_stds:
        assert values.std() == pytest.approx(std, rel=0.04)


@pytest.mark.parametrize(
    ("known", "percent", "expected"),
    [
        (Uncertainty(), 10, (16.1, 12.5, 9.5)),
        pytest.param(
            replace(Uncertainty.none(), gain=0.01, phase_deg=1.0),
            50,
            (33.0, 18.0, 14.5),
            marks=pytest.mark.long,
        ),
    ],
)
def test_answers_reach_what_an_independent_optimum_does(known, percent, expected):
    """Medians over 20 contact sets of the contrast of plates with loading fingers, 1 to 3 quiet.

    The optimum climbed the percentile itself on other sets of the same plate, on another model of
    it; medians over so few sets move by a decibel.
    """
    table = build_table(replace(smooth_rig(), uncertainty=known), frequencies=SMALL_TABLE_HZ)
    rng = np.random.default_rng(8)
    for quiet, optimum in zip((1, 2, 3), expected, strict=True):
        found = []
        for places in contact_sets(20, fingers=1 + quiet, seed=100 + quiet):
            placed = Placement((places[0],), tuple(places[1:]))
            layer, _ = only(table, placed, drive_mode="phased")
            plates = draw_plates(rng, known, of=table, count=100, contact_count=1 + quiet)
            _, contrast = felt_on(table, placed, layer.excitation, plates)
            found.append(20 * np.log10(np.percentile(contrast, percent)))
        assert np.median(found) == pytest.approx(optimum, abs=2.0)
