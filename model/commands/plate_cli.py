"""`era plate`: natural frequencies and maps."""

import json
import time
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from model.commands.options import (
    JsonOption,
    MeshOption,
    RigArgument,
    SizeOption,
    figure_size,
    next_line,
    progress_bar,
)
from model.config.points import parse_frequencies, parse_pair
from model.files.replacing import check_picture

plate_app = typer.Typer(help="Compute modes and vibration maps of a plate.")


class Support(StrEnum):
    """Boundary condition of the plate."""

    ERAS = "eras"
    SIMPLY_SUPPORTED = "simply-supported"
    FREE = "free"


@plate_app.command()
def modes(
    rig_file: RigArgument,
    mesh: MeshOption = None,
    support: Annotated[Support, typer.Option(help="Boundary condition.")] = Support.ERAS,
    count: Annotated[int, typer.Option("-n", min=1, help="Number of modes.")] = 12,
    as_json: JsonOption = False,
) -> None:
    """Compute natural frequencies.

    The plate is undamped; rigid modes of a free plate are left out.
    """
    from model.rig.file import load_rig
    from model.vibration.natural_modes import natural_modes

    rig = load_rig(rig_file, mesh=mesh)
    started = time.perf_counter()
    solved = natural_modes(rig, count, support=support.value)
    elapsed = time.perf_counter() - started
    carried = solved.mesh.highest_frequency(rig.plate)
    if as_json:
        print(
            json.dumps(
                {
                    "frequencies_hz": solved.frequencies.tolist(),
                    "mesh_carries_up_to_hz": carried,
                    "support": support.value,
                    "mesh": [solved.mesh.nx, solved.mesh.ny],
                    "dof": solved.mesh.dof,
                    "element": solved.mesh.element_name,
                    "solve_time_s": elapsed,
                }
            )
        )
        return
    name = solved.mesh.element_name
    element = "" if name in str(solved.mesh) else f" {name}"
    print(f"{rig_file}: {solved.mesh}{element}, {solved.mesh.dof} dof, support: {support.value}")
    for number, frequency in enumerate(solved.frequencies, start=1):
        beyond = "  mesh too coarse" if frequency > carried else ""
        print(f"mode {number:3d}  {frequency:9.2f} Hz{beyond}")
    if solved.frequencies[-1] > carried:
        print(
            f"above {carried:.0f} Hz a bending wavelength has fewer than six nodes; use a finer "
            "--mesh for those frequencies"
        )
    print(f"solved in {elapsed:.2f} s")


