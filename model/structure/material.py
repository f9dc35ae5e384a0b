"""Materials, isotropic or with a grain, and the catalog of known materials by name.

The catalog is model/data/materials.toml, with the source of each value.

An installed package adds a material through an entry point of the group `era_haptics.materials`
that refers to a `KnownMaterial` with that name; rig files, their schema and `era plate materials`
then include it.

Moduli of plywood follow from its veneers, which have E along their grain, and none across it
(Handbook of Finnish Plywood), so that in bending, with the cross veneers between heights a and b
from the middle, E2 h³ = 8 E sum (b³ - a³) and E1 + E2 = E.
"""

import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from importlib.resources import files
from typing import Any

from model.errors import InputError, expect_values
from registry.plugins import PluginRegistry


@dataclass(frozen=True)
class Orthotropy:
    """Moduli of a material with a grain, as shares of E, the modulus along the plate's length."""

    e2: float  # across the length
    g12: float  # shear in the plane
    g13: float  # transverse shear along the length
    g23: float  # transverse shear across it

    def __post_init__(self) -> None:
        """Reject moduli that are not above zero."""
        expect_values(self, "orthotropic material", above="e2 g12 g13 g23")


@dataclass(frozen=True)
class Material:
    """A linear material, isotropic unless it has a grain."""

    name: str
    E: float
    """Young's modulus [Pa], with a grain along the plate's length."""

    rho: float
    """Density [kg/m³]."""

    nu: float
    """Poisson's ratio; with a grain, nu12: contraction across the length by a stress along it."""

    orthotropy: Orthotropy | None = None

    def __post_init__(self) -> None:
        """Reject values that no solid has."""
        expect_values(self, f"material {self.name}", above="E rho")
        if self.orthotropy is None and not -1 < self.nu < 0.5:
            raise InputError(
                f"material {self.name}: nu must be between -1 and 0.5, got {self.nu} (most solids: "
                "0.2 to 0.45)"
            )
        if not self.nu**2 * self.shares.e2 < 1:  # of no elastic energy; also of NaN
            limit = self.shares.e2**-0.5
            raise InputError(
                f"material {self.name}: nu12 must be less than the root of E1 / E2, {limit:.3g}, "
                f"got {self.nu}"
            )

    @property
    def shares(self) -> Orthotropy:
        """Moduli as shares of E; an isotropic material has G = E / (2 (1 + nu)) in all planes."""
        if self.orthotropy is not None:
            return self.orthotropy
        shear = 1 / (2 * (1 + self.nu))
        return Orthotropy(1.0, shear, shear, shear)

    @property
    def moduli(self) -> dict[str, float]:
        """Its moduli [Pa] by the keys of a rig file."""
        grain = self.orthotropy
        if grain is None:
            return {"E": self.E}
        shares = vars(grain).items()
        return {"E1": self.E} | {key.upper(): share * self.E for key, share in shares}

    @property
    def plane_stress(self) -> float:
        """1 - nu12 nu21, the divisor of plate moduli."""
        return 1 - self.nu**2 * self.shares.e2

    def turned(self) -> "Material":
        """The material with its grain turned by a right angle."""
        grain = self.orthotropy
        if grain is None:
            return self
        e2 = grain.e2
        turned = Orthotropy(1 / e2, grain.g12 / e2, grain.g23 / e2, grain.g13 / e2)
        return replace(self, E=self.E * e2, nu=self.nu * e2, orthotropy=turned)


@dataclass(frozen=True)
class KnownMaterial:
    """A material with its sources."""

    material: Material
    source: str
    """Source of E, rho and nu."""

    variation: str
    """Variation of these values between grades and measurements."""

    loss_factor: str
    """Order of magnitude of the bare material's loss factor (Cremer and Heckl, Structure-Borne
    Sound, 2nd ed.).
    """

    own_loss: float = 0.0
    """Default loss factor of a plate if it exceeds 1 %, the value for a mounted panel's joints."""

    by_frequency: tuple[tuple[float, float, float], ...] = ()
    """Frequency [Hz], factor of E and loss factor, same as for a layer; empty if constant."""

    by_thickness: Callable[[float], Material] | None = None
    """Material of a board by thickness [m]; `material` is then the one for a typical thickness."""

    by_kelvin: float = 0.0
    """Relative change of its moduli per kelvin."""

    by_moisture: float = 0.0
    """Relative change of its moduli per moisture (share of the dry mass); 0 if it takes up none."""

    weather: str = "assumed to be none"
    """Source of both."""

    def of_thickness(self, thickness: float) -> Material:
        """The material of a board of a thickness [m]."""
        return self.material if self.by_thickness is None else self.by_thickness(thickness)

    def by_weather(self, temperature: float, humidity: float) -> float:
        """Relative change of modulus over density in equilibrium with air.

        Twice the change of natural frequencies, relative to 20 °C and 65 %, the climate of wood
        tests (EN 408). temperature [°C]; humidity: relative, 0 to 1.
        """
        import numpy as np  # plug-ins of materials do not need it

        change = self.by_kelvin * (temperature - STANDARD_TEMPERATURE)
        if self.by_moisture:
            humidities = [humidity, STANDARD_HUMIDITY]
            moisture, standard = np.interp(humidities, *_MOISTURE_OF_WOOD).tolist()
            change += (self.by_moisture - 1 / (1 + standard)) * (moisture - standard)
        return change


