"""A plate in time whose equations of motion cannot be taken apart."""

from dataclasses import replace

import numpy as np
import pytest

from model.errors import InputError
from model.reduction.reduced_plate import ReducedPlate
from model.structure.attachments import Era
from model.structure.materials import material
from model.structure.plate import Plate
from model.transients.time_response import plate_in_time

ERA = Era("", 0, 0, stiffness=100.0**2, damping=2 * 100.0, bolt_mass=0.0, stroke=1e-4)
"""Under one kilogram it is damped critically, in numbers that are exact."""


PLATE = Plate(0.3, 0.2, 0.001, material("steel"), loss_factor=0.0)
THREE_MASSES = ReducedPlate(
    PLATE, np.zeros(3), np.zeros(3), lambda points: np.eye(3)[: len(points)]
)
"""A kilogram on each of three ERAs, and nothing between them: as few coordinates as stand."""


@pytest.mark.parametrize("mass", [0.0, 3.0])
def test_plate_in_time_refuses_critical_damping(mass: float) -> None:
    """c = 2 sqrt(k m): two eigenvectors are one, and nothing must be computed with their inverse.

    With 1 + 3 kg and twice the damping as well, there the numbers make it singular altogether.
    """
    factor = (1 + mass) ** 0.5
    era = replace(ERA, bolt_mass=mass, damping=factor * ERA.damping)
    eras = [replace(era, x=x, y=y) for x, y in ((0.0, 0.0), (0.1, 0.0), (0.0, 0.1))]
    with pytest.raises(InputError, match="damped critically"):
        plate_in_time(THREE_MASSES, eras)
    softer = [replace(each, damping=0.999 * era.damping) for each in eras]
    solved = plate_in_time(THREE_MASSES, softer)
    assert np.abs(solved.eigenvalues) == pytest.approx(100 / factor)
