"""A hidden plate, and the paper's rig identified on it."""

import numpy as np
import pytest

from benchmarks.identification.plates import Hidden, draw
from model.estimate.following import PlateEstimate
from model.estimate.forward import Sensor
from model.estimate.identify import Identification, identify
from model.estimate.measurement import Measurement
from model.rig.rig_file import example_rig_path, load_rig
from plates import SETTLED_PATTERNS_FREQUENCIES


@pytest.fixture(scope="session")
def hidden() -> Hidden:
    """A plate with places and a mass of its own."""
    return draw("form", 1)


@pytest.fixture(scope="session")
def found(hidden: Hidden) -> Identification:
    """The paper's rig identified on it."""
    rig = load_rig(example_rig_path())
    sensors = [Sensor(era.name, era.name) for era in rig.eras]
    values = hidden.measured(SETTLED_PATTERNS_FREQUENCIES, np.random.default_rng(1))
    return identify(rig, Measurement(sensors, SETTLED_PATTERNS_FREQUENCIES, values))


@pytest.fixture(scope="session")
def known(found: Identification) -> PlateEstimate:
    """What a daemon knows of that plate when it starts: what the identified rig states."""
    return PlateEstimate.of_rig(found.rig, found.fitted.model.sensors)
