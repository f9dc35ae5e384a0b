"""What people write for drives and places, and what they are told where it cannot be used."""

import math

import numpy as np
import pytest

import era_haptics as era
from era_haptics.drive import excitation_of
from era_haptics.places import as_points
from paper_plate import make_paper_rig

RIG = make_paper_rig(12, 9)


def test_a_drive_in_three_ways() -> None:
    """A bare frequency is full stroke, 100 µm; a share and degrees; physics as it is."""
    tone = era.Tone(250.0, 3e-5, 0.1)
    drives = {"SW": 110, "SE": era.Drive(110, level=0.25, phase_deg=-90), "NE": tone}
    assert excitation_of(drives, RIG) == {
        "SW": era.Tone(110, 1e-4, 0.0),
        "SE": era.Tone(110, 0.25e-4, -math.pi / 2),
        "NE": tone,
    }


def test_numbers_of_numpy_come_out_as_plain_ones() -> None:
    """Of single precision too, which would go on into every command; 110.5 and 0.25 are exact."""
    drive = era.Drive(np.float32(110.5), level=np.float32(0.25), phase_deg=np.float32(0))  # type: ignore[arg-type]
    tone = excitation_of({"SW": drive}, RIG)["SW"]
    assert tone == era.Tone(110.5, 0.25e-4, 0.0)
    assert {type(tone.frequency), type(tone.amplitude), type(tone.phase)} == {float}


@pytest.mark.parametrize(
    ("drives", "says"),
    [
        ({"XX": 110}, "no ERA 'XX', only SW, SE, NE, NW"),
        ({"XX": era.Tone(110, 1e-4)}, "no ERA 'XX', only SW, SE, NE, NW"),
        ({"SW": 0}, "a drive of 0 Hz is none"),
        ({"SW": math.inf}, "a drive of inf Hz is none"),
        ({"SW": "110 Hz"}, "frequency='110 Hz' of a drive is no number"),
    ],
)
def test_a_drive_that_is_none(drives: dict[str, float], says: str) -> None:
    """The ERA and what is wrong with what it shall play."""
    with pytest.raises(era.InputError, match=says):
        excitation_of(drives, RIG)


@pytest.mark.parametrize(
    ("level", "phase", "says"),
    [(1.1, 0, "level of 1.1"), (math.nan, 0, "level of nan"), (1, math.inf, "phase of inf")],
)
def test_a_level_that_is_none(level: float, phase: float, says: str) -> None:
    """Beyond full stroke, and what is no number."""
    with pytest.raises(era.InputError, match=says):
        era.Drive(110, level=level, phase_deg=phase)


@pytest.mark.parametrize(
    "places",
    [(0.1, 0.2), [0.1, 0.2], [(0.1, 0.2)], np.array([0.1, 0.2]), np.array([[0.1, 0.2]])],
)
def test_a_place_in_every_way(places: object) -> None:
    """One alone or in a list, as an array or not."""
    assert as_points(places, what="target") == ((0.1, 0.2),)


def test_several_places_and_none() -> None:
    """A list of places keeps their order, and any empty one, an array too, is no place."""
    assert as_points([(0.1, 0.2), (0.3, 0.1)], what="quiet") == ((0.1, 0.2), (0.3, 0.1))
    for nothing in ((), [], np.empty((0, 2))):
        assert as_points(nothing, what="quiet") == ()


@pytest.mark.parametrize("places", [(0.1,), (0.1, 0.2, 0.3), "SW", [(0.1, 0.2), (0.3,)], 0.1, None])
def test_a_place_that_is_none(places: object) -> None:
    """It says which argument, and what a place looks like."""
    with pytest.raises(era.InputError, match=r"target=.* is no place; .*\(0.08, 0.06\)"):
        as_points(places, what="target")
