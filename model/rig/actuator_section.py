"""Keys that actuators of every kind have below `eras` in a rig file."""

from typing import Annotated

from pydantic import ConfigDict, Field

from model.config.sections import Section
from model.rig.key_types import GAINS, Foot, GainRow, Identifier, Place


class ActuatorSection(Section):
    """What actuators of every kind have."""

    model_config = ConfigDict(
        json_schema_extra={
            "dependentRequired": {"amplifier": ["channel"], "channel": ["amplifier"]}
        }
    )

    at: Place
    """`[x, y]` where it acts on the plate; on the plate, at most one per position."""

    amplifier: Identifier | None = None
    """The amplifier that drives it; none for an ERA that only supports the plate.

    Limits: a name under `amplifiers`
    """

    channel: Annotated[int, Field(ge=0, le=255)] | None = None
    """Its channel; unique per ERA, none without an amplifier."""

    foot: Foot = 0.0
    """Radius of the disc on which it presses, 0 for a point as in the paper; only the part on the
    plate counts. Required from a stiffness of 1 MN/m: [points and
    feet](../concepts/plate-model.md#points-and-feet).
    """

    gains: Annotated[list[GainRow], Field(max_length=2000), GAINS] | None = None
    """`[[frequency in Hz, magnitude, phase in degrees], ...]`: its drive by a level, in full
    levels, measured by `era calibrate` ([calibration](../how-to/calibration.md)); linear in
    between, constant outside, 1 without rows.

    Limits: rows by ascending frequency
    """
