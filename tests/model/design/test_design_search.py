"""Layouts found for contrast, against enumeration, symmetry and the answers of tables."""

from dataclasses import replace
from functools import cache
from itertools import combinations

import numpy as np
import pytest

from dense_contrast import GAINS, dense_score
from model.design import search as search_module
from model.design.area import Edge, Within, area_of, candidates_of, everywhere
from model.design.contacts import ContactRule, anywhere
from model.design.judge import judge
from model.design.search import DesignProblem, LayoutSearch
from model.design.support import SupportRule, static_loads
from model.errors import InputError
from model.rig.file import example_rig_path, load_rig
from model.structure.actuator import Era


@cache
def rig():
    """The paper's plate."""
    return load_rig(example_rig_path())


def test_search_finds_the_best_of_all_layouts_on_a_coarse_raster(monkeypatch) -> None:
    """The best of some starts is the best of all triples of ERAs that a dense solve gives."""
    monkeypatch.setitem(search_module.CANDIDATES, True, 7)
    monkeypatch.setattr(search_module, "SEARCH_FREQUENCIES", 2)
    # Weights of any kind reach the level, so that it does not matter.
    strong = tuple(replace(era, stroke=0.01) for era in rig().eras)
    loud = replace(rig(), uncertainty=GAINS, eras=strong)
    pairs = tuple(replace(anywhere(loud.plate), quiet=(1, 1)).sets(4, seed=4))
    rule = ContactRule((1, 1), 0.05, lambda rng, n: np.zeros((n, 2)), pairs, "given")
    search = LayoutSearch(problem(rig=loud, count=3, contacts=rule))
    candidates = candidates_of(search.problem.area, loud.plate, count=8)
    ends = np.array([loud.limits.frequency_min, loud.limits.frequency_max])
    dense = {}
    for triple in combinations(range(len(candidates)), 3):
        places = candidates[list(triple)]
        if SupportRule(loud, 20.0).shortfall(search.problem.eras(places)) == 0:
            dense[triple] = dense_score(loud, places, pairs, ends)
            assert search.value(triple) == pytest.approx(dense[triple], abs=0.05)
    rng = np.random.default_rng(0)
    starts = [
        search.add(search.add(search.add(()))),
        *(search.random_layout(rng) for _ in range(4)),
    ]
    found = max(map(search.exchange, starts), key=search.value)
    assert len(dense) >= 20
    assert dense[tuple(sorted(found))] == pytest.approx(max(dense.values()), abs=0.05)


def problem(**changes) -> DesignProblem:
    """Four ERAs along the edge of the paper's plate."""
    some = changes.pop("rig", rig())
    usual = {
        "count": 4, "kept": (), "area": area_of("edge", some.plate),
        "contacts": replace(anywhere(some.plate), quiet=(1, 2)),
        "apart": 0.03, "lowest": 20.0, "seed": 0,
    }  # fmt: skip
    return DesignProblem(rig=some, **(usual | changes))


def test_further_eras_never_score_less(monkeypatch) -> None:
    """The best layout of ever more ERAs has ever more contrast, and moved places no less."""
    monkeypatch.setitem(search_module.CANDIDATES, True, 16)
    search = LayoutSearch(problem())
    layout, values = search.kept_layout(), []
    for _ in range(4):
        layout = search.add(layout)
        values.append(search.value(layout))
    assert values == sorted(values)
    found = search.refine(layout)
    assert found.score_db >= search.value(layout) - 1e-3
    assert search.at(found.positions) == pytest.approx(found.score_db, abs=0.02)


def test_kept_eras_stay_and_all_keep_their_distance() -> None:
    """A start at random, exchanged and moved, leaves what is kept and the least distance."""
    search = LayoutSearch(problem(kept=("SW", "NE"), apart=0.08))
    layout = search.random_layout(np.random.default_rng(2))
    found = search.refine(search.exchange(layout, sweeps=1))
    plate = rig().plate
    assert found.positions[:2].tolist() == [[0, 0], [plate.length, plate.width]]
    gaps = np.linalg.norm(found.positions[:, None] - found.positions, axis=-1)
    assert gaps[np.triu_indices(4, 1)].min() >= 0.08
    assert Edge(plate.length, plate.width).contains(found.positions).all()


@pytest.mark.long
def test_search_beats_the_rigs_corners_on_fresh_contact_sets(monkeypatch) -> None:
    """Answers of the table for contacts that the search has not seen confirm what it found."""
    monkeypatch.setitem(search_module.CANDIDATES, True, 24)
    case = problem(rig=replace(rig(), uncertainty=GAINS))
    search = LayoutSearch(case)
    layout = search.kept_layout()
    for _ in range(4):
        layout = search.add(layout)
    found = search.refine(search.exchange(layout, sweeps=1))
    sets = case.contacts.sets(40, seed=99)
    corners = np.array([[era.x, era.y] for era in case.rig.eras])
    ours, theirs = (judge(case.rig_with(at), sets) for at in (found.positions, corners))
    assert ours.mean_db > theirs.mean_db
    assert ours.reached_share > 0.9


def test_static_loads_of_a_seesaw() -> None:
    """Three ERAs at two corners and the middle of the far side carry a quarter, a quarter, half."""
    some, one = rig(), rig().eras[0]
    length, width = some.plate.length, some.plate.width
    eras = [
        replace(one, name=str(number), x=x, y=y)
        for number, (x, y) in enumerate([(0, 0), (length, 0), (length / 2, width)])
    ]
    weight = 9.81 * some.plate.mass
    assert static_loads(some, eras) == pytest.approx([weight / 4, weight / 4, weight / 2])
    assert SupportRule(some, 10.0).shortfall(eras) == 0
    # The centre of mass behind all of them: the plate tips.
    tipping = [replace(era, y=0.2 * era.y) for era in eras]
    assert SupportRule(some, 1.0).shortfall(tipping) > 0
    assert SupportRule(some, 1e4).shortfall(eras) > 0


def test_steps_along_the_edge_turn_its_corners() -> None:
    """A step past a corner goes on along the next side, and back."""
    edge = Edge(0.3, 0.2)
    on, back = (edge.moved(np.array([0.29, 0.0]), 0.03)[::-1], np.array([0.3, 0.02]))
    assert on[0] == pytest.approx(back)
    assert edge.moved(on[0], 0.03)[0] == pytest.approx([0.29, 0.0])
    assert edge.contains(edge.candidates(0.03)).all()
    assert not edge.contains(np.array([[0.1, 0.1]])).any()


def test_area_without_room_is_refused() -> None:
    """Too many ERAs too far apart, and no place at all, are named."""
    with pytest.raises(InputError, match=r"room"):
        LayoutSearch(problem(apart=0.3)).random_layout(np.random.default_rng(0))
    plate = rig().plate
    nowhere = Within(plate.length, plate.width, lambda points: ~everywhere(points))
    with pytest.raises(InputError, match=r"--where"):
        candidates_of(nowhere, plate, count=20)


def test_era_without_foot_is_like_the_others() -> None:
    """New ERAs are like the first that is not kept, with names that no kept one has."""
    some = rig()
    first = replace(some.eras[0], name="E1", stroke=5e-5)
    case = problem(rig=replace(some, eras=(first, *some.eras[1:])), kept=("E1",))
    eras: tuple[Era, ...] = case.eras(np.zeros((3, 2)))
    assert [era.name for era in eras] == ["E1", "E2", "E3"]
    assert [era.stroke for era in eras] == [5e-5, 1e-4, 1e-4]
