"""Rigs and plates of the simulation's tests."""

from dataclasses import replace

import pytest

from model.reduction.reduced_plate import ReducedPlate, reduce_plate
from model.rig.rig import Channel, Rig
from model.structure.attachments import footprints_of


@pytest.fixture(scope="session")
def reduced(coarse_rig: Rig) -> ReducedPlate:
    """The paper's plate on its own mesh, for forces at its ERAs."""
    return reduce_plate(coarse_rig.plate, coarse_rig.mesh, footprints_of(coarse_rig.eras))


@pytest.fixture(scope="session")
def two_amplifiers(coarse_rig: Rig) -> Rig:
    """The paper's plate; two ERAs on one amplifier, two on another."""
    channels = [Channel(name, number) for name in ("left", "right") for number in (0, 1)]
    wiring = dict(zip(coarse_rig.wiring, channels, strict=True))
    return replace(coarse_rig, wiring=wiring, amplifiers={"left": "sim://", "right": "sim://"})
