"""How far sources are off the places of a calibrated rig, as the rig states it."""

from collections.abc import Iterator

import numpy as np
import pytest

from benchmarks.calibration.hidden_plates import draw_plate, measure
from benchmarks.weekend import chain
from model.arrays import FloatArray
from model.calibration.calibrate import calibrate
from model.diagnosis.verdict import check_consistency
from model.rig.rig import Rig
from model.rig.rig_file import example_rig_path, load_rig


def _off(found: Rig, true: Rig) -> FloatArray:
    """Distances of places in a rig to the true ones along both sides, by the error it states.

    In shares of the sides, which a rig does not have by half a millimetre.
    """
    size = [found.plate.length, found.plate.width]
    places, at = (
        np.array([[era.x, era.y] for era in rig.eras]) / [rig.plate.length, rig.plate.width]
        for rig in (found, true)
    )
    return np.abs((places - at) * size).ravel() / found.uncertainty.place


def boards(seeds: range) -> Iterator[FloatArray]:
    """Exciters on wood, 1 mm off, of which one sensor is moved about twelve places."""
    rig = load_rig(chain.FOLDER / "rig.yaml")
    for seed in seeds:
        built, responses = chain.measured(rig, seed)
        yield _off(calibrate(rig, responses, check_consistency(rig, responses)).rig, built.rig)


def plates(seeds: range) -> Iterator[FloatArray]:
    """ERAs on aluminium, 1.5 mm off inwards, with form errors, of finite elements."""
    rig = load_rig(example_rig_path())
    for seed in seeds:
        hidden = draw_plate(rig, seed=seed)
        responses = measure(hidden, rig, seed=seed)
        yield _off(calibrate(rig, responses, check_consistency(rig, responses)).rig, hidden.rig)


@pytest.mark.parametrize(
    ("drawn", "by_one", "by_two"),
    [
        pytest.param(boards(range(1, 3)), (0.45, 0.9), 0.8, id="2-boards"),
        pytest.param(boards(range(3, 11)), (0.56, 0.8), 0.88, id="boards", marks=pytest.mark.long),
        pytest.param(plates(range(1, 7)), (0.56, 0.8), 0.85, id="plates", marks=pytest.mark.long),
    ],
)
def test_places_are_off_by_what_the_rig_states(
    drawn: Iterator[FloatArray], by_one: tuple[float, float], by_two: float
) -> None:
    """Normal distances: 68 % within one standard deviation, 95 % within two.

    To 2 standard deviations of such shares of 64 distances, and of 16 where there are few.
    """
    off = np.concatenate([*drawn])
    assert by_one[0] < np.mean(off < 1) < by_one[1]
    assert np.mean(off < 1.96) > by_two
