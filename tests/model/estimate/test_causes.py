"""What lies on a plate or is beyond tolerances, on plates that another solver computes."""

import numpy as np
import pytest

from benchmarks.identification.causes import FAULTS, verdict_on
from benchmarks.identification.hidden import draw
from model.estimate.diagnosis_report import as_json, verdict_rows


@pytest.mark.parametrize(
    ("name", "seed"),
    [
        ("none", 112),
        ("none", 113),
        ("none, with form errors and 3 g", 119),
        ("none, with form errors and 3 g", 404),
    ],
)
def test_diagnose_passes_plates_within_tolerances(rig, name, seed):
    """Dampers at 2.3 to 3.8 times what is written, of a spread by 1.5, and 3 g in one place.

    At last 10 mm from an edge.
    """
    assert verdict_on(rig, name, seed).is_well


@pytest.mark.parametrize(
    ("name", "seed", "word"),
    [
        ("bonded frame", 204, "UNNAMED"),
        ("thickness ± 3 % from end to end", 1, "THICKNESS"),
        ("the same with form errors and 3 g", 203, "THICKNESS"),
        ("a resting finger", 1, "FINGER"),
        ("10 g", 1, "MASS"),
    ],
)
def test_diagnose_names_what_is_beyond_tolerances(rig, name, seed, word):
    """Each is what it is, and fails the check though the plate matches.

    Of the frame a spring is 3.9 standard deviations off, which modes that are farther off explain.
    """
    verdict = verdict_on(rig, name, seed)
    assert FAULTS[name].is_named(verdict)
    assert verdict.plate_matches
    assert not verdict.is_well
    assert verdict_rows(verdict)[-1].partition(":")[0] == word


def test_diagnose_places_and_weighs_a_mass(rig):
    """10 g within 1 g, and within a centimetre and a half of where it lies."""
    verdict = verdict_on(rig, "10 g", 2)
    beyond = as_json(verdict)["plate"]["beyond"]
    at = np.random.default_rng([2, 93]).uniform(0.1, 0.9, 2) * [0.3048, 0.2286]
    (load,) = beyond["loads"]
    assert load["mass_kg"] == pytest.approx(0.010, abs=1e-3)
    assert np.hypot(load["x_m"] - at[0], load["y_m"] - at[1]) < 0.015


def test_diagnose_places_and_weighs_two_masses(rig):
    """Twice 5 g, each within 1.5 g, and within a centimetre of where it lies."""
    beyond = verdict_on(rig, "twice 5 g, with form errors", 401).beyond
    assert beyond.kind == "mass"
    for x, y, mass in draw("two", 401).mounted.masses.tolist():
        (near,) = (each for each in beyond.loads if np.hypot(each.x - x, each.y - y) < 0.01)
        assert near.mass == pytest.approx(mass, abs=1.5e-3)
