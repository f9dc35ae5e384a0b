"""Sections of a rig file: keys with defaults and bounds, and the objects they describe.

A section that builds a part of a rig (`made`) also writes it (`stated`). Bounds are wide: they
catch values in the wrong unit.
"""

import math
from collections.abc import Mapping
from dataclasses import asdict, replace
from itertools import product
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    BeforeValidator,
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    GetJsonSchemaHandler,
    Strict,
    ValidatorFunctionWrapHandler,
    WrapValidator,
)
from pydantic_core import CoreSchema, core_schema

from model.config.document import KeyPath
from model.config.fields import FileName, Quantity, Section
from model.config.units import (
    DAMPING,
    DENSITY,
    LENGTH,
    LINE_MASS,
    LINE_STIFFNESS,
    MASS,
    MODULUS,
    RATE,
    RATIO,
    SLEW,
    STIFFNESS,
    TEMPERATURE,
    TIME,
    Dimension,
)
from model.errors import InputError
from model.finger import DEFAULT_THRESHOLD, THRESHOLDS
from model.rig.actuator_keys import (
    MODES,
    MODULI,
    ActuatorOfAnyKind,
    Foot,
    Frequency,
    GainRow,
    Identifier,
    ModeRow,
    Place,
    Side,
    Thickness,
    ThresholdSet,
    check_ascending,
    check_url,
    place_on,
)
from model.rig.rig import BOUNDS, Uncertainty
from model.structure.attachments import (
    DEFAULT_POINTS,
    EDGE_FOOT,
    FEET,
    FEET_DEVIATE,
    FOOT_LOSS,
    FootKind,
    PointLoad,
    edge_points,
)
from model.structure.material import (
    STANDARD_HUMIDITY,
    STANDARD_TEMPERATURE,
    KnownMaterial,
    Material,
    Orthotropy,
    known_material,
    material_names,
)
from model.structure.plate import (
    MAX_LOSS_EXPONENT,
    AirGap,
    Bond,
    Laminate,
    LaminateLayer,
    Plate,
    equivalent_plate,
)
from model.structure.surface import (
    NU,
    THICKNESS,
    Surface,
    deviating_losses,
    digest_of_file,
    homogeneous,
    surface_shapes,
)
from model.structure.surface_check import check_surface
from registry.limits import GuardLimits


class _MaterialByName:
    """Annotation of a material that can be given by name."""

    def read(self, value: object, section: ValidatorFunctionWrapHandler) -> object:
        """Look up a material by name; its numbers can depend on the thickness."""
        return known_material(value) if isinstance(value, str) else section(value)

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        section = handler.generate_schema(MaterialSection)
        return core_schema.no_info_wrap_validator_function(self.read, section)

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        return {"anyOf": [{"enum": list(material_names())}, handler(schema)]}


Modulus = Annotated[float, Quantity(MODULUS, at_least=1e3, at_most=1e13)]
ModulusRows = Annotated[list[GainRow], Field(min_length=2, max_length=200), MODULI]

ISOTROPIC = frozenset({"E", "nu"})
ORTHOTROPIC = frozenset({"E1", "E2", "G12", "G13", "G23", "nu12"})
"""Required numbers of an isotropic material, and of an orthotropic one (with a grain)."""


