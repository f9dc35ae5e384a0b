"""Actuators in a rig file: values of their keys, and a section for each kind.

A section makes the actuator that it states, and states one again. ERAs are the default kind.

A data sheet's resonance of an exciter is mostly that of the light coil against the magnet, `free`;
glued to a plate the magnet moves, `mounted`. Stiffness and damping follow from either and the mass
that moves: k = m (2 pi f)², c = 2 pi f m / Q. The voltage at level 1 is the lower one of the
amplifier's clip and of the voltage that heats the coil by its rated power, (R_e + R_g) sqrt(2 P /
R_e).
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
    """The URL of an amplifier; raises ValueError for other text."""
    if not re.fullmatch(r"[a-z][a-z0-9+.-]*://[!-~]{0,250}", text):
        raise ValueError(
            "must be a URL, for example sim:// or serial:///dev/ttyUSB0?baud=921600, got "
            f"{text[:40]!r}"
        )
    return text


def check_ascending(bounds: tuple[float, float]) -> tuple[float, float]:
    """The lower and the higher frequency [Hz]; raises ValueError for others."""
    low, high = bounds
    if low >= high:
        raise ValueError(f"must be the lower and the higher frequency, got {low:g} and {high:g} Hz")
    return bounds


def _rows(
    columns: str, lowest: Sequence[float], highest: Sequence[float], *, ascending: bool = True
) -> AfterValidator:
    """Check of rows of numbers between bounds, by default sorted by the first of them."""

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
    """Check of text that is one of the known names of something."""

    def checked(name: str) -> str:
        if name not in known:
            raise ValueError(
                f"unknown {what} {name}; {did_you_mean(name, known)}known are {', '.join(known)}"
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
    """A place clipped to the plate, off whose edge rounding may have put it."""
    x, y = place
    return min(max(x, 0.0), plate.length), min(max(y, 0.0), plate.width)


def _gains_of(rows: Sequence[GainRow] | None) -> tuple[Gain, ...]:
    """Gains of rows with phases in degrees."""
    return tuple((f, size, math.radians(phase)) for f, size, phase in rows or ())


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
    """`[[frequency in Hz, magnitude, phase in degrees], ...]`: its response to a level, in full
    levels, as [measured](../how-to/measure-your-plate.md); interpolated linearly, constant outside,
    1 without rows.

    Limits: rows by ascending frequency
    """

    @abstractmethod
    def made(self, name: str, plate: Plate, count: int) -> Actuator:
        """The actuator of a name on a plate; count: of the rig's actuators."""

    @classmethod
    def stated(cls, actuator: Actuator) -> dict[str, Any]:
        """Values of the keys that state what a fit changes of an actuator, as `made` reads them."""
        found: dict[str, Any] = {"at": [actuator.x, actuator.y]}
        found |= {key: getattr(actuator, name) for name, key in cls.keys.items()}
        return found | {"gains": [[f, size, math.degrees(a)] for f, size, a in actuator.gains]}

    @classmethod
    @abstractmethod
    def problems(cls, given: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
        """What keys require of each other: problems by key.

        given: keys of a file with the values of those that are valid by themselves, else None.
        """


STIFF_MOUNT = 1e6
"""Stiffness [N/m] from which the dent of a point force in the plate counts beside the mount's own.

On the paper's plate a radius of 5 mm in place of a point changes the response by 2 % at 400 Hz and
16 % near a resonance.
"""

_SAME = {each.name for each in fields(Era)} - {"damping", "gains"}
"""Fields that have the values of the keys of their names."""


class EraSection(ActuatorSection):
    """One ERA; without an amplifier it only supports the plate.

    Defaults of damping and stroke are assumed, the paper prints neither.
    """

    kind: Literal["era"] = "era"
    """An ERA, unless it is an [exciter](#exciters)."""

    stiffness: Annotated[float, Quantity(STIFFNESS, above=0, at_most=1e12)]
    """Stiffness of its spring, k_b."""

    damping_ratio: Annotated[float, Quantity(RATIO, at_least=0, at_most=2)] = 0.05
    """Zeta of its damper: c = 2 zeta sqrt(k_b m / n), m the bare plate's mass, n the number of
    ERAs.
    """

    damping: Annotated[float, Quantity(DAMPING, at_least=0, at_most=1e6)] | None = None
    """C itself, instead of `damping_ratio`."""

    bolt_mass: Annotated[float, Quantity(MASS, at_least=0, at_most=10)] = 0.0
    """Mass that moves with the plate, m_b."""

    stroke: Annotated[float, Quantity(LENGTH, above=0, at_most=0.01)] = 100e-6
    """Amplitude of its base at level 1, where its gain is 1."""

    keys: ClassVar = {each: each for each in ("stiffness", "damping", "bolt_mass", "gains")}
    instead: ClassVar = {"damping": ("damping_ratio",)}

    def made(self, name: str, plate: Plate, count: int) -> Era:
        """An ERA; its damping from a ratio depends on plate and count."""
        by_ratio = damping_from_ratio(
            self.damping_ratio, stiffness=self.stiffness, plate_mass=plate.mass, era_count=count
        )
        damping = by_ratio if self.damping is None else self.damping
        at, same = place_on(plate, self.at), self.model_dump(include=_SAME)
        return Era(name, *at, damping=damping, gains=_gains_of(self.gains), **same)

    @classmethod
    def problems(cls, given: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
        """Damping in two ways, half of a wiring, and a stiff mount without a size."""
        if {"damping", "damping_ratio"} <= given.keys():
            yield "damping", "must not be given with damping_ratio; remove one of the two"
        for key, other in (("amplifier", "channel"), ("channel", "amplifier")):
            if other in given and key not in given:
                yield key, f"missing; add it, or remove {other} too for an ERA that only supports"
        yield from stiff_mount_problems(given)


def stiff_mount_problems(given: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """The problem of a stiff mount without a size, by key; none of others. given: as `problems`."""
    stiffness = given.get("stiffness")
    if stiffness is not None and stiffness >= STIFF_MOUNT and "foot" not in given:
        yield (
            "foot",
            f"missing; add the radius of the patch on which it holds the plate: at "
            f"{stiffness:g} N/m, {STIFF_MOUNT:g} N/m or more, the response depends on it",
        )


_OTHER = "; leave it out and give the values of another"


class ExciterSection(ActuatorSection):
    """One exciter, a voice coil that is glued to the plate and a magnet behind it.

    Values that a type has may be left out; those given replace them.
    """

    kind: Literal["exciter"]
    """`exciter`."""

    type: Annotated[str, _one_of(EXCITER_TYPES, "type of exciter", _OTHER)] | None = None
    """A type that is sold, whose values are taken where no key gives them.

    Limits: a name [below](#exciters)
    """

    coil_mass: Annotated[float, Quantity(MASS, at_least=0, at_most=0.1)] | None = None
    """Mass of the coil and what is glued with it, m_c, which moves with the plate.

    Default: of the type
    """

    weight: Annotated[float, Quantity(MASS, above=0, at_most=10)] | None = None
    """Mass of the part that moves if the coil is glued, M: the magnet, and mostly the housing.

    Default: of the type
    """

    resonance: Annotated[float, Quantity(FREQUENCY, above=0, at_most=2000)] | None = None
    """Resonance frequency of coil and magnet on the suspension, without current.

    Default: of the type
    """

    resonance_is: Literal["free", "mounted"] | None = None
    """Whose resonance this is: that of the coil with the magnet held, as on most data sheets
    (`free`), or that of the magnet behind a glued coil (`mounted`).

    Default: required with `resonance`
    """

    q: Annotated[float, Quantity(RATIO, above=0, at_most=1000)] | None = None
    """Mechanical quality there, without the current (Qms).

    Default: of the type
    """

    stiffness: Annotated[float, Quantity(STIFFNESS, above=0, at_most=1e9)] | None = None
    """Stiffness of the suspension, k, as a fit finds it; it replaces `resonance`."""

    damping: Annotated[float, Quantity(DAMPING, at_least=0, at_most=1e6)] | None = None
    """Damping of the suspension, c, without current; it replaces `q`."""

    force_factor: Annotated[float, Quantity(FORCE_FACTOR, above=0, at_most=1000)] | None = None
    """Force by current, Bl.

    Default: of the type
    """

    resistance: Annotated[float, Quantity(RESISTANCE, above=0, at_most=1e4)] | None = None
    """Resistance of the coil, R_e.

    Default: of the type
    """

    inductance: Annotated[float, Quantity(INDUCTANCE, at_least=0, at_most=0.1)] | None = None
    """Inductance of the coil, L.

    Default: of the type, or 0
    """

    source_resistance: Annotated[float, Quantity(RESISTANCE, at_least=0, at_most=1e4)] = 0.1
    """Resistance of the amplifier's output and the cable, R_g; the default is an assumption."""

    power: Annotated[float, Quantity(POWER, above=0, at_most=1e4)] | None = None
    """Power in the coil at level 1, averaged over a sine: the rated power, or less.

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
            gains=_gains_of(self.gains),
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


ActuatorOfAnyKind: TypeAlias = Annotated[EraSection | ExciterSection, ByKind()]
"""Sections of which `kind` chooses one, ERAs by default."""

ACTUATOR_KINDS: Mapping[type[Actuator], type[ActuatorSection]] = {
    Era: EraSection,
    Exciter: ExciterSection,
}
"""Section by class of the actuator."""
