"""`era plate show`: the summary of a rig's plate, with its attachments and exciters."""

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import typer

from model.commands.options import JsonOption, RigArgument, print_report
from model.quantities import in_display_unit

if TYPE_CHECKING:
    from model.rig.rig import Rig

_MAX_NAMED = 6  # masses or supports that are listed one by one; a frame has many

_ATTACHED = {
    "point_masses": ("carries", "mass_kg", 1e3, "g"),
    "supports": ("held by", "stiffness_n_m", 1e-3, "kN/m"),
}
"""By key of a summary: a verb, the key of a quantity, and its factor from SI to a display unit."""


def show(rig_file: RigArgument, as_json: JsonOption = False) -> None:
    """Show material, rigidity and exciters of a rig's plate.

    Levels that exciters reach are for the nominal board; real parts vary.
    """
    from model.rig.rig_file import load_rig
    from model.rig.rig_summary import plate_summary

    rig = load_rig(rig_file)
    summary = plate_summary(rig)
    if summary["exciters"]:
        _add_reach(summary, rig)
    rows = [
        f"{rig_file}: {1e3 * summary['length_m']:g} x {1e3 * summary['width_m']:g} mm",
        *_construction_rows(summary),
        *_homogeneous_rows(summary),
        *_attached_rows(summary),
        *_exciter_rows(summary["exciters"], summary.get("reach"), rig.threshold),
        *_type_rows(summary["exciter_types"]),
    ]
    print_report(rows, summary, as_json=as_json)
    for note in rig.surface_notes:
        typer.echo(f"era: warning: {note}", err=True)


def _add_reach(summary: dict[str, Any], rig: "Rig") -> None:
    """Add the levels that exciters reach, and the excursions of their magnets, to a summary."""
    from model.reduction.free_plate import solve_free_plate
    from model.transients.excursions import excursions_of
    from model.transients.reach import reach_of

    free = solve_free_plate(rig.plate, rig.mesh, frequency_max=rig.limits.frequency_max)
    summary["reach"] = reach_of(rig, free).as_json()
    excursions = excursions_of(rig, free)
    at_lowest = excursions.at_lowest.tolist()
    for exciter, excursion in zip(summary["exciters"], at_lowest, strict=True):
        exciter["excursion_at_lowest_m"] = excursion
    summary["magnets_allow_from_hz"] = excursions.allowed


def _construction_rows(summary: dict[str, Any]) -> Iterator[str]:
    """Yield the layers of a plate or the modes of a surface, before its homogeneous plate."""
    surface = summary["surface"]
    if surface is not None:
        yield (
            f"surface by {surface['modes']} modes up to {surface['highest_frequency_hz']:.0f} Hz "
            f"of {surface['modes_file']}, {surface['rigid_modes']} of the rigid body, along "
            f"{surface['normal']}; outline of {surface['rings'] or 'no'} rings"
        )
        yield "homogeneous plate with as many modes and the same mass, for wavelengths alone"
    elif summary["laminate"] is not None:
        yield from _laminate_rows(summary["laminate"])
    else:
        yield "plate"


def _laminate_rows(laminate: dict[str, Any]) -> Iterator[str]:
    """Yield the layers and rigidities of a laminate."""
    bonded = laminate["rigidity_perfectly_bonded_n_m"]
    rigidities = {}
    if len(laminate["layers"]) == 1:
        yield "plate whose modulus depends on the frequency"
    else:
        yield f"laminate of {1e3 * laminate['thickness_m']:g} mm, bond {laminate['bond']}"
        rigidities["perfectly bonded"] = bonded
        rigidities["freely sliding"] = laminate["rigidity_freely_sliding_n_m"]
    for layer in laminate["layers"]:
        yield (
            f"    {1e3 * layer['thickness_m']:g} mm of {layer['material']}: "
            f"E {layer['E_pa'] / 1e9:g} GPa, rho {layer['rho_kg_m3']:g} kg/m³, nu {layer['nu']:g}"
        )
    for key, rigidity in laminate.get("rigidity_by_frequency_n_m", {}).items():
        rigidities[f"in free waves of {_frequency(key)}"] = rigidity
    for name, rigidity in rigidities.items():
        factor = math.sqrt(rigidity / bonded)
        yield f"    {name}  {rigidity:.4g} N m: bending frequencies x {factor:.3f}"
    yield "homogeneous plate like it at the highest frequency"


def _frequency(key: str) -> str:
    return key.replace("_hz", " Hz")


def _homogeneous_rows(summary: dict[str, Any]) -> Iterator[str]:
    """Yield the properties of the plate that is solved."""
    from model.rig.rig_summary import FURTHER

    yield (
        f"    {1e3 * summary['thickness_m']:.4g} mm of {summary['material']}: "
        f"E {summary['E_pa'] / 1e9:.4g} GPa, rho {summary['rho_kg_m3']:.5g} kg/m³, "
        f"nu {summary['nu']:.3g}, loss factor {summary['loss_factor']:g}"
    )
    if summary["orthotropic"] is not None:
        yield from _board_rows(summary["orthotropic"])
    yield f"    flexural rigidity  {summary['flexural_rigidity_n_m']:.4g} N m"
    mass = in_display_unit(summary["mass_kg"], "kg", digits=4)
    yield f"    mass  {mass} ({summary['surface_density_kg_m2']:.4g} kg/m²)"
    for name, dimension in FURTHER.items():
        value = summary["further"][dimension.key(name)]
        if value:
            yield f"    {name.replace('_', ' ')}  {in_display_unit(value, dimension.unit)}"
    if summary["surface"] is None:
        yield from _air_rows(summary)
    for key, wavelength in summary["bending_wavelength_m"].items():
        yield f"    bending wavelength at {_frequency(key)}  {100 * wavelength:.3g} cm"


