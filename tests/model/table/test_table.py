"""The localization table: its fields, frequencies, raster, and the table that follows a plate."""

import math
from dataclasses import replace
from itertools import combinations, product

import numpy as np
import pytest

from kit.direct_plate import direct_acceleration
from kit.plates import contact_sets, make_paper_rig, smooth_rig, smooth_table
from kit.set_table import only
from model.answer.plan import query
from model.answer.stimulus import Placement
from model.errors import InputError
from model.fem import assemble
from model.finger import Grid, detection_threshold, fingertip_points, fingertip_weights
from model.rig.rig import Rig
from model.structure.fingertips import FingertipLoad
from model.structure.material import Material
from model.structure.plate import Plate
from model.study.exact_plates import Plates, felt_on
from model.switched_patterns import highest_levels
from model.table.fingertip_shapes import read_fingertips
from model.table.raster import Raster
from model.table.table import LocalizationTable, default_drive_frequencies
from model.table.table_file import TableProblem, build_table
from model.vibration import Tone, tone_fields
from registry.limits import GuardLimits


def test_highest_level_is_that_of_the_best_pattern_tried_by_hand():
    """Each of Eq. 28 written out: amplitudes add at one frequency, powers of two do.

    Four ERAs alone and six pairs at 27 frequencies: 4 * 27 + 6 * 27² = 4482 different ones.
    """
    assert smooth_table().pattern_count == 4482
    rng = np.random.default_rng(0)
    fields = (rng.normal(size=(4, 5, 3)) + 1j * rng.normal(size=(4, 5, 3))).astype(np.complex64)
    patterns = [{era: f} for era in range(3) for f in range(5)]
    for one, other in combinations(range(3), 2):
        patterns += [{one: f, other: g} for f in range(5) for g in range(5)]
    for found, at in zip(highest_levels(fields[:, None]), fields, strict=True):
        levels = []
        for pattern in patterns:
            driven = [[era for era, row in pattern.items() if row == f] for f in range(5)]
            powers = [abs(at[f, eras].sum()) ** 2 for f, eras in enumerate(driven)]
            levels.append(np.sqrt(sum(powers)))
        assert found == pytest.approx(max(levels), rel=1e-5)


@pytest.mark.parametrize("mode", ["switched", "phased"])
def test_query_predicts_what_the_direct_solver_finds(mode):
    """Level, contrast and the loudest quiet level, by the sparse direct solve with fingers on."""
    rig, table = smooth_rig(), smooth_table()
    target, *quiet = places = contact_sets(1, fingers=4, seed=2)[0]
    answer = query(table, Placement((target,), tuple(quiet)), 17.0, drive_mode=mode)
    layer, felt = answer.layers[0], answer.fingers[0]
    points = np.concatenate([fingertip_points(*place, rig.plate) for place in places])
    matrices = assemble(rig.plate, rig.mesh)

    fingers = [FingertipLoad(*place, rig.fingertip) for place in places]
    frequencies, fields = tone_fields(
        layer.excitation,
        rig.eras,
        lambda f: direct_acceleration(matrices, rig.eras, f, points, loads=fingers),
    )
    weights = fingertip_weights(*target, rig.plate)
    count = len(weights)
    above = np.sqrt(((np.abs(fields).T / detection_threshold(frequencies)) ** 2).sum(axis=1))
    level = 20 * np.log10(above[:count] @ weights)
    assert felt.level_db_sl == pytest.approx(level, abs=0.03)
    assert felt.promised_level_db_sl == pytest.approx(17.0)
    quiet_level = felt.level_db_sl - felt.contrast_db
    assert quiet_level == pytest.approx(20 * np.log10(above[count:].max()), abs=0.1)


def test_query_scales_the_drive_with_the_level():
    """A softer level admits every pattern; 1 dB less is 0.89 of the stroke of the same ERAs."""
    placed = Placement(((0.1, 0.1),), ((0.2, 0.1),))
    (loud, strong), (less, weaker), (_, soft) = (
        only(smooth_table(), placed, level) for level in (20.0, 19.0, -20.0)
    )
    assert soft.promised_contrast_db >= strong.promised_contrast_db - 0.5
    assert weaker.contrast_db == pytest.approx(strong.contrast_db)
    assert {name: tone.amplitude for name, tone in less.excitation.items()} == pytest.approx(
        {name: tone.amplitude * 10 ** (-1 / 20) for name, tone in loud.excitation.items()}
    )


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [
        (20.0, 700.0, range(40, 501, 10)),
        (60.0, 300.0, range(60, 301, 10)),
        (75.0, 85.0, [80]),
        (400.0, 430.0, [400, 410, 420, 430]),
        (61.0, 69.0, [61]),
    ],
)
def test_default_drive_frequencies_are_within_the_limits(low, high, expected):
    """40 to 500 Hz in steps of 10 within the limits; at least one."""
    found = default_drive_frequencies(GuardLimits(frequency_min=low, frequency_max=high, level=1.0))
    np.testing.assert_array_equal(found, list(expected))