STANDARD_TEMPERATURE, STANDARD_HUMIDITY = 20.0, 0.65
"""Climate [°C, relative humidity] of the values of a material."""

_MOISTURE_OF_WOOD = (
    [0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.65, 0.7, 0.8, 0.9, 1.0],
    [0.0, 0.025, 0.045, 0.062, 0.077, 0.092, 0.11, 0.12, 0.131, 0.16, 0.205, 0.28],
)
"""Humidities of air, and moisture of wood in equilibrium with it at 21 °C.

From the Wood Handbook FPL-GTR-282, table 4-2.
"""

VENEER = 1.4e-3  # m, of each veneer
_SANDED = 0.6e-3  # m; sanding makes a board thinner


def plies(thickness: float) -> int:
    """Number of veneers of a birch plywood board of a thickness [m]: the nearest odd one."""
    return max(3, 2 * round(((thickness + _SANDED) / VENEER - 1) / 2) + 1)


def plywood(thickness: float) -> Material:
    """Birch plywood of a thickness [m], the grain of its faces along the plate's length.

    Boards of other thicknesses are assumed to have proportionally thinner or thicker veneers.
    """
    count = plies(thickness)
    board = VENEER * count - _SANDED  # m, the thickness of boards with this count
    sign = 1 if count % 4 == 3 else -1  # 1 if the middle veneer is a cross ply
    across = 0.0
    for number in range((count - 1) // 2):
        height = VENEER * (number + 0.5)  # from the middle, where the grain turns
        across += sign * (-1) ** number * (2 * height / board) ** 3
    E = 17.5e9
    G = 0.62e9
    along = E * (1 - across)
    shares = Orthotropy(across / (1 - across), G / along, 0.35e9 / along, 0.25e9 / along)
    return Material("plywood", E=along, rho=680.0, nu=0.05, orthotropy=shares)


_BY_THICKNESS = {"plywood": plywood}
_TYPICAL_THICKNESS = 6.4e-3  # m


def _known(row: dict[str, Any], wood: Mapping[str, Any]) -> KnownMaterial:
    """Build a material from its row in materials.toml; wood: defaults of all kinds of wood."""
    name = row.pop("name")
    by_thickness = _BY_THICKNESS.get(name)
    by_frequency: tuple[tuple[float, float, float], ...] = ()
    if by_thickness is not None:
        material = by_thickness(_TYPICAL_THICKNESS)
    else:
        E = row.pop("E")
        grain = None
        if "E2" in row:
            grain = Orthotropy(*(modulus / E for modulus in (row.pop("E2"), *row.pop("G"))))
        material = Material(name, 1e9 * E, row.pop("rho"), row.pop("nu"), grain)
        rows = row.pop("by_frequency", ())
        by_frequency = tuple((frequency, modulus / E, loss) for frequency, modulus, loss in rows)
    if row.pop("wood", False):
        row = {**wood, **row}
    return KnownMaterial(material, by_frequency=by_frequency, by_thickness=by_thickness, **row)


def read_catalog(file: str) -> dict[str, Any]:
    """Read a TOML file of the folder model/data."""
    return tomllib.loads((files("model") / "data" / file).read_text(encoding="utf-8"))


_CATALOG = read_catalog("materials.toml")
KNOWN_MATERIALS = {row["name"]: _known({**row}, _CATALOG["wood"]) for row in _CATALOG["materials"]}
KNOWN_MATERIALS["float-glass"] = replace(
    KNOWN_MATERIALS["soda-lime-glass"],
    material=replace(KNOWN_MATERIALS["soda-lime-glass"].material, name="float-glass"),
)
"""Materials that come with this package, by name."""

_MATERIALS: PluginRegistry[KnownMaterial] = PluginRegistry(
    "material",
    "era_haptics.materials",
    KnownMaterial,
    error=InputError,
    is_instance=True,
    own=KNOWN_MATERIALS,
    called=lambda known: known.material.name,
    hint="; for any other, state its properties: {E: 70 GPa, rho: 2700, nu: 0.33}",
)


def material_names() -> tuple[str, ...]:
    """Return names of all materials, including plug-ins, without loading these."""
    return _MATERIALS.names()


def known_material(name: str) -> KnownMaterial:
    """Look up a material with its sources; raises InputError with a suggestion.

    Case does not matter, nor whether words are joined by hyphen, underscore or space.
    """
    plain = "-".join(name.lower().replace("_", " ").replace("-", " ").split())
    return _MATERIALS.find(plain)


def material(name: str) -> Material:
    """Look up a material; raises InputError as `known_material`."""
    return known_material(name).material