class MaterialSection(Section):
    """Material given by numbers: `E` and `nu`, or those along and across a grain."""

    model_config = ConfigDict(
        json_schema_extra={
            "oneOf": [{"required": [*sorted(ISOTROPIC)]}, {"required": [*sorted(ORTHOTROPIC)]}]
        }
    )

    name: Identifier = "custom"
    """Displayed only.

    Limits: a name
    """

    E: Modulus | None = None
    """Young's modulus.

    Default: required, or those with a grain
    """

    rho: Annotated[float, Quantity(DENSITY, at_least=1, at_most=1e5)]
    """Density."""

    nu: Annotated[float, Quantity(RATIO, above=-1, below=0.5)] | None = None
    """Poisson's ratio.

    Default: required, or those with a grain
    """

    E1: Modulus | None = None
    """Young's modulus along the grain, instead of `E`; see [boards](#boards)."""

    E2: Modulus | None = None
    """Across the grain."""

    G12: Modulus | None = None
    """Shear modulus in the plane of the board."""

    nu12: Annotated[float, Quantity(RATIO, above=-5, below=5)] | None = None
    """Contraction across the grain due to stress along it, instead of `nu`.

    Limits: above -5, below 5; less than the square root of E1 / E2
    """

    G13: Modulus | None = None
    """Transverse shear modulus along the grain."""

    G23: Modulus | None = None
    """Transverse shear modulus across the grain; for wood, the rolling shear modulus."""

    by_frequency: ModulusRows | None = None
    """Modulus as a function of frequency, for an isotropic material; same format as in a
    [layer](#layers).

    Limits: 2 rows or more, by ascending frequency
    """

    def of_thickness(self, thickness: float) -> Material:
        """Build the material, the same at any thickness; raises InputError for impossible elastic
        constants."""
        if self.E is not None and self.nu is not None:
            return Material(self.name, self.E, self.rho, self.nu)
        E1, E2, nu12 = self.E1, self.E2, self.nu12
        G12, G13, G23 = self.G12, self.G13, self.G23
        # see model.rig.rig_file
        assert E1 and E2 and G12 and G13 and G23 and nu12 is not None  # noqa: S101, PT018
        shares = Orthotropy(E2 / E1, G12 / E1, G13 / E1, G23 / E1)
        return Material(self.name, E1, self.rho, nu12, shares)

    @staticmethod
    def stated(material: Material) -> dict[str, Any]:
        """Return the keys that describe a material; inverse of `of_thickness`."""
        ratio = "nu" if material.orthotropy is None else "nu12"
        return {"name": material.name, **material.moduli, "rho": material.rho, ratio: material.nu}


MaterialOrName = Annotated[MaterialSection | KnownMaterial, _MaterialByName()]


def _named(material: MaterialSection | KnownMaterial | None) -> KnownMaterial | None:
    """Return the known material that is given or named; None for another one."""
    if isinstance(material, MaterialSection):
        is_known = material.name in material_names()
        return known_material(material.name) if is_known else None
    return material


class LayerSection(Section):
    """One layer of a laminate."""

    material: MaterialOrName
    """A name, or numbers."""

    thickness: Thickness
    """Thickness of this layer."""

    loss_factor: Annotated[float, Quantity(RATIO, at_least=0, at_most=2)] | None = None
    """Loss factor of the layer itself, E (1 + i eta), in addition to the plate's `loss_factor`."""

    by_frequency: ModulusRows | None = None
    """`[[frequency in Hz, factor of E, loss factor], ...]`: interpolated linearly in the logarithms
    of frequency and factor, constant outside; replaces `loss_factor`.

    Limits: 2 rows or more, by ascending frequency
    """

    def made(self) -> LaminateLayer:
        """Build the layer; its material's by_frequency applies unless it has losses of its own."""
        rows = self.by_frequency
        if rows is None and self.loss_factor is None:
            rows = [*(self.material.by_frequency or ())]
        return LaminateLayer(
            self.material.of_thickness(self.thickness),
            self.thickness,
            loss_factor=self.loss_factor or 0.0,
            by_frequency=tuple(rows or ()),
        )


class AirGapSection(Section):
    """Air between the plate and a rigid wall behind it."""

    depth: Annotated[float, Quantity(LENGTH, at_least=1e-5, at_most=0.1)]
    """Depth of the gap to a rigid wall."""

    closed: bool = False
    """`true` for a gap sealed along all edges, `false` for one open along all edges.

    Default: none

    Limits: `true`, `false`
    """


def _ascending(ends: tuple[float, float]) -> tuple[float, float]:
    """Return the lower and the higher value; raises ValueError if they are not ascending."""
    if ends[0] > ends[1]:
        raise ValueError(f"must be the lower and the higher value, got {ends[0]:g} and {ends[1]:g}")
    return ends


Temperature = Annotated[float, Quantity(TEMPERATURE, at_least=-40, at_most=120)]
Humidity = Annotated[float, Quantity(RATIO, at_least=0, at_most=1)]
_PAIR = (Strict(strict=False), AfterValidator(_ascending))
Temperatures = Annotated[tuple[Temperature, Temperature], *_PAIR]
Humidities = Annotated[tuple[Humidity, Humidity], *_PAIR]

