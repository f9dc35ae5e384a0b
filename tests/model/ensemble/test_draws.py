"""Drawn plates with uncertain feet, harmonics and clock errors, by Monte Carlo and by hand.

Fields under loading fingertips, and with ERAs or exciters at other places, and their sensitivities:
by differences of the direct solve, and by rebuilt plates.
"""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from kit.direct_plate import direct_acceleration
from kit.plates import LENGTH, WIDTH, contact_sets, smooth_rig
from model.answer.answer import Answer
from model.answer.fingers_on_plate import FingersOnPlate
from model.answer.plan import answer
from model.answer.stimulus import Finger, Stimulus
from model.arrays import ComplexArray, FloatArray
from model.ensemble.attached_plate import MODELED, PlateOnEras, attach, thickness_nodes
from model.ensemble.draws import (
    PROMISED_DRAWS,
    ClockErrors,
    Drawing,
    delayed,
    draw,
    percentile,
)
from model.ensemble.kernel_plates import touch
from model.ensemble.touched_plate import TouchedPlate
from model.errors import InputError
from model.fem import ELEMENTS, Mesh, assemble
from model.finger import FINGERTIP_RADIUS, FIVE_POINTS, detection_threshold
from model.reduction.reduced_plate import reduce_plate
from model.rig.rig import Channel, Uncertainty
from model.structure.attachments import PointLoad, footprints_of
from model.structure.exciter import Exciter
from model.structure.fingertips import FingertipLoad
from model.table.table import LocalizationTable
from model.table.table_file import build_table


def test_common_gain_moves_all_channels_together():
    """Channels that are known relative to each other are louder or softer by the same.

    By two standard deviations of 3 % on half of the plates each, however these are drawn else: of
    plates that are up to 1.28 of them off, nine of ten, each keeps nine of ten of its levels.
    """
    known = {**CERTAIN, "common_gain": 0.03, "thicknesses": 40}
    factors = 1 + draw(4, 2, masses=0, count=200, seed=8, **known).gains[:4]
    np.testing.assert_allclose(factors, np.broadcast_to(factors[0], factors.shape), rtol=1e-6)
    sizes, counts = np.unique(np.log(factors[0].real).round(5), return_counts=True)
    assert sizes == pytest.approx([-0.06, 0.06], rel=1e-3)
    assert counts.tolist() == [100, 100]
    np.testing.assert_allclose(factors.imag, 0, atol=1e-6)


CERTAIN = {"gain": 0.0, "phase": 0.0, "common_gain": 0.0, "harmonic": 0.0, "thicknesses": 1}
"""Plates of which nothing that is drawn deviates."""


PLACES = ((0.09, 0.07), (0.25, 0.18))
LOADS = (1.0, 2.5)
FREQUENCIES = np.array([60.0, 145.0, 260.0, 430.0, 520.0])
SHARE = 0.02
WEIGHTS = np.array(
    [[1, 0.3j, -0.5, 0.2], [0.1, 1, 0.4j, 0], [-1, 0.2, 0.6, 1j], [1, 1, 0, 0], [1, 0, 0, 0]],
    dtype=np.complex64,
)

MANY = Drawing(count=4000, seed=3, thicknesses=1)


@cache
def table() -> LocalizationTable:
    """The paper's plate on a mesh that carries 1 kHz; one drive is weaker above 60 Hz."""
    rig = smooth_rig()
    gains = ((60.0, 1.0, 0.3), (61.0, 0.5, 0.3))
    eras = (replace(rig.eras[0], gains=gains), *rig.eras[1:])
    mesh = Mesh(8, 6, rig.plate.length, rig.plate.width, ELEMENTS["Q5"])
    known = replace(Uncertainty.none(), harmonic=SHARE)
    limits = replace(rig.limits, frequency_max=520.0)
    rig = replace(rig, eras=eras, mesh=mesh, limits=limits, uncertainty=known)
    return build_table(rig, frequencies=FREQUENCIES)


