"""Layouts designed for contrast, against enumeration, symmetry and the answers of tables."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from era_haptics.command import run_era
from era_haptics.lab.design import problem as problem_module
from era_haptics.lab.design.assessment import assess
from era_haptics.lab.design.contact_rule import ContactRule, anywhere, contact_rule
from era_haptics.lab.design.design_run import rank_layouts
from era_haptics.lab.design.era_area import Area, area_of, candidates_of, everywhere
from era_haptics.lab.design.layout_keys import layout_keys
from era_haptics.lab.design.layout_search import LayoutSearch
from era_haptics.lab.design.problem import DesignProblem
from era_haptics.lab.design.runner import Runner
from kit.plates import exciter_rig_text, make_paper_rig
from model.arrays import ComplexArray, FloatArray
from model.config.document import parse_document
from model.errors import InputError
from model.finger import FIVE_POINTS, fingertips_on
from model.reduction.free_plate import FreePlate, solve_free_plate
from model.rig.rig import Rig, Uncertainty
from model.rig.rig_file import example_rig_path, load_rig, parse_rig
from model.structure.attachments import attached_stiffness
from model.structure.sources import drive_forces

RIG = load_rig(example_rig_path())
PLATE = RIG.plate


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few layouts together, and two frequencies."""
    monkeypatch.setattr("era_haptics.lab.design.design_run.CHUNK", 4)
    monkeypatch.setattr(problem_module, "SEARCH_FREQUENCIES", 2)


def problem(rig: Rig = RIG, **changes: Any) -> DesignProblem:
    """Return the problem of four ERAs along the edge of a plate."""
    defaults = {
        "count": 4,
        "kept": (),
        "area": area_of("edge", rig.plate),
        "contacts": replace(anywhere(rig.plate), quiet=(1, 2)),
        "apart": 0.03,
        "lowest": 20.0,
        "seed": 0,
    }
    return DesignProblem(rig=rig, **defaults | changes)


# Runs

COARSE = make_paper_rig(12, 9)
THREE_SETS = tuple(anywhere(COARSE.plate).sets(3, seed=1))
EDGE = area_of("edge", COARSE.plate), replace(anywhere(COARSE.plate), given=THREE_SETS)
"""ERAs along the edge, judged by three contact sets."""


def test_layout_is_judged_with_the_eras_of_its_problem() -> None:
    """The same positions with ERAs of two stiffnesses: each has the answers of its own rig."""
    soft = DesignProblem(COARSE, 4, *EDGE, stiffness=1e4)
    stiff = DesignProblem(COARSE, 4, *EDGE, stiffness=3e4)
    corners = {"corners": soft.own_positions}

    design = rank_layouts({soft: corners, stiff: corners}, finalists=1, runner=Runner())

    for layout in design.layouts:
        rig = layout.problem.rig_with(soft.own_positions)
        expected = sorted(assess(rig, THREE_SETS).contrast_db)
        assert sorted(layout.answers.contrast_db) == pytest.approx(expected)


def test_layouts_of_exciters_have_their_own_keys() -> None:
    """A suspension by stiffness and damping replaces resonance and q, and reads back."""
    text = exciter_rig_text("type: DAEX25CT-4, resonance: 300, resonance_is: free, q: 4")
    rig = parse_rig("board.yaml", text)
    area, contacts = area_of("edge", rig.plate), anywhere(rig.plate)
    board = DesignProblem(rig, 4, area, contacts, stiffness=5e3)
    places = np.array([[0.05, 0.04], [0.25, 0.04], [0.25, 0.19], [0.06, 0.18]])

    keys = layout_keys(board, places, parse_document("board.yaml", text).data)

    eras = parse_rig("layout.yaml", json.dumps(keys)).eras
    np.testing.assert_array_equal([(exciter.x, exciter.y) for exciter in eras], places)
    assert [exciter.stiffness for exciter in eras] == [5e3] * 4
    damping = [rig.eras[0].damping] * 4
    assert [exciter.damping for exciter in eras] == pytest.approx(damping, rel=1e-5)