_AT_ENDS = 0.8  # benchmarks.promise weather: 86 to 94 % at both ends


class PlateSection(Section):
    """The plate: thickness and material, or layers from one face to the other.

    - loss_factor: not stated in the paper; 1 % is usual for a metal panel. Valid at 150 Hz; varies
      with frequency to the power of loss_exponent.
    - modes: natural frequency and loss factor of the lowest elastic modes, ascending, relative to
      those of plate theory.
    """

    model_config = ConfigDict(
        json_schema_extra={
            "oneOf": [{"required": ["thickness", "material"]}, {"required": ["layers"]}]
        }
    )

    length: Side
    """Along x."""

    width: Side
    """Along y."""

    thickness: Thickness | None = None
    """At most the shorter side.

    Default: required, or `layers`
    """

    material: MaterialOrName | None = None
    """A name, or numbers; see [material](#material).

    Default: required, or `layers`
    """

    grain: Literal["length", "width"] = "length"
    """Side along which the grain of a board runs: axis 1 of its material; for plywood, the grain of
    its faces.
    """

    layers: Annotated[list[LayerSection], Field(min_length=1, max_length=20)] | None = None
    """Laminate, instead of `thickness` and `material`; see [layers](#layers)."""

    bond: Annotated[Bond, Strict(strict=False)] = Bond.FULL
    """Bond between the layers; see [laminates](#laminates)."""

    air_gap: AirGapSection | None = None
    """Air between the plate and a rigid wall behind it; see [air_gap](#air_gap).

    Limits: see there
    """

    loss_factor: Annotated[float, Quantity(RATIO, at_least=0, below=1)] | None = None
    """Structural loss factor eta of the mounted plate: hysteretic stiffness (1 + i eta) K.

    Default: 0.01, or the loss factor of its [material](#material) if larger
    """

    loss_exponent: Annotated[
        float, Quantity(RATIO, at_least=-MAX_LOSS_EXPONENT, at_most=MAX_LOSS_EXPONENT)
    ] = 0.0
    """Exponent of the loss factor's frequency dependence; `loss_factor` is its value at 150 Hz."""

    temperature: Temperatures | None = None
    """Lowest and highest temperature of use; see [weather](#weather). Units: °C, °F, K.

    Limits: ascending, -40 °C to 120 °C
    """

    measured_temperature: Temperature = STANDARD_TEMPERATURE
    """Temperature at which the numbers of this file hold: that of the plate's measurement."""

    humidity: Humidities | None = None
    """Lowest and highest relative humidity of use, such as [35 %, 65 %].

    Limits: ascending, 0 to 1
    """

    measured_humidity: Humidity = STANDARD_HUMIDITY
    """Relative humidity at which the numbers of this file hold: that of the weeks before the
    plate's measurement."""

    modes: Annotated[list[ModeRow], Field(max_length=64, default_factory=list), MODES]
    """Natural frequency and loss factor of the lowest elastic modes of the free plate, ascending,
    relative to plate theory, as written by an identification. Mode shapes and higher modes do not
    change.

    Limits: rows of [0.8 to 1.25, 0.01 to 100]
    """

    @property
    def weather(self) -> float:
        """Relative standard deviation of the plate's modulus over density due to weather.

        At this value 90 % of plates keep a promise at both ends of the range; 0 without a range.
        For layers, the change of the layer that changes most; for materials given by numbers, that
        of the material with the same name.
        """
        if self.temperature is None and self.humidity is None:
            return 0.0
        when = self.measured_temperature, self.measured_humidity
        ends = [*product(self.temperature or when[:1], self.humidity or when[1:])]
        parts = [self.material, *(each.material for each in self.layers or ())]
        known = [one for part in parts if (one := _named(part)) is not None]
        changes = [one.by_weather(*end) - one.by_weather(*when) for one in known for end in ends]
        return _AT_ENDS * max(map(abs, changes), default=0.0)

    @property
    def laminate(self) -> Laminate | None:
        """Laminate of the plate; None for a homogeneous plate.

        A single layer represents a material that depends on frequency.
        """
        if self.layers is not None:
            return Laminate(tuple(each.made() for each in self.layers), bond=self.bond)
        known, thickness = self.material, self.thickness
        if known is None or not known.by_frequency or thickness is None:
            return None
        alone = known.of_thickness(thickness)
        return Laminate((LaminateLayer(alone, thickness, by_frequency=tuple(known.by_frequency)),))

    def made(self, *, frequency_max: float) -> Plate:
        """Build the plate; a laminate is represented by its equivalent plate at the highest
        frequency [Hz]."""
        # If no loss factor is given: the larger of a mounted panel's and the material's own.
        known = self.material.own_loss if isinstance(self.material, KnownMaterial) else 0.0
        default = max(known, Plate.loss_factor)
        own: dict[str, Any] = {name: getattr(self, name) for name in PLAIN_KEYS}
        own |= {
            "loss_factor": default if self.loss_factor is None else self.loss_factor,
            "mode_deviations": tuple((2 * math.log(f), math.log(loss)) for f, loss in self.modes),
            "air_gap": None if self.air_gap is None else AirGap(**self.air_gap.model_dump()),
        }
        laminate = self.laminate
        if laminate is not None:
            plate = equivalent_plate(
                laminate, length=self.length, width=self.width, frequency=frequency_max
            )
            return replace(plate, **own)
        assert self.thickness is not None  # noqa: S101  see model.rig.rig_file
        assert self.material is not None  # noqa: S101
        material = self.material.of_thickness(self.thickness)
        if self.grain == "width":
            material = material.turned()
        return Plate(thickness=self.thickness, material=material, **own)

    def stated(self, plate: Plate, laminate: Laminate | None) -> dict[KeyPath, Any]:
        """Return the values of these keys, by path, that describe another plate; inverse of `made`.

        laminate: from which that plate is built. It must have the form of this section: as many
        layers, the same air gap (if any), grain and bond.
        """
        layers = laminate.layers if laminate else ()
        found: dict[KeyPath, Any] = {}
        if self.layers is None:
            whole = layers[0] if layers else plate
            along = whole.material.turned() if self.grain == "width" else whole.material
            found["material",] = MaterialSection.stated(along)
            found["thickness",] = whole.thickness
        else:
            for number, layer in enumerate(layers):
                found["layers", number, "material"] = MaterialSection.stated(layer.material)
                found["layers", number, "thickness"] = layer.thickness
        if self.air_gap is not None and plate.air_gap is not None:
            found |= {("air_gap", key): each for key, each in asdict(plate.air_gap).items()}
        found["loss_factor",] = plate.loss_factor
        found |= {(name,): getattr(plate, name) for name in PLAIN_KEYS}
        found["modes",] = [
            [math.exp(shift / 2), math.exp(loss)] for shift, loss in plate.mode_deviations
        ]
        return found


