"""Numbers of a rig's plate: materials, rigidity, bending wavelengths."""

from dataclasses import replace
from typing import Any

from model.rig.rig import Rig
from model.structure.laminate import Bond, Laminate, bending, freely_sliding, perfectly_bonded
from registry.limits import GuardLimits


def plate_summary(rig: Rig) -> dict[str, Any]:
    """The plate that is solved, the laminate that it stands for, and what it carries.

    Keys carry their units. A laminate comes with both bounds of its rigidity, perfectly bonded and
    freely sliding layers, and, where its adhesives shear, the rigidity at both ends of the rig's
    frequencies.
    """
    plate, limits = rig.plate, rig.limits
    return {
        "length_m": plate.length,
        "width_m": plate.width,
        "thickness_m": plate.thickness,
        "material": plate.material.name,
        "E_pa": plate.material.E,
        "rho_kg_m3": plate.material.rho,
        "nu": plate.material.nu,
        "loss_factor": plate.loss_factor,
        "mass_kg": plate.mass,
        "surface_density_kg_m2": plate.material.rho * plate.thickness,
        "flexural_rigidity_n_m": plate.flexural_rigidity,
        "bending_wavelength_m": {
            f"{frequency:g}_hz": plate.bending_wavelength(frequency)
            for frequency in (limits.frequency_min, limits.frequency_max)
        },
        "point_masses": [
            {"at_m": [mass.x, mass.y], "mass_kg": mass.mass} for mass in rig.masses if mass.mass
        ],
        "laminate": None if rig.laminate is None else _laminate(rig.laminate, limits),
    }


def _laminate(laminate: Laminate, limits: GuardLimits) -> dict[str, Any]:
    summary: dict[str, Any] = {
        "layers": [
            {
                "material": layer.material.name,
                "thickness_m": layer.thickness,
                "E_pa": layer.material.E,
                "rho_kg_m3": layer.material.rho,
                "nu": layer.material.nu,
            }
            for layer in laminate.layers
        ],
        "thickness_m": laminate.thickness,
        "bond": laminate.bond.value,
        "bond_frequency_hz": laminate.bond_frequency,
        "rigidity_n_m": bending(laminate).rigidity,
        "rigidity_perfectly_bonded_n_m": perfectly_bonded(laminate.layers).rigidity,
        "rigidity_freely_sliding_n_m": freely_sliding(laminate.layers).rigidity,
    }
    if laminate.bond is Bond.SHEAR:
        summary["rigidity_by_frequency_n_m"] = {
            f"{frequency:g}_hz": bending(replace(laminate, bond_frequency=frequency)).rigidity
            for frequency in (limits.frequency_min, limits.frequency_max)
        }
    return summary
