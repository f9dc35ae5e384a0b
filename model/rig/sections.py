"""The sections of a rig file: keys, defaults and bounds.

Bounds are wide: they catch values in the wrong unit.
"""

import re
from collections.abc import Sequence
from dataclasses import asdict
from itertools import pairwise
from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    BeforeValidator,
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    GetJsonSchemaHandler,
    Strict,
)
from pydantic_core import CoreSchema, core_schema

from model.config.sections import Quantity, Section
from model.config.units import (
    DAMPING,
    DENSITY,
    FREQUENCY,
    LENGTH,
    MASS,
    MODULUS,
    RATE,
    RATIO,
    SLEW,
    STIFFNESS,
    TIME,
)
from model.finger.perception import DEFAULT_THRESHOLD, THRESHOLDS
from model.rig.uncertainty import Uncertainty
from model.structure.materials import material, material_names
from model.structure.plate import MAX_LOSS_EXPONENT, Bond
from registry.suggestions import did_you_mean


class _MaterialByName:
    """Annotation of a material that may be given by name."""

    def read(self, value: object) -> object:
        """Replace the name of a material by its numbers."""
        if not isinstance(value, str):
            return value
        known = material(value)
        return MaterialSection(name=known.name, E=known.E, rho=known.rho, nu=known.nu)

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        return core_schema.no_info_before_validator_function(self.read, handler(source))

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        return {"anyOf": [{"enum": list(material_names())}, handler(schema)]}


def _identifier(text: str) -> str:
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_-]{0,31}", text):
        raise ValueError("must be a letter followed by at most 31 letters, digits, - and _")
    return text


def _url(text: str) -> str:
    if not re.fullmatch(r"[a-z][a-z0-9+.-]*://[!-~]{0,250}", text):
        raise ValueError(
            "must be a URL, for example sim:// or serial:///dev/ttyUSB0?baud=921600, got "
            f"{text[:40]!r}"
        )
    return text


def _ascending(bounds: tuple[float, float]) -> tuple[float, float]:
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


def _threshold(name: str) -> str:
    if name not in THRESHOLDS:
        raise ValueError(
            f"unknown set of thresholds {name}; {did_you_mean(name, THRESHOLDS)}known are "
            f"{', '.join(THRESHOLDS)}"
        )
    return name


_GAINS = _rows(
    "frequency in Hz, magnitude 0.001 to 1000, phase -360 to 360 degrees",
    (1e-6, 1e-3, -360),
    (1e5, 1e3, 360),
)
_MODULI = _rows(
    "frequency in Hz, factor of E 0.001 to 1000, loss factor 0 to 2", (1e-6, 1e-3, 0), (1e5, 1e3, 2)
)
_MODES = _rows(
    "natural frequency 0.8 to 1.25, loss factor 0.01 to 100, relative to the plate's theory",
    (0.8, 0.01),
    (1.25, 100),
    ascending=False,
)
GainRow = Annotated[tuple[float, float, float], Strict(strict=False)]  # a list in the file
ModeRow = Annotated[tuple[float, float], Strict(strict=False)]
Identifier = Annotated[str, AfterValidator(_identifier)]
Side = Annotated[float, Quantity(LENGTH, above=0, at_most=100)]
Coordinate = Annotated[float, Quantity(LENGTH, at_least=-100, at_most=100)]
Place = Annotated[tuple[Coordinate, Coordinate], Strict(strict=False)]  # a list in the file
Foot = Annotated[float, Quantity(LENGTH, at_least=0, at_most=0.2)]
Thickness = Annotated[float, Quantity(LENGTH, at_least=1e-6, at_most=1)]
Frequency = Annotated[float, Quantity(FREQUENCY, at_least=1, at_most=2000)]


class MaterialSection(Section):
    """A material by its numbers."""

    name: Identifier = "custom"
    E: Annotated[float, Quantity(MODULUS, at_least=1e3, at_most=1e13)]
    rho: Annotated[float, Quantity(DENSITY, at_least=1, at_most=1e5)]
    nu: Annotated[float, Quantity(RATIO, above=-1, below=0.5)]


MaterialOrName = Annotated[MaterialSection, _MaterialByName()]


class LayerSection(Section):
    """One layer of a laminate."""

    material: MaterialOrName
    thickness: Thickness
    loss_factor: Annotated[float, Quantity(RATIO, at_least=0, at_most=2)] | None = None
    by_frequency: Annotated[list[GainRow], Field(min_length=2, max_length=200), _MODULI] | None = (
        None
    )


class AirGapSection(Section):
    """Air between the plate and a rigid wall behind it."""

    depth: Annotated[float, Quantity(LENGTH, at_least=1e-5, at_most=0.1)]
    closed: bool = False


class PlateSection(Section):
    """The plate: thickness and material, or layers from one face to the other.

    loss_factor: not printed in the paper; 1 % is usual for a metal panel. It is that at 150 Hz and
    varies as the power loss_exponent of the frequency. modes: natural frequency and loss factor of
    the lowest elastic modes, ascending, relative to those of the plate's theory.
    """

    model_config = ConfigDict(
        json_schema_extra={
            "oneOf": [{"required": ["thickness", "material"]}, {"required": ["layers"]}]
        }
    )

    length: Side
    width: Side
    thickness: Thickness | None = None
    material: MaterialOrName | None = None
    layers: Annotated[list[LayerSection], Field(min_length=1, max_length=20)] | None = None
    bond: Annotated[Bond, Strict(strict=False)] = Bond.FULL
    air_gap: AirGapSection | None = None
    loss_factor: Annotated[float, Quantity(RATIO, at_least=0, below=1)] = 0.01
    loss_exponent: Annotated[
        float, Quantity(RATIO, at_least=-MAX_LOSS_EXPONENT, at_most=MAX_LOSS_EXPONENT)
    ] = 0.0
    modes: Annotated[list[ModeRow], Field(max_length=64, default_factory=list), _MODES]


