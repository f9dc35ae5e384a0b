"""Materials by name."""

from difflib import get_close_matches

from model.errors import InputError
from model.plate import Material

MATERIALS = {
    material.name: material
    for material in (
        # Section 3 of the founding paper gives these three numbers for its plate.
        Material("aluminium", E=70e9, rho=2700.0, nu=0.33),
    )
}


def material(name: str) -> Material:
    """The material of this name; raises InputError, with what may have been meant."""
    if name in MATERIALS:
        return MATERIALS[name]
    close = get_close_matches(name.lower(), MATERIALS, n=1, cutoff=0.6)
    meant = f"did you mean {close[0]}? " if close else ""
    raise InputError(
        f"unknown material {name[:40]!r}; {meant}known are: {', '.join(MATERIALS)}; any other can "
        "be given by its numbers, {E: 70 GPa, rho: 2700, nu: 0.33}"
    )
