"""Fields at loading fingertips and their sensitivities, by differences of the direct solve."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from model.ensemble.attached_plate import attach
from model.ensemble.contact_forms import load_contacts
from model.ensemble.draws import draw
from model.ensemble.thickness import responses_of_thicknesses, thickness_nodes
from model.ensemble.tone_responses import NOMINAL, Tones, tone_responses
from model.fem.mesh import ELEMENTS, Mesh
from model.fem.plate import assemble, direct_acceleration
from model.finger.fingertip import FINGERTIP_RADIUS, FIVE_POINTS
from model.reduction.reduced_plate import reduce_plate
from model.rig.uncertainty import Uncertainty
from model.structure.fingertip import FingertipLoad
from model.structure.point_load import PointLoad, footprints_of
from paper_plate import LENGTH, WIDTH
from paper_table import smooth_rig

PLACES = np.array([[0.09, 0.07], [0.25, 0.18], [0.03, 0.19]])
FREQUENCIES = np.array([60.0, 145.0, 260.0, 430.0])
RIG = replace(
    smooth_rig(),
    mesh=Mesh(4, 3, LENGTH, WIDTH, ELEMENTS["Q5"]),
    masses=(PointLoad(0.2, 0.05, mass=0.03),),
)
POINTS = PLACES[:, None] + FINGERTIP_RADIUS * FIVE_POINTS.points


def solved(uncertainty, loads=()):
    """The plate with three fingers on it; reduced for them too, so that nothing is left out."""
    fixed = footprints_of(RIG.eras, RIG.masses)
    fingers = np.column_stack([PLACES, np.zeros(3)])
    reduced = reduce_plate(RIG.plate, RIG.mesh, np.vstack([fixed, fingers]), frequency_max=500.0)
    plate = attach(
        RIG.plate,
        reduced.omega,
        reduced.losses,
        reduced.at(fixed),
        eras=RIG.eras,
        masses=RIG.masses,
        fingertip=RIG.fingertip,
        uncertainty=uncertainty,
        frequencies=FREQUENCIES,
    )
    shapes = reduced.at(POINTS.reshape(-1, 2)).astype(np.float32).reshape(3, 5, -1)
    weights = np.tile(FIVE_POINTS.weights, (3, 1)).astype(np.float32)
    contacts = load_contacts(plate, shapes, weights, np.zeros((4, 4), np.float32), loads)
    return plate, contacts, shapes


@cache
def directly(
    *,
    thickness=1.0,
    loss=1.0,
    damping=1.0,
    stiffness=(1, 1, 1, 1),
    load=(1, 1, 1),
    pressed=(1, 1, 1),
):
    """Fields (f, eras, points) of a plate that differs by these factors.

    pressed: on pulp and contact mass of each finger; load: on all of it.
    """
    plate = replace(
        RIG.plate,
        thickness=thickness * RIG.plate.thickness,
        loss_factor=loss * RIG.plate.loss_factor,
    )
    eras = [
        replace(era, stiffness=k * era.stiffness, damping=damping * era.damping)
        for era, k in zip(RIG.eras, stiffness, strict=True)
    ]
    fingers = [
        FingertipLoad(*place, RIG.fingertip.scaled(more).multiplied(factor))
        for place, more, factor in zip(PLACES, pressed, load, strict=True)
    ]
    return direct_acceleration(
        assemble(plate, RIG.mesh),
        eras,
        FREQUENCIES,
        POINTS.reshape(-1, 2),
        loads=[*RIG.masses, *fingers],
    )


@pytest.mark.usefixtures("kernels_or_numpy")
@pytest.mark.parametrize("loads", [(), (0.4, 1.0, 2.5)])
def test_fields_are_those_of_the_direct_solve(loads):
    """At every finger's points, with an ERA's drive and a mass on the plate: to 1e-4.

    Whether all fingers press alike or not.
    """
    _, contacts, _ = solved(Uncertainty(), loads)
    found = contacts.fields.transpose(0, 3, 1, 2).reshape(4, 4, 15)
    exact = directly(pressed=loads or (1, 1, 1))
    error = np.abs(found - exact).max(axis=(1, 2)) / np.abs(exact).max(axis=(1, 2))
    assert error.max() < 2e-4


NO_ERROR = np.zeros(4, np.float32)
WEIGHTS = np.array([0.6, -0.3 + 0.5j, 1.0, 0.2j], dtype=np.complex64)

CHANGES = {
    1: lambda d: {"loss": math.exp(d)},
    2: lambda d: {"damping": math.exp(d)},
    4: lambda d: {"stiffness": (1, 1 + d, 1, 1)},
    8: lambda d: {"load": (1, 1 + d, 1)},
}


def test_sensitivity_to_the_load_of_a_finger_that_presses_harder():
    """Of a finger pressed 2.5 times as much between others, by a difference of the direct solve."""
    pressed = (0.4, 2.5, 1.0)
    plate, contacts, shapes = solved(Uncertainty(0, 0, 1.0, 1.0, math.e, 1.0), pressed)
    tones = Tones(np.arange(4), np.ones((4, 4), dtype=np.complex64))
    found = tone_responses(plate, contacts, tones, shapes.reshape(15, -1))[:, :, 8]
    more, less = (directly(pressed=pressed, load=(1, 1 + d, 1)) for d in (1e-3, -1e-3))
    exact = ((more - less) / 2e-3).sum(axis=1)
    error = np.abs(found - exact).max(axis=1) / np.abs(exact).max(axis=1)
    assert error.max() < 0.01


@pytest.mark.usefixtures("kernels_or_numpy")
def test_thickness_is_exact_at_its_nodes():
    """The direct solve of plates so much thicker, far from what is in proportion."""
    plate, contacts, shapes = solved(Uncertainty(thickness=0.02))
    tones = Tones(np.arange(4), np.tile(WEIGHTS, (4, 1)))
    points, nodes = shapes.reshape(15, -1), np.array([-2.0, -0.5, 0.0, 0.7, 1.5])
    found = responses_of_thicknesses(plate, contacts, tones, points, nodes)
    for at in (0, 1, 4):
        exact = np.einsum("e,fep->fp", WEIGHTS, directly(thickness=1 + 0.02 * float(nodes[at])))
        error = np.abs(found[:, :, at] - exact).max(axis=1) / np.abs(exact).max(axis=1)
        assert error.max() < 5e-3
    nominal = tone_responses(plate, contacts, tones, points)[:, :, NOMINAL]
    assert found[:, :, 2] == pytest.approx(
        nominal, rel=1e-3, abs=1e-4 * float(np.abs(nominal).max())
    )
    assert np.abs(found[:, :, 0] + found[:, :, 4] - 2 * nominal).max() > 0.1 * np.abs(nominal).max()


@pytest.mark.parametrize("column", CHANGES)
def test_sensitivities_of_a_thicker_plate_are_differences_of_the_direct_solve(column):
    """Of a plate 3 % thicker, by central differences: within 1 % of the largest change."""
    plate, _, shapes = solved(Uncertainty(0, 0, 0.02, 1.0, math.e, 1.0))
    plates = plate.of_thicknesses(np.array([1.5]), np.arange(4))
    centres, ones = shapes[:, :1], np.ones((3, 1), dtype=np.float32)
    contacts = load_contacts(plates, centres, ones, np.zeros((4, 4), np.float32))
    tones = Tones(np.arange(4), np.tile(WEIGHTS, (4, 1)))
    found = tone_responses(plates, contacts, tones, shapes.reshape(15, -1))
    more, less = (directly(thickness=1.03, **CHANGES[column](d)) for d in (1e-3, -1e-3))
    exact = np.einsum("e,fep->fp", WEIGHTS, (more - less) / 2e-3)
    error = np.abs(found[:, :, column] - exact).max(axis=1) / np.abs(exact).max(axis=1)
    assert error.max() < 0.01


@pytest.mark.parametrize("count", [2, 5, 10])
def test_thickness_nodes_are_those_of_a_normal_deviation(count):
    """Mean 0, variance 1; with many, nine of ten are below 1.28."""
    nodes = thickness_nodes(count)
    assert (nodes.mean(), nodes.var()) == pytest.approx((0, 1))
    assert (np.diff(nodes) > 0).all()
    assert np.quantile(thickness_nodes(1000), 0.9) == pytest.approx(1.2816, abs=0.01)


def test_responses_add_up_from_the_parts_of_each_era():
    """The nominal response is the sum of the columns that the gains multiply."""
    plate, contacts, shapes = solved(Uncertainty())
    tones = Tones(np.array([1, 3]), np.array([[1, 2j, -1, 0.5]] * 2, dtype=np.complex64))
    found = tone_responses(plate, contacts, tones, shapes.reshape(15, -1))
    np.testing.assert_allclose(found[:, :, -4:].sum(axis=2), found[:, :, 0], rtol=1e-3, atol=1e-2)


@pytest.mark.usefixtures("kernels_or_numpy")
def test_expected_power_is_the_mean_square_of_the_draws():
    """w^H R w of random weights equals the mean over 4000 drawn plates but for the loss factor.

    Of two thicknesses that deviate so little that they count in proportion.
    """
    plate, contacts, shapes = solved(replace(Uncertainty(), thickness=0.002, damping=1.0))
    rng = np.random.default_rng(0)
    weights = (rng.normal(size=(4, 4)) + 1j * rng.normal(size=(4, 4))).astype(np.complex64)
    tones = Tones(np.arange(4), weights)
    responses = tone_responses(plate, contacts, tones, shapes.reshape(15, -1))
    draws = draw(4, 3, count=4000, seed=5, gain=plate.gain, phase=plate.phase, thicknesses=2)
    at_nodes = responses_of_thicknesses(
        plate, contacts, tones, shapes.reshape(15, -1), thickness_nodes(2)
    )
    powers = (
        draws.power(draws.accelerations(responses, at_nodes), NO_ERROR)
        .mean(axis=2)
        .reshape(4, 3, 5)
    )
    found = np.einsum("fi,fqij,fj->fq", weights.conj(), contacts.power, weights).real
    np.testing.assert_allclose(found, powers @ FIVE_POINTS.weights, rtol=0.05)