PLAIN_KEYS: Mapping[str, Dimension] = {
    name: each.dimension
    for name, key in PlateSection.model_fields.items()
    for each in key.metadata
    if isinstance(each, Quantity) and name in Plate.__dataclass_fields__
}
"""Dimensions of plate keys that are quantities and equal a field of `Plate`."""

Corner = Annotated[
    tuple[
        Annotated[float, Quantity(LENGTH, at_least=-10, at_most=10)],
        Annotated[float, Quantity(LENGTH, at_least=-10, at_most=10)],
    ],
    Strict(strict=False),
]
Ring = Annotated[list[Corner], Field(min_length=3, max_length=1000)]


class SurfaceSection(Section):
    """Surface given by modes from another program, instead of a plate."""

    modes: FileName
    """File of its modes, relative to the rig file: universal, .npz or .csv; see
    [surfaces](#surface).

    Limits: a file
    """

    normal: Literal["x", "y", "z", "-x", "-y", "-z", "local x", "local y", "local z"] = "z"
    """Direction from the surface toward the fingers, in axes of the file; `local z` for the normal
    at each node of a curved surface.
    """

    mass: Annotated[float, Quantity(MASS, above=0, at_most=1000)] | None = None
    """Mass that moves along the normal.

    Default: from the rigid modes in the file; required without them
    """

    loss_factor: Annotated[float, Quantity(RATIO, at_least=0, below=1)] | None = None
    """Structural loss factor of all modes.

    Default: twice the damping ratio of each mode in the file, else 0.01
    """

    outline: Annotated[list[Ring], Field(min_length=1, max_length=100)] | None = None
    """Rings of points `[x, y]`: edges and cut-outs of the surface.

    Default: of the shells in the file, else the rectangle around all nodes
    """

    def made(self, path: Path) -> Plate:
        """Build the plate from a modes file; raises InputError for invalid modes."""
        digest = digest_of_file(path)
        shapes = surface_shapes(str(path), digest, self.normal)
        notes = check_surface(str(path), digest, self.normal, self.mass)
        modulus, density, loss = homogeneous(shapes, self.mass)
        if self.loss_factor is None and not 0 <= loss < 1:
            raise InputError(
                f"{path}: damping ratios must be from 0 to below 0.5 in most modes, got "
                f"{loss / 2:g} in the median; export fractions of critical damping, or give "
                "surface.loss_factor"
            )
        rings = shapes.outline if self.outline is None else self.outline
        surface = Surface(
            str(path),
            digest,
            self.normal,
            count=len(shapes.frequencies),
            rigid=shapes.rigid,
            frequency=float(shapes.frequencies[-1]),
            modulus=modulus,
            outline=tuple(tuple((float(x), float(y)) for x, y in ring) for ring in rings),
            notes=notes,
        )
        length, width = shapes.size.tolist()
        return Plate(
            length,
            width,
            THICKNESS,
            Material("surface", E=modulus, rho=density, nu=NU),
            loss if self.loss_factor is None else self.loss_factor,
            mode_deviations=() if self.loss_factor is not None else deviating_losses(shapes, loss),
            surface=surface,
        )


