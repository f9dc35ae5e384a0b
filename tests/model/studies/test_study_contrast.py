"""Ranking of a study by robust felt contrast, against dense systems and published figures."""

from dataclasses import replace

import numpy as np
import pytest

from dense_contrast import GAINS, dense_score
from model.design.contacts import anywhere
from model.design.judge import Judged
from model.design.support import SupportRule
from model.rig.file import example_rig_path, load_rig
from model.studies import finalists
from model.studies.cases import OWN, VACANT, Cases
from model.studies.finalists import judge_finalists
from model.studies.kinds import count_cases, placement_cases, stiffness_cases
from model.studies.outcome import all_columns, ranking_summary
from model.studies.ranking import Scored, rank, score_order
from model.studies.solve import DRIVES, CaseResults, StudyProblem, empty_results, solve_cases
from model.studies.supported import support_of
from model.vibration.activation import MEDIAN
from paper_plate import make_paper_rig

CORNERS = [(0, 0), (1, 0), (1, 1), (0, 1)]
MID_EDGES = [(0.5, 0), (1, 0.5), (0.5, 1), (0, 0.5)]
ONE_SIDE = [(0, 0.4), (0, 0.6)]
INSIDE = [(0.25, 0.3), (0.75, 0.3), (0.5, 0.8)]
# Eight, 5.25 apart, along the edge of 12 by 9.
EVENLY = [(0.21875, 0), (0.65625, 0), (1, 0.125), (1, 0.70833), (0.78125, 1), (0.34375, 1),
          (0, 0.875), (0, 0.29167)]  # fmt: skip


@pytest.fixture(scope="module")
def rig():
    """The paper's rig with errors of its gains only, and strokes that reach any level."""
    read = load_rig(example_rig_path())
    strong = tuple(replace(era, stroke=0.01) for era in read.eras)
    return replace(read, uncertainty=GAINS, eras=strong)


def cases_of(rig, layouts) -> Cases:
    """Layouts by name, in shares of the plate's sides."""
    positions = np.array([at for layout in layouts.values() for at in layout])
    places = np.full((len(layouts), max(map(len, layouts.values()))), VACANT, dtype=np.int32)
    start = 0
    for row, layout in zip(places, layouts.values(), strict=True):
        row[: len(layout)] = np.arange(start, start + len(layout))
        start += len(layout)
    sides = [rig.plate.length, rig.plate.width]
    return Cases(positions * sides, places, np.ones(len(places)), tuple(layouts))


def scored_by(values, *, supported=None, cases=None) -> Scored:
    """Cases of a placement in the order of these expected contrasts [dB]."""
    some = make_paper_rig(12, 9)
    if cases is None:
        cases = placement_cases(some, layouts=len(values), seed=0, raster=(7, 5))
    empty = empty_results(len(values))
    results = CaseResults(np.array(values, dtype=float), empty.statistics, empty.active)
    scored = score_order(some, cases, results, drive=1, lowest=20.0)
    support = replace(
        scored.support,
        is_tipping=~np.array(supported or [True] * len(values)),
        lowest_hz=np.full(len(values), 100.0),
    )
    order = np.lexsort((-results.expected_db, ~support.is_supported))
    return replace(scored, support=support, order=order)


def answers(mean: float) -> Judged:
    """Answers with this mean contrast [dB]."""
    return Judged(np.array([1, 2]), np.array([mean + 1, mean - 1]), np.array([20.0, 20.0]))


def test_study_ranks_layouts_as_dense_systems_do(rig) -> None:
    """Expected contrasts are those of the definition; two ERAs on one side come last."""
    layouts = {
        "one side": ONE_SIDE, "inside": INSIDE, "mid-edges": MID_EDGES, "corners": CORNERS,
        "evenly": EVENLY,
    }  # fmt: skip
    cases = cases_of(rig, layouts)
    sets = tuple(replace(anywhere(rig.plate), quiet=(1, 1)).sets(6, seed=5))
    problem = StudyProblem(rig, cases.positions, np.array([110.0]), sets, 20.0)
    results = solve_cases(problem.solve(), cases)
    frequencies = problem.solve().scorer._plate.frequencies
    dense = {
        name: dense_score(
            rig, cases.positions_of(case), sets, frequencies,
            damping=np.sqrt(4 / len(layouts[name])),
        )
        for case, name in enumerate(layouts)
        if name != "one side"
    }  # fmt: skip
    expected = dict(zip(layouts, results.expected_db, strict=True))
    assert np.isnan(expected.pop("one side"))
    assert expected == pytest.approx(dense, abs=0.3)  # of 25 to 41 dB, in single precision
    scored = score_order(rig, cases, results, drive=DRIVES.index("2"), lowest=20.0)
    in_order = sorted(dense, key=lambda name: -dense[name])
    assert [cases.names[case] for case in scored.order] == [*in_order, "one side"]
    assert in_order[0] == "evenly"
    assert scored.support.problem(0) == "tips over"


