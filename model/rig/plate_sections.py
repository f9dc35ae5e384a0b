"""Sections of a rig file for the plate: material, layers and air gap, or the modes of a surface.

A section that builds a part of a rig (`build`) also writes it (`keys_of`). Bounds are wide: they
catch values in the wrong unit.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from itertools import product
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    GetJsonSchemaHandler,
    Strict,
    ValidatorFunctionWrapHandler,
)
from pydantic_core import CoreSchema, core_schema

from model.config.document import KeyPath
from model.config.fields import FileName, Quantity, Section
from model.config.units import DENSITY, LENGTH, MASS, MODULUS, RATIO, TEMPERATURE, Dimension
from model.errors import InputError
from model.rig.key_types import (
    MODES,
    MODULI,
    GainRow,
    Identifier,
    LossRatio,
    ModeRow,
    MountedLossFactor,
    Share,
    Side,
    Thickness,
)
from model.structure.laminate_bending import equivalent_plate
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
    SurroundingAir,
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
"""Required numbers of an isotropic and of an orthotropic material (with a grain)."""


class MaterialSection(Section):
    """Material given by numbers: `E` and `nu`, or moduli along and across a grain."""

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
    """Modulus as a function of frequency, for an isotropic material; same format as for a
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
        # see model.rig.rig_checks
        assert E1 and E2 and G12 and G13 and G23 and nu12 is not None  # noqa: S101, PT018
        shares = Orthotropy(E2 / E1, G12 / E1, G13 / E1, G23 / E1)
        return Material(self.name, E1, self.rho, nu12, shares)

    @staticmethod
    def keys_of(material: Material) -> dict[str, Any]:
        """Return the keys that describe a material; inverse of `of_thickness`."""
        ratio = "nu" if material.orthotropy is None else "nu12"
        return {"name": material.name, **material.moduli, "rho": material.rho, ratio: material.nu}


MaterialOrName = Annotated[MaterialSection | KnownMaterial, _MaterialByName()]


def _catalog_material(material: MaterialSection | KnownMaterial | None) -> KnownMaterial | None:
    """Return the material of the catalog that is given, or that has the same name; else None."""
    if not isinstance(material, MaterialSection):
        return material
    return known_material(material.name) if material.name in material_names() else None


