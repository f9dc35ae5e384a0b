"""`era report` (files for a bug report) and `era figure` (figures of the founding paper)."""

from pathlib import Path
from typing import Annotated

import typer

from drivers.by_hand.cli import EXIT_STATUS as EXIT_STATUS
from era_haptics.lab.checks.content_cli import content_app, play
from era_haptics.lab.checks.layout_cli import layout_app
from era_haptics.lab.conformance.conformance_cli import conformance
from era_haptics.lab.design.design_cli import design_app
from era_haptics.lab.measuring.measure_cli import MeasureCommand, measure, outputs
from model.commands.options import (
    FolderOption,
    JsonOption,
    MeshOption,
    RigArgument,
    Stopwatch,
    next_line,
    print_report,
)
from model.errors import InputError


def report(
    configs: Annotated[
        list[Path] | None,
        typer.Argument(metavar="[CONFIG]...", help="Rig, layout and daemon files to include."),
    ] = None,
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder to make.")] = Path(
        "era-report"
    ),
    socket: Annotated[
        Path | None, typer.Option("--socket", help="Socket of the daemon; default: the usual path.")
    ] = None,
) -> None:
    """Collect files for a bug report in a folder.

    The folder contains versions, configuration files, the daemon's state and the end of its log,
    reduced to harmless values of known keys. Free text, names, hosts and everything unknown are
    hidden.
    """
    from era_haptics.lab.report import collect, write_report

    for path in configs or ():
        if not path.exists():
            raise InputError(f"{path}: no such file; check its name and folder")
    collected = collect(configs or [], socket=socket)
    write_report(output, collected)
    for name, file in collected.files.items():
        source = "" if file.source is None else f" of {file.source}"
        print(f"  {name}: {len(file.text)} characters{source}")
    for what in collected.missing:
        print(f"  skipped: {what}")
    print(f"wrote {output}\nNext: read the files, then send the folder")


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

    Also writes its numbers as a CSV file.
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


amp = typer.Typer()
amp.command()(conformance)

app = typer.Typer()
app.add_typer(amp, name="amp")
app.add_typer(content_app, name="content")
app.add_typer(layout_app, name="layout")
app.add_typer(design_app)
app.add_typer(figure_app)
for _command in (play, report, outputs):
    app.command()(_command)
app.command(cls=MeasureCommand)(measure)
