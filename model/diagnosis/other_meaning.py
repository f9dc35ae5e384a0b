"""What a rig's file says the wrong way round of two, found before anything is fitted to it."""

from typing import TypeAlias

from model.calibration.fit import SensedPlate, plate_of
from model.calibration.responses import Responses
from model.diagnosis.assignment import ShapeMatch, match_shapes
from model.diagnosis.grain_direction import TurnedGrain, turned_grain
from model.diagnosis.resonance_meaning import MisreadResonance, misread_resonance
from model.errors import InputError
from model.rig.rig import Rig

OtherMeaning: TypeAlias = TurnedGrain | MisreadResonance
"""A rig with the other of two values, of which the measurement clearly is."""


def other_meaning(
    plate: SensedPlate, shapes: ShapeMatch, observation: Responses
) -> OtherMeaning | None:
    """Find what the rig of a plate says the wrong way round, the grain first; None for nothing.

    shapes: of the observation, by that plate.
    """
    return turned_grain(plate, shapes, observation) or misread_resonance(plate, shapes, observation)


def check_meaning(rig: Rig, observation: Responses) -> None:
    """Raise InputError for a rig that clearly says something the wrong way round."""
    plate = plate_of(rig, observation)
    found = other_meaning(plate, match_shapes(plate, observation.values), observation)
    if found:
        raise InputError(str(found))
