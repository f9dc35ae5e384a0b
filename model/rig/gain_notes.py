"""What is not known of how bases follow the outputs of amplifiers, for `era config check`."""

import cmath
import math
from itertools import pairwise

from model.rig.rig import Rig
from model.structure.actuator import Era

_MAX_ANGLE = math.radians(20.5)  # between two rows


def gain_notes(rig: Rig) -> list[str]:
    """One warning for each ERA behind an output whose gains are missing, or rows too far apart."""
    behind = [era for era in rig.eras if rig.wiring[era.name].amplifier in rig.outputs]
    low, high = rig.limits.frequency_min, rig.limits.frequency_max
    return [text for era in behind for text in _notes(era, low, high)]


def _notes(era: Era, low: float, high: float) -> list[str]:
    if not era.gains:
        return [
            f"eras.{era.name}.gains: missing behind an output, so that its motion is a guess, a "
            "stroke by full level at every frequency; measure the plate and calibrate the rig"
        ]
    played = [each for each in pairwise(era.gains) if each[0][0] < high and each[1][0] > low]
    turns = {
        abs(cmath.phase(cmath.rect(1, other[2] - one[2]))): (one[0], other[0])
        for one, other in played
    }
    angle = max(turns, default=0.0)
    if angle <= _MAX_ANGLE:
        return []
    first, last = turns[angle]
    return [
        f"eras.{era.name}.gains: phases differ by {math.degrees(angle):.0f} degrees between "
        f"{first:g} and {last:g} Hz, at most 20 are interpolated well; measure between them"
    ]
