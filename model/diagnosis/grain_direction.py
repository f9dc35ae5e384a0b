"""Which side a board's grain runs along, by the shapes in which it responds.

Boards are cut both ways, and a file that names the wrong side describes another board: no modulus
makes up for it. Both are fitted as coarsely as wiring is first looked at, with a gain of each
channel and frequency and a few moduli and stiffnesses (`model.diagnosis.assignment.match_shapes`).
Boards as bought leave a quarter of their response unexplained in this way, or less, and half to
three quarters with their grain turned.
"""

from dataclasses import dataclass, replace

from model.calibration.fit import SensedPlate, plate_of
from model.calibration.responses import Responses
from model.diagnosis.assignment import ShapeMatch, match_shapes
from model.identification.identify import solved_for
from model.quantities import percent
from model.rig.rig import Rig

_CLEARLY = 0.6  # of the error as written
_MAX_ERROR = 0.45  # of a coarse fit of the right board, a fault beside


@dataclass(frozen=True)
class TurnedGrain:
    """A board whose grain runs along the other side than in its rig.

    rig: with its grain; along, as_written: the sides, `length` and `width`; error,
    error_as_written: shares of the responses that the coarse fits of either leave unexplained.
    """

    rig: Rig
    along: str
    as_written: str
    error: float
    error_as_written: float

    label = "GRAIN"

    def __str__(self) -> str:
        """What is wrong, and what to do."""
        return (
            f"plate.grain must be {self.along}, got {self.as_written}: with the grain along its "
            f"{self.along} a coarse fit leaves {percent(self.error)} of the responses unexplained, "
            f"along its {self.as_written} {percent(self.error_as_written)}; look at the veneer of "
            "its faces, and correct the rig"
        )


def turned_grain(
    plate: SensedPlate, shapes: ShapeMatch, observation: Responses
) -> TurnedGrain | None:
    """Find the board with its grain along the other side where that is clearly the measured one.

    shapes: of the observation, by the rig's plate. None for a board without a grain.
    """
    rig = plate.rig
    if rig.plate.material.orthotropy is None:
        return None
    turned = replace(rig.plate, material=rig.plate.material.turned())
    other = replace(rig, plate=turned)
    other = replace(other, mesh=solved_for(other, rig.limits.frequency_max).mesh)
    sensed = plate_of(other, observation)
    error = match_shapes(sensed, observation.values).error
    if error > min(_MAX_ERROR, _CLEARLY * shapes.error):
        return None
    as_written = rig.grain
    along = "length" if as_written == "width" else "width"
    return TurnedGrain(other, along, as_written, error, shapes.error)