class EraSection(Section):
    """One ERA; without an amplifier it only supports the plate.

    Defaults of damping and stroke are assumed, the paper prints neither.
    """

    model_config = ConfigDict(
        json_schema_extra={
            "dependentRequired": {"amplifier": ["channel"], "channel": ["amplifier"]}
        }
    )

    at: Place
    stiffness: Annotated[float, Quantity(STIFFNESS, above=0, at_most=1e12)]
    damping_ratio: Annotated[float, Quantity(RATIO, at_least=0, at_most=2)] = 0.05
    damping: Annotated[float, Quantity(DAMPING, at_least=0, at_most=1e6)] | None = None
    bolt_mass: Annotated[float, Quantity(MASS, at_least=0, at_most=10)] = 0.0
    stroke: Annotated[float, Quantity(LENGTH, above=0, at_most=0.01)] = 100e-6
    foot: Foot = 0.0
    gains: Annotated[list[GainRow], Field(max_length=2000), _GAINS] | None = None
    amplifier: Identifier | None = None
    channel: Annotated[int, Field(ge=0, le=255)] | None = None


class MassSection(Section):
    """A mass on the plate, at a point or on a disc."""

    at: Place
    mass: Annotated[float, Quantity(MASS, at_least=0, at_most=10)]
    foot: Foot = 0.0


class AmplifierSection(Section):
    """An amplifier: its URL, and what its full level is."""

    url: Annotated[str, AfterValidator(_url)]
    full_level: Literal["motion", "output"] = "motion"


class UncertaintySection(Section):
    """Standard deviations of a rig's parameters, see `Uncertainty`; a key left out means none."""

    @classmethod
    def not_measured(cls) -> "UncertaintySection":
        """Return the section of a rig that was not measured."""
        return cls(**asdict(Uncertainty()))

    gain: Annotated[float, Quantity(RATIO, at_least=0, at_most=0.5)] = 0.0
    phase_deg: Annotated[float, Quantity(RATIO, at_least=0, at_most=60)] = 0.0
    thickness: Annotated[float, Quantity(RATIO, at_least=0, at_most=0.03)] = 0.0
    stiffness: Annotated[float, Quantity(RATIO, at_least=0, at_most=0.5)] = 0.0
    damping: Annotated[float, Quantity(RATIO, at_least=1, at_most=4)] = 1.0
    fingertip: Annotated[float, Quantity(RATIO, at_least=0, at_most=1)] = 0.0
    common_gain: Annotated[float, Quantity(RATIO, at_least=0, at_most=0.5)] = 0.0
    field: Annotated[float, Quantity(RATIO, at_least=0, at_most=0.5)] = 0.0


def _mapping(value: object) -> object:
    if value is None:
        raise ValueError(
            "must be a mapping of `key: value` lines, got null; remove the key for a rig that was "
            "not measured, or write {} for one that is known exactly"
        )
    return value


class FingertipSection(Section):
    """The load of a fingertip, see `Fingertip`; a key left out has the default's value."""

    stiffness: Annotated[float, Quantity(STIFFNESS, at_least=0, at_most=1e6)] = 1000.0
    damping: Annotated[float, Quantity(DAMPING, above=0, at_most=1e4)] = 2.0
    contact_mass: Annotated[float, Quantity(MASS, at_least=0, at_most=0.1)] = 0.0002
    phalanx_mass: Annotated[float, Quantity(MASS, at_least=1e-5, at_most=1)] = 0.005
    joint_stiffness: Annotated[float, Quantity(STIFFNESS, at_least=0, at_most=1e6)] = 500.0
    joint_damping: Annotated[float, Quantity(DAMPING, at_least=0, at_most=1e4)] = 2.0


class LimitsSection(Section):
    """Limits of commands, see `GuardLimits`; all but the frequencies are unlimited by default.

    The default frequencies are those that skin feels well.
    """

    frequency: Annotated[
        tuple[Frequency, Frequency], Strict(strict=False), AfterValidator(_ascending)
    ] = (40.0, 500.0)
    level: Annotated[float, Quantity(RATIO, at_least=0, at_most=1)] = 1.0
    slew: Annotated[float, Quantity(SLEW, above=0, at_most=1e6)] | None = None
    power: Annotated[float, Quantity(RATIO, above=0, at_most=256)] | None = None
    on_time: Annotated[float, Quantity(TIME, above=0, at_most=86_400)] | None = None
    duty: Annotated[float, Quantity(RATIO, above=0, at_most=1)] | None = None
    rate: Annotated[float, Quantity(RATE, at_least=1, at_most=2000)] | None = None


class RigSection(Section):
    """A rig file.

    mesh: auto, auto 1 %, NXxNY, or NXxNY ELEMENT; uncertainty: without it that of a plate which was
    not measured; fingertip: none for weightless fingers; threshold: a set of detection thresholds.
    """

    plate: PlateSection
    mesh: str = "auto"
    eras: Annotated[dict[Identifier, EraSection], Field(min_length=1, max_length=64)]
    masses: Annotated[dict[Identifier, MassSection], Field(max_length=64, default_factory=dict)]
    amplifiers: Annotated[dict[Identifier, AmplifierSection], Field(min_length=1)]
    limits: LimitsSection = LimitsSection()
    uncertainty: Annotated[UncertaintySection, BeforeValidator(_mapping)] = (
        UncertaintySection.not_measured()
    )
    fingertip: FingertipSection | Literal["none"] = FingertipSection()
    threshold: Annotated[str, AfterValidator(_threshold)] = DEFAULT_THRESHOLD