Edges = Literal["edges"]
Points = Annotated[int, Field(ge=3, le=40)]


class MassSection(Section):
    """Mass on the plate, at a point or on a disc, or along all edges."""

    model_config = ConfigDict(
        json_schema_extra={
            "oneOf": [{"required": ["at", "mass"]}, {"required": ["along", "mass_per_length"]}]
        }
    )

    at: Place | None = None
    """`[x, y]`, on the plate.

    Default: required, or `along`
    """

    mass: Annotated[float, Quantity(MASS, at_least=0, at_most=10)] | None = None
    """Mass at the point.

    Default: required with `at`
    """

    foot: Foot = 0.0
    """Radius of its contact disc, 0 for a point."""

    along: Edges | None = None
    """`edges` for a frame bonded to all edges, instead of `at`."""

    mass_per_length: Annotated[float, Quantity(LINE_MASS, at_least=0, at_most=100)] | None = None
    """Frame mass per length.

    Default: required with `along`
    """

    points: Points = DEFAULT_POINTS
    """Number of points per edge at which a frame acts; increase it for many waves along an edge."""

    def made(self, plate: Plate) -> tuple[PointLoad, ...]:
        """Build the mass on a plate, or the masses of a frame along its edges."""
        if self.at is not None:
            x, y = place_on(plate, self.at)
            return (PointLoad(x, y, mass=self.mass or 0.0, foot=self.foot),)
        per_length = self.mass_per_length or 0.0
        return tuple(
            PointLoad(x, y, mass=per_length * length, foot=EDGE_FOOT)
            for x, y, length in edge_points(plate, self.points)
        )


