"""Parameters of a plate that a fit can change, one class per kind.

A kind is, for example, the stiffness of the ERAs: one parameter per ERA, the logarithm of a factor
on the rig's value. Its class defines

- `names`: the names of its parameters for a given rig;
- `prior` and `datasheet_prior`: their uncertainty before a fit, for an installed rig and for a rig
  described only by data sheets;
- `value`: the value of the rig that they represent;
- `derivative`: the derivatives of the plate's responses with respect to them.

Base classes are in `model.estimate.parameter_kinds`; kinds of the plate, of ERAs and other
attachments, and of sensors and form errors are in a module each.

To add a kind, write a class, add it to `ALL_KINDS`, and use its value (`values[name]`) in
`model.estimate.forward`. `jacobian` collects the derivatives of all kinds.
`tests/model/estimate/test_identify.py` compares every derivative with a difference quotient.
"""

import numpy as np
from numpy.typing import NDArray

from model.arrays import ComplexArray
from model.estimate.derivatives import ResponseDerivatives
from model.estimate.era_parameters import (
    AddedMasses,
    BoltMass,
    Damping,
    DampingAdded,
    DampingOfEra,
    DriveDrag,
    DriveGain,
    DriveInertia,
    DrivePhase,
    EraLocation,
    FootStiffness,
    ForceFactor,
    MagnetMass,
    Stiffness,
)
from model.estimate.forward import PlateAt
from model.estimate.parameter_kinds import DifferentiableKind, FormError
from model.estimate.plate_parameters import (
    LossAdded,
    LossExponent,
    LossFactor,
    ModeLoss,
    ModeStiffness,
    ModulusFactor,
    ThicknessFactor,
)
from model.estimate.sensor_parameters import (
    ForeignMass,
    LossLaw,
    PoissonRatio,
    SensorGain,
    SensorPhase,
    SensorPosition,
    SensorScale,
    SideLength,
)

ALL_KINDS: tuple[DifferentiableKind, ...] = (
    ThicknessFactor(),
    ModulusFactor(),
    Stiffness(),
    Damping(),
    DampingOfEra(),
    DampingAdded(),
    LossFactor(),
    LossAdded(),
    LossExponent(),
    DriveGain(),
    DrivePhase(),
    DriveInertia(),
    DriveDrag(),
    SensorGain(),
    SensorPhase(),
    BoltMass(),
    MagnetMass(),
    ForceFactor(),
    EraLocation(),
    AddedMasses(),
    ModeStiffness(),
    ModeLoss(),
    FootStiffness(),
    SensorScale(),
    SensorPosition(),
    ForeignMass(),
    SideLength(),
    PoissonRatio(),
    LossLaw(),
)
"""All kinds of parameters, in the order in which a space lists them."""

PARAMETER_KINDS: dict[str, DifferentiableKind] = {kind.name: kind for kind in ALL_KINDS}
"""All kinds of parameters by name."""

FORM_ERRORS = tuple(kind.name for kind in ALL_KINDS if isinstance(kind, FormError))
"""Names of the kinds that only a plate with form errors has."""


def jacobian(plate: PlateAt, searched: NDArray[np.bool_] | None = None) -> ComplexArray:
    """Derivatives of the responses of a plate by x, (f, s, n, p).

    searched (p,): mask of the requested parameters, default all; kinds without any get zeros.
    """
    space = plate.model.space
    is_requested = space.uncertain
    if searched is not None:
        is_requested = is_requested & searched
    derivatives = ResponseDerivatives(plate)
    slopes = np.zeros((*plate.responses.shape, space.size), dtype=complex)
    for name, part in space.groups.items():
        if is_requested[part].any():
            slopes[..., part] = PARAMETER_KINDS[name].derivative(derivatives) * space.std[part]
    return slopes
