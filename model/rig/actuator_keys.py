"""Actuators in a rig file: values of their keys, and one section per kind.

A section builds the actuator it describes, and writes one back. ERAs are the default kind.

An exciter's data sheet usually states the resonance of the light coil against the fixed magnet,
`free`. When glued to a plate the magnet moves, `mounted`. Stiffness and damping follow from either
resonance and the moving mass: k = m (2 pi f)², c = 2 pi f m / Q. The voltage at level 1 is the
lower of the amplifier's clip and the voltage that heats the coil with its rated power, (R_e + R_g)
sqrt(2 P / R_e).
"""

import math
import re
from abc import abstractmethod
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import fields
from itertools import pairwise
from typing import Annotated, Any, ClassVar, Literal, TypeAlias

from pydantic import AfterValidator, ConfigDict, Field, Strict

from model.config.fields import ByKind, Quantity, Section
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
from model.finger import THRESHOLDS
from model.structure.attachments import Era, Gain, damping_from_ratio
from model.structure.exciter import Actuator, Exciter
from model.structure.material import EXCITER_TYPES
from model.structure.plate import Plate
from registry.plugins import did_you_mean


def _identifier(text: str) -> str:
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_-]{0,31}", text):
        raise ValueError("must be a letter followed by at most 31 letters, digits, - and _")
    return text


def check_url(text: str) -> str:
    """Return the URL of an amplifier; raises ValueError for other text."""
    if not re.fullmatch(r"[a-z][a-z0-9+.-]*://[!-~]{0,250}", text):
        raise ValueError(
            "must be a URL, for example sim:// or serial:///dev/ttyUSB0?baud=921600, got "
            f"{text[:40]!r}"
        )
    return text


def check_ascending(bounds: tuple[float, float]) -> tuple[float, float]:
    """Return the lower and the higher frequency [Hz]; raises ValueError if they are not
    ascending."""
    low, high = bounds
    if low >= high:
        raise ValueError(f"must be the lower and the higher frequency, got {low:g} and {high:g} Hz")
    return bounds


def _rows(
    columns: str, lowest: Sequence[float], highest: Sequence[float], *, ascending: bool = True
) -> AfterValidator:
    """Check rows of numbers for bounds, and by default for ascending first numbers."""

    def checked(rows: list[tuple[float, ...]]) -> list[tuple[float, ...]]:
        for row in rows:
            if not all(
                low <= each <= high for low, each, high in zip(lowest, row, highest, strict=True)
            ):
                got = ", ".join(f"{each:g}" for each in row)
                raise ValueError(f"must be rows of [{columns}], got [{got}]")
        if ascending and any(low[0] >= high[0] for low, high in pairwise(rows)):
            raise ValueError("frequencies must ascend; sort the rows by the first number")
        return rows

    return AfterValidator(checked)


def _one_of(known: Collection[str], what: str, remedy: str = "") -> AfterValidator:
    """Check that text is one of the known names."""

    def checked(name: str) -> str:
        if name not in known:
            raise ValueError(
                f"unknown {what} {name}; {did_you_mean(name, known)}known: {', '.join(known)}"
                f"{remedy}"
            )
        return name

    return AfterValidator(checked)


GAINS = _rows(
    "frequency in Hz, magnitude 0.001 to 1000, phase -360 to 360 degrees",
    (1e-6, 1e-3, -360),
    (1e5, 1e3, 360),
)
MODULI = _rows(
    "frequency in Hz, factor of E 0.001 to 1000, loss factor 0 to 2", (1e-6, 1e-3, 0), (1e5, 1e3, 2)
)
MODES = _rows(
    "natural frequency 0.8 to 1.25, loss factor 0.01 to 100, relative to the plate's theory",
    (0.8, 0.01),
    (1.25, 100),
    ascending=False,
)
GainRow = Annotated[tuple[float, float, float], Strict(strict=False)]  # a list in the file
ModeRow = Annotated[tuple[float, float], Strict(strict=False)]
ThresholdSet = Annotated[str, _one_of(THRESHOLDS, "set of thresholds")]
Identifier = Annotated[str, AfterValidator(_identifier)]
Side = Annotated[float, Quantity(LENGTH, above=0, at_most=100)]
Coordinate = Annotated[float, Quantity(LENGTH, at_least=-100, at_most=100)]
Place = Annotated[tuple[Coordinate, Coordinate], Strict(strict=False)]  # a list in the file
Foot = Annotated[float, Quantity(LENGTH, at_least=0, at_most=0.2)]
Thickness = Annotated[float, Quantity(LENGTH, at_least=1e-6, at_most=1)]
Frequency = Annotated[float, Quantity(FREQUENCY, at_least=1, at_most=2000)]


