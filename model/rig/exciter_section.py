"""Exciters in a rig file: their keys, and the exciter that a section is.

A data sheet's resonance is mostly that of the light coil against the magnet, `free`; glued to a
plate the magnet moves, `mounted`. Of either and the mass that moves then follow stiffness and
damping: k = m (2 pi f)², c = 2 pi f m / Q. The voltage at level 1 is the least of the amplifier's
clip and of what heats the coil by its rated power, (R_e + R_g) sqrt(2 P / R_e).
"""

import math
from collections.abc import Iterator, Mapping
from typing import Annotated, Any, ClassVar, Literal

from model.config.fields import (
    DAMPING,
    FORCE_FACTOR,
    FREQUENCY,
    INDUCTANCE,
    LENGTH,
    MASS,
    POWER,
    RATIO,
    RESISTANCE,
    STIFFNESS,
    VOLTAGE,
    Quantity,
)
from model.rig.actuator_section import ActuatorSection
from model.rig.key_types import gains_of, one_of, place_on
from model.structure.exciter import Exciter
from model.structure.exciter_types import EXCITER_TYPES
from model.structure.plate import Plate

_OTHER = "; leave it out and give the values of another"


class ExciterSection(ActuatorSection):
    """One exciter, a voice coil that is glued to the plate and a magnet behind it.

    Values that a type has may be left out; those given replace them.
    """

    kind: Literal["exciter"]
    """`exciter`."""

    type: Annotated[str, one_of(EXCITER_TYPES, "type of exciter", _OTHER)] | None = None
    """A type that is sold, whose values are taken where no key gives them.

    Limits: a name [below](#exciters)
    """

    coil_mass: Annotated[float, Quantity(MASS, at_least=0, at_most=0.1)] | None = None
    """Of the coil and what is glued with it, m_c: moves with the plate.

    Default: of the type
    """

    weight: Annotated[float, Quantity(MASS, above=0, at_most=10)] | None = None
    """Of the part that moves when the coil is glued, M: the magnet, and mostly the housing.

    Default: of the type
    """

    resonance: Annotated[float, Quantity(FREQUENCY, above=0, at_most=2000)] | None = None
    """Of coil and magnet on the suspension, without the current.

    Default: of the type
    """

    resonance_is: Literal["free", "mounted"] | None = None
    """Of which: the coil alone, held by the magnet, as on most data sheets (`free`), or the magnet
    behind a coil that is glued (`mounted`).

    Default: required with `resonance`
    """

    q: Annotated[float, Quantity(RATIO, above=0, at_most=1000)] | None = None
    """Mechanical quality there, without the current (Qms).

    Default: of the type
    """

    stiffness: Annotated[float, Quantity(STIFFNESS, above=0, at_most=1e9)] | None = None
    """Of the suspension, k, instead of `resonance`: as a fit finds it."""

    damping: Annotated[float, Quantity(DAMPING, at_least=0, at_most=1e6)] | None = None
    """Of the suspension, c, without the current, instead of `q`."""

    force_factor: Annotated[float, Quantity(FORCE_FACTOR, above=0, at_most=1000)] | None = None
    """Force by current, Bl.

    Default: of the type
    """

    resistance: Annotated[float, Quantity(RESISTANCE, above=0, at_most=1e4)] | None = None
    """Of the coil, R_e.

    Default: of the type
    """

    inductance: Annotated[float, Quantity(INDUCTANCE, at_least=0, at_most=0.1)] | None = None
    """Of the coil, L.

    Default: of the type, or 0
    """

    source_resistance: Annotated[float, Quantity(RESISTANCE, at_least=0, at_most=1e4)] = 0.1
    """Of the amplifier's output and the cable, R_g; assumed where it is not given."""

    power: Annotated[float, Quantity(POWER, above=0, at_most=1e4)] | None = None
    """Of the coil at level 1, the mean over a sine: the rated one, or less.

    Default: of the type
    """

    clip: Annotated[float, Quantity(VOLTAGE, above=0, at_most=1000)] | None = None
    """Amplitude of the voltage at which the amplifier clips; level 1 stays below it."""

    excursion: Annotated[float, Quantity(LENGTH, above=0, at_most=0.1)] | None = None
    """Largest amplitude of the coil in the magnet, x_max.

    Default: of the type, or unlimited
    """

    magnet: Literal["free", "held"] = "free"
    """Whether a frame holds the magnet."""

    keys: ClassVar = {
        **{"stiffness": "stiffness", "damping": "damping", "magnet_mass": "weight"},
        **{each: each for each in ("coil_mass", "force_factor", "gains")},
    }
    instead: ClassVar = {"stiffness": ("resonance", "resonance_is"), "damping": ("q",)}
    is_electrical = True

    @property
    def of_type(self) -> dict[str, float]:
        """Values of its type by key, none without a type."""
        return _of_type(self.type)

    @property
    def values(self) -> dict[str, Any]:
        """Values by key, those of the type where the section gives none."""
        unknown = dict.fromkeys(ExciterSection.model_fields) | {"resonance_is": "free"}
        return unknown | self.of_type | self.model_dump(exclude_none=True)

    def made(self, name: str, plate: Plate, count: int) -> Exciter:
        """An exciter; nothing of it depends on the count."""
        values = self.values
        moving = values["coil_mass"] if values["resonance_is"] == "free" else values["weight"]
        k = self.stiffness or moving * (2 * math.pi * values["resonance"]) ** 2
        c = math.sqrt(k * moving) / values["q"] if self.damping is None else self.damping
        resistance, source = values["resistance"], self.source_resistance
        heated = (resistance + source) * math.sqrt(2 * values["power"] / resistance)
        return Exciter(
            name,
            *place_on(plate, self.at),
            stiffness=k,
            damping=c,
            magnet_mass=values["weight"],
            coil_mass=values["coil_mass"],
            force_factor=values["force_factor"],
            resistance=resistance,
            voltage=min(heated, self.clip or math.inf),
            source_resistance=source,
            inductance=values["inductance"] or 0.0,
            excursion=values["excursion"] or math.inf,
            held=self.magnet == "held",
            gains=gains_of(self.gains),
            foot=self.foot,
        )

    @classmethod
    def problems(cls, given: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
        """What is missing or stated in two ways, a resonance of what, and too much power."""
        name, power = given.get("type"), given.get("power")
        # Of a type that is misspelt, nothing is known to be missing.
        unknown = "type" in given and name is None
        known = given.keys() | _of_type(name).keys()
        for key in () if unknown else _NEEDED:
            if key not in known and _INSTEAD.get(key) not in given:
                yield key, "missing; add it, or a type that has it"
        for key in ("amplifier", "channel"):
            if key not in given:
                yield key, "missing; add it: an exciter is driven, and supports nothing by itself"
        for key, other in _INSTEAD.items():
            if {key, other} <= given.keys():
                yield other, f"must not be given with {key}; remove one of the two"
        if "resonance" in given and "resonance_is" not in given:
            yield "resonance_is", f"missing; add which of both it is: {_EITHER}"
        if {"stiffness", "resonance_is"} <= given.keys():
            yield "resonance_is", "must not be given with stiffness; remove it"
        rated = _of_type(name).get("power", math.inf)
        if power is not None and power > rated:
            yield "power", f"must be at most {rated:g} W, which a {name} bears, got {power:g} W"


_NEEDED = ("coil_mass", "weight", "force_factor", "resistance", "power", "resonance", "q")
_INSTEAD = {"resonance": "stiffness", "q": "damping"}

_EITHER = (
    "free, of the light coil against the magnet, as on most data sheets, or mounted, of the magnet "
    "behind the coil that is glued to the plate, several times lower"
)


def _of_type(name: str | None) -> dict[str, float]:
    found = {} if name is None else EXCITER_TYPES[name].values
    return {key: each.value for key, each in found.items()}
