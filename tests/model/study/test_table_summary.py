"""Summary of a table, and its map of weak cells."""

import math
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from model.answer.stimulus import Placement
from model.finger import Grid
from model.structure.attachments import PointLoad
from model.structure.plate import Laminate, LaminateLayer
from model.study.contrast_maps import (
    WeakCells,
    ask_once,
    contrasts_reached,
    find_weak_cells,
    map_grid,
    pair_questions,
    sampling_error,
    text_map,
)
from model.study.overview import (
    CONTACT_SETS,
    Overview,
    find_overview,
    set_questions,
    summarize,
)
from model.table.table_file import build_table
from plates import make_paper_rig, small_table, with_strokes


@pytest.fixture(scope="module")
def table():
    """A small one."""
    return small_table()


def test_weak_cells_take_percentiles_over_fingers_all_over_the_plate(table):
    """Half of a cell's contrasts are below its median, a tenth below the other.

    Its other fingers are in different ones of 4 by 4 fields, at least 5 cm from the cell.
    """
    rng = np.random.default_rng(0)
    drawn: dict[tuple[float, float], list[float]] = {}
    tried: dict[tuple[float, float], list[tuple[float, float]]] = {}

    def at_random(question):
        (target,), (other,) = question.targets, question.quiet
        assert math.dist(target, other) >= 0.05
        tried.setdefault(target, []).append(other)
        drawn.setdefault(target, []).append(float(rng.uniform(0, 30)))
        return drawn[target][-1], 0.0

    weak = find_weak_cells(table, [[*map(at_random, each)] for each in pair_questions(table)])
    assert len(drawn) == len(weak.centres) == 12
    for values, share in ((weak.median_db, 0.5), (weak.tenth_db, 0.1)):
        for value, contrasts in zip(values, drawn.values(), strict=True):
            below = (np.array(contrasts) < value).mean()
            assert below == pytest.approx(share, abs=1.5 / len(contrasts))
    size = (table.plate.length, table.plate.width)
    for target, others in tried.items():
        counts, *_ = np.histogram2d(
            *np.array(others).T, bins=(4, 4), range=[(0, side) for side in size]
        )
        assert counts.max() == 1
        assert counts.sum() >= 16 - 4  # a place within 5 cm is in the target's field or beside it
        (x, y) = target
        mirrored = np.array(tried[min(tried, key=lambda at: math.dist(at, (size[0] - x, y)))])
        np.testing.assert_allclose(
            sorted(size[0] - mirrored[:, 0]), sorted(x for x, _ in others), atol=1e-12
        )


def test_other_fingers_mirror_each_other_only_where_the_plate_does(table):
    """A mass on the middle line leaves symmetry along x, a weaker corner none."""
    length, width = table.plate.length, table.plate.width

    def rounded(places):
        return sorted((round(x, 9), round(y, 9)) for x, y in places)

    def symmetries(some):
        asked = {
            rounded(each[0].targets)[0]: [one.quiet[0] for one in each]
            for each in pair_questions(some)
        }
        for at in (lambda x, y: (length - x, y), lambda x, y: (x, width - y)):
            yield all(
                rounded(at(*place) for place in places) == rounded(asked[rounded([at(*target)])[0]])
                for target, places in asked.items()
            )

    mass = PointLoad(length / 2, width / 4, mass=0.05)
    weaker = replace(table.eras[0], stroke=0.9 * table.eras[0].stroke)
    assert list(symmetries(table)) == [True, True]
    assert list(symmetries(replace(table, masses=(mass,)))) == [True, False]
    assert list(symmetries(replace(table, eras=(weaker, *table.eras[1:])))) == [False, False]


def test_questions_that_mirror_each_other_are_one_sample(table):
    """On a symmetric plate both have the answer of one of them, to the bit; not on another one."""
    (target,), (other,) = (pair := pair_questions(table)[0][0]).targets, pair.quiet
    image = Placement(
        ((table.plate.length - target[0], target[1]),),
        ((table.plate.length - other[0], other[1]),),
    )
    ask = ask_once(table)
    assert ask(pair) == ask(image)
    weaker = replace(table.eras[0], stroke=0.5 * table.eras[0].stroke)
    ask = ask_once(replace(table, eras=(weaker, *table.eras[1:])))
    assert ask(pair) != ask(image)


def test_sampling_error_is_how_much_a_percentile_of_random_samples_varies():
    """Of 5000 samples of 64 normal values the median is within 0.157, the tenth within 0.214.

    The standard deviation of a percentile is sqrt(p (1 - p) / n) over the density there. Copies of
    the values tell nothing more.
    """
    samples = np.random.default_rng(0).normal(size=(5000, 64))
    for percent, expected in ((50, 0.1567), (10, 0.2137)):
        stated = np.array([sampling_error(each, percent) for each in samples])
        assert stated.mean() == pytest.approx(expected, rel=0.15)
        assert sampling_error(np.tile(samples[0], 4), percent) == stated[0]
    assert math.isnan(sampling_error([-np.inf, -np.inf, 1.0, 2.0], 50))


