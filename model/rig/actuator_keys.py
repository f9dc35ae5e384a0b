"""Actuators in a rig file: one section per kind.

A section builds the actuator it describes, and writes one back. ERAs are the default kind.

An exciter's data sheet usually states the resonance of the light coil against the fixed magnet,
`free`. When glued to a plate the magnet moves, `mounted`. Stiffness and damping follow from either
resonance and the moving mass: k = m (2 pi f)², c = 2 pi f m / Q. The voltage at level 1 is the
lower of the amplifier's clip and the voltage that heats the coil with its rated power, (R_e + R_g)
sqrt(2 P / R_e).
"""

import math
from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields
from typing import Annotated, Any, ClassVar, Literal, TypeAlias

from pydantic import ConfigDict, Field

from model.config.fields import ByKind, Quantity, Section
from model.config.units import (
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
from model.rig.key_types import (
    GAINS,
    AttachedMass,
    Foot,
    GainRow,
    Identifier,
    LossRatio,
    Place,
    SmallMass,
    SpringDamping,
    SpringStiffness,
    name_among,
    place_on,
)
from model.structure.exciter import EXCITER_TYPES, Actuator, Exciter
from model.structure.plate import Plate
from model.structure.sources import Era, Gain, damping_from_ratio

STIFF_MOUNT = 1e6
"""Stiffness [N/m] above which the local dent under a point force matters.

On the paper's plate, a radius of 5 mm instead of a point changes the response by 2 % at 400 Hz and
by 16 % near a resonance.
"""

_ERA_FIELDS = {field.name for field in fields(Era)} - {"damping", "gains"}
"""Fields with the same name and value as their key."""

_OTHER_TYPE = "; leave it out and give the values of another"

_EITHER_RESONANCE = (
    "free (the light coil moves against the magnet; used by most data sheets) or mounted (the "
    "magnet moves behind the coil that is glued to the plate; several times lower)"
)

_REQUIRED = ("coil_mass", "weight", "force_factor", "resistance", "power", "resonance", "q")
"""Keys that an exciter needs, from its type or from the file."""

_FITTED_KEYS = {"resonance": "stiffness", "q": "damping"}
"""Keys that a fit writes, by the data-sheet key that they replace."""


def _gains_of(rows: Sequence[GainRow] | None) -> tuple[Gain, ...]:
    """Return gains from rows with phases in degrees."""
    return tuple((f, size, math.radians(phase)) for f, size, phase in rows or ())


class ActuatorSection(Section):
    """Keys that all kinds of actuators share; each kind adds its own."""

    keys: ClassVar[Mapping[str, str]]
    """Rig-file key by field of the actuator, for fields that a fit changes."""

    instead: ClassVar[Mapping[str, tuple[str, ...]]]
    """Alternatives that each key replaces; these keys are always written."""

    is_electrical: ClassVar[bool] = False
    """Whether its full level is a voltage, so that its amplifier has an electrical output."""

    model_config = ConfigDict(
        json_schema_extra={
            "dependentRequired": {"amplifier": ["channel"], "channel": ["amplifier"]}
        }
    )

    at: Place
    """`[x, y]`: position on the plate; at most one actuator per position."""

    amplifier: Identifier | None = None
    """Amplifier that drives the actuator; none for an ERA that only supports the plate.

    Limits: a name under `amplifiers`
    """

    channel: Annotated[int, Field(ge=0, le=255)] | None = None
    """Channel of the amplifier; unique per ERA, none without an amplifier."""

    foot: Foot = 0.0
    """Radius of its contact disc, 0 for a point; only the part on the plate counts.
    Required if the stiffness is 1 MN/m or more: [points and
    feet](../concepts/plate-model.md#points-and-feet).
    """

    gains: Annotated[list[GainRow], Field(max_length=2000), GAINS] | None = None
    """`[[frequency in Hz, magnitude, phase in degrees], ...]`: its response to a level, in full
    levels, as [measured](../how-to/measure-your-plate.md); interpolated linearly, constant outside,
    1 without rows.

    Limits: rows by ascending frequency
    """

    @abstractmethod
    def build(self, name: str, plate: Plate, count: int) -> Actuator:
        """Build an actuator with this name on a plate; count: number of the rig's actuators."""

    @classmethod
    def keys_of(cls, actuator: Actuator) -> dict[str, Any]:
        """Return the values of keys for the fields that a fit changes; inverse of `build`."""
        values: dict[str, Any] = {"at": [actuator.x, actuator.y]}
        values |= {key: getattr(actuator, name) for name, key in cls.keys.items()}
        values["gains"] = [[f, size, math.degrees(angle)] for f, size, angle in actuator.gains]
        return values

    @classmethod
    @abstractmethod
    def problems(cls, keys: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
        """Yield conflicts between keys: problems by key.

        keys: keys of a file; valid ones with their values, others None.
        """


class EraSection(ActuatorSection):
    """One ERA; without an amplifier it only supports the plate.

    Defaults of damping and stroke are assumptions; the paper does not state them.
    """

    kind: Literal["era"] = "era"
    """`era`; use `exciter` for an [exciter](#exciters)."""

    stiffness: SpringStiffness
    """Stiffness of its spring, k_b."""

    damping_ratio: LossRatio = 0.05
    """Damping ratio zeta: c = 2 zeta sqrt(k_b m / n), with m the bare plate's mass and n the number
    of ERAs.
    """

    damping: SpringDamping | None = None
    """Damping c, instead of `damping_ratio`."""

    bolt_mass: AttachedMass = 0.0
    """Mass m_b that moves with the plate."""

    stroke: Annotated[float, Quantity(LENGTH, above=0, at_most=0.01)] = 100e-6
    """Amplitude of its base at level 1 (zero to peak), where its gain is 1."""

    keys: ClassVar = {
        "stiffness": "stiffness",
        "damping": "damping",
        "bolt_mass": "bolt_mass",
        "gains": "gains",
    }
    instead: ClassVar = {"damping": ("damping_ratio",)}

    def build(self, name: str, plate: Plate, count: int) -> Era:
        """Build an ERA; a damping ratio is relative to plate and count."""
        x, y = place_on(plate, self.at)
        damping = self.damping
        if damping is None:
            damping = damping_from_ratio(
                self.damping_ratio, stiffness=self.stiffness, plate_mass=plate.mass, era_count=count
            )
        values = self.model_dump(include=_ERA_FIELDS)
        return Era(name, x, y, damping=damping, gains=_gains_of(self.gains), **values)

    @classmethod
    def problems(cls, keys: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
        """Yield problems: two kinds of damping, incomplete wiring, and a stiff mount without a
        radius."""
        if {"damping", "damping_ratio"} <= keys.keys():
            yield "damping", "must not be given with damping_ratio; remove one of the two"
        for key, present in (("amplifier", "channel"), ("channel", "amplifier")):
            if present in keys and key not in keys:
                yield key, f"missing; add it, or remove {present} too for an ERA that only supports"
        yield from stiff_mount_problems(keys)


def stiff_mount_problems(keys: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield the problem of a stiff mount without a radius; keys: see `problems`."""
    stiffness = keys.get("stiffness")
    if stiffness is not None and stiffness >= STIFF_MOUNT and "foot" not in keys:
        yield (
            "foot",
            f"missing; add the radius of its contact with the plate: at "
            f"{stiffness:g} N/m, {STIFF_MOUNT:g} N/m or more, the response depends on it",
        )


class ExciterSection(ActuatorSection):
    """One exciter: a voice coil glued to the plate, with a magnet behind it.

    Values of its type can be left out; given values replace them.
    """

    kind: Literal["exciter"]
    """`exciter`."""

    type: Annotated[str, name_among(EXCITER_TYPES, "type of exciter", _OTHER_TYPE)] | None = None
    """Commercial type; its values are used for keys that are not given.

    Limits: a name [below](#exciters)
    """

    coil_mass: SmallMass | None = None
    """Mass m_c of the coil and its adhesive, which moves with the plate.

    Default: from `type`
    """

    weight: Annotated[float, Quantity(MASS, above=0, at_most=10)] | None = None
    """Mass M that moves when the coil is glued: the magnet, usually with the housing.

    Default: from `type`
    """

    resonance: Annotated[float, Quantity(FREQUENCY, above=0, at_most=2000)] | None = None
    """Resonance frequency of coil and magnet on the suspension, without current.

    Default: from `type`
    """

    resonance_is: Literal["free", "mounted"] | None = None
    """`free`: the coil moves and the magnet is held (on most data sheets); `mounted`: the magnet
    moves behind a glued coil.

    Default: required with `resonance`
    """

    q: Annotated[float, Quantity(RATIO, above=0, at_most=1000)] | None = None
    """Mechanical quality factor at this resonance, without current (Qms).

    Default: from `type`
    """

    stiffness: Annotated[float, Quantity(STIFFNESS, above=0, at_most=1e9)] | None = None
    """Stiffness k of the suspension, as written by a fit; replaces `resonance`."""

    damping: SpringDamping | None = None
    """Damping c of the suspension, without current; replaces `q`."""

    force_factor: Annotated[float, Quantity(FORCE_FACTOR, above=0, at_most=1000)] | None = None
    """Force per current, Bl.

    Default: from `type`
    """

    resistance: Annotated[float, Quantity(RESISTANCE, above=0, at_most=1e4)] | None = None
    """Coil resistance R_e.

    Default: from `type`
    """

    inductance: Annotated[float, Quantity(INDUCTANCE, at_least=0, at_most=0.1)] | None = None
    """Coil inductance L.

    Default: from `type`, or 0
    """

    source_resistance: Annotated[float, Quantity(RESISTANCE, at_least=0, at_most=1e4)] = 0.1
    """Output resistance R_g of amplifier and cable; the default is an assumption."""

    power: Annotated[float, Quantity(POWER, above=0, at_most=1e4)] | None = None
    """Power in the coil at level 1, averaged over a sine: the rated power or less.

    Default: from `type`
    """

    clip: Annotated[float, Quantity(VOLTAGE, above=0, at_most=1000)] | None = None
    """Voltage amplitude at which the amplifier clips; level 1 stays below it."""

    excursion: Annotated[float, Quantity(LENGTH, above=0, at_most=0.1)] | None = None
    """Largest amplitude of the coil in the magnet, Xmax.

    Default: from `type`, or unlimited
    """

    magnet: Literal["free", "held"] = "free"
    """Whether a frame holds the magnet."""

    keys: ClassVar = {
        "stiffness": "stiffness",
        "damping": "damping",
        "magnet_mass": "weight",
        "coil_mass": "coil_mass",
        "force_factor": "force_factor",
        "gains": "gains",
    }
    instead: ClassVar = {"stiffness": ("resonance", "resonance_is"), "damping": ("q",)}
    is_electrical = True

    @property
    def of_type(self) -> dict[str, float]:
        """Values of its type by key, empty without a type."""
        return _of_type(self.type)

    @property
    def values(self) -> dict[str, Any]:
        """Values by key, including the values of the type."""
        values: dict[str, Any] = dict.fromkeys(ExciterSection.model_fields)
        values["resonance_is"] = "free"
        return values | self.of_type | self.model_dump(exclude_none=True)

    def build(self, name: str, plate: Plate, count: int) -> Exciter:
        """Build an exciter; independent of the count."""
        values = self.values
        x, y = place_on(plate, self.at)
        moving_mass = values["coil_mass"] if values["resonance_is"] == "free" else values["weight"]
        stiffness = self.stiffness
        if stiffness is None:
            stiffness = moving_mass * (2 * math.pi * values["resonance"]) ** 2
        damping = self.damping
        if damping is None:
            damping = math.sqrt(stiffness * moving_mass) / values["q"]
        resistance, source = values["resistance"], self.source_resistance
        rated_voltage = (resistance + source) * math.sqrt(2 * values["power"] / resistance)
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
            voltage=min(rated_voltage, self.clip or math.inf),
            source_resistance=source,
            inductance=values["inductance"] or 0.0,
            excursion=values["excursion"] or math.inf,
            held=self.magnet == "held",
            gains=_gains_of(self.gains),
            foot=self.foot,
        )

    @classmethod
    def problems(cls, keys: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
        """Yield missing keys, conflicting keys, an ambiguous resonance, and excessive power."""
        type_name, power = keys.get("type"), keys.get("power")
        type_values = _of_type(type_name)
        is_misspelt = "type" in keys and type_name is None  # which does not make its keys missing
        if not is_misspelt:
            known = keys.keys() | type_values.keys()
            for key in _REQUIRED:
                if key not in known and _FITTED_KEYS.get(key) not in keys:
                    yield key, "missing; add it, or a type that has it"
        for key in ("amplifier", "channel"):
            if key not in keys:
                yield key, "missing; add it: an exciter is driven, and supports nothing by itself"
        for key, fitted_key in _FITTED_KEYS.items():
            if {key, fitted_key} <= keys.keys():
                yield fitted_key, f"must not be given with {key}; remove one of the two"
        if "resonance" in keys and "resonance_is" not in keys:
            yield "resonance_is", f"missing; add which one it is: {_EITHER_RESONANCE}"
        if {"stiffness", "resonance_is"} <= keys.keys():
            yield "resonance_is", "must not be given with stiffness; remove it"
        rated = type_values.get("power", math.inf)
        if power is not None and power > rated:
            yield (
                "power",
                f"must be at most {rated:g} W, the rating of a {type_name}, got {power:g} W",
            )


def _of_type(name: str | None) -> dict[str, float]:
    if name is None:
        return {}
    return {key: sourced.value for key, sourced in EXCITER_TYPES[name].values.items()}


ActuatorOfAnyKind: TypeAlias = Annotated[EraSection | ExciterSection, ByKind()]
"""Section selected by `kind`, ERAs by default."""

ACTUATOR_KINDS: Mapping[type[Actuator], type[ActuatorSection]] = {
    Era: EraSection,
    Exciter: ExciterSection,
}
"""Section by actuator class."""
