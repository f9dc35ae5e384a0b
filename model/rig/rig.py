"""A rig: a plate, its ERAs, and the amplifier channel of each ERA."""

import hashlib
import json
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from numbers import Real

from model.errors import InputError
from model.finger.fingertip import FINGERTIP_RADIUS
from model.finger.perception import DEFAULT_THRESHOLD
from model.rig.uncertainty import Uncertainty
from model.spectral.mesh import PlateMesh
from model.structure.attachments import Era, Fingertip, PointLoad
from model.structure.plate import Laminate, Plate
from registry.limits import GuardLimits
from registry.suggestions import did_you_mean

# m; two bolts cannot be closer
SAME_POINT = 1e-6


@dataclass(frozen=True)
class Channel:
    """The wiring of an ERA: an amplifier by its name in the rig, and the number of its channel."""

    amplifier: str
    number: int


@dataclass(frozen=True)
class Rig:
    """A plate on its ERAs, with wiring and limits.

    eras: those that are driven. wiring: channel by the name of the ERA; amplifiers: URL by name;
    masses: on the plate, ERAs without an amplifier among them, whose names are supports; laminate:
    of which the plate is made, also where its layers are solved as a homogeneous one; uncertainty:
    of its parameters; fingertip: load of each finger on the plate, None for weightless ones;
    threshold: name of the set of detection thresholds (`model.finger.perception`); outputs: the
    amplifiers whose full level is an output, to which bases move by their gains, not a motion.
    """

    plate: Plate
    mesh: PlateMesh
    eras: tuple[Era, ...]
    wiring: Mapping[str, Channel]
    amplifiers: Mapping[str, str]
    limits: GuardLimits
    masses: tuple[PointLoad, ...] = ()
    laminate: Laminate | None = None
    uncertainty: Uncertainty = field(default_factory=Uncertainty)
    fingertip: Fingertip | None = field(default_factory=Fingertip)
    threshold: str = DEFAULT_THRESHOLD
    supports: tuple[str, ...] = ()
    outputs: frozenset[str] = frozenset()

    def __post_init__(self) -> None:
        """Check that ERAs and masses are on the plate, and places and names of ERAs unique."""
        for what, place in (
            *((f"ERA {era.name}", (era.x, era.y)) for era in self.eras),
            *(("point mass", (mass.x, mass.y)) for mass in self.masses),
        ):
            if not self.plate.contains(*place):
                raise InputError(
                    f"{what} must be on the plate, from (0, 0) to ({self.plate.length:g}, "
                    f"{self.plate.width:g}) m, got ({place[0]:g}, {place[1]:g}) m"
                )
        for number, era in enumerate(self.eras):
            for other in self.eras[:number]:
                if era.name == other.name:
                    raise InputError(
                        f"names of ERAs must be unique, got {era.name} twice; rename one"
                    )
                if math.dist((era.x, era.y), (other.x, other.y)) < SAME_POINT:
                    raise InputError(
                        f"ERAs must be at different places, got {other.name} and {era.name} at "
                        f"({era.x:g}, {era.y:g}) m; move one of them"
                    )

    def era(self, name: str) -> Era:
        """The ERA of a name; raises InputError for an unknown one."""
        eras = {era.name: era for era in self.eras}
        if name not in eras:
            meant = did_you_mean(str(name), eras)
            raise InputError(f"unknown ERA {name!r}; {meant}choose from {', '.join(eras)}")
        return eras[name]

    @property
    def channel_counts(self) -> Counter[str]:
        """Numbers of channels that are wired, by the amplifier's name."""
        return Counter(channel.amplifier for channel in self.wiring.values())

    @property
    def fingerprint(self) -> str:
        """Fingerprint of all that decides what is felt; see `physics_fingerprint`."""
        return physics_fingerprint(
            self.plate, self.eras, self.masses, self.uncertainty, self.fingertip, self.threshold
        )


def physics_fingerprint(
    plate: Plate,
    eras: Sequence[Era],
    masses: Sequence[PointLoad],
    uncertainty: Uncertainty,
    fingertip: Fingertip | None,
    threshold: str,
) -> str:
    """SHA-256 over all that decides what fingers feel; not mesh or wiring.

    Over plate, ERAs, masses, their uncertainty, and load, contact and thresholds of a finger. Rigs
    with the same fingerprint share localization tables, also with other names of materials.
    """
    numbers = asdict(plate)
    del numbers["material"]["name"]
    # A laminate is its layers; what it is like depends on the frequency.
    if numbers["laminate"] is not None:
        del numbers["material"], numbers["thickness"]
    # Plates without layers or air, and as their theory has them, keep the fingerprint of a rig that
    # has no such keys.
    for key in ("laminate", "air_gap", "loss_exponent", "mode_deviations"):
        if not numbers[key]:
            del numbers[key]
    for layer in numbers.get("laminate", {}).get("layers", ()):
        del layer["material"]["name"]
    # ERAs without gains have the fingerprint of a rig that has no such key.
    held = [
        {key: value for key, value in asdict(era).items() if key != "gains" or value}
        for era in eras
    ]
    physics = {
        "plate": numbers,
        "eras": held,
        "masses": sorted(list(map(float, mass.numbers.values())) for mass in masses),
        "uncertainty": asdict(uncertainty),
        "fingertip": None if fingertip is None else asdict(fingertip),
        "fingertip_radius": FINGERTIP_RADIUS,
        "threshold": threshold,
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