class SupportSection(Section):
    """Passive foot under the plate, or support along its edges."""

    at: Place | None = None
    """`[x, y]`, on the plate.

    Default: required, or `along`
    """

    kind: FootKind | None = None
    """Type of foot, which sets its stiffness [as listed](#supports) unless `stiffness` is given."""

    stiffness: Annotated[float, Quantity(STIFFNESS, above=0, at_most=1e12)] | None = None
    """Stiffness of its spring.

    Default: required with `at`, or `kind`
    """

    loss_factor: Annotated[float, Quantity(RATIO, at_least=0, at_most=2)] | None = None
    """Loss factor eta of the spring, k (1 + i eta).

    Default: [as listed](#supports), or 0 with `damping`
    """

    damping: Annotated[float, Quantity(DAMPING, at_least=0, at_most=1e6)] | None = None
    """Viscous damping, instead of a loss factor or in addition to a given one."""

    foot: Foot = 0.0
    """Radius of its contact disc, 0 for a point; required if the stiffness is 1 MN/m or more."""

    along: Edges | None = None
    """`edges` for a support along all edges, such as foam tape, instead of `at`."""

    stiffness_per_length: (
        Annotated[float, Quantity(LINE_STIFFNESS, above=0, at_most=1e9)] | None
    ) = None
    """Stiffness per length of a support along the edges.

    Default: required with `along`
    """

    points: Points = DEFAULT_POINTS
    """Number of points per edge at which it acts; increase it for many waves along an edge."""

    def made(self, plate: Plate) -> tuple[PointLoad, ...]:
        """Build the foot under a plate, or springs along its edges."""
        damping, loss_factor = self.damping or 0.0, self.loss_factor
        if loss_factor is None:
            loss_factor = FOOT_LOSS if self.damping is None else 0.0
        spring = PointLoad(0.0, 0.0, damping=damping, loss_factor=loss_factor)
        if self.at is not None:
            stiffness = self.stiffness or FEET[self.kind or "foam"]
            x, y = place_on(plate, self.at)
            foot = replace(spring, x=x, y=y, foot=self.foot)
            return (replace(foot, stiffness=stiffness, is_foot=True),)
        edge, per_length = 2 * (plate.length + plate.width), self.stiffness_per_length or 0.0
        return tuple(
            replace(
                spring,
                x=x,
                y=y,
                stiffness=per_length * length,
                damping=damping * length / edge,
                foot=EDGE_FOOT,
            )
            for x, y, length in edge_points(plate, self.points)
        )


class AmplifierSection(Section):
    """Amplifier: its URL, and the meaning of its full level."""

    url: Annotated[str, AfterValidator(check_url)]
    """Address: `sim://`, `serial:///dev/ttyUSB0?baud=921600`.

    Limits: [`SCHEME://...`](urls.md)
    """

    full_level: Literal["motion", "output"] | None = None
    """Quantity played at level 1.

    Default: `output` if it drives an exciter, else `motion`

    Limits: `motion`, `output`
    """

    clock_error: Annotated[
        float | Literal["unknown"], Quantity(TIME, at_least=0, at_most=0.001, word="unknown")
    ] = 5e-6
    """Clock error assumed by `era config check`; once connected, the amplifier states its own.

    Limits: 0 to 1 ms, or `unknown` for a clock that cannot be steered
    """


def _within(key: str, unit: Dimension = RATIO) -> Quantity:
    """Return the bounds of a parameter of an `Uncertainty`."""
    return Quantity(unit, at_least=BOUNDS[key][0], at_most=BOUNDS[key][1])


