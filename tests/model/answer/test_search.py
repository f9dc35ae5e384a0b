"""Tones of contents: of ranked frequencies, and by the kernel in C as in numpy."""

import pickle
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from scipy.linalg import eigh

from model.answer import tone_search
from model.answer.promise import FingersOnPlate, share_stroke
from model.answer.stimulus import KEPT, MISSING, Contents, Placement, Stream
from model.answer.tone_search import choose_by_numpy, choose_tones, ranked, worst_ratios
from model.finger import THRESHOLDS
from model.rig.rig import Uncertainty
from model.structure.attachments import PointLoad
from model.table.table import LocalizationTable
from model.table.table_file import build_table
from plates import contact_sets, forms_of, smooth_rig
from set_table import only

RNG = np.random.default_rng(5)
PLACES = [(float(x), float(y)) for x, y in RNG.uniform([0.02, 0.02], [0.29, 0.21], (8, 2))]
IDENTIFIED = Uncertainty(0.015, 1.5, 0.002, 0.01, 1.1, 0.5, modulus=0.002, place=0.0002)
FLAT = Uncertainty(0.02, 1.0, 0.0, 0.02, 1.2, 0.3)  # of a thickness that is certain


@cache
def table() -> LocalizationTable:
    """Of four ERAs and a mass."""
    return build_table(replace(smooth_rig(), masses=(PointLoad(0.2, 0.05, mass=0.03),)))


@cache
def random_table(seed: int) -> LocalizationTable:
    """Of three to seven ERAs anywhere, unequal in stiffness and stroke, known or not.

    Two promise by all sets of thresholds, one by that of its levels.
    """
    rng, rig = np.random.default_rng(seed), smooth_rig()
    eras = tuple(
        replace(
            rig.eras[0],
            name=f"E{number}",
            x=float(rng.uniform(0, rig.plate.length)),
            y=float(rng.uniform(0, rig.plate.width)),
            stiffness=rig.eras[0].stiffness * float(rng.uniform(0.7, 1.4)),
            stroke=rig.eras[0].stroke * float(rng.uniform(0.7, 1.4)),
        )
        for number in range(3 + 2 * seed)
    )
    masses = (PointLoad(0.2, 0.05, mass=0.03),) * (seed % 2)
    uncertainty = (rig.uncertainty, IDENTIFIED, FLAT)[seed]
    rig = replace(rig, eras=eras, masses=masses, uncertainty=uncertainty)
    if seed != 1:
        rig = replace(rig, promised_thresholds=THRESHOLDS)
    return build_table(rig, frequencies=np.linspace(40, 320, 29), drive_mode="phased")


def content(of: LocalizationTable, placed: Placement, level_db_sl: float = 20.0) -> Contents:
    """One for the first of these fingers, at all frequencies."""
    stream = Stream((0,), level_db_sl, ((0, len(of.frequencies)),))
    quiet = tuple(range(1, len(placed.contacts)))
    return Contents(placed.contacts, (), (stream,), quiet)


SETS: dict[str, tuple[int, int, dict[str, Any]]] = {
    "one, and a quiet finger": (1, 1, {}),
    "one, and many quiet fingers": (1, 9, {}),
    "one alone": (1, 0, {}),
    "two, and two quiet fingers": (2, 2, {}),
    "four": (4, 0, {}),
    "two that share": (2, 2, {"shared": True}),
    "five that share": (5, 0, {"shared": True}),
    "eight that share, and two quiet fingers": (8, 2, {"shared": True}),
    "twenty that share": (20, 0, {"shared": True}),
    "twenty that share more than the stroke": (20, 0, {"shared": True, "level": 70.0}),
    "six": (6, 1, {}),
    "bands that may be exchanged": (3, 0, {"bands": ((0, 9), (10, 20), (19, 29))}),
    "more than the stroke": (2, 1, {"level": 60.0}),
    "one that no level margin allows": (1, 2, {"level": 46.0}),
    "one that nothing reaches": (1, 2, {"level": 90.0}),
    "stroke taken whole by two": (3, 1, {"level": 60.0}),
    "one band for both": (2, 1, {"bands": ((3, 4),)}),
    "fingers that press": (2, 2, {"loads": (0.4, 1.0, 2.5, 1.0)}),
    "fingers on edges": (1, 4, {"at": ((0, 0), (1, 1), (0.02, 0.4), (0.5, 0.98), (0.97, 0.03))}),
}