def directly(frequency: float) -> FloatArray:
    """Acceleration at twice it by each base that moves by its full stroke, (eras, fingers, p)."""
    of = table()
    points = np.array(PLACES)[:, None] + FINGERTIP_RADIUS * FIVE_POINTS.points
    found = direct_acceleration(
        assemble(of.plate, of.mesh),
        [replace(era, gains=()) for era in of.eras],
        np.array([2 * frequency]),
        points.reshape(-1, 2),
        loads=[
            FingertipLoad(*at, of.fingertip.scaled(load))
            for at, load in zip(PLACES, LOADS, strict=True)
        ],
    )
    return found[0].reshape(len(of.eras), len(PLACES), -1)


@pytest.mark.parametrize("row", range(4))
def test_harmonics_at_fingers_are_those_of_drawn_phases(row: int) -> None:
    """Mean and percentiles of independent complex normal numbers of a share, by the direct solver.

    Of each ERA's own motion, which for one is smaller at twice the frequency. Beyond what skin
    feels they count for nothing: thresholds end at 1 kHz, so twice 520 Hz has none.
    """
    frequency = float(FREQUENCIES[row])
    motion = SHARE * np.abs(WEIGHTS[row]) * [1.0 if frequency < 60.5 else 0.5, 1.0, 1.0, 1.0]
    rng = np.random.default_rng(1)
    numbers = rng.standard_normal((20_000, 4, 2)) @ [1, 1j] / np.sqrt(2)
    fields = np.einsum("de,e,ekp->dkp", numbers, motion, directly(frequency))
    expected = np.abs(fields) ** 2 @ FIVE_POINTS.weights / detection_threshold(2 * frequency) ** 2

    fingers = FingersOnPlate.of(table(), PLACES, LOADS)
    found = fingers.harmonics(MANY, np.array([row]), WEIGHTS[[row]])[0]
    assert (found[:, 0] == 0).all()  # of the nominal plate
    assert not fingers.harmonics(MANY, np.array([4]), WEIGHTS[[4]]).any()
    np.testing.assert_allclose(found[:, 1:].mean(axis=1), expected.mean(axis=0), rtol=0.06)
    for percent in (50, 90):
        by_draws = np.percentile(expected, percent, axis=0)
        np.testing.assert_allclose(percentile(found[:, 1:], percent), by_draws, rtol=0.09)


def test_search_counts_harmonics_as_over_the_plate() -> None:
    """One ERA: mean square over the plate at twice the frequency by the direct solver."""
    of, row = table(), 2
    direct = direct_acceleration(
        assemble(of.plate, of.mesh),
        [replace(era, gains=()) for era in of.eras],
        2 * FREQUENCIES[[row]],
        of.raster.points,
    )[0, 1]
    thresholds = detection_threshold(FREQUENCIES[row] * np.array([1.0, 2.0]))
    expected = (SHARE * thresholds[0] / thresholds[1]) ** 2 * (np.abs(direct) ** 2).mean()
    found = of.search_error_power[row, 1] - of.error_power[row, 1]
    assert found == pytest.approx(expected, rel=0.02)


IDENTIFIED = Uncertainty(0.015, 1.5, 0.002, 0.01, 1.1, 0.5, modulus=0.0, place=0.0, harmonic=0.0)
ERAS = tuple(era.name for era in smooth_rig().eras)
WIRING = {name: Channel("ab"[number % 2], number) for number, name in enumerate(ERAS)}
"""Each amplifier has two ERAs of the four at the corners."""

OF = np.array([0, 1, 0, 1])


@cache
def late_table() -> LocalizationTable:
    """The paper's plate after an identification."""
    rig = replace(smooth_rig(), uncertainty=IDENTIFIED)
    return build_table(rig, frequencies=np.arange(40.0, 321.0, 10.0), drive_mode="phased")


def clocks(**errors: float) -> ClockErrors:
    """Clocks of amplifiers a and b with these errors [s]."""
    return ClockErrors.of(ERAS, WIRING, errors)