def place_on(plate: Plate, place: tuple[float, float]) -> tuple[float, float]:
    """Clip a position to the plate; rounding can have moved it across the edge."""
    x, y = place
    return min(max(x, 0.0), plate.length), min(max(y, 0.0), plate.width)


def _gains_of(rows: Sequence[GainRow] | None) -> tuple[Gain, ...]:
    """Return gains from rows with phases in degrees."""
    return tuple((f, size, math.radians(phase)) for f, size, phase in rows or ())


class ActuatorSection(Section):
    """Keys that all kinds of actuators share; each kind adds its own."""

    keys: ClassVar[Mapping[str, str]]
    """Rig-file key by field of the actuator, for fields that a fit changes."""

    instead: ClassVar[Mapping[str, tuple[str, ...]]]
    """Alternatives that each key replaces; these keys are always written, whatever else changes."""

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
    def made(self, name: str, plate: Plate, count: int) -> Actuator:
        """Build an actuator with this name on a plate; count: number of the rig's actuators."""

    @classmethod
    def stated(cls, actuator: Actuator) -> dict[str, Any]:
        """Return the values of keys for the fields that a fit changes; inverse of `made`."""
        found: dict[str, Any] = {"at": [actuator.x, actuator.y]}
        found |= {key: getattr(actuator, name) for name, key in cls.keys.items()}
        return found | {"gains": [[f, size, math.degrees(a)] for f, size, a in actuator.gains]}

    @classmethod
    @abstractmethod
    def problems(cls, given: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
        """Yield conflicts between keys: problems by key.

        given: keys of a file; valid ones with their values, others None.
        """


STIFF_MOUNT = 1e6
"""Stiffness [N/m] above which the local dent under a point force matters.

On the paper's plate, a radius of 5 mm instead of a point changes the response by 2 % at 400 Hz and
by 16 % near a resonance.
"""

_SAME = {each.name for each in fields(Era)} - {"damping", "gains"}
"""Fields with the same name and value as their key."""


class EraSection(ActuatorSection):
    """One ERA; without an amplifier it only supports the plate.

    Defaults of damping and stroke are assumptions; the paper does not state them.
    """

    kind: Literal["era"] = "era"
    """`era`; use `exciter` for an [exciter](#exciters)."""

    stiffness: Annotated[float, Quantity(STIFFNESS, above=0, at_most=1e12)]
    """Stiffness of its spring, k_b."""

    damping_ratio: Annotated[float, Quantity(RATIO, at_least=0, at_most=2)] = 0.05
    """Damping ratio zeta: c = 2 zeta sqrt(k_b m / n), with m the bare plate's mass and n the number
    of ERAs.
    """

    damping: Annotated[float, Quantity(DAMPING, at_least=0, at_most=1e6)] | None = None
    """Damping c, instead of `damping_ratio`."""

    bolt_mass: Annotated[float, Quantity(MASS, at_least=0, at_most=10)] = 0.0
    """Mass m_b that moves with the plate."""

    stroke: Annotated[float, Quantity(LENGTH, above=0, at_most=0.01)] = 100e-6
    """Amplitude of its base at level 1 (zero to peak), where its gain is 1."""

    keys: ClassVar = {each: each for each in ("stiffness", "damping", "bolt_mass", "gains")}
    instead: ClassVar = {"damping": ("damping_ratio",)}

    def made(self, name: str, plate: Plate, count: int) -> Era:
        """Build an ERA; a damping ratio is relative to plate and count."""
        by_ratio = damping_from_ratio(
            self.damping_ratio, stiffness=self.stiffness, plate_mass=plate.mass, era_count=count
        )
        damping = by_ratio if self.damping is None else self.damping
        at, same = place_on(plate, self.at), self.model_dump(include=_SAME)
        return Era(name, *at, damping=damping, gains=_gains_of(self.gains), **same)

    @classmethod
    def problems(cls, given: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
        """Yield problems: two kinds of damping, incomplete wiring, and a stiff mount without a
        radius."""
        if {"damping", "damping_ratio"} <= given.keys():
            yield "damping", "must not be given with damping_ratio; remove one of the two"
        for key, other in (("amplifier", "channel"), ("channel", "amplifier")):
            if other in given and key not in given:
                yield key, f"missing; add it, or remove {other} too for an ERA that only supports"
        yield from stiff_mount_problems(given)


def stiff_mount_problems(given: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield the problem of a stiff mount without a radius; given: see `problems`."""
    stiffness = given.get("stiffness")
    if stiffness is not None and stiffness >= STIFF_MOUNT and "foot" not in given:
        yield (
            "foot",
            f"missing; add the radius of its contact with the plate: at "
            f"{stiffness:g} N/m, {STIFF_MOUNT:g} N/m or more, the response depends on it",
        )


_OTHER = "; leave it out and give the values of another"


class ExciterSection(ActuatorSection):
    """One exciter: a voice coil glued to the plate, with a magnet behind it.

    Values of its type can be left out; given values replace them.
    """

    kind: Literal["exciter"]
    """`exciter`."""

    type: Annotated[str, _one_of(EXCITER_TYPES, "type of exciter", _OTHER)] | None = None
    """Commercial type; its values are used for keys that are not given.

    Limits: a name [below](#exciters)
    """

    coil_mass: Annotated[float, Quantity(MASS, at_least=0, at_most=0.1)] | None = None
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
    """What the resonance refers to: `free` for the coil with the magnet held, as on most data
    sheets; `mounted` for the magnet behind a glued coil.

    Default: required with `resonance`
    """

    q: Annotated[float, Quantity(RATIO, above=0, at_most=1000)] | None = None
    """Mechanical quality factor at this resonance, without current (Qms).

    Default: from `type`
    """

    stiffness: Annotated[float, Quantity(STIFFNESS, above=0, at_most=1e9)] | None = None
    """Stiffness k of the suspension, as written by a fit; replaces `resonance`."""

    damping: Annotated[float, Quantity(DAMPING, at_least=0, at_most=1e6)] | None = None
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
        unknown = dict.fromkeys(ExciterSection.model_fields) | {"resonance_is": "free"}
        return unknown | self.of_type | self.model_dump(exclude_none=True)

    def made(self, name: str, plate: Plate, count: int) -> Exciter:
        """Build an exciter; independent of the count."""
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
            gains=_gains_of(self.gains),
            foot=self.foot,
        )

    @classmethod
    def problems(cls, given: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
        """Yield missing keys, conflicting keys, an ambiguous resonance, and excessive power."""
        name, power = given.get("type"), given.get("power")
        # A misspelt type does not make its keys missing.
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
            yield "resonance_is", f"missing; add which one it is: {_EITHER}"
        if {"stiffness", "resonance_is"} <= given.keys():
            yield "resonance_is", "must not be given with stiffness; remove it"
        rated = _of_type(name).get("power", math.inf)
        if power is not None and power > rated:
            yield "power", f"must be at most {rated:g} W, the rating of a {name}, got {power:g} W"


_NEEDED = ("coil_mass", "weight", "force_factor", "resistance", "power", "resonance", "q")
_INSTEAD = {"resonance": "stiffness", "q": "damping"}

_EITHER = (
    "free (the light coil moves against the magnet, as on most data sheets) or mounted (the magnet "
    "moves behind the coil that is glued to the plate; several times lower)"
)


def _of_type(name: str | None) -> dict[str, float]:
    found = {} if name is None else EXCITER_TYPES[name].values
    return {key: each.value for key, each in found.items()}


ActuatorOfAnyKind: TypeAlias = Annotated[EraSection | ExciterSection, ByKind()]
"""Section selected by `kind`, ERAs by default."""

ACTUATOR_KINDS: Mapping[type[Actuator], type[ActuatorSection]] = {
    Era: EraSection,
    Exciter: ExciterSection,
}
"""Section by actuator class."""