class UncertaintySection(Section):
    """Standard deviations of a rig's parameters, with the defaults and bounds of `Uncertainty`."""

    gain: Annotated[float, _within("gain")] = Uncertainty.gain
    """Gain of each channel, relative."""

    phase_deg: Annotated[float, _within("phase_deg")] = Uncertainty.phase_deg
    """Phase of each channel, in degrees."""

    thickness: Annotated[float, _within("thickness")] = Uncertainty.thickness
    """Thickness of the plate, relative."""

    stiffness: Annotated[float, _within("stiffness")] = Uncertainty.stiffness
    """Stiffness of each ERA, relative."""

    damping: Annotated[float, _within("damping")] = Uncertainty.damping
    """Factor, for the ERAs' damping and, independently, the plate's loss factor."""

    fingertip: Annotated[float, _within("fingertip")] = Uncertainty.fingertip
    """Natural logarithm of each finger's load."""

    common_gain: Annotated[float, _within("common_gain")] = Uncertainty.common_gain
    """Common gain of all channels, relative; affects levels only."""

    field: Annotated[float, _within("field")] = Uncertainty.field
    """Acceleration caused by each ERA at a finger, relative to its RMS over the plate, from causes
    that no other key describes.
    """

    modulus: Annotated[float, _within("modulus")] = Uncertainty.modulus
    """Modulus of elasticity of the plate, relative; it counts as 0 if `thickness` is 0."""

    place: Annotated[float, _within("place", LENGTH)] = Uncertainty.place
    """Position of each ERA, along x and along y."""

    harmonic: Annotated[float, _within("harmonic")] = Uncertainty.harmonic
    """Second harmonic of each ERA's motion relative to its own amplitude, at any phase."""

    supports: Annotated[float, _within("supports")] | None = None
    """Natural logarithm of the stiffness of each foot.

    Default: 0.3 if the rig has feet, else 0
    """

    weather: Annotated[float, _within("weather")] | None = None
    """Modulus of the plate due to temperature and moisture, relative; also used if `thickness` is
    0.

    Default: from `plate.temperature` and `plate.humidity`, see [weather](#weather), else 0
    """

    foreign_mass: Annotated[float, _within("foreign_mass", MASS)] = Uncertainty.foreign_mass
    """Mass of an object that can be anywhere on the plate, such as a 200 g cup; see [what lies on
    the plate](../concepts/people.md#objects-on-the-plate).
    """

    mode_frequency: Annotated[float, _within("mode_frequency")] = Uncertainty.mode_frequency
    """Natural frequency of each mode individually, relative: the difference between a computed
    [surface](#surface) and the one that was built.
    """

    mode_amplitude: Annotated[float, _within("mode_amplitude")] = Uncertainty.mode_amplitude
    """Amplitude of each mode shape of a surface individually, relative."""

    def made(self, *, has_feet: bool, weather: float) -> Uncertainty:
        """Build the uncertainty of a rig; for feet, default `FEET_DEVIATE`.

        weather: default, from the plate.
        """
        unknown = {"supports": FEET_DEVIATE if has_feet else 0.0, "weather": weather}
        return Uncertainty(**(unknown | self.model_dump(exclude_none=True)))


class FingertipSection(Section):
    """Load of a fingertip, see `Fingertip`; a missing key has its default value."""

    stiffness: Annotated[float, Quantity(STIFFNESS, at_least=0, at_most=1e6)] = 1000.0
    """Stiffness of the pulp."""

    damping: Annotated[float, Quantity(DAMPING, above=0, at_most=1e4)] = 2.0
    """Damping of the pulp."""

    contact_mass: Annotated[float, Quantity(MASS, at_least=0, at_most=0.1)] = 0.0002
    """Mass that moves with the plate."""

    phalanx_mass: Annotated[float, Quantity(MASS, at_least=1e-5, at_most=1)] = 0.005
    """Mass of the bone behind the pulp."""

    joint_stiffness: Annotated[float, Quantity(STIFFNESS, at_least=0, at_most=1e6)] = 500.0
    """Stiffness of the joint that holds the bone."""

    joint_damping: Annotated[float, Quantity(DAMPING, at_least=0, at_most=1e4)] = 2.0
    """Damping of that joint."""


class LimitsSection(Section):
    """Limits of commands, see `GuardLimits`; all except the frequencies are unlimited by default.

    The default frequencies are in the range that skin feels well.
    """

    frequency: Annotated[
        tuple[Frequency, Frequency], Strict(strict=False), AfterValidator(check_ascending)
    ] = (40.0, 500.0)
    """Lowest and highest mechanical drive frequency."""

    level: Annotated[float, Quantity(RATIO, at_least=0, at_most=1)] = 1.0
    """Maximum level, as a fraction of full level (an ERA's stroke)."""

    slew: Annotated[float, Quantity(SLEW, above=0, at_most=1e6)] | None = None
    """Maximum rise of a level; `2 %/ms` is from rest to full stroke in 50 ms. Ramps are lengthened
    accordingly; an envelope that rises faster is rejected. The rise is an average over the ramp,
    starting at the lowest level that can be playing; a raised cosine is 1.6 times as steep in its
    middle.
    """

    power: Annotated[float, Quantity(RATIO, above=0, at_most=256)] | None = None
    """Maximum sum of the squared levels of an amplifier's channels; 1 is one channel at full
    stroke, or four channels at half stroke.
    """

    on_time: Annotated[float, Quantity(TIME, above=0, at_most=86_400)] | None = None
    """Longest continuous vibration of an amplifier, including ramps; the amplifier then ends it on
    its own."""

    duty: Annotated[float, Quantity(RATIO, above=0, at_most=1)] | None = None
    """Maximum fraction of any ten seconds in which an amplifier vibrates, including ramps."""

    rate: Annotated[float, Quantity(RATE, at_least=1, at_most=2000)] | None = None
    """Maximum number of command sets per second sent to one amplifier, other than silence. Sets are
    counted over 1.1 s, so that the amplifier never gets more in one second even if some are
    delayed. A rejected set is played as soon as the limit allows.
    """

    def made(self) -> GuardLimits:
        """Build the limits, infinite unless given."""
        low, high = self.frequency
        given = self.model_dump(exclude={"frequency"}, exclude_none=True)
        return GuardLimits(frequency_min=low, frequency_max=high, **given)


