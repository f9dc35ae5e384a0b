"""Layouts designed for contrast, against enumeration, symmetry and the answers of tables.

Also the files that say where ERAs may stand and where fingers touch, and designs on several
machines.
"""

import json
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from era_haptics.command import run_era
from era_haptics.lab.design import problem as problem_module
from era_haptics.lab.design.design_run import assess, rank_layouts
from era_haptics.lab.design.layout_keys import layout_keys
from era_haptics.lab.design.layout_search import LayoutSearch
from era_haptics.lab.design.problem import (
    Area,
    ContactRule,
    DesignProblem,
    anywhere,
    area_of,
    candidates_of,
    contact_rule,
    everywhere,
    layouts_of,
    shortfall,
)
from era_haptics.lab.design.results import Design
from era_haptics.lab.design.runner import Runner
from kit.plates import exciter_rig_text, make_paper_rig
from model.arrays import ComplexArray, FloatArray
from model.config.document import parse_document
from model.errors import InputError
from model.finger import FIVE_POINTS, fingertips_on
from model.processes import on_cluster, on_processes
from model.reduction.free_plate import FreePlate, solve_free_plate
from model.rig.rig import Rig, Uncertainty
from model.rig.rig_file import example_rig_path, load_rig, parse_rig
from model.structure.attachments import attached_stiffness
from model.structure.sources import Era, drive_forces
from model.structure.statics import static_loads


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few layouts together."""
    monkeypatch.setattr("era_haptics.lab.design.design_run.CHUNK", 4)


COARSE = make_paper_rig(12, 9)
FEW = tuple(anywhere(COARSE.plate).sets(3, seed=1))
EDGE = area_of("edge", COARSE.plate), replace(anywhere(COARSE.plate), given=FEW)
"""ERAs along the edge, judged by three contact sets."""


def ranked(runner: Runner, *, seed: int = 0) -> Design:
    """Ten layouts of four ERAs, two of them judged by three contact sets."""
    some = DesignProblem(COARSE, 4, *EDGE, seed=seed)
    return rank_layouts({some: layouts_of("random:10", some)}, finalists=2, runner=runner)


def figures(design: Design) -> bytes:
    """All numbers of a design."""
    rows = [
        [*each.found.positions.ravel(), each.found.score_db, each.mean_db if each.judged else 0]
        for each in design.layouts
    ]
    return np.array(rows).tobytes()


@pytest.mark.long
def test_processes_and_a_cluster_find_the_same_to_the_bit() -> None:
    """One process, two of this machine and two Dask workers."""
    import dask  # takes a second
    from distributed import LocalCluster

    here = figures(ranked(Runner()))
    assert figures(ranked(Runner(machines=partial(on_processes, 2)))) == here
    with (
        dask.config.set({"distributed.worker.multiprocessing-method": "forkserver"}),
        LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0") as running,
    ):
        there = Runner(machines=partial(on_cluster, running.scheduler_address))
        assert figures(ranked(there)) == here


def test_a_layout_is_judged_with_the_eras_of_its_problem() -> None:
    """The same places with ERAs of two stiffnesses: each has the answers of its own rig."""
    soft, stiff = (DesignProblem(COARSE, 4, *EDGE, stiffness=each) for each in (1e4, 3e4))
    corners = {"corners": soft.own_positions}
    found = rank_layouts({soft: corners, stiff: corners}, finalists=1, runner=Runner())
    for each in found.layouts:
        alone = assess(each.problem.rig_with(soft.own_positions), FEW)
        assert sorted(each.answers.contrast_db) == pytest.approx(sorted(alone.contrast_db))


def test_layouts_of_exciters_state_their_own_keys() -> None:
    """A suspension by stiffness and damping takes the place of resonance and q, and reads back."""
    text = exciter_rig_text("type: DAEX25CT-4, resonance: 300, resonance_is: free, q: 4")
    rig = parse_rig("board.yaml", text)
    area, contacts = area_of("edge", rig.plate), anywhere(rig.plate)
    sought = DesignProblem(rig, 4, area, contacts, stiffness=5e3)
    places = np.array([[0.05, 0.04], [0.25, 0.04], [0.25, 0.19], [0.06, 0.18]])
    keys = layout_keys(sought, places, parse_document("board.yaml", text).data)
    found = parse_rig("layout.yaml", json.dumps(keys))
    assert [(era.x, era.y) for era in found.eras] == [tuple(at) for at in places.tolist()]
    assert [era.stiffness for era in found.eras] == [5e3] * 4
    assert [era.damping for era in found.eras] == pytest.approx([rig.eras[0].damping] * 4, rel=1e-5)


RIG = load_rig(example_rig_path())
PLATE = RIG.plate
GAINS = Uncertainty(0.05, 5.0, 0.0, 0.0, 1.0, 0.0)
"""Errors of the gains only, 5 % and 5 degrees."""
LOUD = replace(RIG, uncertainty=GAINS, eras=tuple(replace(era, stroke=0.01) for era in RIG.eras))
"""Weights of any kind reach the level, so that it does not matter."""
PAIRS = tuple(replace(anywhere(PLATE), quiet=(1, 1)).sets(4, seed=4))
OF_PAIRS = ContactRule((1, 1), 0.05, lambda rng, n: np.zeros((n, 2)), PAIRS)


@pytest.mark.parametrize(
    ("options", "cause"),
    [(["--eras", "3-"], "--eras must be"), (["--keep", "SW,XX"], "keep must be")],
)
def test_refused_design_leaves_no_folder(
    options: list[str], cause: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A range without its end, and an unknown ERA, are refused before anything is written."""
    folder = tmp_path / "out"
    words = ["design", str(example_rig_path()), "-o", str(folder), "--where", "nosuch.yaml"]
    assert run_era([*words, *options]) == 2
    assert cause in capsys.readouterr().err
    assert not folder.exists()