@pytest.mark.long
def test_study_orders_layouts_as_an_independent_optimiser_does(rig, monkeypatch) -> None:
    """Eight ERAs evenly around beat eight at corners and mid-edges, those the paper's corners.

    Its medians with one quiet finger, at gains good to 5 % and 5 degrees, are 29.9, 28.8 and 24.3
    dB. Two ERAs on one side come last.
    """
    monkeypatch.setattr(finalists, "JUDGED_SETS", 60)
    layouts = {
        "two": ONE_SIDE, "corners": CORNERS, "both": CORNERS + MID_EDGES, "evenly": EVENLY,
    }  # fmt: skip
    cases = cases_of(rig, layouts)
    results = empty_results(4)
    results.expected_db[1:] = [3, 2, 1]  # the wrong way round
    scored = score_order(rig, cases, results, drive=1, lowest=20.0)
    contacts = replace(anywhere(rig.plate), quiet=(1, 1))
    own = replace(load_rig(example_rig_path()), uncertainty=GAINS)
    ranking = judge_finalists(own, scored, contacts=contacts, finalists=3)
    order = [cases.names[case] for case in ranking.order]
    assert order == ["evenly", "both", "corners", "two"]
    corners, both, evenly = (ranking.judged[case].median_db(1) for case in (1, 2, 3))
    assert evenly > both > corners + 4


@pytest.mark.parametrize(("stiffness", "lowest"), [(1500.0, 25.0), (17000.0, 5.0)])
def test_support_of_cases_is_that_of_a_design(rig, stiffness, lowest) -> None:
    """Layouts of one to six ERAs, soft and stiff, are supported where a design says so."""
    some = replace(rig, eras=tuple(replace(era, stiffness=stiffness) for era in rig.eras))
    cases = count_cases(some, layouts=60, seed=3, raster=(7, 5))
    found = support_of(some, cases, lowest=lowest)
    rule = SupportRule(some, lowest)
    shortfalls = [rule.shortfall(cases.eras_of(case, some.eras)) for case in range(len(cases))]
    assert found.is_supported.tolist() == [each == 0 for each in shortfalls]
    problems = {found.problem(case) for case in range(len(cases))}
    assert {None, "tips over"} <= problems


def test_finalists_are_the_first_and_those_that_pictures_show() -> None:
    """The first of the order, the best of each group, own, middle and worst; none that tips."""
    scored = scored_by([5, 9, 8, 7, 6, 4, 3, 2, 99, 1], supported=[True] * 8 + [False, True])
    assert scored.order.tolist() == [1, 2, 3, 4, 0, 5, 6, 7, 9, 8]
    assert scored.finalists(2) == [1, 2, 0, 9]
    groups = [np.array([0, 0, 0, 0, 0, 1, 1, 1, 1, 2])]
    assert scored.finalists(1, groups=groups) == [1, 0, 5, 9]
    assert (scored.own, scored.middle, scored.worst) == (0, 0, 9)
    assert scored.cases.names[0] == OWN


def test_rank_leads_with_the_best_answers() -> None:
    """Finalists are in the order of their answers; another judged case joins if no worse."""
    scored = scored_by([5, 9, 8, 7, 6])
    judged = {1: answers(10), 2: answers(12), 0: answers(11), 4: answers(3)}
    ranking = rank(scored, judged, finalists=2)
    assert ranking.order.tolist() == [2, 0, 1, 3, 4]
    assert (ranking.best, ranking.recommended, ranking.head) == (2, 2, 3)
    summary = ranking_summary(make_paper_rig(12, 9), ranking)
    means = [case["contrast_db"] and case["contrast_db"]["mean"] for case in summary["ranking"]]
    assert means == [12, 11, 10, None, 3]
    assert [case["rank"] for case in summary["ranking"]] == [1, 2, 3, 4, 5]


def test_ranking_summary_includes_the_own_rig() -> None:
    """Ten cases are listed and, where it is not among them, the rig's own with its rank."""
    scored = scored_by(np.arange(30))
    ranking = rank(scored, {29: answers(9)}, finalists=1)
    shown = ranking_summary(make_paper_rig(12, 9), ranking)["ranking"]
    assert [case["rank"] for case in shown] == [*range(1, 11), 30]
    assert shown[-1]["layout"] == OWN


def test_rank_recommends_the_softest_of_nearly_equal_eras() -> None:
    """Among those within a decibel of the best answers the fewest ERAs, then the softest, count."""
    cases = stiffness_cases(make_paper_rig(12, 9), layouts=1, seed=0, raster=(7, 5))
    values = [1, 2, 3, 8, 9.1, 9.5, 10, 9.9, 9.8]
    scored = scored_by(values, cases=cases)
    ranking = rank(scored, dict(enumerate(map(answers, values))), finalists=1)
    assert (ranking.best, ranking.recommended) == (6, 4)
    assert ranking.best_by(cases.stiffness_factors) == {2.0**k: k + 4 for k in range(-4, 5)}


def test_unsupported_cases_come_last_by_loudness_and_have_no_contrast(rig) -> None:
    """However loud, layouts that tip are behind all others and are named so in every output."""
    cases = cases_of(rig, {"a": ONE_SIDE, "b": ONE_SIDE[::-1], "four": CORNERS})
    results = empty_results(3)
    results.statistics[:, 1, :] = np.array([[7.0], [9.0], [1.0]])
    results.expected_db[2] = 5.0
    scored = score_order(rig, cases, results, drive=1, lowest=20.0)
    ranking = rank(scored, {2: answers(4)}, finalists=5)
    assert ranking.order.tolist() == [2, 1, 0]
    assert ranking.recommended == 2
    shown = ranking_summary(rig, ranking)
    assert (shown["tipping"], shown["too_low"]) == (2, 0)
    assert [case["support_problem"] for case in shown["ranking"]] == [None, *["tips over"] * 2]
    assert shown["ranking"][1]["expected_contrast_db"] is None
    assert shown["ranking"][1]["median_m_s2"] == results.statistics[1, 1, MEDIAN]
    columns = all_columns(ranking)
    assert list(columns["supported"]) == ["no", "no", "yes"]
    assert list(columns["rank"]) == [3, 2, 1]