@plate_app.command("map")
def plate_map(
    rig_file: RigArgument,
    drive: Annotated[
        list[str],
        typer.Option(metavar="ERA=HZ[@LEVEL[:PHASE_DEG]]", help="Tone of one ERA; repeatable."),
    ],
    mesh: MeshOption = None,
    points: Annotated[
        str | None, typer.Option(metavar="XxY", help="Points of the map; default: the mesh's.")
    ] = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="MAP.png", help="Picture to draw.")
    ] = None,
    size: SizeOption = None,
    as_json: JsonOption = False,
) -> None:
    """Compute peak acceleration over the plate for any drive."""
    import numpy as np

    from model.commands.drive_option import beyond_limits, parse_drives
    from model.rig.file import load_rig
    from model.structure.support import support_problem
    from model.vibration.excitation import G
    from model.vibration.maps import plate_map as solve

    inches = figure_size(size)
    if output is not None:
        check_picture(output)
    rig = load_rig(rig_file, mesh=mesh)
    excitation = parse_drives(drive, rig)
    started = time.perf_counter()
    solved = solve(rig, excitation, raster=parse_pair(points, what="--points") if points else None)
    elapsed = time.perf_counter() - started
    unsupported = support_problem(rig.plate, rig.eras, loads=rig.masses)
    for warning in (beyond_limits(excitation, rig), unsupported):
        if warning:
            typer.echo(f"era: warning: {warning}", err=True)
    if output is not None:
        from model.figures import map_figure, save_figure

        title = ", ".join([*drive, *(["not supported"] if unsupported else [])])
        figure = map_figure(rig, solved, active=excitation.keys(), title=title)
        save_figure(figure, output, inches=inches)
    from model.choice import best_of

    row, column = divmod(best_of(solved.peak.ravel()), len(solved.x))
    if as_json:
        print(
            json.dumps(
                {
                    "x_m": solved.x.tolist(),
                    "y_m": solved.y.tolist(),
                    "peak_acceleration_m_s2": solved.peak.tolist(),
                    "max_m_s2": float(solved.peak.max()),
                    "max_at_m": [float(solved.x[column]), float(solved.y[row])],
                    "nulls_m": solved.nulls.tolist(),
                    "is_supported": unsupported is None,
                    "mesh": [rig.mesh.nx, rig.mesh.ny],
                    "solve_time_s": elapsed,
                    "files": [str(output)] if output else [],
                }
            )
        )
        return
    print(f"{rig_file}: {', '.join(drive)}, mesh {rig.mesh}, solved in {elapsed:.2f} s")
    print(
        f"largest  {solved.peak.max() / G:8.2f} g  ({solved.peak.max():.1f} m/s²) "
        f"at ({solved.x[column]:.4f}, {solved.y[row]:.4f}) m"
    )
    print(f"median   {float(np.median(solved.peak)) / G:8.2f} g")
    print(f"nulls    {len(solved.nulls):5d}")
    if output is not None:
        print(f"wrote {output}")
        print(next_line("era", "table", "build", rig_file, "-o", "table.npz"))


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
    """Compare meshes with a finer one.

    Print errors of natural frequencies and of responses.
    """
    from model.rig.file import load_rig
    from model.vibration.convergence import (
        FOOT,
        MOVED,
        default_frequencies,
        meshes_to_compare,
        study_convergence,
    )

    rig = load_rig(rig_file, mesh=mesh)
    chosen = parse_frequencies(frequencies) if frequencies else default_frequencies(rig)
    started = time.perf_counter()
    with progress_bar("meshes") as progress:
        study = study_convergence(
            rig, meshes_to_compare(rig), frequencies=chosen, progress=progress
        )
    elapsed = time.perf_counter() - started
    if as_json:
        rows = [
            {
                "mesh": [error.mesh.nx, error.mesh.ny],
                "element": error.mesh.element_name,
                "strip_m": error.mesh.strip,
                "dof": error.dof,
                "is_the_rigs": error.mesh == rig.mesh,
                "natural_frequency_error_percent": (100 * error.frequency).tolist(),
                "response_error_percent": (100 * error.response).tolist(),
                "estimated_response_error_percent": (
                    None if error.estimate is None else (100 * error.estimate).tolist()
                ),
            }
            for error in study.errors
        ]
        reference = {
            "mesh": [study.reference.nx, study.reference.ny],
            "element": study.reference.element_name,
            "strip_m": study.reference.strip,
            "natural_frequencies_hz": study.natural_frequencies.tolist(),
        }
        answer = {
            "reference": reference,
            "drive_frequencies_hz": chosen.tolist(),
            "meshes": rows,
            "moved_era_change_percent": (100 * study.by_place).tolist(),
            "wider_foot_change_percent": (100 * study.by_foot).tolist(),
        }
        print(json.dumps(answer | {"solve_time_s": elapsed}))
        return
    print(f"{rig_file}: errors against {study.reference}, solved in {elapsed:.1f} s")
    print("natural frequencies: maximum of the lowest twelve, on the ERAs; response: relative L2")
    print("error of the acceleration over the plate, maximum over the ERAs driven alone")
    print()
    heads = "".join(f"{f'at {frequency:g} Hz':>12}" for frequency in chosen)
    print(f"{'mesh':>9}{'element':>9}{'strips':>8}{'dof':>8}{'nat. freq.':>12}{heads}")
    for error in study.errors:
        mesh_text = f"{error.mesh.nx}x{error.mesh.ny}"
        strip = f"{1000 * error.mesh.strip:.3g} mm" if error.mesh.strip else "-"
        errors = [100 * abs(error.frequency).max(), *(100 * error.response)]
        columns = "".join(f"{value:10.3f} %" for value in errors)
        mine = "  <- the rig's" if error.mesh == rig.mesh else ""
        print(f"{mesh_text:>9}{error.mesh.element_name:>9}{strip:>8}{error.dof:>8}{columns}{mine}")
        if error.estimate is not None:
            columns = "".join(f"{value:10.3f} %" for value in 100 * error.estimate)
            print(f"{'estimated without the reference':>46}{columns}")
    print()
    print("for comparison, what the same response changes by if every ERA")
    changes = {
        f"is {1000 * MOVED:g} mm nearer to the middle": study.by_place,
        f"has a foot with {1000 * FOOT:g} mm more radius": study.by_foot,
    }
    for what, change in changes.items():
        print(f"    {what:<42}" + "".join(f"{value:10.3f} %" for value in 100 * change))
