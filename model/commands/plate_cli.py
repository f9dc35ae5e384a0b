"""`era plate modes`, `map`, `convergence`, `materials` and `template`."""

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
    parse_frequencies,
    parse_pair,
    print_report,
    progress_bar,
)
from model.commands.plate_show_cli import in_gpa
from model.errors import InputError, expect_between
from model.files.output_paths import check_picture
from model.quantities import counted
from registry.plugins import did_you_mean

if TYPE_CHECKING:
    from model.arrays import FloatArray
    from model.rig.rig import Rig
    from model.structure.material import KnownMaterial
    from model.vibration import Convergence, Excitation, MeshError, PlateMap

plate_app = typer.Typer(help="Compute modes and vibration maps of a plate.")


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
    mesh_name = str(solved.mesh)
    if solved.mesh.element_name not in mesh_name:
        mesh_name += f" {solved.mesh.element_name}"
    highest = solved.mesh.highest_frequency(rig.plate)
    rows = [f"{rig_file}: {mesh_name}, {solved.mesh.dof} dof, support: {support}"]
    for number, frequency in enumerate(solved.frequencies, start=1):
        warning = "  mesh too coarse" if frequency > highest else ""
        rows.append(f"mode {number:3d}  {frequency:9.2f} Hz{warning}")
    if solved.frequencies[-1] > highest:
        rows.append(
            f"above {highest:.0f} Hz a bending wavelength has fewer than six nodes; use a finer "
            "--mesh for those frequencies"
        )
    rows.append(f"solved in {timed.elapsed:.2f} s")
    answer = {
        "frequencies_hz": solved.frequencies.tolist(),
        "mesh_carries_up_to_hz": highest,
        "support": support,
        "mesh": [solved.mesh.nx, solved.mesh.ny],
        "dof": solved.mesh.dof,
        "element": solved.mesh.element_name,
        "solve_time_s": timed.elapsed,
    }
    print_report(rows, answer, as_json=as_json)


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
    from model.rig.rig_file import load_rig
    from model.structure.statics import support_problem
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
        from model.figures.plate_maps import drive_title, map_figure
        from model.figures.style import save_figure

        title = drive_title(excitation, rig)
        if unsupported:
            title += " (ERAs do not support the plate)"
        figure = map_figure(rig, solved, active=excitation.keys(), title=title)
        save_figure(figure, output, inches=inches)
    summary = _map_summary(solved, rig.threshold)
    rows = [
        f"{rig_file}: {', '.join(drive)}, mesh {rig.mesh}, solved in {timed.elapsed:.2f} s",
        *_map_rows(solved, summary, rig.threshold),
    ]
    if output is not None:
        rows.append(f"wrote {output}")
        rows.append(next_line("era", "table", "build", rig_file, "-o", "table.npz"))
    answer = {
        "x_m": solved.x.tolist(),
        "y_m": solved.y.tolist(),
        "peak_acceleration_m_s2": solved.peak.tolist(),
        **summary,
        "is_supported": unsupported is None,
        "mesh": [rig.mesh.nx, rig.mesh.ny],
        "solve_time_s": timed.elapsed,
        "files": [str(output)] if output else [],
    }
    print_report(rows, answer, as_json=as_json)


def _map_summary(solved: "PlateMap", threshold: str) -> dict[str, Any]:
    """Return the maximum, the nulls and the levels of a map, as a JSON object."""
    from model.arrays import best_of

    row, column = divmod(best_of(solved.peak.ravel()), len(solved.x))
    levels = _levels_over(solved, threshold)
    return {
        "max_m_s2": float(solved.peak.max()),
        "max_at_m": [float(solved.x[column]), float(solved.y[row])],
        "nulls_m": solved.nulls.tolist(),
        "median_level_db_sl": None if levels is None else levels.median,
        "level_on_99_percent_db_sl": None if levels is None else levels.on_99_percent,
    }


