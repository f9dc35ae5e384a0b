"""A material, and the catalog of materials and of exciters by name, each with its source.

An installed package adds a material through an entry point of the group `era_haptics.materials`
that refers to a `KnownMaterial` with that name; rig files, their schema and `era plate materials`
then include it.

Moduli of plywood follow from its veneers, which have E along their grain, and none across it
(Handbook of Finnish Plywood), so that in bending, with the cross veneers between heights a and b
from the middle, E2 h³ = 8 E sum (b³ - a³) and E1 + E2 = E.

Manufacturers' data sheets of exciters were not available: values are second-hand, or assumed if
there is no source. Resonances are `free` (the light coil against the magnet). Measure your own.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
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
        """Refuse moduli that are not above zero."""
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
    """Poisson's ratio, with a grain the contraction across the length by a stress along it."""

    orthotropy: Orthotropy | None = None

    def __post_init__(self) -> None:
        """Refuse values of no solid."""
        expect_values(self, f"material {self.name}", above="E rho")
        if self.orthotropy is None and not -1 < self.nu < 0.5:
            raise InputError(
                f"material {self.name}: nu must be between -1 and 0.5, got {self.nu} (most solids: "
                "0.2 to 0.45)"
            )
        if not self.nu**2 * self.shares.e2 < 1:  # of no elastic energy; also of NaN
            raise InputError(
                f"material {self.name}: nu12 must be less than the root of E1 / E2, "
                f"{self.shares.e2**-0.5:.3g}, got {self.nu}"
            )

    @property
    def shares(self) -> Orthotropy:
        """Moduli as shares of E: an isotropic one has G = E / 2 (1 + nu) in all planes."""
        if self.orthotropy is not None:
            return self.orthotropy
        shear = 1 / (2 * (1 + self.nu))
        return Orthotropy(1.0, shear, shear, shear)

    @property
    def moduli(self) -> dict[str, float]:
        """Its moduli [Pa] by the keys of a rig file."""
        of = self.orthotropy
        if of is None:
            return {"E": self.E}
        shares = {"E1": 1.0, "E2": of.e2, "G12": of.g12, "G13": of.g13, "G23": of.g23}
        return {key: share * self.E for key, share in shares.items()}

    @property
    def plane_stress(self) -> float:
        """1 - nu_12 nu_21, the divisor of plate moduli."""
        return 1 - self.nu**2 * self.shares.e2

    def turned(self) -> "Material":
        """The material with its grain turned by a right angle."""
        of = self.orthotropy
        if of is None:
            return self
        return Material(
            self.name,
            E=self.E * of.e2,
            rho=self.rho,
            nu=self.nu * of.e2,
            orthotropy=Orthotropy(1 / of.e2, *(g / of.e2 for g in (of.g12, of.g23, of.g13))),
        )


@dataclass(frozen=True)
class KnownMaterial:
    """A material with its sources."""

    material: Material
    source: str
    """Source of E, rho and nu."""

    variation: str
    """How much they vary between grades and measurements."""

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
    """Relative change of its moduli by a kelvin."""

    by_moisture: float = 0.0
    """Relative change of its moduli by moisture, a share of the dry mass; 0 for what takes none."""

    weather: str = "assumed to be none"
    """Source of both."""

    def of_thickness(self, thickness: float) -> Material:
        """The material of a board of a thickness [m]."""
        return self.material if self.by_thickness is None else self.by_thickness(thickness)

    def by_weather(self, temperature: float, humidity: float) -> float:
        """Relative change of modulus over density in equilibrium with air at a temperature and
        humidity.

        Twice the change of natural frequencies, relative to 20 °C and 65 %, the climate of wood
        tests (EN 408). temperature [°C]; humidity: relative, 0 to 1.
        """
        import numpy as np  # which plug-ins of materials do without

        change = self.by_kelvin * (temperature - STANDARD_TEMPERATURE)
        if self.by_moisture:
            now, standard = np.interp([humidity, STANDARD_HUMIDITY], *_MOISTURE).tolist()
            change += (self.by_moisture - 1 / (1 + standard)) * (now - standard)
        return change


STANDARD_TEMPERATURE, STANDARD_HUMIDITY = 20.0, 0.65
"""Climate [°C] of a material's numbers."""

_MOISTURE = (
    [0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.65, 0.7, 0.8, 0.9, 1.0],
    [0.0, 0.025, 0.045, 0.062, 0.077, 0.092, 0.11, 0.12, 0.131, 0.16, 0.205, 0.28],
)
"""Moisture of wood at rest in air of a humidity at 21 °C (Wood Handbook FPL-GTR-282, table 4-2)."""

