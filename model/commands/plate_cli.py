"""`era plate`: natural frequencies, maps, meshes, materials, rigidity and a template of a plate."""

import math
import re
import sys
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

import typer

from model.commands.options import (
    JsonOption,
    MeshOption,
    RigArgument,
    SizeOption,
    Stopwatch,
    figure_size,
    next_line,
    print_report,
    progress_bar,
)
from model.config.units import parse_frequencies, parse_pair
from model.errors import InputError, expect_between
from model.files.output_paths import check_picture
from model.quantities import counted
from registry.plugins import did_you_mean

if TYPE_CHECKING:
    from model.rig.rig import Rig
    from model.vibration import Excitation, PlateMap

plate_app = typer.Typer(help="Compute modes and vibration maps of a plate.")

_MAX_NAMED = 6  # masses or supports that are listed one by one; a frame has many

_ATTACHED = {
    "point_masses": ("carries", "mass_kg", 1e3, "g"),
    "supports": ("held by", "stiffness_n_m", 1e-3, "kN/m"),
}
"""By key of a summary: a verb, the key of a quantity, and its factor from SI to a display unit."""


@plate_app.command()
def modes(
    rig_file: RigArgument,
    mesh: MeshOption = None,
    support: Annotated[
        Literal["eras", "simply-supported", "free"], typer.Option(help="Boundary condition.")
    ] = "eras",
    count: Annotated[int, typer.Option("-n", min=1, help="Number of modes.")] = 12,
    as_json: JsonOption = False,
) -> None:
    """Compute natural frequencies.

    The plate is undamped; rigid-body modes of a free plate are omitted.
    """
    from model.rig.rig_file import load_rig
    from model.vibration import natural_modes

    rig = load_rig(rig_file, mesh=mesh)
    with Stopwatch() as timed:
        solved = natural_modes(rig, count, support=support)
    carried = solved.mesh.highest_frequency(rig.plate)
    name = solved.mesh.element_name
    element = "" if name in str(solved.mesh) else f" {name}"
    rows = [
        f"{rig_file}: {solved.mesh}{element}, {solved.mesh.dof} dof, support: {support}",
        *(
            f"mode {number:3d}  {frequency:9.2f} Hz"
            f"{'  mesh too coarse' if frequency > carried else ''}"
            for number, frequency in enumerate(solved.frequencies, start=1)
        ),
        f"above {carried:.0f} Hz a bending wavelength has fewer than six nodes; use a finer "
        "--mesh for those frequencies"
        if solved.frequencies[-1] > carried
        else None,
        f"solved in {timed.elapsed:.2f} s",
    ]
    answer = {
        "frequencies_hz": solved.frequencies.tolist(),
        "mesh_carries_up_to_hz": carried,
        "support": support,
        "mesh": [solved.mesh.nx, solved.mesh.ny],
        "dof": solved.mesh.dof,
        "element": solved.mesh.element_name,
        "solve_time_s": timed.elapsed,
    }
    print_report(rows, answer, as_json=as_json)