@pytest.mark.usefixtures("kernels_or_numpy")
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("name", SETS)
def test_kernel_finds_what_numpy_finds(name: str, seed: int) -> None:
    """Frequencies, weights and all figures, on random rigs: within 0.03 dB."""
    count, quiet, given = SETS[name]
    of = random_table(seed)
    fingers = count + quiet
    (places,) = contact_sets(1, fingers=max(2, fingers), seed=seed) if fingers < 10 else (GRID,)
    places = places[:fingers]
    if "at" in given:
        places = [(x * of.plate.length, y * of.plate.width) for x, y in given["at"]]
    bands = given.get("bands", ((0, len(of.frequencies)),))
    level = given.get("level", 15.0)
    groups = [tuple(range(count))] if "shared" in given else [(each,) for each in range(count)]
    streams = tuple(Stream(fingers, level, bands, n) for n, fingers in enumerate(groups))
    contents = Contents(
        tuple(places),
        given.get("loads", ()),
        streams,
        tuple(range(count, count + quiet)),
        apart_hz=30.0,
        background=None if quiet or len(groups) > 1 else of.background(places),
    )
    found, expected = choose_tones(of, contents), choose_by_numpy(of, contents)
    assert found.rows == expected.rows
    assert found.is_apart == expected.is_apart
    if name == "stroke taken whole by two" and seed == 0:  # of higher priority
        assert found.gains[0] == expected.gains[0] == 0
    assert np.abs(found.weights) == pytest.approx(np.abs(expected.weights), abs=0.02)
    for key in ("gains", "stroke_factor"):
        np.testing.assert_allclose(getattr(found, key), getattr(expected, key), rtol=2e-3)
    for key in ("contrast_db", "level_db_sl", "foreign_db_sl", "worst_db"):
        one, other = getattr(found, key), getattr(expected, key)
        np.testing.assert_allclose(one, other, rtol=0, atol=0.03, err_msg=key)


GRID = [
    (0.03 + 0.06 * x + column, 0.05 + 0.12 * y)
    for column in (0, 0.028)
    for x in range(5)
    for y in range(2)
]


def test_bound_and_level_are_those_of_the_best_weights_for_the_mean() -> None:
    """The frequency of the highest bound that reaches the level is kept, few that miss it.

    Bounds by a general optimiser: the largest eigenvalue of the target's form to the mean one.
    """
    of = table()
    placed = Placement((PLACES[0],), tuple(PLACES[1:4]))
    forms, contents = forms_of(of, placed), content(of, placed)
    c = forms.targets[0].conj().astype(complex)
    R = forms.quiet.mean(axis=1).astype(complex)
    bounds, levels = [], []
    for target, form in zip(c, R, strict=True):
        values, vectors = eigh(np.outer(target, target.conj()), form)
        bounds.append(values[-1])
        levels.append(abs(target.conj() @ vectors[:, -1]) / np.abs(vectors[:, -1]).max())
    reaches = np.array(levels) >= forms.wanted * forms.threshold
    kept = ranked(FingersOnPlate.of(of, contents.places, ()), contents)
    assert len(kept) == min(KEPT, int(reaches.sum()) + int((~reaches[kept]).sum()))
    assert int((~reaches[kept]).sum()) <= MISSING
    best = np.argsort(-np.array(bounds)[reaches])[: int(reaches[kept].sum())]
    assert set(np.flatnonzero(reaches)[best]) == set(kept[reaches[kept]])


def test_answers_lose_little(monkeypatch: pytest.MonkeyPatch) -> None:
    """Against a search of all frequencies: 0.1 dB in the mean, and the level is as high."""
    of, lost = table(), []
    all_kept = replace(of)  # that keeps no rules yet
    monkeypatch.setattr(tone_search, "KEPT", len(of.frequencies))
    only(all_kept, Placement((PLACES[0],), (PLACES[1],)))
    monkeypatch.undo()
    for at in range(4):
        for more in (1, 2, 4):
            quiet = (*PLACES[:at], *PLACES[at + 1 : at + 1 + more])
            contents = content(of, Placement((PLACES[at],), quiet))
            some = choose_tones(of, contents)
            every = choose_tones(all_kept, contents)
            lost.append(every.worst_db - some.worst_db)
            assert some.level_db_sl[0][1] > every.level_db_sl[0][1] - 0.1
    assert np.mean(lost) < 0.1


