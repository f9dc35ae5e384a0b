"""`era table build`, `plot`, `map` and `export`: files of a table."""

from collections.abc import Iterator
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from model.commands.options import (
    FolderOption,
    JsonOption,
    MeshOption,
    RigArgument,
    SizeOption,
    Stopwatch,
    TableArgument,
    figure_size,
    next_line,
    print_report,
    progress_bar,
)
from model.config.points import parse_frequencies, parse_pair, parse_point
from model.errors import InputError
from model.files.replacing import (
    begins_with,
    check_ending,
    check_picture,
    check_place,
    check_replaceable,
)
from model.quantities import counted

if TYPE_CHECKING:
    from model.spectral.mesh import PlateMesh
    from model.study.contrast_map import ContrastMap


class Format(StrEnum):
    """File format of other programs."""

    MAT = "mat"
    CSV = "csv"


class Picture(StrEnum):
    """File format of pictures."""

    PNG = "png"
    SVG = "svg"
    PDF = "pdf"


class TableContent(StrEnum):
    """Rows of a CSV file."""

    PATTERNS = "patterns"
    FIELDS = "fields"


def plot(
    table_file: TableArgument,
    output: FolderOption,
    to: Annotated[Picture, typer.Option("--format", help="Of the pictures.")] = Picture.PNG,
    size: SizeOption = None,
    as_json: JsonOption = False,
) -> None:
    """Draw weak cells, levels, contrast and an answer."""
    from model.figures import save_figure
    from model.figures.table_pictures import table_figures
    from model.study.overview import find_overview
    from model.table.file import load_table

    inches = figure_size(size)
    table = load_table(table_file)
    output.mkdir(parents=True, exist_ok=True)
    files = []
    with Stopwatch() as timed:
        with progress_bar("questions") as progress:
            overview = find_overview(table, progress=progress)
        for name, figure in table_figures(table, overview):
            path = output / f"{name}.{to.value}"
            save_figure(figure, path, inches=inches)
            files.append(str(path))
    rows = [
        f"{timed.elapsed:.1f} s; wrote",
        *(f"  {file}" for file in files),
        next_line("era", "table", "show", table_file, "--weak"),
    ]
    print_report(rows, {"files": files}, as_json=as_json)