@plate_app.command("map")
def plate_map(
    rig_file: RigArgument,
    drive: Annotated[
        list[str],
        typer.Option(metavar="ERA=HZ[@LEVEL[:PHASE_DEG]]", help="Tone of an ERA (repeatable)."),
    ],
    mesh: MeshOption = None,
    points: Annotated[
        str | None,
        typer.Option(
            metavar="XxY",
            help="Number of points along x and y. Default: as many as the mesh resolves.",
        ),
    ] = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="MAP.png", help="Picture to write.")
    ] = None,
    size: SizeOption = None,
    as_json: JsonOption = False,
) -> None:
    """Compute peak acceleration over the plate for any drive."""
    import numpy as np

    from model.arrays import best_of
    from model.rig.rig_file import load_rig
    from model.structure.attachments import support_problem
    from model.vibration import G
    from model.vibration import plate_map as solve

    inches = figure_size(size)
    if output is not None:
        check_picture(output)
    rig = load_rig(rig_file, mesh=mesh)
    excitation = parse_drives(drive, rig)
    raster = parse_pair(points, what="--points") if points else None
    with Stopwatch() as timed:
        solved = solve(rig, excitation, raster=raster)
    unsupported = support_problem(rig.plate, rig.eras, loads=rig.masses)
    for warning in (beyond_limits(excitation, rig), unsupported):
        if warning:
            typer.echo(f"era: warning: {warning}", err=True)
    if output is not None:
        from model.figures import drive_title, map_figure, save_figure

        title = drive_title(excitation, rig)
        if unsupported:
            title += " (ERAs do not support the plate)"
        figure = map_figure(rig, solved, active=excitation.keys(), title=title)
        save_figure(figure, output, inches=inches)
    row, column = divmod(best_of(solved.peak.ravel()), len(solved.x))
    levels = _levels_over(solved, rig.threshold)
    level_row = None
    if levels is not None:
        level_row = (
            f"level    {levels.median:8.1f} dB SL median, "
            f"{levels.on_99_percent:.1f} or more on 99 % of the points ({rig.threshold})"
        )
    rows: list[str | None] = [
        f"{rig_file}: {', '.join(drive)}, mesh {rig.mesh}, solved in {timed.elapsed:.2f} s",
        f"largest  {solved.peak.max() / G:8.2f} g  ({solved.peak.max():.1f} m/s²) "
        f"at ({solved.x[column]:.4f}, {solved.y[row]:.4f}) m",
        f"median   {float(np.median(solved.peak)) / G:8.2f} g",
        level_row,
        f"nulls    {len(solved.nulls):5d}",
    ]
    if output is not None:
        further = next_line("era", "table", "build", rig_file, "-o", "table.npz")
        rows += [f"wrote {output}", further]
    answer = {
        "x_m": solved.x.tolist(),
        "y_m": solved.y.tolist(),
        "peak_acceleration_m_s2": solved.peak.tolist(),
        "max_m_s2": float(solved.peak.max()),
        "max_at_m": [float(solved.x[column]), float(solved.y[row])],
        "nulls_m": solved.nulls.tolist(),
        "median_level_db_sl": None if levels is None else levels.median,
        "level_on_99_percent_db_sl": None if levels is None else levels.on_99_percent,
        "is_supported": unsupported is None,
        "mesh": [rig.mesh.nx, rig.mesh.ny],
        "solve_time_s": timed.elapsed,
        "files": [str(output)] if output else [],
    }
    print_report(rows, answer, as_json=as_json)


class _Levels(NamedTuple):
    """Levels over a plate [dB SL]: the median, and the level that 99 % of the points reach."""

    median: float
    on_99_percent: float


def _levels_over(solved: "PlateMap", threshold: str) -> _Levels | None:
    """Return levels over a plate relative to a threshold set; None beyond the data of the set."""
    import numpy as np

    from model.finger import sensation_level

    try:
        levels = sensation_level(solved.frequencies, np.abs(solved.field), threshold)
    except InputError:
        return None
    return _Levels(float(np.median(levels)), float(np.percentile(levels, 1)))


_NUMBER = r"[-+]?(\d+\.?\d*|\.\d+)(e[-+]?\d{1,2})?"
_DRIVE = re.compile(
    rf"(?P<era>[^=]+)=\s*(?P<frequency>{_NUMBER})\s*"
    rf"(@\s*(?P<level>{_NUMBER})\s*(:\s*(?P<phase>{_NUMBER}))?)?",
    re.IGNORECASE,
)
_NUMBERS = {"frequency": "", "level": "1", "phase": "0"}
"""Groups of `_DRIVE` that are numbers, and their defaults."""


def parse_drives(texts: Sequence[str], rig: "Rig") -> "Excitation":
    """Parse texts of `--drive`, such as `SW=110` or `NE=250@0.5:90`, to an excitation.

    Default level 1 (full stroke) and phase 0. Raises InputError.
    """
    from model.vibration import Tone

    excitation: dict[str, Tone] = {}
    names = [era.name for era in rig.eras]
    for text in texts:
        match = _DRIVE.fullmatch(text.strip())
        if match is None:
            raise InputError(
                f"--drive must be ERA=HZ[@LEVEL[:PHASE_DEG]], in hertz, share of full stroke and "
                f"degrees without a unit, got {text!r}; for instance {names[0]}=110 or "
                f"{names[0]}=110@0.5:90"
            )
        name = match["era"]
        if name not in names:
            raise InputError(
                f"--drive {text!r}: the rig has no ERA {name!r}; "
                f"{did_you_mean(name, names)}it has {', '.join(names)}"
            )
        if name in excitation:
            raise InputError(f"--drive {text!r}: ERA {name} must have one tone, got two")
        frequency, level, phase = (
            float(match[key] or default) for key, default in _NUMBERS.items()
        )
        expect_between(level, 0, 1, what=f"--drive {text!r}: level")
        if frequency <= 0:
            raise InputError(f"--drive {text!r}: frequency must be positive, got {frequency:g} Hz")
        stroke = rig.full_levels[name]
        excitation[name] = Tone(frequency, level * stroke, math.radians(phase))
    return excitation


