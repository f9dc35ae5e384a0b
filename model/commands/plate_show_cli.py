"""`era plate materials` and `show`."""

import json
import math
import sys
from typing import Any

from model.commands.options import JsonOption, RigArgument
from model.errors import InputError


def materials(as_json: JsonOption = False) -> None:
    """List known materials with their sources."""
    from model.structure.materials import known_material, material_names

    known, problems = {}, []
    for name in material_names():
        try:
            known[name] = known_material(name)
        except InputError as error:  # that of one plug-in does not hide the others
            problems.append(str(error))
    if as_json:
        entries = [
            {
                "name": name,
                "E_pa": one.material.E,
                "rho_kg_m3": one.material.rho,
                "nu": one.material.nu,
                "source": one.source,
                "variation": one.variation,
                "loss_factor": one.loss_factor,
            }
            for name, one in known.items()
        ]
        print(json.dumps({"materials": entries, "problems": problems}))
        return
    for name, one in known.items():
        numbers = one.material
        print(f"{name}: E {numbers.E / 1e9:g} GPa, rho {numbers.rho:g} kg/m³, nu {numbers.nu:g}")
        print(f"    source  {one.source}")
        print(f"    variation  {one.variation}")
        print(f"    loss factor of the bare material, about  {one.loss_factor}")
    print("Any other is given by numbers: material: {E: 70 GPa, rho: 2700, nu: 0.33}")
    for problem in problems:
        print(f"era: warning: {problem}", file=sys.stderr)


def show(rig_file: RigArgument, as_json: JsonOption = False) -> None:
    """Show material and rigidity of a rig's plate."""
    from model.quantities import in_display_unit
    from model.rig.file import load_rig
    from model.rig.plate_summary import plate_summary

    summary = plate_summary(load_rig(rig_file))
    if as_json:
        print(json.dumps(summary))
        return
    print(f"{rig_file}: {1e3 * summary['length_m']:g} x {1e3 * summary['width_m']:g} mm")
    laminate = summary["laminate"]
    if laminate is not None:
        _print_laminate(laminate)
    print("homogeneous plate like it at the highest frequency" if laminate is not None else "plate")
    print(
        f"    {1e3 * summary['thickness_m']:.4g} mm of {summary['material']}: "
        f"E {summary['E_pa'] / 1e9:.4g} GPa, rho {summary['rho_kg_m3']:.5g} kg/m³, "
        f"nu {summary['nu']:.3g}, loss factor {summary['loss_factor']:g}"
    )
    print(f"    flexural rigidity  {summary['flexural_rigidity_n_m']:.4g} N m")
    bare = in_display_unit(summary["mass_kg"], "kg", digits=4)
    print(f"    mass  {bare} ({summary['surface_density_kg_m2']:.4g} kg/m²)")
    _print_air(summary["air_gap"])
    for key, wavelength in summary["bending_wavelength_m"].items():
        print(f"    bending wavelength at {_frequency(key)}  {100 * wavelength:.3g} cm")
    for mass in summary["point_masses"]:
        x, y = mass["at_m"]
        print(f"    carries {1e3 * mass['mass_kg']:g} g at ({x:g}, {y:g}) m")


def _print_laminate(laminate: dict[str, Any]) -> None:
    print(f"laminate of {1e3 * laminate['thickness_m']:g} mm, bond {laminate['bond']}")
    for layer in laminate["layers"]:
        print(
            f"    {1e3 * layer['thickness_m']:g} mm of {layer['material']}: "
            f"E {layer['E_pa'] / 1e9:g} GPa, rho {layer['rho_kg_m3']:g} kg/m³, nu {layer['nu']:g}"
        )
    bonded = laminate["rigidity_perfectly_bonded_n_m"]
    rows = {"perfectly bonded": bonded, "freely sliding": laminate["rigidity_freely_sliding_n_m"]}
    for key, rigidity in laminate.get("rigidity_by_frequency_n_m", {}).items():
        rows[f"in free waves of {_frequency(key)}"] = rigidity
    for name, rigidity in rows.items():
        ratio = math.sqrt(rigidity / bonded)
        print(f"    {name}  {rigidity:.4g} N m: natural frequencies of bending x {ratio:.3f}")


def _print_air(air: dict[str, Any] | None) -> None:
    if air is None:
        print("    no air: a plate in a vacuum, unless air_gap is given")
        return
    edges = "sealed" if air["closed"] else "open"
    print(f"    air gap of {1e3 * air['depth_m']:g} mm behind it, edges {edges}")
    if air["closed"]:
        print(f"        stiffness against even motion  {air['stiffness_n_m3'] / 1e6:.4g} MN/m³")


def _frequency(key: str) -> str:
    return key.replace("_hz", " Hz")