def test_map_grid_is_coarser_than_a_fine_grid(table):
    """A cell of the map is no smaller than an eighth by a sixth of the plate."""
    assert map_grid(replace(table, grid=Grid(24, 5))) == Grid(8, 5)
    assert map_grid(replace(table, grid=Grid(4, 20))) == Grid(4, 6)


def test_weak_and_feasible_follow_from_twelve_decibels():
    """Feasible by the median other finger, weak by one in ten; a text map shows both."""
    weak = WeakCells(
        Grid(2, 2),
        np.zeros((4, 2)),
        median_db=np.array([20.4, 12.0, -np.inf, 9.0]),
        tenth_db=np.array([12.0, 11.9, -np.inf, 5.0]),
        errors_db=np.zeros((2, 4)),
        pairs_db=np.empty((2, 0)),
    )
    assert weak.feasible.tolist() == [True, True, False, False]
    assert weak.weak.tolist() == [False, True, True, True]
    assert list(text_map(weak)) == ["   -*   9*", "  20   12*"]  # the largest y first


def test_summary_of_a_plate_too_small_for_two_fingers():
    """Where no two fingers fit 5 cm apart the distribution is empty, not an endless loop."""
    rig = make_paper_rig(6, 6)
    small = replace(
        rig,
        plate=replace(rig.plate, length=0.03, width=0.03),
        mesh=replace(rig.mesh, length=0.03, width=0.03),
        eras=tuple(replace(era, x=0.03 * (era.x > 0), y=0.03 * (era.y > 0)) for era in rig.eras),
    )
    built = build_table(small, frequencies=np.array([110.0]), grid=Grid(2, 2))
    summary = summarize(built, find_overview(built))
    assert summary["promised_contrast_1_quiet_median_db"] is None
    assert summary["feasible_share"] is None


def test_weak_cells_are_not_feasible_when_only_19_db_sl_are_reached(table):
    """The map is at 20 dB SL, which no pattern reaches with these strokes."""
    weaker = with_strokes(table, 10 ** ((19.0 - table.available_level_db_sl.max()) / 20))
    assert weaker.available_level_db_sl.max() == pytest.approx(19.0, abs=0.01)
    weak = find_overview(weaker).cells
    assert np.isneginf(weak.median_db).all()
    assert not weak.feasible.any()


def test_summary_counts_levels_and_shares(table):
    """Levels from 12 dB SL count as felt; shares are of the cells for which there is a value."""
    one_to_hundred = np.array([np.arange(101.0), np.arange(101.0) + 5])
    levels = np.sort(table.available_level_db_sl)
    lower = 10 ** ((12.0 - levels[5:7].mean()) / 20)  # six of twelve cells are below 12 dB SL then
    quieter = with_strokes(table, lower)
    values = np.array([20.0, 12.0, 9.0, -np.inf, *[np.nan] * 8])
    errors = np.zeros((2, 12))
    weak = WeakCells(table.grid, np.zeros((12, 2)), values, values - 0.1, errors, one_to_hundred)
    layers = tuple(LaminateLayer(table.plate.material, thickness) for thickness in (1e-3, 2e-3))
    quieter = replace(quieter, plate=replace(table.plate, laminate=Laminate(layers)))
    summary = summarize(quieter, Overview(weak, [one_to_hundred] * 3))
    assert summary["plate_m"][2] == pytest.approx(3e-3)  # not of one material that bends alike
    assert summary["frequency_range_hz"] == [60.0, 250.0]
    expected = {
        "dead_zone_share": 0.5,
        "least_level_at_full_stroke_db_sl": levels[0] + 20 * np.log10(lower),
        "feasible_share": 0.5,
        "weak_share": 0.75,
        "frequency_count": 3,
        "patterns": 4 * 3 + 6 * 3**2,
        "promised_contrast_2_quiet_median_db": 50.0,
        "promised_contrast_2_quiet_tenth_percentile_db": 10.0,
        "contrast_2_quiet_median_db": 55.0,
        "discretisation_error_percent": 100 * max(quieter.discretisation_error),
    }
    assert {name: summary[name] for name in expected} == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("others", [1, 3])
def test_contact_sets_are_of_fingers_apart(table, others):
    """As many sets as are wanted, all at least 5 cm apart, no two alike."""
    questions = set_questions(table, others=others, rng=np.random.default_rng(1))
    assert len({question.contacts for question in questions}) == CONTACT_SETS
    for question in questions:
        assert len(question.quiet) == others
        for one, other in combinations(question.contacts, 2):
            assert math.dist(one, other) >= 0.05


def test_sets_that_miss_the_level_are_left_out():
    """Of three answers the one without contrast."""
    assert contrasts_reached([(1.0, 2.0), None, (3.0, 4.0)]).tolist() == [[1, 3], [2, 4]]
    assert contrasts_reached([None]).shape == (2, 0)
