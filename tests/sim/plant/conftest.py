"""The plate of the plant's tests."""

import pytest

from model.reduction.reduced_plate import ReducedPlate, reduce_plate
from model.rig.rig import Rig
from model.structure.attachments import footprints_of


@pytest.fixture(scope="session")
def reduced(coarse_rig: Rig) -> ReducedPlate:
    """The paper's plate on its own mesh, for forces at its ERAs."""
    return reduce_plate(coarse_rig.plate, coarse_rig.mesh, footprints_of(coarse_rig.eras))