@pytest.mark.parametrize(
    ("options", "cause"),
    [(["--eras", "3-"], "--eras must be"), (["--keep", "SW,XX"], "keep must be")],
)
def test_refused_design_leaves_no_folder(
    options: list[str], cause: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A range without its end, and an unknown ERA, are refused before anything is written."""
    folder = tmp_path / "out"
    command = ["design", str(example_rig_path()), "-o", str(folder), "--where", "nosuch.yaml"]

    assert run_era([*command, *options]) == 2

    assert cause in capsys.readouterr().err
    assert not folder.exists()


# Contacts

LAYOUT = """\
quiet: [2, 2]
apart: 4 cm
elsewhere: null
regions:
  a: {rectangle: {start: [0, 0], end: [5 cm, 5 cm]}, on_press: click}
  b: {circle: {at: [20 cm, 10 cm], radius: 4 cm}}
"""


def gaps_between(points: FloatArray) -> FloatArray:
    """Return the distances of all pairs of points [m]."""
    distances = np.linalg.norm(points[:, None] - points, axis=-1)
    return np.asarray(distances[np.triu_indices(len(points), 1)])


def test_contacts_are_in_the_regions_of_a_layout(tmp_path: Path) -> None:
    """Three fingers, 4 cm apart; effects do not matter."""
    path = tmp_path / "layout.yaml"
    path.write_text(LAYOUT)

    rule = contact_rule(path, PLATE)

    for contacts in (*rule.sets(20, seed=1), *rule.pooled_sets(10, seed=1)):
        assert len(contacts) == 3
        in_rectangle = np.all(contacts <= 0.05, axis=1)
        in_circle = np.linalg.norm(contacts - [0.2, 0.1], axis=1) <= 0.04
        np.testing.assert_array_equal(in_rectangle | in_circle, True, err_msg=str(contacts))
        assert gaps_between(contacts).min() > 0.04


# Scores and a dense solve

GAINS = Uncertainty(0.05, 5.0, 0.0, 0.0, 1.0, 0.0)
"""Errors of the gains only, 5 % and 5 degrees."""
LONG_STROKES = tuple(replace(corner, stroke=0.01) for corner in RIG.eras)
LOUD = replace(RIG, uncertainty=GAINS, eras=LONG_STROKES)
"""Weights of any kind reach the level, so it does not matter."""
PAIRS = tuple(replace(anywhere(PLATE), quiet=(1, 1)).sets(4, seed=4))
OF_PAIRS = ContactRule((1, 1), 0.05, lambda rng, count: np.zeros((count, 2)), PAIRS)


@dataclass(frozen=True)
class DenseScore:
    """The score of a layout by the definition: a dense system for each set, frequency and finger.

    With errors of the gains and of the thickness only, whose plates are solved again, and a quiet
    finger; the best weights are an eigenvector.
    """

    rig: Rig
    places: FloatArray
    """Of ERAs like the first (n, 2) [m], or (n, 3) with their feet."""

    def mean(self, sets: Sequence[FloatArray], frequencies: FloatArray) -> float:
        """Return the mean over contact sets of the score at the best frequency [dB]."""
        std = self.rig.uncertainty.frequency
        plates = []
        for factor in (1, 1 + std, 1 - std) if std else (1,):
            plate = replace(self.rig.plate, thickness=factor * self.rig.plate.thickness)
            plates.append(solve_free_plate(plate, self.rig.mesh, frequency_max=frequencies.max()))
        scores = []
        for contacts in sets:
            by_frequency = [self.at(frequency, contacts, plates) for frequency in frequencies]
            scores.append(max(by_frequency))
        return float(np.mean(scores))

    def at(self, frequency: float, contacts: FloatArray, plates: Sequence[FreePlate]) -> float:
        """Return the score [dB] of a target and a quiet finger at a frequency [Hz]."""
        plate = self.rig.plate
        tips, weights = fingertips_on(
            contacts, length=plate.length, width=plate.width, rule=FIVE_POINTS
        )
        target = weights[0] @ self.field(plates[0], frequency, contacts[0], tips[0])
        root = np.sqrt(weights[1])[:, None]
        fields = [root * self.field(free, frequency, contacts[1], tips[1]) for free in plates]
        nominal = fields[0]
        form = nominal.conj().T @ nominal
        for changed in fields[1:]:
            change = changed - nominal
            form += 0.5 * change.conj().T @ change
        powers = (np.abs(nominal) ** 2).sum(axis=0)
        form += self.rig.uncertainty.gain_variance(len(powers)) * np.diag(powers)
        # The largest |h w|² / w^H R w is the one eigenvalue of R^-1 h* h^T.
        ratios = np.linalg.eigvals(np.linalg.solve(form, np.outer(target.conj(), target)))
        return float(10 * np.log10(np.abs(ratios).max()))

    def field(
        self, free: FreePlate, frequency: float, finger: FloatArray, points: FloatArray
    ) -> ComplexArray:
        """Return the accelerations (p, n) of each ERA alone, under a finger on the plate."""
        omega = 2 * np.pi * np.array([frequency])
        eras = []
        for number, (x, y, *_) in enumerate(self.places):
            eras.append(replace(self.rig.eras[0], name=str(number), x=x, y=y))
        (stiffness,) = attached_stiffness(omega, eras)
        (force,) = drive_forces(omega, eras)
        tip = self.rig.fingertip.dynamic_stiffness(omega)
        contact = np.resize([*finger, 0.0], self.places.shape[1])
        (between,), (to,) = free.receptances(
            np.vstack([self.places, contact]), points, np.array([frequency])
        )
        applied = np.vstack([np.diag(force), np.zeros(len(eras))])
        loaded = np.eye(len(between)) + np.diag([*stiffness, *tip]) @ between
        forces = np.linalg.solve(loaded, applied)
        return np.asarray(-(omega**2) * to.T @ forces)


def score_of(design_problem: DesignProblem, places: FloatArray) -> float:
    """Return the score of the search for a layout [dB]."""
    (scored,) = LayoutSearch(design_problem).scored([places])
    return float(scored.score_db)


def test_search_finds_the_best_of_all_layouts_on_a_coarse_raster(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The best of some starts is the best of all triples of ERAs by a dense solve."""
    monkeypatch.setattr(problem_module, "EDGE_CANDIDATES", 7)
    search = LayoutSearch(problem(rig=LOUD, count=3, contacts=OF_PAIRS))
    candidates = search.problem.candidates
    frequencies = search.problem.searched_frequencies
    dense_scores = {}
    for triple in combinations(range(len(candidates)), 3):
        places = candidates[list(triple)]
        if search.problem.support_deficit(places) == 0:
            dense_scores[triple] = DenseScore(LOUD, places).mean(PAIRS, frequencies)
            (scored,) = search.scored([places])
            assert scored.score_db == pytest.approx(dense_scores[triple], abs=0.05), triple
    assert len(dense_scores) >= 20
    rng = np.random.default_rng(0)
    positions = np.empty((0, 2))
    for _ in range(3):
        positions = search.add(positions).positions
    starts = [positions]
    for _ in range(8):
        starts.append(candidates[rng.choice(8, 3, replace=False)])

    results = search.scored([search.exchange(start) for start in starts])

    best = max(results, key=lambda scored: scored.score_db)
    matches = (candidates[:, None] == best.positions).all(axis=-1)
    triple = tuple(np.flatnonzero(matches.any(axis=1)).tolist())
    assert dense_scores[triple] == pytest.approx(max(dense_scores.values()), abs=0.05)


def test_each_era_is_scored_with_its_own_foot() -> None:
    """A kept ERA on a point and new ones on discs of 6 cm."""
    first, *others = LOUD.eras
    rig = replace(LOUD, eras=(first, *(replace(corner, foot=0.06) for corner in others)))
    design_problem = problem(rig=rig, count=3, kept=(first.name,), contacts=OF_PAIRS)
    places = np.array([[first.x, first.y], [0.25, 0.05], [0.1, 0.2]])

    score = score_of(design_problem, places)

    footprints = np.column_stack([places, [0.0, 0.06, 0.06]])
    frequencies = design_problem.searched_frequencies
    expected = DenseScore(rig, footprints).mean(PAIRS, frequencies)
    assert score == pytest.approx(expected, abs=0.05)


def test_scores_count_plates_of_other_thickness_exactly() -> None:
    """4 % of thickness move resonances past a tone."""
    rig = replace(LOUD, uncertainty=replace(GAINS, thickness=0.04))
    design_problem = problem(rig=rig, contacts=OF_PAIRS)
    places = design_problem.own_positions

    score = score_of(design_problem, places)

    frequencies = design_problem.searched_frequencies
    expected = DenseScore(rig, places).mean(PAIRS, frequencies)
    exact_thickness = DenseScore(LOUD, places).mean(PAIRS, frequencies)
    assert score == pytest.approx(expected, abs=0.05)
    assert expected < exact_thickness - 1


@pytest.mark.parametrize("is_reversed", [False, True])
def test_score_of_two_contents_is_that_of_the_worse(is_reversed: bool) -> None:
    """Each with the other finger quiet."""
    (pair,) = replace(anywhere(PLATE), quiet=(1, 1)).sets(1, seed=4)
    if is_reversed:
        pair = pair[::-1]
    design_problem = problem(rig=LOUD, contacts=replace(anywhere(PLATE, 2), given=(pair,)))
    places = design_problem.own_positions

    score = score_of(design_problem, places)

    dense = DenseScore(LOUD, places)
    frequencies = design_problem.searched_frequencies
    first = dense.mean([pair], frequencies)
    second = dense.mean([pair[::-1]], frequencies)
    assert abs(first - second) > 0.5
    assert score == pytest.approx(min(first, second), abs=0.05)


# Rules for ERAs


def test_kept_eras_stay_and_all_keep_their_distance() -> None:
    """A random start is exchanged and moved, 8 cm apart along the edge."""
    search = LayoutSearch(problem(kept=("SW", "NE"), apart=0.08))

    positions = search.from_random(np.random.default_rng(2)).positions

    assert positions[:2].tolist() == [[0, 0], [PLATE.length, PLATE.width]]
    assert gaps_between(positions).min() >= 0.08
    is_at_edge = area_of("edge", PLATE).contains(positions)
    np.testing.assert_array_equal(is_at_edge, True)


def test_area_without_room_is_refused() -> None:
    """For ERAs too far apart, and without any position."""
    nowhere = Area("none", PLATE.length, PLATE.width, lambda points: ~everywhere(points))

    with pytest.raises(InputError, match="room"):
        problem(apart=0.3).random_layout(np.random.default_rng(0))
    with pytest.raises(InputError, match=r"^where must"):
        candidates_of(nowhere, count=20)
