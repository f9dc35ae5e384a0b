"""`era table plot` and `era table export`."""

import json
import time
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from model.commands.options import (
    FolderOption,
    JsonOption,
    SizeOption,
    TableArgument,
    figure_size,
    next_line,
    progress_bar,
)
from model.errors import InputError
from model.files.replacing import check_ending, check_place


class Format(StrEnum):
    """File format of other programs."""

    MAT = "mat"
    CSV = "csv"


class Picture(StrEnum):
    """File format of pictures."""

    PNG = "png"
    SVG = "svg"
    PDF = "pdf"


class Content(StrEnum):
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
    from model.table.file import load_table
    from model.table.overview import find_overview

    inches = figure_size(size)
    table = load_table(table_file)
    output.mkdir(parents=True, exist_ok=True)
    started = time.perf_counter()
    files = []
    with progress_bar("cells and contact sets") as progress:
        overview = find_overview(table, progress=progress)
    for name, figure in table_figures(table, overview):
        path = output / f"{name}.{to.value}"
        save_figure(figure, path, inches=inches)
        files.append(str(path))
    if as_json:
        print(json.dumps({"files": files}))
        return
    print(f"{time.perf_counter() - started:.1f} s; wrote")
    for file in files:
        print(f"  {file}")
    print(next_line("era", "table", "show", table_file, "--weak"))


def export(
    table_file: TableArgument,
    to: Annotated[Format, typer.Option("--format", help="MATLAB and Octave, or text.")],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="FILE", help="File to write.")],
    content: Annotated[
        Content | None,
        typer.Option(help="Rows of a CSV file: patterns of the map, or fields on the raster."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Write a table for other programs.

    docs/reference/table-file.md describes the content.
    """
    from model.table.export import export_csv, export_mat
    from model.table.file import load_table

    if content is not None and to is Format.MAT:
        raise InputError("--content must be left out with --format mat, which holds everything")
    check_place(output, example=f"table.{to.value}")
    check_ending(output, f".{to.value}", what=f"a file of --format {to.value}")
    table = load_table(table_file)
    if to is Format.MAT:
        export_mat(table, output)
    else:
        export_csv(table, output, content=(content or Content.PATTERNS).value)
    if as_json:
        print(json.dumps({"files": [str(output)]}))
        return
    print(f"wrote {output} ({output.stat().st_size / 1e6:.1f} MB)")
    print(f"Next: {_reader(to, output)}")


def _reader(to: Format, output: Path) -> str:
    """Format a hint that opens the file."""
    if to is Format.MAT:
        return f"load('{output}') in MATLAB or Octave, scipy.io.loadmat in Python"
    return f"open {output} in a spreadsheet, or pandas.read_csv('{output}')"
