"""Studies of layouts from Python."""

import numpy as np
import pytest

import era_haptics as era
from model.fem.assembly import assemble
from model.fem.harmonic import direct_acceleration
from model.studies import finalists
from model.vibration.activation import equal_area_points
from paper_plate import make_paper_rig

FREQUENCIES = (60.0, 110.0, 250.0)


@pytest.fixture(autouse=True)
def few_sets(monkeypatch: pytest.MonkeyPatch) -> None:
    """Finalists are judged by few contact sets."""
    monkeypatch.setattr(finalists, "JUDGED_SETS", 3)


def test_study_ranks_by_contrast_and_states_loudness_as_a_direct_solution_does() -> None:
    """Finalists are in the order of their contrast; loudness is the sum of peaks of one ERA."""
    rig = make_paper_rig(12, 9)
    found = era.study(
        rig, layouts=6, active="1", finalists=2, frequencies=FREQUENCIES, candidates=(7, 5)
    )
    contrasts = [one.contrast for one in found[:2]]
    assert contrasts == sorted(contrasts, reverse=True)
    assert all(one.expected_contrast > 0 for one in found if one.support_problem is None)
    best = found[0]
    points = equal_area_points(rig.plate, frequency_max=max(FREQUENCIES))
    matrices = assemble(rig.plate, rig.mesh)
    each = direct_acceleration(matrices, best.eras, np.array(FREQUENCIES), points)
    peaks = dict(zip((one.name for one in best.eras), np.abs(each).sum(axis=0), strict=True))
    assert best.median == pytest.approx(np.median(peaks[best.driven[0]]), rel=1e-4)
    assert best.median == pytest.approx(max(map(np.median, peaks.values())), rel=1e-4)
    assert best.maximum == pytest.approx(peaks[best.driven[0]].max(), rel=1e-4)


@pytest.mark.parametrize(
    "wrong",
    [{"what": "places"}, {"active": "3"}, {"layouts": 0}, {"finalists": 0}, {"lowest": 0.5}],
)
def test_study_refuses(wrong: dict[str, object]) -> None:
    """Names that are no study or drive, no layouts, no finalists and too low a mode."""
    with pytest.raises(era.InputError):
        era.study(make_paper_rig(12, 9), **wrong)  # type: ignore[arg-type]
