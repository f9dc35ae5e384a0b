"""Studies of layouts from Python."""

import numpy as np
import pytest

import era_haptics as era
from model.fem.assembly import assemble
from model.fem.harmonic import direct_acceleration
from model.vibration.activation import equal_area_points
from paper_plate import make_paper_rig

FREQUENCIES = (60.0, 110.0, 250.0)


def test_study_ranks_layouts_by_what_a_direct_solution_gives() -> None:
    """The median over the plate of the peaks of one ERA, frequencies added; no other has more."""
    rig = make_paper_rig(12, 9)
    found = era.study(rig, layouts=6, active="1", frequencies=FREQUENCIES, candidates=(7, 5))
    medians = [one.median for one in found]
    assert medians == sorted(medians, reverse=True)
    best = found[0]
    points = equal_area_points(rig.plate, frequency_max=max(FREQUENCIES))
    matrices = assemble(rig.plate, rig.mesh)
    each = direct_acceleration(matrices, best.eras, np.array(FREQUENCIES), points)
    peaks = dict(zip((one.name for one in best.eras), np.abs(each).sum(axis=0), strict=True))
    assert best.median == pytest.approx(np.median(peaks[best.driven[0]]), rel=1e-4)
    assert best.median == pytest.approx(max(map(np.median, peaks.values())), rel=1e-4)
    assert best.maximum == pytest.approx(peaks[best.driven[0]].max(), rel=1e-4)


@pytest.mark.parametrize("wrong", [{"what": "places"}, {"active": "3"}, {"layouts": 0}])
def test_study_refuses(wrong: dict[str, object]) -> None:
    """Names that are no study or drive, and no layouts."""
    with pytest.raises(era.InputError):
        era.study(make_paper_rig(12, 9), **wrong)  # type: ignore[arg-type]
