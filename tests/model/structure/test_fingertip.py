"""The load of a fingertip against figures worked out by hand."""

import numpy as np
import pytest

from model.errors import InputError
from model.structure.attachments import Fingertip

HERTZ = np.array([60.0, 100.0, 250.0])


def test_dynamic_stiffness_of_a_phalanx_that_moves() -> None:
    """Real parts at 60, 100 and 250 Hz as worked out from the formula by hand."""
    found = Fingertip().dynamic_stiffness(2 * np.pi * HERTZ)
    assert found.real == pytest.approx([69, -87, -358], abs=1)
    assert (found.imag > 0).all()


def test_dynamic_stiffness_of_a_phalanx_at_rest() -> None:
    """A phalanx too heavy to move leaves spring, damper and contact mass."""
    found = Fingertip(phalanx_mass=1e9).dynamic_stiffness(2 * np.pi * HERTZ)
    assert found.real == pytest.approx([972, 921, 507], abs=1)
    assert found.imag == pytest.approx(2 * 2 * np.pi * HERTZ, rel=1e-4)


def test_scaled_contact_keeps_phalanx_and_joint() -> None:
    """Twice the contact has twice the pulp; at rest pulp and joint are springs in series."""
    at_rest = Fingertip().scaled(2).dynamic_stiffness(np.zeros(1))
    assert at_rest.real == pytest.approx(2000 * 500 / 2500)


@pytest.mark.parametrize("wrong", [{"damping": 0.0}, {"stiffness": -1.0}, {"phalanx_mass": np.nan}])
def test_refuses_what_no_finger_has(wrong: dict[str, float]) -> None:
    """Negative values, NaN, and a pulp without damping."""
    with pytest.raises(InputError):
        Fingertip(**wrong)