def export(
    table_file: TableArgument,
    to: Annotated[Format, typer.Option("--format", help="MATLAB and Octave, or text.")],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="FILE", help="File to write.")],
    content: Annotated[
        TableContent | None,
        typer.Option(help="Rows of a CSV file: patterns of the map, or fields on the raster."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Write a table for other programs.

    docs/reference/table-file.md describes the content.
    """
    from model.study.export import export_csv, export_mat
    from model.table.file import load_table

    if content is not None and to is Format.MAT:
        raise InputError("--content must be left out with --format mat, which holds everything")
    check_place(output, example=f"table.{to.value}")
    check_ending(output, f".{to.value}", what=f"a file of --format {to.value}")
    table = load_table(table_file)
    if to is Format.MAT:
        export_mat(table, output)
    else:
        export_csv(table, output, content=(content or TableContent.PATTERNS).value)
    rows = [
        f"wrote {output} ({output.stat().st_size / 1e6:.1f} MB)",
        f"Next: {_reader(to, output)}",
    ]
    print_report(rows, {"files": [str(output)]}, as_json=as_json)


def _reader(to: Format, output: Path) -> str:
    """Format a hint that opens the file."""
    if to is Format.MAT:
        return f"load('{output}') in MATLAB or Octave, scipy.io.loadmat in Python"
    return f"open {output} in a spreadsheet, or pandas.read_csv('{output}')"


def contrast_map(
    table_file: TableArgument,
    quiet: Annotated[
        list[str],
        typer.Option(metavar="X,Y", help="Position of a finger that must not feel it; repeatable."),
    ],
    modes: Annotated[
        str | None,
        typer.Option(metavar="MODE,MODE", help="Drive modes side by side; default: the table's."),
    ] = None,
    level: Annotated[
        float, typer.Option(metavar="DB_SL", help="Level at each place, dB SL.")
    ] = 20.0,
    grid: Annotated[
        str | None, typer.Option(metavar="NXxNY", help="Places along x and y; default: the cells.")
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="FILE", help="Picture (.png .svg .pdf), or .csv."),
    ] = None,
    size: SizeOption = None,
    as_json: JsonOption = False,
) -> None:
    """Map the promised contrast of every place to given quiet fingers."""
    from model.finger import Grid
    from model.study.contrast_map import map_contrast
    from model.table.file import load_table

    inches = figure_size(size)
    is_csv = output is not None and output.suffix.lower() == ".csv"
    if output is not None:
        if is_csv:
            check_place(output, example="map.csv")
        else:
            check_picture(output, instead=", or that of a table in .csv")
    fingers = [parse_point(text, what="--quiet") for text in quiet]
    places = Grid(*parse_pair(grid, what="--grid")) if grid else None
    table = load_table(table_file)
    with Stopwatch() as timed, progress_bar("places") as progress:
        found = map_contrast(
            table,
            fingers,
            drive_modes=[mode.strip() for mode in modes.split(",")] if modes else (),
            level_db_sl=level,
            grid=places,
            progress=progress,
        )
    if output is not None and is_csv:
        from model.files.csv_file import write_columns

        write_columns(output, found.columns)
    elif output is not None:
        from model.figures import save_figure
        from model.figures.table_pictures import contrast_map_figure

        save_figure(contrast_map_figure(table, found), output, inches=inches)
    words = [word for text in quiet for word in ("--quiet", text)]
    target = f"{found.x[0]:.3g},{found.y[0]:.3g}"
    rows = [
        *_map_rows(found),
        f"computed in {timed.elapsed:.1f} s{'' if output is None else f'; wrote {output}'}",
        next_line("era", "table", "query", table_file, "--target", target, *words),
    ]
    files = [] if output is None else [str(output)]
    answer = found.as_json() | {"solve_time_s": timed.elapsed, "files": files}
    print_report(rows, answer, as_json=as_json)


def _map_rows(found: "ContrastMap") -> Iterator[str]:
    """Yield a map of each drive mode, the largest y first, and its distribution."""
    import numpy as np

    for mode, promised in found.promised_db.items():
        yield f"{mode}: promised felt contrast to the quiet fingers, dB"
        for row in promised[::-1]:
            yield "".join("   -" if np.isnan(value) else f"{value:4.0f}" for value in row)
        known, nominal = (of[np.isfinite(of)] for of in (promised, found.nominal_db[mode]))
        if len(known):
            low, median, high = np.percentile(known, [10, 50, 90])
            yield (
                f"median {median:.1f} dB, one place in ten below {low:.1f}, one above {high:.1f}; "
                f"median nominal {np.median(nominal):.1f}"
            )
        yield ""


def build(
    rig_file: RigArgument,
    output: Annotated[Path, typer.Option("--output", "-o", metavar="TABLE", help="File to write.")],
    frequencies: Annotated[
        str | None,
        typer.Option(
            metavar="LO:HI:STEP",
            help="Frequencies in Hz, both ends included; default: 40:500:10 within the rig's "
            "limits.frequency.",
        ),
    ] = None,
    drive_mode: Annotated[
        str, typer.Option("--mode", help="Default drive mode: switched or phased.")
    ] = "switched",
    grid: Annotated[
        str, typer.Option(metavar="NXxNY", help="Target cells along x and y.")
    ] = "12x9",
    mesh: MeshOption = None,
    workers: Annotated[int, typer.Option(min=1, max=256, help="Number of processes.")] = 1,
    as_json: JsonOption = False,
) -> None:
    """Solve the plate and write its table."""
    from model.compiled.kernels import why_slow
    from model.drive_modes import checked_mode
    from model.finger import Grid
    from model.rig.file import load_rig
    from model.table.build import TableProblem, solve_table
    from model.table.file import ZIP, save_table
    from model.table.table import default_drive_frequencies

    checked_mode(drive_mode, "--mode")
    check_place(output, example="table.npz")
    check_ending(output, ".npz", what="a localization table")
    check_replaceable(output, is_own=begins_with(output, ZIP), what="localization table")
    rig = load_rig(rig_file, mesh=mesh)
    chosen = (
        parse_frequencies(frequencies) if frequencies else default_drive_frequencies(rig.limits)
    )
    problem = TableProblem(rig, chosen, Grid(*parse_pair(grid, what="--grid")))
    with Stopwatch() as timed, progress_bar("parts") as progress:
        table = solve_table(problem, drive_mode=drive_mode, workers=workers, progress=progress)
    save_table(table, output)
    error = 100 * float(table.discretisation_error.max())
    rows = [
        f"{counted(table.pattern_count, 'pattern')} of "
        f"{counted(len(table.frequencies), 'frequency', plural='frequencies')} for "
        f"{counted(table.grid.cell_count, 'cell')}, built in {timed.elapsed:.2f} s",
        f"mesh {table.mesh}: error of the fields {error:.3g} %, estimated with "
        f"{table.reference_mesh}",
        rig.uncertainty_note,
        f"wrote {output} ({output.stat().st_size / 1e6:.1f} MB)",
        next_line("era", "table", "show", output),
    ]
    answer = {
        "patterns": table.pattern_count,
        "cells": table.grid.cell_count,
        "drive_frequencies_hz": table.frequencies.tolist(),
        "mesh": [table.mesh.nx, table.mesh.ny],
        "element": table.mesh.element_name,
        "discretisation_error_percent": error,
        "mode": table.drive_mode,
        "fingerprint": table.fingerprint,
        "code_version": table.code_version,
        "exactly_known": [*rig.exactly_known],
        "build_time_s": timed.elapsed,
        "files": [str(output)],
    }
    print_report(rows, answer, as_json=as_json)
    for warning in filter(None, (_coarse(error, table.mesh), why_slow())):
        typer.echo(f"era: warning: {warning}", err=True)


NOTED_ERROR = 5.0
"""Error of the fields [%] from which a mesh is called coarse, as large as that of a gain."""


def _coarse(error: float, mesh: "PlateMesh") -> str | None:
    """Warn of the error [%] of a mesh, None for a small one."""
    if error < NOTED_ERROR:
        return None
    return (
        f"mesh {mesh} is coarse: its fields are wrong by {error:.3g} %; what is promised takes "
        "this error into account and is lower for it; `mesh: auto` chooses one for about 1 %"
    )
