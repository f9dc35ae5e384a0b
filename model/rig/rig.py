"""A rig: one plate, the ERAs under it, and which amplifier channel drives which ERA."""

import hashlib
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from numbers import Real
from typing import Any

from model.errors import InputError
from model.fem.mesh import Mesh
from model.structure.actuator import Era
from model.structure.laminate import Laminate
from model.structure.plate import Plate
from model.structure.point_load import PointLoad
from model.structure.point_mass import PointMass

# Two bolts cannot be closer [m].
SAME_POINT = 1e-6


@dataclass(frozen=True)
class Channel:
    """Where an ERA is wired: an amplifier by its name in the rig, and the channel's number."""

    amplifier: str
    number: int


@dataclass(frozen=True)
class Limits:
    """What no command may exceed: mechanical frequencies [Hz] and level (1 is full stroke).

    slew [1/s]: how fast a level may rise. For each amplifier by itself: power, the sum of the
    squared levels of its channels; on_time [s], how long it may vibrate without a pause; duty,
    which share of any ten seconds; rate [1/s], how many command sets that are not silent.
    """

    frequency_min: float
    frequency_max: float
    level: float
    slew: float = math.inf
    power: float = math.inf
    on_time: float = math.inf
    duty: float = 1.0
    rate: float = math.inf


@dataclass(frozen=True)
class Rig:
    """Everything that is fixed once the hardware is built.

    wiring: a channel per ERA, by the ERA's name; amplifiers: URL by name; masses: what the plate
    carries; laminate: what the plate, then an equivalent one, is made of, for showing.
    """

    plate: Plate
    mesh: Mesh
    eras: tuple[Era, ...]
    wiring: Mapping[str, Channel]
    amplifiers: Mapping[str, str]
    limits: Limits
    masses: tuple[PointMass, ...] = ()
    laminate: Laminate | None = None

    def __post_init__(self) -> None:
        """Refuse ERAs and masses off the plate, and two ERAs at one point or of one name."""
        for what, place in (
            *((f"ERA {era.name}", (era.x, era.y)) for era in self.eras),
            *(("point mass", (mass.x, mass.y)) for mass in self.masses),
        ):
            if not self.plate.contains(*place):
                raise InputError(
                    f"{what} at ({place[0]:g}, {place[1]:g}) m is off the plate, which reaches "
                    f"from (0, 0) to ({self.plate.length:g}, {self.plate.width:g}) m"
                )
        for number, era in enumerate(self.eras):
            for other in self.eras[:number]:
                if era.name == other.name:
                    raise InputError(f"two ERAs have the name {era.name}; rename one")
                if math.dist((era.x, era.y), (other.x, other.y)) < SAME_POINT:
                    raise InputError(
                        f"ERAs {other.name} and {era.name} are both at ({era.x:g}, {era.y:g}) m; "
                        "move one of them"
                    )

    def era(self, name: str) -> Era:
        """The ERA of this name; KeyError if the rig has none."""
        for era in self.eras:
            if era.name == name:
                return era
        raise KeyError(name)

    @property
    def loads(self) -> tuple[PointLoad, ...]:
        """What the plate carries, as what is attached to it."""
        return tuple(PointLoad(mass.x, mass.y, mass=mass.mass) for mass in self.masses)

    @property
    def fingerprint(self) -> str:
        """Fingerprint of the plate on its ERAs; see `physics_fingerprint`."""
        return physics_fingerprint(self.plate, self.eras, masses=self.masses)


def physics_fingerprint(
    plate: Plate, eras: Sequence[Era], *, masses: Sequence[PointMass] = ()
) -> str:
    """SHA-256 over plate, ERAs and masses, which decide the plate's response; not mesh or wiring.

    Rigs with the same fingerprint share localization tables, whatever their material is called.
    """
    numbers = _as_floats(asdict(plate))
    del numbers["material"]["name"]
    # ERAs without gains have the fingerprint of a rig that has no such key.
    held = [
        {key: value for key, value in _as_floats(asdict(era)).items() if key != "gains" or value}
        for era in eras
    ]
    physics = {
        "plate": numbers,
        "eras": held,
        "masses": sorted((float(m.x), float(m.y), float(m.mass)) for m in masses),
    }
    return hashlib.sha256(canonical_json(physics).encode()).hexdigest()


def canonical_json(value: object) -> str:
    """JSON of plain data with sorted keys, the same for 1 and 1.0, and for -0.0 and 0.0."""
    return json.dumps(_with_floats(value), sort_keys=True, separators=(",", ":"))


def _with_floats(value: object) -> object:
    match value:
        case bool() | str() | None:
            return value
        case Real():
            return float(value) + 0.0
        case Mapping():
            return {key: _with_floats(each) for key, each in value.items()}
        case Iterable():
            return [_with_floats(each) for each in value]
        case _:
            raise TypeError(f"no plain data: {type(value).__name__}")


def _as_floats(value: Any) -> Any:
    """Numbers as floats wherever they are: 1 is the same stiffness as 1.0."""
    if isinstance(value, Mapping):
        return {key: _as_floats(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_as_floats(entry) for entry in value]
    return float(value) if isinstance(value, Real) else value
