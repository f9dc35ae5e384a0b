"""Which channels push where the others pull, from phases of the drive."""

import math

import numpy as np
import pytest

from model.calibration.responses import Responses
from model.diagnosis.polarity import phases_of_drive


@pytest.mark.parametrize(
    ("degrees", "sign"), [(0.0, 1), (80.0, 1), (-80.0, 1), (100.0, -1), (-100.0, -1), (180.0, -1)]
)
def test_phases_of_drive_inverts_beyond_a_quarter_turn(degrees: float, sign: int) -> None:
    """Measured is what was predicted, turned by an angle; that is found, and the nearer sign."""
    rng = np.random.default_rng(0)
    predicted = rng.standard_normal((5, 1, 4)) + 1j * rng.standard_normal((5, 1, 4))
    turned = predicted * np.exp(1j * math.radians(degrees))
    observation = Responses(
        tuple("ABCD"), np.zeros((4, 2)), np.arange(5.0), turned, has_phases=True
    )
    (phase,) = phases_of_drive(observation, predicted)
    assert phase.degrees == pytest.approx(degrees, abs=1e-6)
    assert phase.sign == sign
    assert phase.confidence == pytest.approx(1.0)
