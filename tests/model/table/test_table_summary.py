"""What `era table show` says of a table."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from model.errors import InputError
from model.finger.grid import Grid
from model.table.build import build_table
from model.table.summary import contrast_distribution, similar_share, summarize
from model.table.weak_cells import WeakCells, find_weak_cells, map_grid, text_map
from paper_plate import make_paper_rig
from small_table import small_table


@pytest.fixture(scope="module")
def table():
    """A small one."""
    return small_table()


def test_the_map_of_a_symmetric_plate_is_symmetric(table):
    """Cells that mirror each other are told from other fingers equally well."""
    weak = find_weak_cells(table)
    for values in (weak.median_db, weak.tenth_db):
        rows = values.reshape(3, 4)
        np.testing.assert_allclose(rows, rows[:, ::-1], atol=0.01)
        np.testing.assert_allclose(rows, rows[::-1], atol=0.01)
    assert (weak.tenth_db <= weak.median_db).all()
    assert np.ptp(weak.median_db) > 0.5


def test_of_a_cells_contrasts_the_median_and_the_tenth_percentile_are_kept(table, monkeypatch):
    """Of random contrasts half are below the one, a tenth below the other, for every cell."""
    rng = np.random.default_rng(0)
    drawn: dict[tuple[float, float], list[float]] = {}

    def at_random(table, target, other):
        assert np.linalg.norm(target - other) >= 0.05
        drawn.setdefault(tuple(target), []).append(float(rng.uniform(0, 30)))
        return drawn[tuple(target)][-1]

    monkeypatch.setattr("model.table.weak_cells._contrast", at_random)
    weak = find_weak_cells(table)
    assert len(drawn) == len(weak.centres) == 12
    for values, share in ((weak.median_db, 0.5), (weak.tenth_db, 0.1)):
        for value, contrasts in zip(values, drawn.values(), strict=True):
            below = (np.array(contrasts) < value).mean()
            assert below == pytest.approx(share, abs=1.5 / len(contrasts))


def test_other_fingers_are_tried_all_over_the_plate(table, monkeypatch):
    """One in each twelfth of a quarter and at its mirror images: one in each of 8 by 6 fields."""
    tried = set()
    monkeypatch.setattr(
        "model.table.weak_cells._contrast",
        lambda table, target, other: tried.add(tuple(other)) or 0.0,
    )
    find_weak_cells(table)
    x, y = np.array(sorted(tried)).T
    size = (table.plate.length, table.plate.width)
    counts, *_ = np.histogram2d(x, y, bins=(8, 6), range=[(0, side) for side in size])
    assert (counts == 1).all()


def test_a_fine_grid_is_asked_about_more_coarsely(table):
    """A cell of the map is no smaller than a sixteenth by a twelfth of the plate."""
    assert map_grid(replace(table, grid=Grid(24, 5))) == Grid(16, 5)
    assert map_grid(replace(table, grid=Grid(4, 20))) == Grid(4, 12)


def test_weak_and_feasible_follow_from_twelve_decibels():
    """Feasible by the median other finger, weak by one in ten; unreachable levels are neither."""
    weak = WeakCells(
        Grid(4, 1),
        np.zeros((4, 2)),
        median_db=np.array([20.0, 12.0, 9.0, -np.inf]),
        tenth_db=np.array([12.0, 11.9, 5.0, -np.inf]),
    )
    assert weak.feasible.tolist() == [True, True, False, False]
    assert weak.weak.tolist() == [False, True, True, True]


def test_the_map_as_text_stands_as_the_plate_does():
    """The largest y is the first line; weak cells carry a star, those without a value a dash."""
    weak = WeakCells(
        Grid(2, 2),
        np.zeros((4, 2)),
        median_db=np.array([20.4, 9.0, -np.inf, 14.6]),
        tenth_db=np.array([13.0, 4.0, -np.inf, 3.0]),
    )
    assert list(text_map(weak)) == ["   -*  15*", "  20    9*"]


def test_where_nothing_is_felt_all_is_dead_and_weak():
    """ERAs that move a nanometre: no cell is felt, none feasible, and no contrast is made up."""
    rig = make_paper_rig(12, 9)
    still = replace(rig, eras=tuple(replace(era, stroke=1e-9) for era in rig.eras))
    table = build_table(still, frequencies=np.array([60.0, 250.0]), grid=Grid(3, 2))
    summary = summarize(table, find_weak_cells(table))
    assert summary["dead_zone_share"] == 1.0
    assert summary["feasible_share"] == 0.0
    assert summary["weak_share"] == 1.0
    assert summary["contrast_1_quiet_median_db"] is None


def test_a_cell_that_is_felt_but_not_strongly_is_not_feasible(table):
    """Strokes with which the loudest cell reaches 19 dB SL: of 20 dB SL there is none to tell."""
    rig = make_paper_rig(12, 9)
    least = 10 ** ((19.0 - table.available_level_db_sl.max()) / 20)
    weaker = replace(rig, eras=tuple(replace(era, stroke=least * era.stroke) for era in rig.eras))
    table = build_table(weaker, frequencies=table.frequencies, grid=table.grid)
    assert table.available_level_db_sl.max() == pytest.approx(19.0, abs=0.01)
    weak = find_weak_cells(table)
    assert np.isneginf(weak.median_db).all()
    assert not weak.feasible.any()


def test_the_numbers_of_a_table(table, monkeypatch):
    """Levels from 12 dB SL count as felt; shares are of the cells for which there is a value."""
    asked = []

    def one_to_hundred(table, *, others, rng, progress):
        asked.append(others)
        return np.arange(101.0)

    monkeypatch.setattr("model.table.summary.contrast_distribution", one_to_hundred)
    levels = np.sort(table.available_level_db_sl)
    lower = 10 ** ((12.0 - levels[5:7].mean()) / 20)  # six of twelve cells are below 12 dB SL then
    rig = make_paper_rig(12, 9)
    eras = tuple(replace(era, stroke=lower * era.stroke) for era in rig.eras)
    quieter = build_table(replace(rig, eras=eras), frequencies=table.frequencies, grid=table.grid)
    values = np.array([20.0, 12.0, 9.0, -np.inf, *[np.nan] * 8])
    weak = WeakCells(table.grid, np.zeros((12, 2)), median_db=values, tenth_db=values - 0.1)
    summary = summarize(quieter, weak)
    assert asked == [1, 2, 3]
    assert summary["frequency_range_hz"] == [60.0, 250.0]
    expected = {
        "dead_zone_share": 0.5,
        "least_level_at_full_stroke_db_sl": levels[0] + 20 * np.log10(lower),
        "feasible_share": 0.5,
        "weak_share": 0.75,
        "frequency_count": 3,
        "patterns": 4 * 3 + 6 * 3**2,
        "contrast_2_quiet_median_db": 50.0,
        "contrast_2_quiet_tenth_percentile_db": 10.0,
        "discretisation_error_percent": 100 * max(quieter.discretisation_error),
    }
    assert {name: summary[name] for name in expected} == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("others", [1, 3])
def test_contrast_is_asked_of_fingers_apart(table, others):
    """Two hundred sets at least 5 cm apart; where no target is reached it ends at four hundred."""
    asked = []

    def answer(question):
        asked.append(np.array([*question.targets, *question.quiet]))
        return SimpleNamespace(contrast_db=float(len(asked)))

    def refuse(question):
        answer(question)
        raise InputError("out of reach")

    found, none = (
        contrast_distribution(
            SimpleNamespace(plate=table.plate, query=each),
            others=others,
            rng=np.random.default_rng(1),
        )
        for each in (answer, refuse)
    )
    assert found.tolist() == list(range(1, 201))
    assert (len(none), len(asked)) == (0, 200 + 400)
    for contacts in asked:
        assert contacts.shape == (others + 1, 2)
        gaps = np.linalg.norm(contacts[:, None] - contacts, axis=-1)
        assert gaps[np.triu_indices(others + 1, 1)].min() >= 0.05


def test_alike_patterns_are_counted(table):
    """Copies of one pattern are all alike, noise is not; a single cell tells nothing."""
    row = table.cell_sources[0]
    copies = np.tile(row, (len(table.cell_sources), 1))
    copies[-1] = 0  # nothing driven beside the first source
    assert similar_share(replace(table, cell_sources=copies)) == 1.0
    rng = np.random.default_rng(0)
    noise = rng.uniform(0, 1, copies.shape).astype(np.float32)
    assert similar_share(replace(table, cell_sources=noise)) < 0.02
    single = replace(table, grid=Grid(1, 1), cell_sources=noise[:, :1])
    assert similar_share(single) is None
