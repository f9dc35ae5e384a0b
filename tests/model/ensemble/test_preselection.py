"""Ranking of frequencies, against the exact forms and against answers that search all of them."""

import pickle
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from model.ensemble.contact_forms import load_contacts
from model.ensemble.preselection import Preselection
from model.rig.uncertainty import Uncertainty
from model.structure.point_load import PointLoad
from model.table.build import build_table
from model.table.question import Question
from model.table.table import LocalizationTable
from paper_table import smooth_rig

RNG = np.random.default_rng(5)
PLACES = [(float(x), float(y)) for x, y in RNG.uniform([0.02, 0.02], [0.29, 0.21], (8, 2))]
GAINS = Uncertainty(thickness=0.0, stiffness=0.0, damping=1.0, fingertip=0.0)


@cache
def table(uncertainty: Uncertainty | None = None) -> LocalizationTable:
    """Of four ERAs and a mass."""
    rig = replace(smooth_rig(), masses=(PointLoad(0.2, 0.05, mass=0.03),))
    return build_table(rig if uncertainty is None else replace(rig, uncertainty=uncertainty))


@pytest.mark.parametrize("fingers", [2, 5, 6])
@pytest.mark.parametrize("loads", [(), (0.3, 2.0, 1.0, 0.7, 1.5, 0.5, 1.0, 3.0)])
@pytest.mark.parametrize(
    ("uncertainty", "within"),
    # Exact for the gains; for the rest, the ERAs move as without the fingers.
    [(GAINS, 2e-3), (replace(GAINS, stiffness=0.1), 0.1), (replace(GAINS, damping=1.5), 0.1)],
)
@pytest.mark.usefixtures("kernels_or_numpy")
def test_bound_and_amplitude_are_those_of_the_exact_forms(
    fingers: int,
    loads: tuple[float, ...],
    uncertainty: Uncertainty,
    within: float,
) -> None:
    """Of the weights that minimise the mean over the quiet fingers."""
    of = table(uncertainty)
    tips, loads = of.read_fingertips(PLACES[:fingers]), loads[:fingers]
    few, weights = tips.few, tips.few_weights
    found = Preselection(of.attached, of.error_power).scores(few, weights, loads)
    if fingers > 5:  # of the centres alone
        few, weights = few[:, :1], np.ones((fingers, 1), dtype=np.float32)
    contacts = load_contacts(of.attached, few, weights, of.error_power, loads)
    R = contacts.power[:, 1:].mean(axis=1).astype(complex)
    c = np.einsum("p,fpn->fn", weights[0], contacts.fields[:, 0]).conj()
    w = np.linalg.solve(R, c[:, :, None])[:, :, 0]
    value = np.einsum("fn,fn->f", c.conj(), w).real
    assert found[0] == pytest.approx(np.sqrt(value), rel=within)
    assert found[1] == pytest.approx(value / np.abs(w).max(axis=1), rel=3 * within)


def test_both_ways_rank_alike(without_kernels: Callable[[], None]) -> None:
    """With all uncertainties, within rounding."""
    of = table()
    tips = of.read_fingertips(PLACES[:3])
    by_kernel = Preselection(of.attached, of.error_power).scores(tips.few, tips.few_weights)
    without_kernels()
    by_numpy = Preselection(of.attached, of.error_power).scores(tips.few, tips.few_weights)
    assert np.array(by_kernel) == pytest.approx(np.array(by_numpy), rel=5e-4)


def test_answers_lose_little(monkeypatch: pytest.MonkeyPatch) -> None:
    """Against a search of all frequencies: 0.1 dB in the mean, and the level is as high."""
    of = table()
    pairs = [
        Question((PLACES[at],), (*PLACES[:at], *PLACES[at + 1 : at + 1 + more]))
        for at in range(4)
        for more in (1, 2, 4)
    ]
    some = [of.query(each) for each in pairs]
    monkeypatch.setattr(Preselection, "rows", lambda *given: given[4])
    every = [of.query(each) for each in pairs]
    lost = [
        (a.robust_felt_contrast_db or 0) - (b.robust_felt_contrast_db or 0)
        for a, b in zip(every, some, strict=True)
    ]
    assert np.mean(lost) < 0.1
    assert all(
        b.robust_level_db_sl > min(a.robust_level_db_sl, 20) - 0.1
        for a, b in zip(every, some, strict=True)
    )


def test_level_that_no_kept_frequency_reaches_is_sought_at_all(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Where the ranking keeps a frequency that is too weak the answer is that of all."""
    of = table()
    question = Question((PLACES[0],), (PLACES[1],), level_db_sl=30.0)
    monkeypatch.setattr(Preselection, "rows", lambda *given: given[4])
    best = of.query(question)
    frequency = next(iter(best.excitation.values())).frequency
    monkeypatch.setattr(Preselection, "rows", lambda *_: np.array([0]))  # 40 Hz
    assert next(iter(of.query(question).excitation.values())).frequency == frequency > 40


def test_prepared_table_goes_to_another_process() -> None:
    """With what it has computed ahead; its answers are the same there."""
    of = table()
    question = Question((PLACES[0],), (PLACES[1],))
    pattern = of.query(question)
    assert pickle.loads(pickle.dumps(of)).query(question).excitation == pattern.excitation
