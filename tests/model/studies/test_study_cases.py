"""Cases of studies: layouts by seed, each once, and their ERAs."""

from dataclasses import replace
from math import comb

import numpy as np
import pytest

from model.errors import InputError
from model.structure.actuator import damping_from_ratio
from model.studies.cases import OWN
from model.studies.kinds import (
    STIFFNESS_FACTORS,
    STUDIES,
    count_cases,
    placement_cases,
    stiffness_cases,
)
from model.studies.ranking import era_counts
from paper_plate import make_paper_rig


@pytest.fixture(scope="module")
def rig():
    """The paper's plate; no case is solved here."""
    return make_paper_rig(12, 9)


def layouts_of(cases):
    """Every layout as a set of positions in micrometres."""
    return [
        frozenset(map(tuple, (cases.positions_of(case) * 1e6).round().astype(int).tolist()))
        for case in range(len(cases))
    ]


def test_placement_cases_start_with_the_rig_and_named_layouts(rig):
    """Its own layout is the paper's corners and is not repeated."""
    cases = placement_cases(rig, layouts=30, seed=0, raster=(13, 13))
    assert cases.names[:3] == (OWN, "mid-edges", "long edges")
    assert "corners" not in cases.names
    assert cases.names[7] == "4-000001"
    assert cases.eras_of(0, rig.eras) == rig.eras


@pytest.mark.parametrize("study", STUDIES)
def test_cases_depend_on_the_seed(rig, study):
    """The same seed gives the same cases, another one others."""
    first, again, other = (
        STUDIES[study](rig, layouts=40, seed=seed, raster=(13, 13)) for seed in (3, 3, 4)
    )
    assert first.names == again.names
    assert (first.places == again.places).all()
    assert not (first.places == other.places).all()


@pytest.mark.parametrize("raster", [(13, 13), (7, 5)], ids=["drawn", "shuffled"])
def test_placement_cases_of_a_longer_study_start_with_the_same(rig, raster):
    """Asking for more keeps those that were solved before."""
    few = placement_cases(rig, layouts=50, seed=1, raster=raster)
    many = placement_cases(rig, layouts=20_000, seed=1, raster=raster)
    assert many.names[:50] == few.names
    assert (many.places[:50] == few.places).all()


def test_placement_cases_exhaust_a_small_raster(rig):
    """On 3x2 places there are C(6, 4) layouts, and named ones that lie between: no more."""
    cases = placement_cases(rig, layouts=1000, seed=0, raster=(3, 2))
    layouts = layouts_of(cases)
    random = [name for name in cases.names if name.startswith("4-")]
    assert len(set(layouts)) == len(layouts)
    assert len(random) == comb(6, 4) - 1  # the corners are the rig's own


def test_placement_cases_keep_parameters_of_unequal_eras(rig):
    """A stiffer SW stays the stiffer one, wherever it goes; its places are not sorted away."""
    different = (replace(rig.eras[0], stiffness=30_000.0), *rig.eras[1:])
    unequal = replace(rig, eras=different)
    cases = placement_cases(unequal, layouts=300, seed=0, raster=(13, 13))
    for case in (1, 9, 299):
        eras = cases.eras_of(case, different)
        assert [era.name for era in eras] == ["SW", "SE", "NE", "NW"]
        assert [era.stiffness for era in eras] == [30_000.0, 17_000.0, 17_000.0, 17_000.0]
    assert (np.diff(cases.places[10:], axis=1) < 0).any()


def test_count_cases_keep_the_damping_ratio(rig):
    """Two ERAs carry half the plate each: c = 2 zeta sqrt(k m / 2), by the definition."""
    cases = count_cases(rig, layouts=60, seed=0, raster=(13, 13))
    counts = era_counts(cases)
    assert sorted(set(counts.tolist())) == [1, 2, 3, 4, 5, 6]
    assert [int((counts == count).sum()) for count in range(1, 7)] == [10] * 6
    for case in (int(np.flatnonzero(counts == count)[0]) for count in (1, 2, 6)):
        eras = cases.eras_of(case, rig.eras)
        assert eras[0].damping == pytest.approx(
            damping_from_ratio(
                0.05, stiffness=17_000.0, plate_mass=rig.plate.mass, era_count=len(eras)
            )
        )
        assert [era.name for era in eras] == [f"E{number + 1}" for number in range(len(eras))]


def test_stiffness_cases_scale_all_eras_and_keep_the_damping_ratio(rig):
    """Each layout comes nine times, from a sixteenth to sixteen times as stiff."""
    cases = stiffness_cases(rig, layouts=4, seed=0, raster=(13, 13))
    assert len(cases) == 4 * len(STIFFNESS_FACTORS) == 36
    eras = cases.eras_of(8, rig.eras)
    assert [(era.x, era.y) for era in eras] == [(era.x, era.y) for era in rig.eras]
    assert {era.stiffness for era in eras} == {16 * 17_000.0}
    assert eras[0].damping == pytest.approx(4 * rig.eras[0].damping)


@pytest.mark.parametrize("study", STUDIES)
def test_cases_refuse_too_few_layouts(rig, study):
    """A count study needs a layout for each of 1 to 6 ERAs, and equal ERAs; others need one."""
    with pytest.raises(InputError, match="layouts"):
        STUDIES[study](rig, layouts=5 if study == "count" else 0, seed=0, raster=(13, 13))
    unequal = replace(rig, eras=(replace(rig.eras[0], stroke=50e-6), *rig.eras[1:]))
    with pytest.raises(InputError, match="alike"):
        count_cases(unequal, layouts=60, seed=0, raster=(13, 13))