_WOOD: Any = {
    "by_kelvin": -0.0023,
    "by_moisture": -1.5,
    "weather": "Wood Handbook FPL-GTR-190: along the grain at 12 % moisture, 7 % less at 50 °C "
    "than at 20 °C (table 5-15); from memory, 9 % more at 6 % moisture than at 12 %, and twice as "
    "much across the grain",
}

VENEER = 1.4e-3  # m; before the faces are sanded to boards of 1.4 n - 0.6 mm
_SANDED = 0.6e-3


def plies(thickness: float) -> int:
    """Number of veneers of a birch plywood board of a thickness [m]: the nearest odd one."""
    return max(3, 2 * round(((thickness + _SANDED) / VENEER - 1) / 2) + 1)


def plywood(thickness: float) -> Material:
    """Birch plywood of a thickness [m], the grain of its faces along the plate's length.

    Boards between those made have veneers thinner or thicker in proportion.
    """
    count = plies(thickness)
    board = VENEER * count - _SANDED
    # Heights from the middle at which the grain turns, outwards; the outermost are the faces.
    heights = [VENEER * (n + 0.5) for n in range((count - 1) // 2)]
    sign = 1 if count % 4 == 3 else -1  # whether the middle veneer is a cross one
    across = sum(sign * (-1) ** n * (2 * h / board) ** 3 for n, h in enumerate(heights))
    E, G = 17.5e9, 0.62e9
    along = E * (1 - across)
    shares = Orthotropy(across / (1 - across), G / along, 0.35e9 / along, 0.25e9 / along)
    return Material("plywood", E=along, rho=680.0, nu=0.05, orthotropy=shares)


def _wood(
    name: str,
    E1: float,
    E2: float,
    *,
    rho: float,
    nu: float,
    G: tuple[float, float, float],
) -> Material:
    """A material with a grain by moduli in GPa; G in the plane, along and across the grain."""
    return Material(name, 1e9 * E1, rho, nu, Orthotropy(*(each / E1 for each in (E2, *G))))


_KNOWN = (
    KnownMaterial(
        Material("aluminium", E=70e9, rho=2700.0, nu=0.33),
        source="section 3 of the founding paper; E and rho also EN 1999-1-1 (Eurocode 9), 3.2.5",
        variation="E 68 to 73 GPa, rho 2640 to 2830 kg/m³, nu 0.30 to 0.34 over the wrought alloys",
        loss_factor="0.0001",
        by_kelvin=-0.0004,
        weather="EN 1999-1-2, table 2: 70 GPa at 20 °C, 67.9 at 100 °C",
    ),
    KnownMaterial(
        Material("steel", E=210e9, rho=7850.0, nu=0.3),
        source="EN 1993-1-1 (Eurocode 3), 3.2.6; rho EN 1991-1-1, Table A.4",
        variation="E 195 to 210 GPa, rho 7700 to 8000 kg/m³; stainless steel: lower E, higher rho",
        loss_factor="0.0002 to 0.0006",
        by_kelvin=-0.00025,
        weather="tuning forks of plain steel, from memory; EN 1993-1-2 starts at 100 °C",
    ),
    KnownMaterial(
        Material("soda-lime-glass", E=70e9, rho=2500.0, nu=0.2),
        source="EN 572-1, general physical properties of soda-lime silicate (float) glass",
        variation="E 69 to 74 GPa, nu 0.20 to 0.23 in makers' data; tempering changes neither",
        loss_factor="0.0006 to 0.002",
        by_kelvin=-0.0001,
        weather="silicate glasses, 0.01 % per kelvin, from memory",
    ),
    KnownMaterial(
        Material("chemically-strengthened-glass", E=71.5e9, rho=2420.0, nu=0.21),
        source="Corning Gorilla Glass 2, product information sheet",
        variation="E 66 to 77 GPa, rho 2390 to 2480 kg/m³, nu 0.21 to 0.23 over aluminosilicate "
        "cover glasses; give the numbers of your own",
        loss_factor="0.0006 to 0.002",
        by_kelvin=-0.0001,
        weather="assumed equal to soda-lime glass",
    ),
    KnownMaterial(
        Material("acrylic", E=4.6e9, rho=1190.0, nu=0.37),
        source="rho and nu Plexiglas GS (cast PMMA), data sheet; E 4.2, 4.6 and 5 GPa at 10, 100 "
        "and 1000 Hz, assumed: as its beta relaxation has it near room temperature; the sheet's "
        "3.3 GPa is from a slow tensile test (ISO 527)",
        variation="20 % in E and in loss, assumed; falling as it warms",
        loss_factor="0.075, 0.06 and 0.045 at 10, 100 and 1000 Hz, assumed; in "
        "addition to the plate's loss factor",
        by_frequency=((10.0, 4.2 / 4.6, 0.075), (100.0, 1.0, 0.06), (1000.0, 5.0 / 4.6, 0.045)),
        by_kelvin=-0.004,
        weather="derived from the modulus over frequency (21 K correspond to a decade): "
        "activation energy of the beta relaxation 78 kJ/mol, from memory; its loss factor then "
        "rises by 1.2 % per kelvin",
    ),
    KnownMaterial(
        Material("polycarbonate", E=2.4e9, rho=1200.0, nu=0.38),
        source="Covestro Makrolon 2658 data sheet, E by ISO 527 at 1 mm/min, 23 °C; nu as usual "
        "for the polymer",
        variation="E 2.1 to 2.4 GPa, rho 1190 to 1220 kg/m³, nu 0.37 to 0.40",
        loss_factor="0.01",
        by_kelvin=-0.002,
        weather="assumed from makers' ISO 527 moduli up to 60 °C",
    ),
    KnownMaterial(
        plywood(6.4e-3),
        source="birch, by thickness: 3 plies (3.6 mm), 5 (6.4), 7 (9.2), 9 (12) and so on; "
        "E1, E2, G12, nu12 and rho Handbook of Finnish Plywood, from memory: veneers of 17.5 GPa, "
        "cross plies counted as 0; G13 and G23 (rolling shear of the cross plies) assumed",
        variation="E1 10 %, E1 : E2 falls from 16 at 3 plies to 2.7 at 5 and 1.6 at 9; E2 up to "
        "73 % more at 3 plies and 12 % at 5 if crosswise veneers count 0.8 GPa; G12 0.6 to "
        "0.75 GPa, G13 and G23 30 %; 6.5 mm by name are 6.1 to 6.9 (a trade sheet, 670 kg/m³); "
        "shops cut along and across the faces' grain",
        loss_factor="0.01 to 0.03, assumed",
        own_loss=0.02,
        by_thickness=plywood,
        **_WOOD,
    ),
    KnownMaterial(
        _wood("pine", 11.0, 0.8, rho=520.0, nu=0.35, G=(0.85, 0.85, 0.14)),
        source="a board of glued staves; ratios of the moduli Wood Handbook FPL-GTR-282, loblolly "
        "pine, from memory (ET / EL 0.078, GLT / EL 0.081, GRT / EL 0.013); E and rho assumed",
        variation="E1 10 to 12 GPa, E2 0.5 to 1, G12 0.7 to 1, nu12 0.3 to 0.45, rho 500 to "
        "550 kg/m³",
        loss_factor="0.01 to 0.02, assumed",
        own_loss=0.015,
        **_WOOD,
    ),
    KnownMaterial(
        _wood("spruce", 10.0, 0.45, rho=430.0, nu=0.42, G=(0.8, 0.8, 0.04)),
        source="Sitka spruce, flat sawn; E1 and E2 Acta Acustica 2025, aacus240113, table 5 (9.05 "
        "and 0.40 GPa static, 9.66 and 0.49 by ultrasound); ratios of G23 and nu12 Wood Handbook "
        "FPL-GTR-282, from memory",
        variation="E1 9 to 12 GPa, E2 0.4 to 0.5, quarter sawn 0.8 to 1.0; G12 0.7 to 1.1, nu12 "
        "0.37 to 0.47, rho 400 to 450 kg/m³",
        loss_factor="0.006 to 0.01 along the grain, 0.02 across, assumed",
        own_loss=0.015,
        **_WOOD,
    ),
    KnownMaterial(
        Material("mdf", E=3.4e9, rho=780.0, nu=0.3),
        source="rho Hunt et al., BioResources 8(1) 115, 2013, of boards of 3.7 mm; E 2.7 GPa (EN "
        "622-5, from memory) times their 1.26, dynamic over static; nu assumed",
        variation="E 2.7 to 4 GPa, rho 700 (8.1 mm) to 830 (2.6 mm) kg/m³, nu 0.25 to 0.3",
        loss_factor="0.01 to 0.03, assumed",
        own_loss=0.02,
        **_WOOD,
    ),
    KnownMaterial(
        _wood("carbon", 66.0, 66.0, rho=1550.0, nu=0.06, G=(3.5, 3.0, 3.0)),
        source="woven sheet at 0 and 90 degrees; E, G12 and nu12 Queen Mary University of London, "
        "page on CFRP (62.7 to 68.7 GPa, 3.5, 0.058); G13 and G23 assumed",
        variation="E 63 to 69 GPa, in bending to 80 (azom 632), rho 1500 to 1600 kg/m³; "
        "unidirectional sheet: 103 to 145 and 7.4 to 10.5 GPa, give its numbers",
        loss_factor="0.002 to 0.01, assumed",
    ),
)

KNOWN_MATERIALS = {known.material.name: known for known in _KNOWN}
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


_DESIGN = "a public loudspeaker design, AudioPicture V2.2 of 2026-09-29, quoting the maker's sheet"
_PINNED = "HanzoRazer/tap_tone_pi, tests/test_e1_hardware_bom.py, survey of 2026-08-25"
_PART_PAGE = "docs.cirkitdesigner.com, page of the part, read 2026-11-26; not the maker's"
_NET_WEIGHT = f"{_DESIGN}: net weight of 110.9 g less the coil's"


@dataclass(frozen=True)
class SheetValue:
    """Value in SI units with its source; with lowest and highest value if it is assumed."""

    value: float
    source: str = ""
    assumed: tuple[float, float] | None = None


def _assumed(value: float, lowest: float, highest: float) -> SheetValue:
    return SheetValue(value, assumed=(lowest, highest))


@dataclass(frozen=True)
class ExciterType:
    """Exciter type by name; note: information for buyers; values: by rig-file key."""

    name: str
    note: str
    values: Mapping[str, SheetValue]

    @property
    def assumed(self) -> dict[str, tuple[float, float]]:
        """Keys that no source gives, with the lowest and highest value that is likely."""
        return {key: each.assumed for key, each in self.values.items() if each.assumed}


_EXCITER_TYPES_KNOWN = (
    ExciterType(
        "DAEX13-4SM",
        "13 mm; force factor and coil mass are in no data sheet, and its resonance is unreliable",
        {
            "coil_mass": _assumed(0.7e-3, 0.5e-3, 1.0e-3),
            "weight": SheetValue(14.3e-3, f"{_PART_PAGE}: 15 g in all, less the coil's"),
            "resonance": SheetValue(200.0, f"{_PART_PAGE}, unreliable"),
            "q": _assumed(3.0, 2.0, 5.0),
            "force_factor": _assumed(1.5, 1.2, 1.8),
            "resistance": _assumed(3.6, 3.2, 4.0),
            "inductance": _assumed(0.06e-3, 0.03e-3, 0.1e-3),
            "excursion": _assumed(0.5e-3, 0.5e-3, 1.0e-3),
            "power": SheetValue(3.0, _PART_PAGE),
        },
    ),
    ExciterType(
        "DAEX25CT-4",
        "25 mm, coin type",
        {
            "coil_mass": SheetValue(1.29e-3, _PINNED),
            "weight": _assumed(33.5e-3, 28.7e-3, 43.7e-3),
            "resonance": SheetValue(306.0, _PINNED),
            "q": _assumed(3.0, 2.0, 5.0),
            "force_factor": SheetValue(1.54, _PINNED),
            "resistance": SheetValue(3.6, _PINNED),
            "inductance": _assumed(0.07e-3, 0.04e-3, 0.1e-3),
            "excursion": _assumed(0.5e-3, 0.5e-3, 1.0e-3),
            "power": SheetValue(10.0, _PINNED),
        },
    ),
    ExciterType(
        "DAEX25FHE-4",
        "25 mm in a frame; superseded by EX25FHE2-4",
        {
            "coil_mass": SheetValue(1.61e-3, _DESIGN),
            "weight": SheetValue(109.29e-3, _NET_WEIGHT),
            "resonance": SheetValue(224.0, _DESIGN),
            "q": _assumed(3.0, 2.0, 5.0),
            "force_factor": SheetValue(3.63, _DESIGN),
            "resistance": SheetValue(4.3, _DESIGN),
            "inductance": SheetValue(0.1e-3, f"{_DESIGN}, at 1 kHz"),
            "excursion": _assumed(0.5e-3, 0.5e-3, 1.0e-3),
            "power": SheetValue(24.0, _DESIGN),
        },
    ),
    ExciterType(
        "EX25FHE2-4",
        "25 mm in a frame, successor of DAEX25FHE-4, whose masses and force factor it uses",
        {
            "coil_mass": _assumed(1.61e-3, 1.2e-3, 2.0e-3),
            "weight": _assumed(109.29e-3, 85e-3, 130e-3),
            "resonance": SheetValue(115.0, _DESIGN),
            "q": _assumed(3.0, 2.0, 5.0),
            "force_factor": _assumed(3.63, 3.0, 4.2),
            "resistance": SheetValue(4.3, _DESIGN),
            "inductance": SheetValue(0.1e-3, f"{_DESIGN}, at 1 kHz"),
            "excursion": _assumed(0.5e-3, 0.5e-3, 1.0e-3),
            "power": SheetValue(24.0, _DESIGN),
        },
    ),
)

EXCITER_TYPES: Mapping[str, ExciterType] = {each.name: each for each in _EXCITER_TYPES_KNOWN}
"""Known types by name; the resonance of each is `free`."""
