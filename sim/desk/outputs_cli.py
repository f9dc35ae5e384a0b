"""`era outputs`: which output of a sound card drives which actuator of a rig."""

from pathlib import Path
from typing import Annotated

import typer

from model.commands.options import JsonOption, RigArgument, print_report

_WRONG = 1


def outputs(
    rig_file: RigArgument,
    device: Annotated[
        str,
        typer.Option(
            metavar="DEVICE", help="Sound card: jack, jack:CLIENT, or a device of PortAudio."
        ),
    ],
    beside: Annotated[
        int | None,
        typer.Option(
            metavar="INPUT",
            help="Listen with an accelerometer on this input, put beside each actuator in turn.",
            min=1,
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="RIG2", help="Write the rig with these channels."),
    ] = None,
    count: Annotated[
        int | None,
        typer.Option(
            "--outputs", metavar="N", help="Test the first N outputs; default: of the rig.", min=1
        ),
    ] = None,
    level: Annotated[
        float, typer.Option(help="Largest sample of each output, 1 is full scale.")
    ] = 0.1,
    frequency: Annotated[
        float | None,
        typer.Option(metavar="HZ", help="Tone that is felt; default: nearest to 160 Hz."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Find which output drives which actuator.

    Play a soft tone on one output after the other, and ask which actuator moved. Or listen with an
    accelerometer, whose sensitivity does not matter, which also tells what is dead, loose or wired
    backwards. Exit status 1 for those, and for channels that are not those of the rig and not
    written.
    """
    from sim.desk.measuring.outputs_run import find_outputs

    rows, answer, is_right = find_outputs(
        rig_file, device, beside=beside, output=output, count=count, level=level,
        frequency=frequency,
    )  # fmt: skip
    print_report(rows, answer, as_json=as_json)
    if not is_right:
        raise typer.Exit(_WRONG)