class LayerSection(Section):
    """One layer of a laminate."""

    material: MaterialOrName
    """A name, or numbers."""

    thickness: Thickness
    """Thickness of this layer."""

    loss_factor: LossRatio | None = None
    """Loss factor of the layer itself, E (1 + i eta), in addition to the plate's `loss_factor`."""

    by_frequency: ModulusRows | None = None
    """`[[frequency in Hz, factor of E, loss factor], ...]`: interpolated linearly in the logarithms
    of frequency and factor, constant outside; replaces `loss_factor`.

    Limits: 2 rows or more, by ascending frequency
    """

    def build(self) -> LaminateLayer:
        """Build the layer; its material's by_frequency applies unless it has losses of its own."""
        rows: Sequence[GainRow] = self.by_frequency or ()
        if self.by_frequency is None and self.loss_factor is None:
            rows = self.material.by_frequency or ()
        return LaminateLayer(
            self.material.of_thickness(self.thickness),
            self.thickness,
            loss_factor=self.loss_factor or 0.0,
            by_frequency=tuple(rows),
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


def _ascending(bounds: tuple[float, float]) -> tuple[float, float]:
    """Return the lower and the higher value; raises ValueError if they do not ascend."""
    low, high = bounds
    if low > high:
        raise ValueError(f"must be the lower and the higher value, got {low:g} and {high:g}")
    return bounds


Temperature = Annotated[float, Quantity(TEMPERATURE, at_least=-40, at_most=120)]
_PAIR = (Strict(strict=False), AfterValidator(_ascending))
Temperatures = Annotated[tuple[Temperature, Temperature], *_PAIR]
Humidities = Annotated[tuple[Share, Share], *_PAIR]

_AT_ENDS = 0.8  # benchmarks.promise weather: 86 to 94 % at both ends


class PlateSection(Section):
    """The plate: thickness and material, or layers from one face to the other.

    - loss_factor: not stated in the paper; 1 % is usual for a metal panel. Valid at 150 Hz; varies
      with frequency to the power of loss_exponent.
    - modes: natural frequency and loss factor of the lowest elastic modes, ascending, relative to
      plate theory.
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

    air: Literal["none", "front", "both sides"] = "none"
    """Open air that moves with the plate; see [air](#air)."""

    air_gap: AirGapSection | None = None
    """Air between the plate and a rigid wall behind it; see [air_gap](#air_gap).

    Limits: see there
    """

    loss_factor: MountedLossFactor | None = None
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
    """Temperature at which the numbers of this file hold; usually the measurement's."""

    humidity: Humidities | None = None
    """Lowest and highest relative humidity of use, such as [35 %, 65 %].

    Limits: ascending, 0 to 1
    """

    measured_humidity: Share = STANDARD_HUMIDITY
    """Relative humidity at which the numbers of this file hold; usually the mean over the weeks
    before the measurement."""

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
        For layers, the largest change of any layer counts. For a material given by numbers, the
        change of the known material with the same name counts.
        """
        if self.temperature is None and self.humidity is None:
            return 0.0
        measured = self.measured_temperature, self.measured_humidity
        temperatures = self.temperature or (self.measured_temperature,)
        humidities = self.humidity or (self.measured_humidity,)
        largest = 0.0
        for part in (self.material, *(layer.material for layer in self.layers or ())):
            material = _catalog_material(part)
            if material is None:
                continue
            for climate in product(temperatures, humidities):
                change = material.by_weather(*climate) - material.by_weather(*measured)
                largest = max(largest, abs(change))
        return _AT_ENDS * largest

    @property
    def laminate(self) -> Laminate | None:
        """Laminate of the plate; None for a homogeneous plate.

        A single layer represents a material that depends on frequency.
        """
        if self.layers is not None:
            return Laminate(tuple(layer.build() for layer in self.layers), bond=self.bond)
        material, thickness = self.material, self.thickness
        if material is None or not material.by_frequency or thickness is None:
            return None
        layer = LaminateLayer(
            material.of_thickness(thickness), thickness, by_frequency=tuple(material.by_frequency)
        )
        return Laminate((layer,))

    def build(self, *, frequency_max: float) -> Plate:
        """Build the plate; a laminate is represented by its equivalent plate at the highest
        frequency [Hz]."""
        values: dict[str, Any] = {name: getattr(self, name) for name in PLAIN_KEYS}
        values["loss_factor"] = self._loss_factor
        values["mode_deviations"] = tuple(
            (2 * math.log(frequency), math.log(loss)) for frequency, loss in self.modes
        )
        if self.air != "none":
            values["air"] = SurroundingAir(self.air)
        if self.air_gap is not None:
            values["air_gap"] = AirGap(**self.air_gap.model_dump())
        laminate = self.laminate
        if laminate is not None:
            plate = equivalent_plate(
                laminate, length=self.length, width=self.width, frequency=frequency_max
            )
            return replace(plate, **values)
        assert self.thickness is not None  # noqa: S101  see model.rig.rig_checks
        assert self.material is not None  # noqa: S101
        material = self.material.of_thickness(self.thickness)
        if self.grain == "width":
            material = material.turned()
        return Plate(**values | {"thickness": self.thickness, "material": material})

    @property
    def _loss_factor(self) -> float:
        """Loss factor of the plate; by default, the larger of a mounted panel's and the
        material's."""
        if self.loss_factor is not None:
            return self.loss_factor
        if isinstance(self.material, KnownMaterial):
            return max(self.material.own_loss, Plate.loss_factor)
        return Plate.loss_factor

    def keys_of(self, plate: Plate, laminate: Laminate | None) -> dict[KeyPath, Any]:
        """Return key values, by path, that describe another plate; inverse of `build`.

        laminate: from which that plate is built. It must have the form of this section: as many
        layers, the same air gap (if any), grain and bond.
        """
        layers = laminate.layers if laminate else ()
        values: dict[KeyPath, Any] = {}
        if self.layers is None:
            sheet = layers[0] if layers else plate
            material = sheet.material.turned() if self.grain == "width" else sheet.material
            values["material",] = MaterialSection.keys_of(material)
            values["thickness",] = sheet.thickness
        else:
            for number, layer in enumerate(layers):
                values["layers", number, "material"] = MaterialSection.keys_of(layer.material)
                values["layers", number, "thickness"] = layer.thickness
        values["air",] = "none" if plate.air is None else plate.air.value
        if self.air_gap is not None and plate.air_gap is not None:
            for key, value in asdict(plate.air_gap).items():
                values["air_gap", key] = value
        values["loss_factor",] = plate.loss_factor
        for name in PLAIN_KEYS:
            values[name,] = getattr(plate, name)
        values["modes",] = [
            [math.exp(shift / 2), math.exp(loss)] for shift, loss in plate.mode_deviations
        ]
        return values


PLAIN_KEYS: Mapping[str, Dimension] = {
    name: annotation.dimension
    for name, field in PlateSection.model_fields.items()
    for annotation in field.metadata
    if isinstance(annotation, Quantity) and name in Plate.__dataclass_fields__
}
"""Dimensions of plate keys that are quantities and equal a field of `Plate`."""

_Length = Annotated[float, Quantity(LENGTH, at_least=-10, at_most=10)]
Corner = Annotated[tuple[_Length, _Length], Strict(strict=False)]
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

    loss_factor: MountedLossFactor | None = None
    """Structural loss factor of all modes.

    Default: twice the damping ratio of each mode in the file, else 0.01
    """

    outline: Annotated[list[Ring], Field(min_length=1, max_length=100)] | None = None
    """Rings of points `[x, y]`: edges and cut-outs of the surface.

    Default: of the shells in the file, else the rectangle around all nodes
    """

    def build(self, path: Path) -> Plate:
        """Build the plate from a modes file; raises InputError for invalid modes."""
        file = str(path)
        digest = digest_of_file(path)
        shapes = surface_shapes(file, digest, self.normal)
        notes = check_surface(file, digest, self.normal, self.mass)
        modulus, density, loss = homogeneous(shapes, self.mass)
        if self.loss_factor is None and not 0 <= loss < 1:
            raise InputError(
                f"{path}: damping ratios must be from 0 to below 0.5 in most modes, got "
                f"{loss / 2:g} in the median; export fractions of critical damping, or give "
                "surface.loss_factor"
            )
        outline = shapes.outline
        if self.outline is not None:
            outline = tuple(tuple((float(x), float(y)) for x, y in ring) for ring in self.outline)
        surface = Surface(
            file,
            digest,
            self.normal,
            count=len(shapes.frequencies),
            rigid=shapes.rigid,
            frequency=float(shapes.frequencies[-1]),
            modulus=modulus,
            outline=outline,
            notes=notes,
        )
        length, width = shapes.size.tolist()
        plate = Plate(
            length,
            width,
            THICKNESS,
            Material("surface", E=modulus, rho=density, nu=NU),
            surface=surface,
        )
        if self.loss_factor is not None:
            return replace(plate, loss_factor=self.loss_factor)
        return replace(plate, loss_factor=loss, mode_deviations=deviating_losses(shapes, loss))
