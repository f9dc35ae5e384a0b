"""The plate of a desk, shared by its tests."""

import pytest

from kit.desk_plate import Truth, draw_truth
from model.rig.rig import Rig


@pytest.fixture(scope="session")
def truth(rig: Rig) -> Truth:
    """A plate that deviates from it, with actuators that resonate, on a coarse mesh."""
    return draw_truth(rig, seed=3, mesh="6x4 Q3")
