"""`era plate template`: the board in real size, to glue by."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from model.commands.options import JsonOption, RigArgument, print_report
from model.files.replacing import check_picture
from model.quantities import counted


class Side(StrEnum):
    """The side of the board that is seen."""

    BELOW = "below"
    ABOVE = "above"


def template(
    rig_file: RigArgument,
    output: Annotated[
        Path,
        typer.Option(
            "--output", "-o", metavar="FILE.svg|.pdf", help="A sheet, or A4 pages as PDF."
        ),
    ],
    side: Annotated[
        Side, typer.Option(help="Where it is stuck on; actuators are glued below.")
    ] = Side.BELOW,
    sensors_file: Annotated[
        Path | None,
        typer.Option("--sensors", metavar="SENSORS.csv", help="Places of sensors, to be marked."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Draw the board in real size with the places of all that is glued to it.

    Print at 100 %: the ruler on it must measure 100 mm.
    """
    from model.calibration.responses import read_places
    from model.figures.template import Template, write_template
    from model.rig.file import load_rig

    check_picture(output)
    rig = load_rig(rig_file)
    sensors = read_places(sensors_file, rig.plate) if sensors_file else {}
    drawn = Template(rig, sensors, is_below=side is Side.BELOW)
    pages = write_template(output, drawn)
    length, width = drawn.board
    rows = [
        f"{rig_file}: {length:g} x {width:g} mm seen from {side.value}, "
        f"{counted(len([*drawn.places()]), 'place')}",
        f"wrote {output}, {counted(pages, 'page')}; print at 100 %",
    ]
    answer = {"board_m": [rig.plate.length, rig.plate.width], "pages": pages}
    print_report(rows, answer | {"side": side.value, "files": [str(output)]}, as_json=as_json)
