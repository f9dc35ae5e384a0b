"""`era table map`: contrast of every place to given quiet fingers."""

import json
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from model.commands.options import (
    JsonOption,
    SizeOption,
    TableArgument,
    figure_size,
    next_line,
    progress_bar,
)
from model.config.points import parse_pair, parse_point
from model.files.replacing import check_picture, check_place

if TYPE_CHECKING:
    from model.table.contrast_map import ContrastMap


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
    from model.finger.grid import Grid
    from model.table.contrast_map import map_contrast
    from model.table.file import load_table

    inches = figure_size(size)
    is_csv = output is not None and output.suffix.lower() == ".csv"
    if output is not None:
        check_place(output, example="map.csv") if is_csv else check_picture(output)
    fingers = [parse_point(text, what="--quiet") for text in quiet]
    places = Grid(*parse_pair(grid, what="--grid")) if grid else None
    table = load_table(table_file)
    started = time.perf_counter()
    with progress_bar("places") as progress:
        found = map_contrast(
            table,
            fingers,
            drive_modes=[mode.strip() for mode in modes.split(",")] if modes else (),
            level_db_sl=level,
            grid=places,
            progress=progress,
        )
    elapsed = time.perf_counter() - started
    if output is not None and is_csv:
        from model.files.csv_file import write_columns

        write_columns(output, found.columns)
    elif output is not None:
        from model.figures import save_figure
        from model.figures.table_pictures import contrast_map_figure

        save_figure(contrast_map_figure(table, found), output, inches=inches)
    if as_json:
        files = [] if output is None else [str(output)]
        print(json.dumps(found.as_json() | {"solve_time_s": elapsed, "files": files}))
        return
    _show(found)
    print(f"computed in {elapsed:.1f} s{'' if output is None else f'; wrote {output}'}")
    words = [word for text in quiet for word in ("--quiet", text)]
    target = f"{found.x[0]:.3g},{found.y[0]:.3g}"
    print(next_line("era", "table", "query", table_file, "--target", target, *words))


def _show(found: "ContrastMap") -> None:
    """Print a map of each drive mode, the largest y first, and its distribution."""
    import numpy as np

    for mode, promised in found.promised_db.items():
        print(f"{mode}: felt contrast of nine of ten plates to the quiet fingers, dB")
        for row in promised[::-1]:
            print("".join("   -" if np.isnan(value) else f"{value:4.0f}" for value in row))
        known, nominal = (of[np.isfinite(of)] for of in (promised, found.nominal_db[mode]))
        if len(known):
            low, median, high = np.percentile(known, [10, 50, 90])
            print(
                f"median {median:.1f} dB, one place in ten below {low:.1f}, one above {high:.1f}; "
                f"median as modelled {np.median(nominal):.1f}"
            )
        print()
