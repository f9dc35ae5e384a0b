"""`era figure`: the founding paper's figures."""

from typing import Annotated

import typer

from model.commands.options import (
    FolderOption,
    JsonOption,
    MeshOption,
    RigArgument,
    Stopwatch,
    next_line,
    print_report,
)

figure_app = typer.Typer()


@figure_app.command()
def figure(
    number: Annotated[
        str, typer.Argument(metavar="6|7|10|11|12|13|all", help="Number of the figure.")
    ],
    rig_file: RigArgument,
    output: FolderOption,
    mesh: MeshOption = None,
    as_json: JsonOption = False,
) -> None:
    """Draw a figure of the founding paper.

    Write a CSV file of its numbers beside it.
    """
    from era_haptics.lab.paper_figures import paper_figures
    from model.figures import save_figure
    from model.files.csv_file import write_columns
    from model.rig.rig_file import load_rig

    rig = load_rig(rig_file, mesh=mesh)
    output.mkdir(parents=True, exist_ok=True)
    names, files = [], []
    with Stopwatch() as timed:
        for made in paper_figures(rig, number):
            picture = output / f"{made.name}.png"
            save_figure(made.figure, picture)
            tables = [output / f"{made.name}{suffix}.csv" for suffix in made.tables]
            for table, columns in zip(tables, made.tables.values(), strict=True):
                write_columns(table, columns)
            names.append(made.name)
            files += [str(path) for path in (picture, *tables)]
    rows = [
        f"{timed.elapsed:.1f} s, mesh {rig.mesh}; wrote",
        *(f"  {name}" for name in files),
        next_line("era", "design", rig_file, "-o", "design"),
    ]
    answer = {"figures": names, "mesh": [rig.mesh.nx, rig.mesh.ny]}
    print_report(rows, answer | {"time_s": timed.elapsed, "files": files}, as_json=as_json)