class RigSection(Section):
    """A rig file.

    - mesh: auto, auto 1 %, NXxNY, or NXxNY ELEMENT.
    - uncertainty: default for a plate without measurements.
    - fingertip: none for massless fingers.
    - threshold: a set of detection thresholds.
    - promised_thresholds: sets for which promises hold.
    """

    plate: PlateSection | None = None
    """The plate; see [plate](#plate).

    Default: required, or `surface`
    """

    surface: Annotated[
        SurfaceSection | None,
        BeforeValidator(
            lambda value: {"modes": value} if isinstance(value, str) else value,
            json_schema_input_type=SurfaceSection | str | None,
        ),
    ] = None
    """Modes from another program, instead of a plate; see [surface](#surface).

    Limits: a mapping, or a file of modes
    """

    mesh: str = "auto"
    """`auto A %` uses polynomials over the plate for a response error of A % up to the upper
    `limits.frequency` (`auto`: 1 %), or elements if that takes too many polynomials; see [the plate
    model](../concepts/plate-model.md). Otherwise: the number of elements along x and y, of type
    MITC4, Q3, Q4 or Q5, with a narrow row along every edge if strips are given; or polynomial
    degrees with `Legendre` as the element. A mesh with fewer than six elements per bending
    wavelength at that frequency is rejected.

    Limits: `auto`, `auto A %` with A from 0.05 to 10, `NXxNY` with 1 to 1000 a side, `NXxNY
    ELEMENT`, or `NXxNY ELEMENT with strips of W`
    """

    eras: Annotated[dict[Identifier, ActuatorOfAnyKind], Field(min_length=1, max_length=64)]
    """ERAs or exciters by name; see [eras](#eras) and [exciters](#exciters)."""

    masses: Annotated[dict[Identifier, MassSection], Field(max_length=64, default_factory=dict)]
    """Masses by name; see [masses](#masses)."""

    supports: Annotated[
        dict[Identifier, SupportSection], Field(max_length=64, default_factory=dict)
    ]
    """Passive supports of the plate by name; see [supports](#supports)."""

    amplifiers: Annotated[dict[Identifier, AmplifierSection], Field(min_length=1)]
    """Amplifiers by name; see [amplifiers](#amplifiers)."""

    limits: LimitsSection = LimitsSection()
    """Limits of drive commands; see [limits](#limits)."""

    uncertainty: UncertaintySection = UncertaintySection()
    """Uncertainty of the rig; see [uncertainty](#uncertainty)."""

    fingertip: Annotated[
        FingertipSection,
        # Not a union, since pydantic would name both alternatives in errors.
        WrapValidator(
            lambda value, section: value if value == "none" else section(value),
            json_schema_input_type=FingertipSection | Literal["none"],
        ),
    ] = FingertipSection()
    """Load of each finger on the plate, see [fingertip](#fingertip); `none` for massless fingers.

    Limits: a mapping, or `none`
    """

    threshold: ThresholdSet = DEFAULT_THRESHOLD
    """Threshold set to which levels in dB SL refer; see
    [people](../concepts/people.md#detection-thresholds).

    Limits: `vibrotactile-probe`, `pressing-fingertip`
    """

    promised_thresholds: Annotated[
        list[ThresholdSet],
        Field(min_length=1, default_factory=lambda: [*THRESHOLDS]),
    ]
    """Threshold sets for which promises hold: the set with the lowest promise counts, and
    `threshold` always counts. Default: all published sets. To base promises on `threshold` alone,
    list only that set.

    Limits: a list of `vibrotactile-probe`, `pressing-fingertip`
    """