@pytest.mark.usefixtures("kernels_or_numpy")
def test_level_that_no_kept_frequency_reaches_is_sought_at_all(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Where the ranking keeps only a frequency that is too weak the answer is that of all."""
    for module in (tone_search, tone_search):
        monkeypatch.setattr(module, "KEPT", 1)
        monkeypatch.setattr(module, "MISSING", 1)
    of = replace(table())  # that keeps no rules yet
    contents = content(of, Placement((PLACES[0],), (PLACES[1],)), 50.0)
    (kept,) = ranked(FingersOnPlate.of(of, contents.places, ()), contents).tolist()
    found = choose_tones(of, contents)
    assert found.rows[0] != kept


def test_prepared_table_goes_to_another_process() -> None:
    """With what it has computed ahead; its answers are the same there."""
    of = table()
    placed = Placement((PLACES[0],), (PLACES[1],))
    (layer, _), (other, _) = (only(each, placed) for each in (of, pickle.loads(pickle.dumps(of))))
    assert other.excitation == layer.excitation


def test_worst_finger_of_combinations_is_counted_plate_by_plate() -> None:
    """By hand: two contents, a quiet finger and one that counts for nothing, on eleven plates.

    The percentile of eleven plates is the second smallest; the first of the contents alone counts
    at the quiet finger only. By a second set of thresholds the power of the second content is four
    times as high, which lowers the first finger's ratio to a quarter.
    """
    own = np.array([[2.0] * 11, [3.0] * 11])
    loudest = np.ones((2, 4, 11))
    loudest[1, 0] = np.arange(1, 12)  # of the second content at the first one's finger
    loudest[:, 3] = 1e6
    streams = [Stream((0,), 20.0, ()), Stream((1,), 20.0, ())]
    one = np.ones((1, 2), dtype=np.float32)
    both = worst_ratios(np.array([[0, 1]]), streams, [2], own, loudest, one)
    assert both == pytest.approx([4 / 10])
    alone = worst_ratios(np.array([[0], [1]]), streams, [2], own, loudest, one)
    assert alone == pytest.approx([4.0, 9.0])
    two = np.array([[1.0, 1.0], [1.0, 2.0]], dtype=np.float32)
    for sets in (two, two[::-1]):
        found = worst_ratios(np.array([[0, 1]]), streams, [2], own, loudest, sets)
        assert found == pytest.approx([4 / 40])


def test_stroke_is_shared_by_one_factor_for_each_priority() -> None:
    """By hand: the higher priority has all of it, two others half of what is left, max-min."""
    weights = np.array([[0.5, 0.1], [0.5, 1.0], [0.5, 1.0]], dtype=np.complex64)
    gains, factor = share_stroke(np.ones(3), weights, np.ones(3), [1, 0, 0])
    assert gains == pytest.approx([1.0, 0.45, 0.45])
    assert factor == pytest.approx(0.45)
    # Levels of 8, 2 and 1 that would need 0.8, 0.4 and 0.3 of one ERA: the first is lowered.
    one = np.array([[0.8], [0.4], [0.3]], dtype=np.complex64)
    gains, factor = share_stroke(np.ones(3), one, np.array([8.0, 2.0, 1.0]), [0, 0, 0])
    assert gains == pytest.approx([0.375, 1.0, 1.0])
    assert factor == pytest.approx(0.375)
    # Needing 0.8, 0.8 and 0.3, the first two end at the level 1.4: 0.14 + 0.56 + 0.3.
    two = np.array([[0.8], [0.8], [0.3]], dtype=np.complex64)
    gains, factor = share_stroke(np.ones(3), two, np.array([8.0, 2.0, 1.0]), [0, 0, 0])
    assert gains == pytest.approx([0.175, 0.7, 1.0])
    assert factor == pytest.approx(0.175)