def _board_rows(board: dict[str, float]) -> Iterator[str]:
    """Yield the moduli of a board along the plate's length (1) and its width (2)."""
    moduli = {}
    for key, value in board.items():
        if key.endswith("_pa"):
            moduli[key.removesuffix("_pa")] = value
    yield f"    along its length and width  {in_gpa(moduli)}, nu12 {board['nu12']:.3g}"
    yield (
        f"    flexural rigidity along, across  {board['flexural_rigidity_along_n_m']:.4g}, "
        f"{board['flexural_rigidity_across_n_m']:.4g} N m"
    )


def in_gpa(moduli: dict[str, float]) -> str:
    """Format the moduli of a material, as `E 70 GPa`."""
    return f"{', '.join(f'{key} {value / 1e9:.4g}' for key, value in moduli.items())} GPa"


def _air_rows(summary: dict[str, Any]) -> Iterator[str]:
    """Yield the open air around a plate, and the air gap behind it."""
    air = summary["air_gap"]
    if summary["air"] != "none":
        grams = 1e3 * summary["air_mass_kg"]
        yield f"    air  {summary['air']}, adds {grams:.3g} g to the plate moving up and down"
    elif air is None:
        yield "    no air: computed in a vacuum"
    if air is None:
        return
    edges = "sealed" if air["closed"] else "open"
    yield f"    air gap of {1e3 * air['depth_m']:g} mm behind it, edges {edges}"
    if air["closed"]:
        stiffness = air["stiffness_n_m3"] / 1e6
        yield f"        stiffness against even motion  {stiffness:.4g} MN/m³"


def _attached_rows(summary: dict[str, Any]) -> Iterator[str]:
    """Yield the masses on the plate, and the supports that do not drive it."""
    for kind, (verb, key, factor, unit) in _ATTACHED.items():
        points = summary[kind]
        if len(points) > _MAX_NAMED:
            total = factor * sum(point[key] for point in points)
            yield f"    {verb} {total:.4g} {unit} at {len(points)} points"
            continue
        for point in points:
            x, y = point["at_m"]
            loss_factor = point.get("loss_factor")
            loss = f", loss factor {loss_factor:g}" if loss_factor else ""
            yield f"    {verb} {factor * point[key]:g} {unit}{loss} at ({x:g}, {y:g}) m"


def _exciter_rows(
    exciters: list[dict[str, Any]], reach: dict[str, Any] | None, threshold: str
) -> Iterator[str]:
    """Yield each exciter, and the frequency from which all together reach a level.

    threshold: name of the set to which the level is relative.
    """
    if reach is None:
        return
    frequencies = reach["frequencies_hz"]
    yield f"exciters, with their largest excursion at full level at {frequencies[0]:g} Hz"
    for exciter in exciters:
        allowed = exciter["excursion_max_m"]
        limit = "" if allowed is None else f" of {1e3 * allowed:.2g}"
        yield (
            f"    {exciter['name']}  magnet {exciter['magnet']}, "
            f"glued at {exciter['magnet_resonance_hz']:.1f} Hz, "
            f"Q {exciter['q']:.1f} (viscous); {exciter['force_at_1_w_n']:.2f} N at 1 W, "
            f"{exciter['full_level_force_n']:.2f} N at full level, {exciter['full_level_v']:.3g} "
            f"V; {1e3 * exciter['excursion_at_lowest_m']:.2g}{limit} mm"
        )
    start = reach["from_hz"]
    from_where = "at no frequency" if start is None else f"from {start:g} Hz"
    yield (
        f"    {reach['level_db_sl']:g} dB SL ({threshold}) under a finger everywhere except within "
        f"2 cm of the edges (nominal board): {from_where}"
    )
    too_weak = []
    for frequency, share in zip(frequencies, reach["share_of_places"], strict=True):
        if share < 1 and (start is None or frequency > start):
            too_weak.append(f"{100 * (1 - share):.1f} % at {frequency:g} Hz")
    if too_weak:
        yield f"    positions below this level: {', '.join(too_weak)}"


def _type_rows(types: dict[str, Any]) -> Iterator[str]:
    """Yield the notes and assumed values of the exciter types."""
    for name, exciter_type in types.items():
        yield f"    {name}: {exciter_type['note']}"
        assumed = []
        for key, (low, high) in exciter_type["assumed"].items():
            assumed.append(f"{key} {low:g} to {high:g}")
        if assumed:
            yield f"        assumed, measure yours: {', '.join(assumed)}"
