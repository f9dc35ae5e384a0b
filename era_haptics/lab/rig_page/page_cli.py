"""`era plate page`: one page about a rig, to send or to print."""

from pathlib import Path
from typing import Annotated

import typer

from model.commands.options import JsonOption, RigArgument, print_report, progress_bar


def page(
    rig_file: RigArgument,
    output: Annotated[
        Path,
        typer.Option("--output", "-o", metavar="PAGE.html", help="Page to write."),
    ],
    sensors_file: Annotated[
        Path | None,
        typer.Option("--sensors", metavar="SENSORS.csv", help="Draw the sensors of this file."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Write one page of HTML about a rig, to send or to print.

    It contains a drawing, promised contrasts, levels, costs of tolerances, findings, modes and
    wiring, and needs no network.
    """
    from era_haptics.lab.rig_page import html_page
    from model.files.output_paths import check_ending
    from model.response_files import read_places
    from model.rig.rig_file import load_rig

    check_ending(output, ".html", ".htm", what="a page")
    rig = load_rig(rig_file)
    sensors = read_places(sensors_file, rig.plate) if sensors_file else {}
    with progress_bar("steps", is_transient=True) as progress:
        html_page.page(rig, output, sensors=sensors, progress=progress)
    rows = [f"wrote {output}; open it in a browser, or print it on three pages"]
    print_report(rows, {"files": [str(output)]}, as_json=as_json)
