"""Exciters in a rig file: their keys, and the exciter that a section is.

A data sheet's resonance is mostly that of the light coil against the magnet, `free`; glued to a
plate the magnet moves, `mounted`. Of either and the mass that moves then follow stiffness and
damping: k = m (2 pi f)², c = 2 pi f m / Q. The voltage at level 1 is the least of the amplifier's
clip and of what heats the coil by its rated power, (R_e + R_g) sqrt(2 P / R_e).
"""

import math
from collections.abc import Callable, Iterator, Set
from typing import Annotated, Any, Literal

from pydantic import AfterValidator

from model.config.sections import Quantity
from model.config.units import (
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
)
from model.rig.actuator_section import ActuatorSection
from model.rig.key_types import gains_of, place_on
from model.structure.exciter import Exciter
from model.structure.exciter_types import EXCITER_TYPES, SheetValue
from model.structure.plate import Plate
from registry.suggestions import did_you_mean


def check_type(name: str) -> str:
    """The name of a type of exciters; raises ValueError for an unknown one."""
    if name not in EXCITER_TYPES:
        raise ValueError(
            f"unknown type of exciter {name}; {did_you_mean(name, EXCITER_TYPES)}known are "
            f"{', '.join(EXCITER_TYPES)}; leave it out and give the values of another"
        )
    return name


class ExciterSection(ActuatorSection):
    """One exciter, a voice coil that is glued to the plate and a magnet behind it.

    Values that a type has may be left out; those given replace them.
    """

    kind: Literal["exciter"]
    """`exciter`."""

    type: Annotated[str, AfterValidator(check_type)] | None = None
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


_NEEDED = ("coil_mass", "weight", "force_factor", "resistance", "power")

_EITHER = (
    "free, of the light coil against the magnet, as on most data sheets, or mounted, of the magnet "
    "behind the coil that is glued to the plate, several times lower"
)


def exciter_of(name: str, section: ExciterSection, plate: Plate, era_count: int) -> Exciter:
    """An exciter; era_count: of the rig, on which nothing of it depends."""
    values = _values(section)
    stiffness, damping = section.stiffness, section.damping
    moving = values["coil_mass"] if values["resonance_is"] == "free" else values["weight"]
    if stiffness is None:
        stiffness = moving * (2 * math.pi * values["resonance"]) ** 2
    if damping is None:
        damping = math.sqrt(stiffness * moving) / values["q"]
    resistance, source = values["resistance"], section.source_resistance
    heated = (resistance + source) * math.sqrt(2 * values["power"] / resistance)
    x, y = place_on(plate, section.at)
    return Exciter(
        name,
        x,
        y,
        stiffness=stiffness,
        damping=damping,
        magnet_mass=values["weight"],
        coil_mass=values["coil_mass"],
        force_factor=values["force_factor"],
        resistance=resistance,
        voltage=min(heated, section.clip or math.inf),
        source_resistance=source,
        inductance=values["inductance"] or 0.0,
        excursion=values["excursion"] or math.inf,
        held=section.magnet == "held",
        gains=gains_of(section.gains),
        foot=section.foot,
    )


def exciter_problems(given: Set[str], read: Callable[[str], Any]) -> Iterator[tuple[str, str]]:
    """What keys of an exciter require of each other: problems by key."""
    name = read("type")
    # Of a type that is misspelt, nothing is known to be missing.
    unknown = "type" in given and name is None
    of_type = _of_type(name)
    for key in ("amplifier", "channel"):
        if key not in given:
            yield key, "missing; add it: an exciter is driven, and supports nothing by itself"
    for key in _NEEDED:
        if not unknown and key not in given and key not in of_type:
            yield key, "missing; add it, or a type that has it"
    for key, instead in (("stiffness", "resonance"), ("damping", "q")):
        if {key, instead} <= given:
            yield key, f"must not be given with {instead}; remove one of the two"
        elif not unknown and not {key, instead} & given and instead not in of_type:
            yield instead, "missing; add it, or a type that has it"
    if "resonance" in given and "resonance_is" not in given:
        yield "resonance_is", f"missing; add which of both it is: {_EITHER}"
    rated, power = of_type.get("power"), read("power")
    if rated is not None and isinstance(power, float) and power > rated.value:
        bears = f"{rated.value:g} W, which a {read('type')} bears"
        yield "power", f"must be at most {bears}, got {power:g} W; lower it"
    if {"stiffness", "resonance_is"} <= given:
        yield "resonance_is", "is of a resonance, got it with stiffness; remove it"


_LIGHT, _HIGH = 0.3, 100.0  # share of the coil in the magnet's mass; Hz


def misread_resonance(section: ExciterSection) -> str | None:
    """A warning for a resonance that is said to be the mounted one, and hardly can be."""
    values = _values(section)
    f, coil, weight = values["resonance"], values["coil_mass"], values["weight"]
    if section.stiffness or values["resonance_is"] != "mounted":
        return None
    if f <= _HIGH or coil >= _LIGHT * weight:
        return None
    return (
        f"{f:g} Hz is high for a magnet of {1e3 * weight:.3g} g, and probably that of the coil of "
        f"{1e3 * coil:.3g} g on a data sheet; with resonance_is: free the glued magnet resonates "
        f"at {f * math.sqrt(coil / weight):.0f} Hz"
    )


def rated_power(section: ExciterSection) -> float:
    """What the coil bears [W]: as its type says, or else the file."""
    rated = _of_type(section.type).get("power")
    return float(_values(section)["power"] if rated is None else rated.value)


def _of_type(name: str | None) -> dict[str, SheetValue]:
    return {} if name is None else {**EXCITER_TYPES[name].values}


def _values(section: ExciterSection) -> dict[str, Any]:
    """Values by key, those of the type where the section gives none."""
    known = {key: each.value for key, each in _of_type(section.type).items()}
    return {
        **dict.fromkeys(ExciterSection.model_fields),
        "resonance_is": "free",
        **known,
        **section.model_dump(exclude_none=True),
    }