def beyond_limits(excitation: "Excitation", rig: "Rig") -> str | None:
    """Return a warning if tones are outside the rig's frequency limits, else None."""
    low, high = rig.limits.frequency_min, rig.limits.frequency_max
    beyond = [
        f"{era} at {tone.frequency:g} Hz"
        for era, tone in excitation.items()
        if not low <= tone.frequency <= high
    ]
    if not beyond:
        return None
    return (
        f"{', '.join(beyond)}: outside the rig's limits.frequency of {low:g} to {high:g} Hz; the "
        "guard enforces this range"
    )


@plate_app.command()
def convergence(
    rig_file: RigArgument,
    mesh: MeshOption = None,
    frequencies: Annotated[
        str | None,
        typer.Option(metavar="LO:HI:STEP|LIST", help="Frequencies in Hz; default: 110,250."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Compare meshes with a finer reference mesh.

    Prints the errors of natural frequencies and responses.
    """
    from model.rig.rig_file import load_rig
    from model.vibration import (
        FOOT,
        MOVED,
        default_frequencies,
        meshes_to_compare,
        study_convergence,
    )

    rig = load_rig(rig_file, mesh=mesh)
    chosen = parse_frequencies(frequencies) if frequencies else default_frequencies(rig)
    with Stopwatch() as timed, progress_bar("meshes") as progress:
        study = study_convergence(
            rig, meshes_to_compare(rig), frequencies=chosen, progress=progress
        )
    meshes = [
        {
            "mesh": [error.mesh.nx, error.mesh.ny],
            "element": error.mesh.element_name,
            "strip_m": error.mesh.strip,
            "dof": error.mesh.dof,
            "is_the_rigs": error.mesh == rig.mesh,
            "natural_frequency_error_percent": (100 * error.frequency).tolist(),
            "response_error_percent": (100 * error.response).tolist(),
            "estimated_response_error_percent": (
                None if error.estimate is None else (100 * error.estimate).tolist()
            ),
        }
        for error in study.errors
    ]
    answer = {
        "reference": {
            "mesh": [study.reference.nx, study.reference.ny],
            "element": study.reference.element_name,
            "strip_m": study.reference.strip,
            "natural_frequencies_hz": study.natural_frequencies.tolist(),
        },
        "drive_frequencies_hz": chosen.tolist(),
        "meshes": meshes,
        "moved_era_change_percent": (100 * study.by_place).tolist(),
        "wider_foot_change_percent": (100 * study.by_foot).tolist(),
        "solve_time_s": timed.elapsed,
    }
    heads = "".join(f"{f'at {frequency:g} Hz':>12}" for frequency in chosen)
    rows = [
        f"{rig_file}: errors against {study.reference}, solved in {timed.elapsed:.1f} s",
        "natural frequencies: maximum of the lowest twelve, on the ERAs; response: relative L2",
        "error of the acceleration over the plate, maximum over the ERAs driven alone",
        "",
        f"{'mesh':>9}{'element':>9}{'strips':>8}{'dof':>8}{'nat. freq.':>12}{heads}",
    ]
    for error in study.errors:
        mesh_text = f"{error.mesh.nx}x{error.mesh.ny}"
        strip = f"{1000 * error.mesh.strip:.3g} mm" if error.mesh.strip else "-"
        errors = _percents([abs(error.frequency).max(), *error.response])
        mine = "  <- the rig's" if error.mesh == rig.mesh else ""
        rows.append(
            f"{mesh_text:>9}{error.mesh.element_name:>9}{strip:>8}{error.mesh.dof:>8}{errors}{mine}"
        )
        if error.estimate is not None:
            estimated = _percents(error.estimate)
            rows.append(f"{'estimated without the reference':>46}{estimated}")
    nearer = f"is {1000 * MOVED:g} mm nearer to the middle"
    wider = f"has a foot with {1000 * FOOT:g} mm more radius"
    rows += [
        "",
        "for comparison, the change of the same response if every ERA",
        f"    {nearer:<42}{_percents(study.by_place)}",
        f"    {wider:<42}{_percents(study.by_foot)}",
    ]
    print_report(rows, answer, as_json=as_json)


def _percents(shares: Iterable[float]) -> str:
    """Format shares as columns of per cent."""
    return "".join(f"{100 * share:10.3f} %" for share in shares)


@plate_app.command()
def materials(as_json: JsonOption = False) -> None:
    """List known materials with their sources."""
    from model.structure.material import known_material, material_names

    known, problems = {}, []
    for name in material_names():
        try:
            known[name] = known_material(name)
        except InputError as error:  # an error in one plug-in does not hide the others
            problems.append(str(error))
    entries: list[dict[str, Any]] = [
        {
            "name": name,
            "E_pa": one.material.E,
            "rho_kg_m3": one.material.rho,
            "nu": one.material.nu,
            "moduli_pa": one.material.moduli,
            "by_frequency": [list(row) for row in one.by_frequency],
            "source": one.source,
            "variation": one.variation,
            "loss_factor": one.loss_factor,
            "by_kelvin": one.by_kelvin,
            "by_moisture": one.by_moisture,
            "weather": one.weather,
        }
        for name, one in known.items()
    ]
    rows = [
        f"{each['name']}: {_in_gpa(each['moduli_pa'])}, rho {each['rho_kg_m3']:g} kg/m³, "
        f"{'nu' if 'E' in each['moduli_pa'] else 'nu12'} {each['nu']:g}\n"
        f"    source  {each['source']}\n    variation  {each['variation']}\n"
        f"    loss factor of the bare material, about  {each['loss_factor']}\n"
        f"    weather  moduli by {100 * each['by_kelvin']:+g} % a kelvin, by "
        f"{each['by_moisture']:+g} % for 1 % of moisture: {each['weather']}"
        for each in entries
    ]
    other = (
        "Any other is given by numbers: material: {E: 70 GPa, rho: 2700, nu: 0.33}, with a grain "
        "{E1, E2, G12, G13, G23, nu12, rho}"
    )
    print_report([*rows, other], {"materials": entries, "problems": problems}, as_json=as_json)
    for problem in () if as_json else problems:
        print(f"era: warning: {problem}", file=sys.stderr)


@plate_app.command()
def show(rig_file: RigArgument, as_json: JsonOption = False) -> None:
    """Show material, rigidity and exciters of a rig's plate.

    Levels that exciters reach are for the nominal board; real parts vary.
    """
    from model.quantities import in_display_unit
    from model.rig.rig_file import load_rig
    from model.rig.rig_summary import FURTHER, plate_summary

    rig = load_rig(rig_file)
    summary = plate_summary(rig)
    if summary["exciters"]:
        from model.reduction.free_plate import solve_free_plate
        from model.transients.excursions import excursions_of, reach_of

        free = solve_free_plate(rig.plate, rig.mesh, frequency_max=rig.limits.frequency_max)
        summary["reach"] = reach_of(rig, free).as_json()
        moved = excursions_of(rig, free)
        for each, excursion in zip(summary["exciters"], moved.at_lowest.tolist(), strict=True):
            each["excursion_at_lowest_m"] = excursion
        summary["magnets_allow_from_hz"] = moved.allowed
    bare = in_display_unit(summary["mass_kg"], "kg", digits=4)
    rows = [
        f"{rig_file}: {1e3 * summary['length_m']:g} x {1e3 * summary['width_m']:g} mm",
        *(
            (
                f"surface by {surface['modes']} modes up to {surface['highest_frequency_hz']:.0f} "
                f"Hz of {surface['modes_file']}, {surface['rigid_modes']} of the rigid body, along "
                f"{surface['normal']}; outline of {surface['rings'] or 'no'} rings",
                "homogeneous plate with as many modes and the same mass, for wavelengths alone",
            )
            if (surface := summary["surface"])
            else _laminate_rows(summary["laminate"])
        ),
        f"    {1e3 * summary['thickness_m']:.4g} mm of {summary['material']}: "
        f"E {summary['E_pa'] / 1e9:.4g} GPa, rho {summary['rho_kg_m3']:.5g} kg/m³, "
        f"nu {summary['nu']:.3g}, loss factor {summary['loss_factor']:g}",
        *_grain_rows(summary["orthotropic"]),
        f"    flexural rigidity  {summary['flexural_rigidity_n_m']:.4g} N m",
        f"    mass  {bare} ({summary['surface_density_kg_m2']:.4g} kg/m²)",
        *(
            f"    {name.replace('_', ' ')}  {in_display_unit(value, each.unit)}"
            for name, each in FURTHER.items()
            if (value := summary["further"][each.key(name)])
        ),
        *(() if surface else _air_rows(summary["air_gap"])),
        *(
            f"    bending wavelength at {_frequency(key)}  {100 * wavelength:.3g} cm"
            for key, wavelength in summary["bending_wavelength_m"].items()
        ),
        *_attached_rows(summary),
        *_exciter_rows(summary["exciters"], summary.get("reach"), rig.threshold),
        *_type_rows(summary["exciter_types"]),
    ]
    print_report(rows, summary, as_json=as_json)
    for note in rig.surface_notes:
        typer.echo(f"era: warning: {note}", err=True)


def _laminate_rows(laminate: dict[str, Any] | None) -> Iterator[str]:
    """Yield the layers and rigidities of a laminate; None for a single-layer plate."""
    if laminate is None:
        yield "plate"
        return
    bonded, rows = laminate["rigidity_perfectly_bonded_n_m"], {}
    if len(laminate["layers"]) == 1:
        yield "plate whose modulus depends on the frequency"
    else:
        yield f"laminate of {1e3 * laminate['thickness_m']:g} mm, bond {laminate['bond']}"
        sliding = laminate["rigidity_freely_sliding_n_m"]
        rows = {"perfectly bonded": bonded, "freely sliding": sliding}
    for layer in laminate["layers"]:
        yield (
            f"    {1e3 * layer['thickness_m']:g} mm of {layer['material']}: "
            f"E {layer['E_pa'] / 1e9:g} GPa, rho {layer['rho_kg_m3']:g} kg/m³, nu {layer['nu']:g}"
        )
    in_waves = laminate.get("rigidity_by_frequency_n_m", {})
    rows |= {f"in free waves of {_frequency(key)}": each for key, each in in_waves.items()}
    for name, rigidity in rows.items():
        yield (
            f"    {name}  {rigidity:.4g} N m: bending frequencies x "
            f"{math.sqrt(rigidity / bonded):.3f}"
        )
    yield "homogeneous plate like it at the highest frequency"


def _frequency(key: str) -> str:
    return key.replace("_hz", " Hz")


def _grain_rows(grain: dict[str, float] | None) -> Iterator[str]:
    """Yield the moduli of a board along the plate's length (1) and its width (2)."""
    if grain is not None:
        moduli = {key[:-3]: each for key, each in grain.items() if key.endswith("_pa")}
        yield f"    along its length and width  {_in_gpa(moduli)}, nu12 {grain['nu12']:.3g}"
        yield (
            f"    flexural rigidity along, across  {grain['flexural_rigidity_along_n_m']:.4g}, "
            f"{grain['flexural_rigidity_across_n_m']:.4g} N m"
        )


def _in_gpa(moduli: dict[str, float]) -> str:
    """Format the moduli of a material, as `E 70 GPa`."""
    return f"{', '.join(f'{key} {each / 1e9:.4g}' for key, each in moduli.items())} GPa"


def _air_rows(air: dict[str, Any] | None) -> Iterator[str]:
    """Yield the air gap behind a plate."""
    if air is None:
        yield "    no air_gap: computed in a vacuum"
    else:
        edges = "sealed" if air["closed"] else "open"
        yield f"    air gap of {1e3 * air['depth_m']:g} mm behind it, edges {edges}"
    if air is not None and air["closed"]:
        stiffness = air["stiffness_n_m3"] / 1e6
        yield f"        stiffness against even motion  {stiffness:.4g} MN/m³"


def _attached_rows(summary: dict[str, Any]) -> Iterator[str]:
    """Yield the masses on the plate, and the supports that do not drive it."""
    for kind, (verb, key, count, unit) in _ATTACHED.items():
        points = summary[kind]
        if len(points) > _MAX_NAMED:
            together = count * sum(each[key] for each in points)
            yield f"    {verb} {together:.4g} {unit} at {len(points)} points"
            continue
        for each in points:
            loss = f", loss factor {loss:g}" if (loss := each.get("loss_factor")) else ""
            yield "    {} {:g} {}{} at ({:g}, {:g}) m".format(
                verb, count * each[key], unit, loss, *each["at_m"]
            )


def _exciter_rows(
    exciters: list[dict[str, Any]], reach: dict[str, Any] | None, threshold: str
) -> Iterator[str]:
    """Yield each exciter, and the frequency from which all together reach a level.

    threshold: name of the set that the level is relative to.
    """
    if reach is None:
        return
    lowest = f"{reach['frequencies_hz'][0]:g} Hz"
    yield f"exciters, with their largest excursion at full level at {lowest}"
    for each in exciters:
        allowed = each["excursion_max_m"]
        of = "" if allowed is None else f" of {1e3 * allowed:.2g}"
        yield (
            f"    {each['name']}  magnet {each['magnet']}, "
            f"glued at {each['magnet_resonance_hz']:.1f} Hz, "
            f"Q {each['q']:.1f} (viscous); {each['force_at_1_w_n']:.2f} N at 1 W, "
            f"{each['full_level_force_n']:.2f} N at full level, {each['full_level_v']:.3g} V; "
            f"{1e3 * each['excursion_at_lowest_m']:.2g}{of} mm"
        )
    level, start = f"{reach['level_db_sl']:g} dB SL ({threshold})", reach["from_hz"]
    where = "under a finger everywhere except within 2 cm of the edges (nominal board)"
    from_where = "at no frequency" if start is None else f"from {start:g} Hz"
    yield f"    {level} {where}: {from_where}"
    rows = zip(reach["frequencies_hz"], reach["share_of_places"], strict=True)
    short = [
        f"{100 * (1 - share):.1f} % at {frequency:g} Hz"
        for frequency, share in rows
        if share < 1 and (start is None or frequency > start)
    ]
    if short:
        yield f"    positions below this level: {', '.join(short)}"


def _type_rows(types: dict[str, Any]) -> Iterator[str]:
    """Yield the notes and assumed values of the exciter types."""
    for name, known in types.items():
        yield f"    {name}: {known['note']}"
        assumed = [f"{key} {low:g} to {high:g}" for key, (low, high) in known["assumed"].items()]
        if assumed:
            yield f"        assumed, measure yours: {', '.join(assumed)}"


@plate_app.command()
def template(
    rig_file: RigArgument,
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            metavar="FILE.svg|.pdf",
            help="Output file: one sheet (.svg), or A4 pages (.pdf).",
        ),
    ],
    side: Annotated[
        Literal["below", "above"],
        typer.Option(help="Face of the board to which the template is taped; actuators go below."),
    ] = "below",
    sensors_file: Annotated[
        Path | None,
        typer.Option(
            "--sensors",
            metavar="SENSORS.csv",
            help="Mark the sensor positions listed in this file.",
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Draw a full-scale template of the board.

    It marks the position of every part glued to the board. Print it at 100 %: the printed ruler
    must measure 100 mm.
    """
    from model.estimate.measurement import read_places
    from model.figures import Template, write_template
    from model.rig.rig_file import load_rig

    check_picture(output)
    rig = load_rig(rig_file)
    sensors = read_places(sensors_file, rig.plate) if sensors_file else {}
    drawn = Template(rig, sensors, is_below=side == "below")
    pages = write_template(output, drawn)
    length, width = drawn.board
    rows = [
        f"{rig_file}: {length:g} x {width:g} mm seen from {side}, "
        f"{counted(len([*drawn.places()]), 'place')}",
        f"wrote {output}, {counted(pages, 'page')}; print at 100 %",
    ]
    answer = {"board_m": [rig.plate.length, rig.plate.width], "pages": pages}
    print_report(rows, answer | {"side": side, "files": [str(output)]}, as_json=as_json)
