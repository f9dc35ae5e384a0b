"""`era report` (files for a bug report), and the other commands of the lab."""

from pathlib import Path
from typing import Annotated

import typer

from drivers.by_hand.cli import EXIT_STATUS as EXIT_STATUS
from era_haptics.lab.checks.content_cli import content_app, play
from era_haptics.lab.checks.layout_cli import layout_app
from era_haptics.lab.conformance.conformance_cli import conformance
from era_haptics.lab.design.design_cli import design_app
from era_haptics.lab.measuring.measure_cli import measure, outputs
from era_haptics.lab.measuring.rig_cli import rig_app
from era_haptics.lab.rig_page.page_cli import page
from model.errors import InputError


def report(
    configs: Annotated[
        list[Path] | None,
        typer.Argument(metavar="[CONFIG]...", help="Rig, layout and daemon files to include."),
    ] = None,
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder to create.")] = Path(
        "era-report"
    ),
    socket: Annotated[
        Path | None,
        typer.Option("--socket", help="Socket of the daemon. Default: its default path."),
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


amp = typer.Typer()
amp.command()(conformance)

plate = typer.Typer()
plate.command()(page)

app = typer.Typer()
app.add_typer(amp, name="amp")
app.add_typer(content_app, name="content")
app.add_typer(layout_app, name="layout")
app.add_typer(plate, name="plate")
app.add_typer(rig_app, name="rig")
app.add_typer(design_app)
for _command in (play, report, measure, outputs):
    app.command()(_command)