FOIL = {"length": 3.0, "width": 3.0, "thickness": 0.0001}


@pytest.mark.parametrize(
    ("frequencies", "plate", "said"),
    [
        *(
            (each, {}, "frequencies")
            for each in ([], [100, 100], [200, 100], [10], [100, 900], [100, math.nan])
        ),
        ([100.0, 500.0], FOIL, "GB"),
    ],
)
def test_what_makes_no_table_is_refused(frequencies, plate, said):
    """No frequencies, unordered, outside the rig's limits, not a number; a foil of 9 m².

    That has some ten thousand modes, and is refused before it is solved.
    """
    rig = make_paper_rig(48, 36)
    rig = replace(rig, plate=replace(rig.plate, **plate))
    with pytest.raises(InputError, match=said):
        TableProblem(rig, np.array(frequencies, dtype=float), Grid(4, 3))


@pytest.mark.usefixtures("kernels_or_numpy")
def test_read_fingertips_reads_the_points_and_weights_of_the_disc():
    """Reading x and y themselves gives back the points, also where edges cut a fingertip.

    Waves on a raster at 3 mm are read within 1e-4 at the edges, where the polynomials of twelve
    points are large.
    """
    table, five = smooth_table(), [0, 9, 12, 15, 18]
    table = replace(table, shapes=table.raster.points.astype(np.float32))
    places = [(0.15, 0.11), (0.0, 0.0), (0.3048, 0.1), (0.2, 0.225), (0.006, 0.0031)]
    tips = read_fingertips(table, places)
    points = np.array([fingertip_points(x, y, table.plate) for x, y in places])
    np.testing.assert_allclose(tips.fine, points, atol=1e-6)
    np.testing.assert_allclose(tips.few, points[:, five], atol=1e-6)
    weights = [fingertip_weights(x, y, table.plate) for x, y in places]
    np.testing.assert_allclose(tips.fine_weights, weights, atol=1e-5)
    np.testing.assert_allclose(tips.few_weights[0], [0.5, *[0.125] * 4], atol=1e-6)

    sides = length, width = table.plate.length, table.plate.width
    raster = Raster(*(round(side / 0.003) + 1 for side in sides), length, width)
    waves = np.array([[20.0, 9.0], [-13.0, 25.0], [5.0, 40.0]])  # rad/m
    table = replace(table, raster=raster, shapes=np.cos(raster.points @ waves.T).astype("f4"))
    along = np.linspace(0.0, 0.006, 25)
    places = [*product([*along, *(length - along)], (0.001, width / 2, width - 0.002))]
    tips = read_fingertips(table, places)
    expected = np.cos(np.array([fingertip_points(x, y, table.plate) for x, y in places]) @ waves.T)
    np.testing.assert_allclose(tips.fine, expected, atol=1e-4)
    np.testing.assert_allclose(tips.few, expected[:, five], atol=1e-4)


@pytest.mark.parametrize("thickness", [0.0001, 0.01])
def test_for_plate_handles_thin_and_small_plates(thickness):
    """A foil of short waves, and a plate barely larger than a fingertip."""
    plate = Plate(0.02, 0.03, thickness, Material("any", E=70e9, rho=2700.0, nu=0.33))
    raster = Raster.for_plate(plate, frequency_max=500.0)
    heights = (3 * raster.points[:, :1] - raster.points[:, 1:]).astype(np.float32)
    np.testing.assert_allclose(
        raster.interpolated(heights, np.array([[0.011, 0.004]])), [[0.029]], rtol=1e-5
    )
    with pytest.raises(InputError, match="6 to"):  # five points carry no quintic
        Raster(5, 9, 0.1, 0.1)


FIVE = np.array([80.0, 145.0, 220.0, 310.0, 450.0])
POINTS = np.array([[0.06, 0.05], [0.15, 0.11], [0.26, 0.17], [0.22, 0.04]])


@pytest.fixture(scope="module")
def table(rig: Rig) -> LocalizationTable:
    """Its table at a few frequencies."""
    return build_table(rig, frequencies=FIVE, drive_mode="phased")


def test_a_frequency_that_a_table_lacks_is_refused(table: LocalizationTable) -> None:
    """Between two of its own and beyond; one of a wire's steps is its own."""
    sizes = (1, 1, 1, (1, 4), (1, 1), (1, 4), (1, 1), 1, (1, 4, 2), (1, 4), (1, 0))
    one = Plates(*(np.ones(size) for size in sizes))
    for frequency in (79.0, 115.0, 145.1, 451.0, math.nan):
        tones = {"SW": Tone(frequency, 1e-6, 0.0)}
        for asked in (
            lambda tones=tones: table.amplitudes(tones, POINTS),
            lambda tones=tones: felt_on(table, Placement(((0.08, 0.06),)), tones, one),
        ):
            with pytest.raises(InputError):
                asked()
    tones = ({"SW": Tone(frequency, 1e-6, 0.0)} for frequency in (145.0, 145.0004))
    expected, found = (table.amplitudes(each, POINTS)[1] for each in tones)
    np.testing.assert_array_equal(found, expected)
