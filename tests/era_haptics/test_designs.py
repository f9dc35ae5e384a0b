"""Layouts of ERAs from Python."""

import pytest

import era_haptics as era
from model.design import problem
from paper_plate import make_paper_rig


def test_design_ranks_given_layouts_by_contrast(monkeypatch: pytest.MonkeyPatch) -> None:
    """Judged ones first, in the order of their contrast, then by score, unsupported ones last."""
    monkeypatch.setattr(problem, "JUDGED_SETS", 3)
    monkeypatch.setattr(problem, "SEARCH_FINGERS", 6)
    found = era.design(make_paper_rig(12, 9), layouts="random:8", finalists=2)
    assert len(found) == 8
    contrasts = [each.contrast for each in found]
    assert contrasts[2:] == [None] * 6
    assert contrasts[0] >= contrasts[1]
    scores = [each.expected_contrast for each in found[2:] if each.expected_contrast is not None]
    assert scores == sorted(scores, reverse=True)
    assert all(len(each.eras) == 4 for each in found)


@pytest.mark.parametrize(
    "wrong",
    [
        {"eras": 2},
        {"eras": 4.5},
        {"layouts": "random:0"},
        {"layouts": "nosuch.yaml"},
        {"layouts": "random:3", "finalists": 0},
        {"lowest": 0.5},
        {"apart": "wide"},
    ],
)
def test_design_refuses(wrong: dict[str, object]) -> None:
    """Too few ERAs, no whole number, no layouts, no file, no finalists, too low a mode, a word."""
    with pytest.raises(era.InputError):
        era.design(make_paper_rig(12, 9), **wrong)  # type: ignore[arg-type]