def _map_rows(solved: "PlateMap", summary: dict[str, Any], threshold: str) -> Iterator[str]:
    """Yield the acceleration and the levels of a map."""
    import numpy as np

    from model.vibration import G

    maximum, (x, y) = summary["max_m_s2"], summary["max_at_m"]
    yield f"largest  {maximum / G:8.2f} g  ({maximum:.1f} m/s²) at ({x:.4f}, {y:.4f}) m"
    yield f"median   {float(np.median(solved.peak)) / G:8.2f} g"
    median_level = summary["median_level_db_sl"]
    if median_level is not None:
        yield (
            f"level    {median_level:8.1f} dB SL median, "
            f"{summary['level_on_99_percent_db_sl']:.1f} or more on 99 % of the points "
            f"({threshold})"
        )
    yield f"nulls    {len(solved.nulls):5d}"


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
        frequency = float(match["frequency"])
        level = float(match["level"] or 1)
        phase = float(match["phase"] or 0)
        expect_between(level, 0, 1, what=f"--drive {text!r}: level")
        if frequency <= 0:
            raise InputError(f"--drive {text!r}: frequency must be positive, got {frequency:g} Hz")
        stroke = rig.full_levels[name]
        excitation[name] = Tone(frequency, level * stroke, math.radians(phase))
    return excitation


def beyond_limits(excitation: "Excitation", rig: "Rig") -> str | None:
    """Return a warning if tones are outside the rig's frequency limits, else None."""
    low, high = rig.limits.frequency_min, rig.limits.frequency_max
    outside = [
        f"{era} at {tone.frequency:g} Hz"
        for era, tone in excitation.items()
        if not low <= tone.frequency <= high
    ]
    if not outside:
        return None
    return (
        f"{', '.join(outside)}: outside the rig's limits.frequency of {low:g} to {high:g} Hz; the "
        "guard enforces this range"
    )


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
    from model.vibration import default_frequencies, meshes_to_compare, study_convergence

    rig = load_rig(rig_file, mesh=mesh)
    chosen = parse_frequencies(frequencies) if frequencies else default_frequencies(rig)
    with Stopwatch() as timed, progress_bar("meshes") as progress:
        study = study_convergence(
            rig, meshes_to_compare(rig), frequencies=chosen, progress=progress
        )
    answer = {
        "reference": {
            "mesh": [study.reference.nx, study.reference.ny],
            "element": study.reference.element_name,
            "strip_m": study.reference.strip,
            "natural_frequencies_hz": study.natural_frequencies.tolist(),
        },
        "drive_frequencies_hz": chosen.tolist(),
        "meshes": [_mesh_json(error, rig) for error in study.errors],
        "moved_era_change_percent": (100 * study.by_place).tolist(),
        "wider_foot_change_percent": (100 * study.by_foot).tolist(),
        "solve_time_s": timed.elapsed,
    }
    heading = f"{rig_file}: errors against {study.reference}, solved in {timed.elapsed:.1f} s"
    rows = [heading, *_convergence_rows(study, rig, chosen)]
    print_report(rows, answer, as_json=as_json)


def _mesh_json(error: "MeshError", rig: "Rig") -> dict[str, Any]:
    """Return the errors of a mesh as a JSON object."""
    estimate = None
    if error.estimate is not None:
        estimate = (100 * error.estimate).tolist()
    return {
        "mesh": [error.mesh.nx, error.mesh.ny],
        "element": error.mesh.element_name,
        "strip_m": error.mesh.strip,
        "dof": error.mesh.dof,
        "is_the_rigs": error.mesh == rig.mesh,
        "natural_frequency_error_percent": (100 * error.frequency).tolist(),
        "response_error_percent": (100 * error.response).tolist(),
        "estimated_response_error_percent": estimate,
    }