def test_two_equal_halves_leave_what_their_delay_says() -> None:
    """2 sin(pi f t) of one half, t apart, and in the mean square 2 (exp(p²) - 1) of the mean's."""
    draws = draw(2, 1, masses=0, count=200, seed=8, **CERTAIN)
    off = ClockErrors((0, 1), (20e-6, 20e-6))
    omega = 2 * math.pi * np.array([1.0, 250.0])
    gains = delayed(draws.gains, off, Drawing(200, 8, 1), omega).astype(complex)
    delays = -np.angle(1 + gains[0, :2]) / (2 * math.pi)  # [s], by the phase at 1 Hz
    assert delays.std(axis=1) == pytest.approx([20e-6, 20e-6], rel=0.01)
    left = np.abs(gains[1, 0] - gains[1, 1])
    by_hand = 2 * np.abs(np.sin(math.pi * 250 * (delays[0] - delays[1])))
    np.testing.assert_allclose(left, by_hand, atol=2e-4)
    shares = off.power_shares(np.array([250.0]))
    power = (1 + shares[0]) * [[1, -1], [-1, 1]]
    assert power.sum() == pytest.approx(2 * math.expm1((2 * math.pi * 250 * 20e-6) ** 2), rel=1e-4)


def test_eras_of_one_amplifier_are_late_together() -> None:
    """Their factors are one number, and those of the other amplifier another.

    Gains of the plates of the promise differ by factors of magnitude 1, but for the clocks.
    """
    draws, by = draw(4, 2, masses=1, count=64, seed=1, **CERTAIN), Drawing(64, 1, 1)
    (gains,) = delayed(draws.gains, clocks(a=1e-4, b=2e-4), by, np.array([200 * math.pi]))
    assert (gains[0] == gains[2]).all()
    assert (gains[1] == gains[3]).all()
    assert np.abs(gains[0] - gains[1]).min() > 0
    assert not gains[4:].any()  # a mass and two fingers have no drive

    known = {**CERTAIN, "gain": 0.05, "phase": 0.1, "thicknesses": 40}
    count, seed = PROMISED_DRAWS.count, PROMISED_DRAWS.seed
    exact = draw(4, 1, masses=0, count=count, seed=seed, **known)
    omega = 2 * math.pi * np.array([100.0, 200.0])
    off = delayed(exact.gains, clocks(a=1e-4, b=1e-4), PROMISED_DRAWS, omega)
    np.testing.assert_allclose(np.abs(1 + off[1]), np.abs(1 + exact.gains), rtol=1e-5)


@pytest.mark.usefixtures("kernels_or_numpy")
def test_expected_power_is_the_mean_square_of_delayed_drives() -> None:
    """w^H R w of random weights is the mean over 4000 plates, relative to the mean amplitude's.

    Which is smaller by exp(-p² / 2), p = 2 pi f times 0.2 ms; all else is certain.
    """
    exact = np.zeros_like(late_table().discretization_error)
    known = replace(late_table(), uncertainty=Uncertainty.none(), discretization_error=exact)
    off = known.with_clocks(clocks(a=2e-4, b=2e-4))
    fingers = FingersOnPlate.of(off, [(0.09, 0.07), (0.25, 0.18)], ())
    rows, n = np.array([3, 12, 25]), 4
    rng = np.random.default_rng(0)
    weights = (rng.normal(size=(3, n)) + 1j * rng.normal(size=(3, n))).astype(np.complex64)
    forms = fingers.touched.forms(
        rows, fingers.tips.fine, fingers.tips.fine_weights, off.error_power
    )
    found = np.einsum("fi,fqij,fj->fq", weights.conj(), forms.power, weights).real
    powers = fingers.powers(Drawing(4000, 5, 1), rows, weights)[..., 1:].mean(axis=-1)
    squares = (powers * fingers.tips.fine_weights).sum(axis=-1) * off.thresholds[rows, None] ** 2
    shrunk = np.exp(-((2 * math.pi * off.frequencies[rows] * 2e-4) ** 2))
    np.testing.assert_allclose(found * shrunk[:, None], squares, rtol=0.06)


def two(of: LocalizationTable, places: list[tuple[float, float]]) -> Answer:
    """Two fingers with a content each."""
    return answer(of, [Finger(at, Stimulus(14.0)) for at in places], min_contrast_db=-math.inf)


@pytest.mark.usefixtures("kernels_or_numpy")
def test_an_amplifier_whose_clock_is_not_held_plays_contents_of_its_own() -> None:
    """Each content is of one amplifier's ERAs."""
    off = late_table().with_clocks(clocks(a=math.inf, b=math.inf))
    for places in contact_sets(8, fingers=2, seed=4):
        wired = [
            {WIRING[era].amplifier for era in each.excitation} for each in two(off, places).layers
        ]
        assert [len(each) for each in wired] == [1, 1]