def test_contacts_in_regions_of_a_layout(tmp_path) -> None:
    """Fingers are in the regions, so many of them, so far apart; effects are passed over."""
    path = tmp_path / "layout.yaml"
    path.write_text(
        "quiet: [2, 2]\napart: 4 cm\nelsewhere: null\nregions:\n"
        "  a: {rectangle: {start: [0, 0], end: [5 cm, 5 cm]}, on_press: click}\n"
        "  b: {circle: {at: [20 cm, 10 cm], radius: 4 cm}}\n"
    )
    rule = contact_rule(path, PLATE)
    for contacts in [*rule.sets(20, seed=1), *rule.pooled_sets(10, seed=1)]:
        assert len(contacts) == 3
        in_a = (contacts <= 0.05).all(axis=1)
        in_b = np.hypot(*(contacts - [0.2, 0.1]).T) <= 0.04
        assert (in_a | in_b).all()
        gaps = np.linalg.norm(contacts[:, None] - contacts, axis=-1)
        assert gaps[np.triu_indices(3, 1)].min() > 0.04


def dense_score(
    rig: Rig,
    places: FloatArray,
    sets: Sequence[FloatArray],
    frequencies: FloatArray,
) -> float:
    """Mean score [dB] by the definition: one dense system for each set, frequency and finger.

    With errors of the gains and of the thickness only, whose plates are solved anew, and one quiet
    finger; the best weights are an eigenvector. ERAs at places (n, 2) [m], or (n, 3) with
    their feet, are like the first.
    """
    plate, std = rig.plate, rig.uncertainty.frequency
    plates = [
        solve_free_plate(
            replace(plate, thickness=h * plate.thickness),
            rig.mesh,
            frequency_max=float(frequencies.max()),
        )
        for h in ((1, 1 + std, 1 - std) if std else (1,))
    ]
    eras = [replace(rig.eras[0], name=str(n), x=x, y=y) for n, (x, y, *_) in enumerate(places)]
    omega = 2 * np.pi * frequencies
    z, force = attached_stiffness(omega, eras), drive_forces(omega, eras)
    tip = rig.fingertip.dynamic_stiffness(omega)
    sigma2, found = rig.uncertainty.gain_variance, []
    for contacts in sets:
        best = []
        tips, weights = fingertips_on(
            contacts, length=plate.length, width=plate.width, rule=FIVE_POINTS
        )
        for row in range(len(frequencies)):
            attached = z[row], tip[row], force[row]
            target, quiet = (
                [
                    _field(free, places, finger, points, frequencies[row], attached)
                    for free in plates
                ]
                for finger, points in zip(contacts, tips, strict=True)
            )
            mean = weights[0] @ target[0]
            root = np.sqrt(weights[1])[:, None]
            changes = [root * (other - quiet[0]) for other in quiet[1:]]
            R = sum((0.5 * each.conj().T @ each for each in changes), 0)
            R = R + (root * quiet[0]).conj().T @ (root * quiet[0])
            R += sigma2 * np.diag((np.abs(root * quiet[0]) ** 2).sum(axis=0))
            # Largest |h w|² / w^H R w is the one eigenvalue of R^-1 h* h^T.
            values = np.linalg.eigvals(np.linalg.solve(R, np.outer(mean.conj(), mean)))
            best.append(10 * np.log10(np.abs(values).max()))
        found.append(max(best))
    return float(np.mean(found))


