"""Keys that actuators of every kind have below `eras` in a rig file, and what each kind adds."""

from abc import abstractmethod
from collections.abc import Iterator, Mapping
from typing import Annotated, Any, ClassVar

from pydantic import ConfigDict, Field

from model.config.fields import Section
from model.rig.key_types import GAINS, Foot, GainRow, Identifier, Place
from model.structure.actuators import Actuator
from model.structure.plate import Plate


class ActuatorSection(Section):
    """What actuators of every kind have; each kind extends it by its own."""

    keys: ClassVar[Mapping[str, str]]
    """By field of the actuator that a fit changes."""

    instead: ClassVar[Mapping[str, tuple[str, ...]]]
    """Keys that some of them replace: these are always written, whatever else of a rig changes."""

    is_electrical: ClassVar[bool] = False
    """Whether its full level is a voltage, so that an amplifier which drives it is an output."""

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

    @abstractmethod
    def made(self, name: str, plate: Plate, count: int) -> Actuator:
        """The actuator of a name on a plate; count: of the rig's actuators."""

    @classmethod
    @abstractmethod
    def problems(cls, given: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
        """What keys require of each other: problems by key.

        given: keys of a file with the values of those that are valid by themselves, else None.
        """
