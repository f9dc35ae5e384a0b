"""A rig: one plate, the ERAs under it, and which amplifier channel drives which ERA."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

from model.actuator import Era
from model.mesh import Mesh
from model.plate import Plate


@dataclass(frozen=True)
class Channel:
    """Where an ERA is wired: an amplifier by its name in the rig, and the channel's number."""

    amplifier: str
    number: int


@dataclass(frozen=True)
class Limits:
    """What no command may exceed: mechanical frequencies [Hz] and level (1 is full stroke)."""

    frequency_min: float
    frequency_max: float
    level: float


@dataclass(frozen=True)
class Rig:
    """Everything that is fixed once the hardware is built.

    wiring: a channel per ERA, by the ERA's name; amplifiers: URL by name.
    """

    plate: Plate
    mesh: Mesh
    eras: tuple[Era, ...]
    wiring: Mapping[str, Channel]
    amplifiers: Mapping[str, str]
    limits: Limits

    def era(self, name: str) -> Era:
        """The ERA of this name; KeyError if the rig has none."""
        for era in self.eras:
            if era.name == name:
                return era
        raise KeyError(name)

    @property
    def fingerprint(self) -> str:
        """Fingerprint of the plate on its ERAs; see `physics_fingerprint`."""
        return physics_fingerprint(self.plate, self.eras)


def physics_fingerprint(plate: Plate, eras: Sequence[Era]) -> str:
    """SHA-256 over what the plate's response depends on: plate and ERAs, not mesh or wiring.

    Rigs with the same fingerprint can use the same localization table, whatever their material is
    called.
    """
    numbers = asdict(plate)
    del numbers["material"]["name"]
    physics = {"plate": numbers, "eras": [asdict(era) for era in eras]}
    text = json.dumps(physics, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()