def _field(
    free: FreePlate,
    places: FloatArray,
    finger: FloatArray,
    points: FloatArray,
    frequency: float,
    attached: tuple[ComplexArray, complex, ComplexArray],
) -> ComplexArray:
    """Acceleration at points (p, 2) under a finger on the plate, of each ERA alone: (p, n).

    attached: dynamic stiffness of the ERAs (n,) and of the finger, force of the ERAs (n,).
    """
    z, tip, force = attached
    at = np.vstack([places, np.resize([*finger, 0.0], places.shape[1])])
    between, to = free.receptances(at, points, np.array([frequency]))
    applied = np.vstack([np.diag(force), np.zeros(len(places))])
    forces = np.linalg.solve(np.eye(len(at)) + np.diag([*z, tip]) @ between[0], applied)
    return np.asarray(-((2 * np.pi * frequency) ** 2) * to[0].T @ forces)


def test_search_finds_the_best_of_all_layouts_on_a_coarse_raster(monkeypatch) -> None:
    """The best of some starts is the best of all triples of ERAs that a dense solve gives."""
    monkeypatch.setitem(problem_module.CANDIDATES, True, 7)
    monkeypatch.setattr(problem_module, "SEARCH_FREQUENCIES", 2)
    search = LayoutSearch(problem(rig=LOUD, count=3, contacts=OF_PAIRS))
    candidates = search.problem.candidates
    ends = np.array([LOUD.limits.frequency_min, LOUD.limits.frequency_max])
    dense = {}
    for triple in combinations(range(len(candidates)), 3):
        places = candidates[list(triple)]
        if search.problem.shortfall(places) == 0:
            dense[triple] = dense_score(LOUD, places, PAIRS, ends)
            (scored,) = search.scored([places])
            assert scored.score_db == pytest.approx(dense[triple], abs=0.05)
    rng = np.random.default_rng(0)
    found = np.empty((0, 2))
    for _ in range(3):
        found = search.add(found).positions
    starts = [found, *(candidates[rng.choice(8, 3, replace=False)] for _ in range(8))]
    ends = search.scored([search.exchange(each) for each in starts])
    best = max(ends, key=lambda each: each.score_db)
    assert len(dense) >= 20
    numbers = np.flatnonzero((candidates[:, None] == best.positions).all(axis=-1).any(axis=1))
    assert dense[tuple(numbers.tolist())] == pytest.approx(max(dense.values()), abs=0.05)


def test_each_era_is_scored_with_its_own_foot(monkeypatch: pytest.MonkeyPatch) -> None:
    """A kept ERA on a point and new ones on discs of 6 cm, against a dense solve of them."""
    monkeypatch.setattr(problem_module, "SEARCH_FREQUENCIES", 2)
    first, *others = LOUD.eras
    rig = replace(LOUD, eras=(first, *(replace(era, foot=0.06) for era in others)))
    search = LayoutSearch(problem(rig=rig, count=3, kept=(first.name,), contacts=OF_PAIRS))
    places = np.array([[first.x, first.y], [0.25, 0.05], [0.1, 0.2]])
    footprints = np.column_stack([places, [0.0, 0.06, 0.06]])
    ends = np.array([rig.limits.frequency_min, rig.limits.frequency_max])
    (scored,) = search.scored([places])
    expected = dense_score(rig, footprints, PAIRS, ends)
    assert scored.score_db == pytest.approx(expected, abs=0.05)


def problem(**changes) -> DesignProblem:
    """Four ERAs along the edge of the paper's plate."""
    some = changes.pop("rig", RIG)
    usual = {
        "count": 4, "kept": (), "area": area_of("edge", some.plate),
        "contacts": replace(anywhere(some.plate), quiet=(1, 2)),
        "apart": 0.03, "lowest": 20.0, "seed": 0,
    }  # fmt: skip
    return DesignProblem(rig=some, **(usual | changes))


def test_kept_eras_stay_and_all_keep_their_distance() -> None:
    """A start at random, exchanged and moved, leaves what is kept and the least distance."""
    search = LayoutSearch(problem(kept=("SW", "NE"), apart=0.08))
    found = search.from_random(np.random.default_rng(2))
    plate = RIG.plate
    assert found.positions[:2].tolist() == [[0, 0], [plate.length, plate.width]]
    gaps = np.linalg.norm(found.positions[:, None] - found.positions, axis=-1)
    assert gaps[np.triu_indices(4, 1)].min() >= 0.08
    assert area_of("edge", plate).contains(found.positions).all()