def test_amplifiers_that_are_held_play_together_beside_one_that_is_not() -> None:
    """Of three amplifiers two are held: their ERAs are one group, and the third's another.

    Errors must be known of all: neither missing, nor not a number, nor negative.
    """
    wiring = {name: Channel("abc"[min(number, 2)], 0) for number, name in enumerate(ERAS)}
    for errors, groups in (
        ({"a": 5e-6, "b": math.inf, "c": 5e-6}, (0, 1, 0, 0)),
        (dict.fromkeys("abc", 1e-4), ()),
        (dict.fromkeys("abc", 1e-3), (0, 1, 2, 2)),
    ):
        assert ClockErrors.of(ERAS, wiring, errors).groups == groups
    for errors in ({"a": 1e-6}, {"a": 1e-6, "b": math.nan}, {"a": 0, "b": -1e-6}):
        with pytest.raises(InputError, match="amplifier b"):
            ClockErrors.of(ERAS, WIRING, errors)


TOUCHED_PLATE_PLACES = np.array([[0.09, 0.07], [0.25, 0.18], [0.03, 0.19]])
TOUCHED_PLATE_FREQUENCIES = np.array([60.0, 145.0, 260.0, 430.0])
RIG = replace(
    smooth_rig(),
    mesh=Mesh(4, 3, LENGTH, WIDTH, ELEMENTS["Q5"]),
    masses=(
        PointLoad(0.2, 0.05, mass=0.03),
        PointLoad(0.02, 0.2, stiffness=30e3, damping=1.0, loss_factor=0.15, is_foot=True),
        PointLoad(0.29, 0.12, mass=0.01),
    ),
)
UNEQUAL = replace(
    RIG,
    eras=tuple(
        replace(
            era,
            stiffness=era.stiffness * (0.8 + 0.15 * number),
            stroke=era.stroke * (1.2 - 0.1 * number),
            gains=((60.0, 0.9 + 0.1 * number, 0.02), (430.0, 1.0, -0.1 * number)),
        )
        for number, era in enumerate(RIG.eras)
    ),
)
MIXED = replace(
    RIG,
    eras=(
        RIG.eras[0],
        Exciter(
            *("SE", RIG.eras[1].x, RIG.eras[1].y),
            **{"stiffness": 4769.0, "damping": 0.83, "magnet_mass": 0.0335, "coil_mass": 1.29e-3},
            **{"force_factor": 1.54, "resistance": 3.6, "voltage": 20.0, "inductance": 7e-5},
            gains=((60.0, 0.9, 0.02), (430.0, 1.0, -0.4)),
        ),
        *RIG.eras[2:],
    ),
)
"""With an exciter in place of an ERA, driven to as much at 60 Hz, its resonance."""
POINTS = TOUCHED_PLATE_PLACES[:, None] + FINGERTIP_RADIUS * FIVE_POINTS.points


def solved(uncertainty, loads=(), *, rig=RIG, count=3, modulus=0.0):
    """The plate with its first fingers on it; reduced for them too, so that nothing is left out."""
    fixed = footprints_of(rig.eras, rig.masses)
    fingers = np.column_stack([TOUCHED_PLATE_PLACES, np.zeros(3)])
    reduced = reduce_plate(rig.plate, rig.mesh, np.vstack([fixed, fingers]), frequency_max=500.0)
    plate = attach(
        rig.plate,
        reduced.omega,
        reduced.losses,
        reduced.at(fixed),
        eras=rig.eras,
        masses=rig.masses,
        fingertip=rig.fingertip,
        uncertainty=replace(uncertainty, modulus=modulus),
        frequencies=TOUCHED_PLATE_FREQUENCIES,
    )
    shapes = reduced.at(POINTS.reshape(-1, 2)).astype(np.float32).reshape(3, 5, -1)
    weights = np.tile(FIVE_POINTS.weights, (3, 1)).astype(np.float32)
    touched = touch(PlateOnEras.of(plate, 2, 5), shapes[:count, 0], loads)
    error = np.zeros((4, 4), np.float32)
    return (
        touched,
        touched.forms(np.arange(4), shapes[:count], weights[:count], error),
        shapes[:count].reshape(5 * count, -1),
    )