def _convergence_rows(study: "Convergence", rig: "Rig", frequencies: "FloatArray") -> Iterator[str]:
    """Yield the table of a convergence study at its frequencies [Hz]."""
    from model.vibration import FOOT, MOVED

    yield "natural frequencies: maximum of the lowest twelve, on the ERAs; response: relative L2"
    yield "error of the acceleration over the plate, maximum over the ERAs driven alone"
    yield ""
    heads = "".join(f"{f'at {frequency:g} Hz':>12}" for frequency in frequencies)
    yield f"{'mesh':>9}{'element':>9}{'strips':>8}{'dof':>8}{'nat. freq.':>12}{heads}"
    for error in study.errors:
        mesh = error.mesh
        size = f"{mesh.nx}x{mesh.ny}"
        strip = f"{1000 * mesh.strip:.3g} mm" if mesh.strip else "-"
        errors = _percents([abs(error.frequency).max(), *error.response])
        mark = "  <- the rig's" if mesh == rig.mesh else ""
        yield f"{size:>9}{mesh.element_name:>9}{strip:>8}{mesh.dof:>8}{errors}{mark}"
        if error.estimate is not None:
            yield f"{'estimated without the reference':>46}{_percents(error.estimate)}"
    yield ""
    yield "for comparison, the change of the same response if every ERA"
    moved = f"is {1000 * MOVED:g} mm nearer to the middle"
    yield f"    {moved:<42}{_percents(study.by_place)}"
    wider = f"has a foot with {1000 * FOOT:g} mm more radius"
    yield f"    {wider:<42}{_percents(study.by_foot)}"


def _percents(shares: Iterable[float]) -> str:
    """Format shares as columns of per cent."""
    return "".join(f"{100 * share:10.3f} %" for share in shares)


def materials(as_json: JsonOption = False) -> None:
    """List known materials with their sources."""
    from model.structure.material import known_material, material_names

    entries, problems = [], []
    for name in material_names():
        try:
            material = known_material(name)
        except InputError as error:  # an error in one plug-in does not hide the others
            problems.append(str(error))
        else:
            entries.append(_material_json(name, material))
    rows = [
        *map(_material_row, entries),
        "Any other is given by numbers: material: {E: 70 GPa, rho: 2700, nu: 0.33}, with a grain "
        "{E1, E2, G12, G13, G23, nu12, rho}",
    ]
    print_report(rows, {"materials": entries, "problems": problems}, as_json=as_json)
    if not as_json:
        for problem in problems:
            print(f"era: warning: {problem}", file=sys.stderr)


def _material_json(name: str, entry: "KnownMaterial") -> dict[str, Any]:
    """Return the numbers and sources of a material as a JSON object."""
    return {
        "name": name,
        "E_pa": entry.material.E,
        "rho_kg_m3": entry.material.rho,
        "nu": entry.material.nu,
        "moduli_pa": entry.material.moduli,
        "by_frequency": [list(row) for row in entry.by_frequency],
        "source": entry.source,
        "variation": entry.variation,
        "loss_factor": entry.loss_factor,
        "by_kelvin": entry.by_kelvin,
        "by_moisture": entry.by_moisture,
        "weather": entry.weather,
    }


def _material_row(entry: dict[str, Any]) -> str:
    """Format the JSON object of a material."""
    ratio = "nu" if "E" in entry["moduli_pa"] else "nu12"
    return (
        f"{entry['name']}: {in_gpa(entry['moduli_pa'])}, rho {entry['rho_kg_m3']:g} kg/m³, "
        f"{ratio} {entry['nu']:g}\n"
        f"    source  {entry['source']}\n    variation  {entry['variation']}\n"
        f"    loss factor of the bare material, about  {entry['loss_factor']}\n"
        f"    weather  moduli by {100 * entry['by_kelvin']:+g} % a kelvin, by "
        f"{entry['by_moisture']:+g} % for 1 % of moisture: {entry['weather']}"
    )


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
    from model.figures.template import Template, write_template
    from model.response_files import read_places
    from model.rig.rig_file import load_rig

    check_picture(output)
    rig = load_rig(rig_file)
    sensors = read_places(sensors_file, rig.plate) if sensors_file else {}
    drawing = Template(rig, sensors, is_below=side == "below")
    pages = write_template(output, drawing)
    length, width = drawing.board
    rows = [
        f"{rig_file}: {length:g} x {width:g} mm seen from {side}, "
        f"{counted(len([*drawing.parts()]), 'place')}",
        f"wrote {output}, {counted(pages, 'page')}; print at 100 %",
    ]
    answer = {
        "board_m": [rig.plate.length, rig.plate.width],
        "pages": pages,
        "side": side,
        "files": [str(output)],
    }
    print_report(rows, answer, as_json=as_json)