def test_static_loads_of_a_seesaw() -> None:
    """Three ERAs at two corners and the middle of the far side carry a quarter, a quarter, half."""
    some, one = RIG, RIG.eras[0]
    length, width = some.plate.length, some.plate.width
    eras = [
        replace(one, name=str(number), x=x, y=y)
        for number, (x, y) in enumerate([(0, 0), (length, 0), (length / 2, width)])
    ]
    weight = 9.80665 * some.plate.mass
    assert static_loads(some.plate, eras) == pytest.approx([weight / 4, weight / 4, weight / 2])
    assert shortfall(some, eras, lowest=10.0) == 0
    # The center of mass behind all of them: the plate tips.
    assert shortfall(some, [replace(era, y=0.2 * era.y) for era in eras], lowest=1.0) > 0
    assert shortfall(some, eras, lowest=1e4) > 0


def test_area_without_room_is_refused() -> None:
    """Too many ERAs too far apart, and no place at all, are named."""
    with pytest.raises(InputError, match=r"room"):
        problem(apart=0.3).random_layout(np.random.default_rng(0))
    plate = RIG.plate
    nowhere = Area("none", plate.length, plate.width, lambda points: ~everywhere(points))
    with pytest.raises(InputError, match=r"^where must"):
        candidates_of(nowhere, count=20)


def test_era_without_foot_is_like_the_others() -> None:
    """New ERAs are like the first that is not kept, with names that no kept one has."""
    some = RIG
    first = replace(some.eras[0], name="E1", stroke=5e-5)
    case = problem(rig=replace(some, eras=(first, *some.eras[1:])), kept=("E1",))
    eras: tuple[Era, ...] = case.eras(np.zeros((3, 2)))
    assert [era.name for era in eras] == ["E1", "E2", "E3"]
    assert [era.stroke for era in eras] == [5e-5, 1e-4, 1e-4]


def test_scores_count_plates_of_other_thickness_exactly(monkeypatch) -> None:
    """As plates that are solved anew, dense: 4 % of thickness move resonances past a tone."""
    monkeypatch.setattr(problem_module, "SEARCH_FREQUENCIES", 2)
    thick = replace(LOUD, uncertainty=replace(GAINS, thickness=0.04))
    some = problem(rig=thick, contacts=OF_PAIRS)
    (found,) = LayoutSearch(some).scored([some.own_positions])
    dense, certain = (
        dense_score(each, some.own_positions, PAIRS, some.searched_frequencies)
        for each in (thick, LOUD)
    )
    assert found.score_db == pytest.approx(dense, abs=0.05)
    assert dense < certain - 1


def test_the_score_of_two_contents_is_that_of_the_worse(monkeypatch) -> None:
    """Each with the other finger quiet, by a dense solve of either."""
    monkeypatch.setattr(problem_module, "SEARCH_FREQUENCIES", 2)
    (pair,) = replace(anywhere(PLATE), quiet=(1, 1)).sets(1, seed=4)
    for one, other in ((pair, pair[::-1]), (pair[::-1], pair)):
        some = problem(rig=LOUD, contacts=replace(anywhere(PLATE, 2), given=(one,)))
        (found,) = LayoutSearch(some).scored([some.own_positions])
        each = [
            dense_score(LOUD, some.own_positions, (way,), some.searched_frequencies)
            for way in (one, other)
        ]
        assert abs(each[0] - each[1]) > 0.5
        assert found.score_db == pytest.approx(min(each), abs=0.05)


def test_layouts_on_a_small_raster_are_all_there_are(monkeypatch) -> None:
    """Of four corners and nothing between them three can be chosen in four ways."""
    monkeypatch.setitem(problem_module.CANDIDATES, True, 4)
    some = problem(count=3, apart=0.1)
    count = len(some.candidates)
    given = layouts_of("random:100", some)
    random = [each for name, each in given.items() if name.startswith("3-")]
    named = [each for each in given.values() if some.area.contains(each).all()]
    choices = [some.candidates[list(each)] for each in combinations(range(count), 3)]
    assert len(random) + sum(
        any((np.sort(a, axis=0) == np.sort(b, axis=0)).all() for b in choices)
        for a in named[: len(named) - len(random)]
    ) == sum(map(some.are_apart, choices))