def changed(touched, points, weights, *, node=MODELED):
    """Accelerations at all frequencies by weights, and their changes by each parameter."""
    at, nodes = np.arange(4), np.full(4, node)
    by_force, moved = touched.sources(at, nodes, points)
    motion = np.einsum("fan,fn->fa", moved, weights)
    changes = touched.changes(at, nodes, weights, motion, points)
    return {
        "nominal": np.matvec(by_force, changes.drives),
        "loss": np.matvec(by_force, changes.loss) + changes.by_loss,
        "damping": np.matvec(by_force, changes.damping),
        "stiffness": by_force[:, :, 1] * changes.own[:, 1, None],
        "foot": by_force[:, :, 5] * changes.own[:, 5, None],  # after four ERAs and a mass
        "load": by_force[:, :, 8] * changes.own[:, 8, None],  # of the second finger
    }


@cache
def touched_plate_directly(
    *,
    with_exciter=False,
    thickness=1.0,
    modulus=1.0,
    loss=1.0,
    damping=1.0,
    stiffness=(1, 1, 1, 1),
    load=(1, 1, 1),
    foot=1,
    pressed=(1, 1, 1),
):
    """Fields (f, eras, points) of a plate that differs by these factors.

    pressed: on pulp and contact mass of each finger; load: on all of it.
    """
    rig = MIXED if with_exciter else RIG
    plate = replace(
        rig.plate.scaled(modulus=modulus),
        thickness=thickness * rig.plate.thickness,
        loss_factor=loss * rig.plate.loss_factor,
    )
    eras = [
        era.varied(stiffness=k, damping=damping) for era, k in zip(rig.eras, stiffness, strict=True)
    ]
    mass, stand, other = rig.masses
    fingers = [
        FingertipLoad(*place, rig.fingertip.scaled(more).multiplied(factor))
        for place, more, factor in zip(TOUCHED_PLATE_PLACES, pressed, load, strict=True)
    ]
    return direct_acceleration(
        assemble(plate, rig.mesh),
        eras,
        TOUCHED_PLATE_FREQUENCIES,
        POINTS.reshape(-1, 2),
        loads=[mass, replace(stand, stiffness=foot * stand.stiffness), other, *fingers],
    )


@pytest.mark.usefixtures("kernels_or_numpy")
@pytest.mark.parametrize(
    ("rig", "loads"), [(RIG, ()), (RIG, (0.4, 1.0, 2.5)), (MIXED, ())], ids=["like", "", "exciter"]
)
def test_fields_are_those_of_the_direct_solve(rig, loads):
    """At every finger's points, with an ERA's drive and a mass on the plate: to 1e-4.

    Whether all fingers press alike or not.
    """
    _, contacts, _ = solved(Uncertainty(), loads, rig=rig)
    found = contacts.fields.transpose(0, 3, 1, 2).reshape(4, 4, 15)
    exact = touched_plate_directly(with_exciter=rig is MIXED, pressed=loads or (1, 1, 1))
    assert furthest(found, exact, axis=(1, 2)) < 2e-4


def furthest(found, exact, axis=1):
    """Largest error of all frequencies, by the largest value at each."""
    return (np.abs(found - exact).max(axis=axis) / np.abs(exact).max(axis=axis)).max()


TOUCHED_PLATE_WEIGHTS = np.array([0.6, -0.3 + 0.5j, 1.0, 0.2j], dtype=np.complex64)

CHANGES = {
    "loss": lambda d: {"loss": math.exp(d)},
    "damping": lambda d: {"damping": math.exp(d)},
    "stiffness": lambda d: {"stiffness": (1, 1 + 0.01 * d, 1, 1)},  # of 1 %
    "load": lambda d: {"load": (1, 1 + d, 1)},
    "foot": lambda d: {"foot": 1 + 0.3 * d},  # of 30 %
}


def test_sensitivity_to_the_load_of_a_finger_that_presses_harder():
    """Of a finger pressed 2.5 times as much between others, by a difference of the direct solve."""
    pressed = (0.4, 2.5, 1.0)
    touched, _, points = solved(Uncertainty(0, 0, 1.0, 1.0, math.e, 1.0), pressed)
    found = changed(touched, points, np.ones((4, 4), dtype=np.complex64))["load"]
    more, less = (
        touched_plate_directly(pressed=pressed, load=(1, 1 + d, 1)) for d in (1e-3, -1e-3)
    )
    assert furthest(found, ((more - less) / 2e-3).sum(axis=1)) < 0.01


