"""Materials by name, each with the source of its numbers and their variation.

An installed package adds one by an entry point of the group `era_haptics.materials` that leads to
a `KnownMaterial` of that name; rig files, their schema and `era plate materials` follow.
"""

from dataclasses import dataclass

from model.errors import InputError
from model.structure.plate import Material
from registry.plugins import PluginRegistry


@dataclass(frozen=True)
class KnownMaterial:
    """A material with its sources.

    source: of E, rho and nu; variation: between grades and measurements;
    loss_factor: order of the bare material's own (Cremer and Heckl, Structure-Borne Sound, 2nd ed.;
    of polycarbonate only an order). What is built in loses far more at its joints, so a rig's loss
    factor does not follow from its material.
    """

    material: Material
    source: str
    variation: str
    loss_factor: str


_KNOWN = (
    KnownMaterial(
        Material("aluminium", E=70e9, rho=2700.0, nu=0.33),
        source="section 3 of the founding paper; E and rho also EN 1999-1-1 (Eurocode 9), 3.2.5",
        variation="E 68 to 73 GPa, rho 2640 to 2830 kg/m³, nu 0.30 to 0.34 over the wrought alloys",
        loss_factor="0.0001",
    ),
    KnownMaterial(
        Material("steel", E=210e9, rho=7850.0, nu=0.3),
        source="EN 1993-1-1 (Eurocode 3), 3.2.6; rho EN 1991-1-1, Table A.4",
        variation="E 195 to 210 GPa, rho 7700 to 8000 kg/m³; stainless steel: lower E, higher rho",
        loss_factor="0.0002 to 0.0006",
    ),
    KnownMaterial(
        Material("soda-lime-glass", E=70e9, rho=2500.0, nu=0.2),
        source="EN 572-1, general physical properties of soda-lime silicate (float) glass",
        variation="E 69 to 74 GPa, nu 0.20 to 0.23 in makers' data; tempering changes neither",
        loss_factor="0.0006 to 0.002",
    ),
    KnownMaterial(
        Material("chemically-strengthened-glass", E=71.5e9, rho=2420.0, nu=0.21),
        source="Corning Gorilla Glass 2, product information sheet",
        variation="E 66 to 77 GPa, rho 2390 to 2480 kg/m³, nu 0.21 to 0.23 over aluminosilicate "
        "cover glasses; give the numbers of your own",
        loss_factor="0.0006 to 0.002",
    ),
    KnownMaterial(
        Material("acrylic", E=3.3e9, rho=1190.0, nu=0.37),
        source="Plexiglas GS (cast PMMA), data sheet, E by ISO 527 at 1 mm/min, 23 °C",
        variation="E 2.8 to 3.4 GPa by sheet and grade; at vibration frequencies up to about "
        "4.7 GPa, falling as it warms",
        loss_factor="0.02 to 0.04",
    ),
    KnownMaterial(
        Material("polycarbonate", E=2.4e9, rho=1200.0, nu=0.38),
        source="Covestro Makrolon 2658 data sheet, E by ISO 527 at 1 mm/min, 23 °C; nu as usual "
        "for the polymer",
        variation="E 2.1 to 2.4 GPa, rho 1190 to 1220 kg/m³, nu 0.37 to 0.40",
        loss_factor="0.01",
    ),
)

KNOWN_MATERIALS = {known.material.name: known for known in _KNOWN}
"""Materials that come with this package, by name."""

_MATERIALS: PluginRegistry[KnownMaterial] = PluginRegistry(
    "material",
    "era_haptics.materials",
    KnownMaterial,
    error=InputError,
    is_instance=True,
    own=KNOWN_MATERIALS,
    called=lambda known: known.material.name,
    hint="; any other can be given by its numbers, {E: 70 GPa, rho: 2700, nu: 0.33}",
)


def material_names() -> tuple[str, ...]:
    """Names of all materials, those of plug-ins included; no plug-in is loaded."""
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
