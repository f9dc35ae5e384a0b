"""Ranking of frequencies, against an eigenvalue problem and answers that search all of them."""

import pickle
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.linalg import eigh

from model.drive_modes import preselection
from model.drive_modes.preselection import KEPT, MISSING, preselect
from model.structure.attachments import PointLoad
from model.table.build import build_table
from model.table.question import Question
from model.table.table import LocalizationTable
from paper_table import smooth_rig

RNG = np.random.default_rng(5)
PLACES = [(float(x), float(y)) for x, y in RNG.uniform([0.02, 0.02], [0.29, 0.21], (8, 2))]


@cache
def table() -> LocalizationTable:
    """Of four ERAs and a mass."""
    return build_table(replace(smooth_rig(), masses=(PointLoad(0.2, 0.05, mass=0.03),)))


def test_bound_and_level_are_those_of_the_best_weights_for_the_mean() -> None:
    """The frequency of the highest bound that reaches the level is kept, few that miss it.

    Bounds by a general optimiser: the largest eigenvalue of the target's form to the mean one.
    """
    of = table()
    forms = of.forms(Question((PLACES[0],), tuple(PLACES[1:4]), level_db_sl=20.0))
    c = forms.targets[0].conj().astype(complex)
    R = forms.quiet.mean(axis=1).astype(complex)
    bounds, levels = [], []
    for target, form in zip(c, R, strict=True):
        values, vectors = eigh(np.outer(target, target.conj()), form)
        bounds.append(values[-1])
        levels.append(abs(target.conj() @ vectors[:, -1]) / np.abs(vectors[:, -1]).max())
    reaches = np.array(levels) >= forms.wanted * forms.threshold
    mean = forms.quiet.mean(axis=1, keepdims=True)
    kept = preselect(replace(forms, quiet=mean, level_margin=0.0, few=None, fine=None))
    assert len(kept) == min(KEPT, int(reaches.sum()) + int((~reaches[kept]).sum()))
    assert int((~reaches[kept]).sum()) <= MISSING
    best = np.argsort(-np.array(bounds)[reaches])[: int(reaches[kept].sum())]
    assert set(np.flatnonzero(reaches)[best]) == set(kept[reaches[kept]])


def test_answers_lose_little(monkeypatch: pytest.MonkeyPatch) -> None:
    """Against a search of all frequencies: 0.1 dB in the mean, and the level is as high."""
    of = table()
    pairs = [
        Question((PLACES[at],), (*PLACES[:at], *PLACES[at + 1 : at + 1 + more]))
        for at in range(4)
        for more in (1, 2, 4)
    ]
    some = [of.query(each) for each in pairs]
    monkeypatch.setattr(preselection, "preselect", lambda forms: np.arange(forms.frequency_count))
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
    monkeypatch.setattr(preselection, "preselect", lambda forms: np.arange(forms.frequency_count))
    best = of.query(question)
    frequency = next(iter(best.excitation.values())).frequency
    monkeypatch.setattr(preselection, "preselect", lambda _: np.array([0]))  # 40 Hz
    assert next(iter(of.query(question).excitation.values())).frequency == frequency > 40


def test_prepared_table_goes_to_another_process() -> None:
    """With what it has computed ahead; its answers are the same there."""
    of = table()
    question = Question((PLACES[0],), (PLACES[1],))
    pattern = of.query(question)
    assert pickle.loads(pickle.dumps(of)).query(question).excitation == pattern.excitation