@pytest.mark.usefixtures("kernels_or_numpy")
@pytest.mark.parametrize("modulus", [0.0, 0.04])
def test_thickness_is_exact_at_its_nodes(modulus):
    """The direct solve of plates so much thicker, far from what is in proportion.

    With a modulus that moves frequencies as much as the thickness, the plate has half of each.
    """
    touched, _, points = solved(Uncertainty(thickness=0.02), modulus=modulus)
    weights, nodes = np.tile(TOUCHED_PLATE_WEIGHTS, (4, 1)), thickness_nodes(5)
    first, at = touched.plate_on_eras.first[5], np.arange(4)
    found = [touched.fields(at, np.full(4, first + node), weights, points) for node in range(5)]
    for node in (0, 1, 4):
        thicker = 0.02 * float(nodes[node])
        higher, share = (math.sqrt(2), math.sqrt(0.5)) if modulus else (1.0, 1.0)
        h = 1 + share * thicker
        stiffer = ((1 + higher * thicker) / h) ** 2
        by_era = touched_plate_directly(thickness=h, modulus=round(stiffer, 12))
        exact = np.einsum("e,fep->fp", TOUCHED_PLATE_WEIGHTS, by_era)
        assert furthest(found[node], exact) < 5e-3
    nominal = touched.fields(at, np.full(4, MODELED), weights, points)
    size = float(np.abs(nominal).max())
    assert found[2] == pytest.approx(nominal, rel=1e-3, abs=1e-4 * size)
    assert np.abs(found[0] + found[4] - 2 * nominal).max() > 0.1 * size


@pytest.mark.parametrize("rig", [RIG, MIXED], ids=["", "exciter"])
@pytest.mark.parametrize("what", CHANGES)
def test_sensitivities_of_a_thicker_plate_are_differences_of_the_direct_solve(what, rig):
    """Of a plate 3 % thicker, by central differences: within 1 % of the largest change."""
    touched, _, points = solved(Uncertainty(0, 0, 0.02, 0.01, math.e, 1.0, supports=0.3), rig=rig)
    node = touched.plate_on_eras.first[5] + 4
    found = changed(touched, points, np.tile(TOUCHED_PLATE_WEIGHTS, (4, 1)), node=node)[what]
    thickness = 1 + 0.02 * float(thickness_nodes(5)[4])
    more, less = (
        touched_plate_directly(with_exciter=rig is MIXED, thickness=thickness, **CHANGES[what](d))
        for d in (1e-3, -1e-3)
    )
    exact = np.einsum("e,fep->fp", TOUCHED_PLATE_WEIGHTS, (more - less) / 2e-3)
    assert furthest(found, exact) < 0.01


def felt_of(touched, points, weights, **drawn):
    """What drawn plates feel of a tone of weights (4, n) at each frequency, at all points."""
    count = len(touched.centers)
    error = np.zeros((4, 4), np.float32)
    if drawn["count"] < 100:
        error[1:3] = [[1e-4], [1e-2]]
    return touched.drawn(
        Drawing(**drawn),
        np.arange(4),
        weights,
        points,
        np.tile(FIVE_POINTS.weights, (count, 1)).astype(np.float32),
        error,
        np.ones(4, dtype=np.float32),
        with_powers=True,
    )


@pytest.mark.usefixtures("kernels_or_numpy")
def test_expected_power_is_the_mean_square_of_the_draws():
    """w^H R w of random weights equals the mean over 4000 drawn plates but for the loss factor.

    Of two thicknesses that deviate so little that they count in proportion.
    """
    touched, contacts, points = solved(
        replace(Uncertainty(), thickness=0.002, damping=1.0, supports=0.3)
    )
    rng = np.random.default_rng(0)
    weights = (rng.normal(size=(4, 4)) + 1j * rng.normal(size=(4, 4))).astype(np.complex64)
    powers = felt_of(touched, points, weights, count=4000, seed=5, thicknesses=2).powers
    powers = powers[:, :, 1:].mean(axis=2).reshape(4, 3, 5)
    found = np.einsum("fi,fqij,fj->fq", weights.conj(), contacts.power, weights).real
    np.testing.assert_allclose(found, powers @ FIVE_POINTS.weights, rtol=0.05)


