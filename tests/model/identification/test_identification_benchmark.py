"""The benchmark of identification in its short form: one hard plate."""

import numpy as np
import pytest

from benchmarks.identification.answers import table_of
from benchmarks.identification.hidden import draw
from benchmarks.identification.plates import FREQUENCIES, outcome
from model.rig.rig_file import example_rig_path, load_rig


@pytest.mark.long
def test_hard_plate_gives_the_contrast_of_the_plate_known() -> None:
    """Identified, weightless fingers feel within 2 dB of the plate known, and more than before."""
    rig = load_rig(example_rig_path())
    written = {loaded: table_of(rig, FREQUENCIES, loaded=loaded) for loaded in (False, True)}
    found = outcome(draw("hard", 1), rig, written, "hard", 1, sets=2)
    assert found.chi2 < 1.5
    mean = {
        way: np.mean([found.contrasts[way, False, quiet] for quiet in (1, 2, 3)])
        for way in ("written", "identified", "known")
    }
    assert abs(mean["identified"] - mean["known"]) < 2
    assert mean["identified"] > mean["written"] + 2