@pytest.mark.parametrize(
    ("rig", "count"),
    [(UNEQUAL, 1), (UNEQUAL, 3), (MIXED, 3)],
    ids=["1", "3", "exciter-3"],
)
@pytest.mark.usefixtures("kernels_or_numpy")
def test_every_stage_is_that_of_numpy(rig, count):
    """Fields, forms and what drawn plates feel, in single precision: to 1e-4 of the largest.

    ERAs differ in stiffness, stroke and gain, so that none takes the place of another.
    """
    loads = (0.4, 12.0, 2.5)[:count]  # a finger, a hand, a finger
    touched, _, points = solved(replace(Uncertainty(), supports=0.3), loads, rig=rig, count=count)
    by_numpy = TouchedPlate(
        touched.plate_on_eras, touched.centers, touched.stiffness, touched.load_std
    )
    weights = np.tile(TOUCHED_PLATE_WEIGHTS, (4, 1))
    few, shares = points.reshape(count, 5, -1), np.tile(FIVE_POINTS.weights, (count, 1))
    error = np.full((4, 4), 0.01, np.float32)
    forms = [
        each.forms(np.array([2, 0, 3]), few, shares.astype(np.float32), error, few[:, 1:3])
        for each in (touched, by_numpy)
    ]
    # All fingers in one group, at their centers, whose fields are known already.
    thirds = np.full((1, count), 1 / count, np.float32)
    together = [
        each.forms(np.arange(4), touched.centers[None], thirds, error, few[:1, 1:3])
        for each in (touched, by_numpy)
    ]
    felt = [
        felt_of(each, points, weights, count=45, seed=1, thicknesses=5, bases=bases)
        for each in (touched, by_numpy)
        for bases in (1, 5)
    ]
    for one, other in (forms, together, felt[::2], felt[1::2]):
        for name, exact in vars(other).items():
            np.testing.assert_allclose(
                getattr(one, name), exact, rtol=1e-4, atol=1e-4 * float(np.abs(exact).max())
            )
    assert felt[0].means.std(axis=2).min() > 0


SHIFTED_HZ = np.array([60.0, 145.0, 260.0])
SHIFTED_AT = ((0.05, 0.04), (0.26, 0.06), (0.24, 0.19), (0.13, 0.12))
STEP, STIFFER = 1e-4, 1e-3  # m, relative


@pytest.mark.long
def test_places_that_are_off_change_fields_as_much_as_stiffnesses_do() -> None:
    """All fields over the plate, mean square: an ERA off by 1 mm along x and y, and its spring."""
    plain = smooth_rig()
    eras = tuple(replace(era, x=x, y=y) for era, (x, y) in zip(plain.eras, SHIFTED_AT, strict=True))
    known = replace(Uncertainty.none(), stiffness=0.01, place=0.001)
    rig = replace(plain, eras=eras, uncertainty=known)
    table = build_table(rig, frequencies=SHIFTED_HZ)
    matrices = assemble(rig.plate, rig.mesh)

    def changed(number: int, **values: float) -> ComplexArray:
        other = replace(rig.eras[number], **values)
        every = [*rig.eras[:number], other, *rig.eras[number + 1 :]]
        return direct_acceleration(matrices, every, SHIFTED_HZ, table.raster.points)

    for number, era in enumerate(rig.eras):
        moved = [
            (changed(number, x=era.x + x, y=era.y + y) - changed(number, x=era.x - x, y=era.y - y))
            / (2 * STEP)
            for x, y in ((STEP, 0.0), (0.0, STEP))
        ]
        k = era.stiffness
        stiffer = changed(number, stiffness=k * (1 + STIFFER))
        softer = changed(number, stiffness=k * (1 - STIFFER))
        by_place = 0.001**2 * (np.abs(moved) ** 2).sum(axis=(0, 2, 3))
        by_spring = (np.abs((stiffer - softer) / (2 * STIFFER * k)) ** 2).sum(axis=(1, 2))
        expected = np.hypot(0.01 * k, np.sqrt(by_place / by_spring))
        found = table.on_eras.plate.by_stiffness[:, number].real
        np.testing.assert_allclose(found, expected, rtol=0.03)
