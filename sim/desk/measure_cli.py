"""`era measure`: frequency responses of a plate through a sound card."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from model.commands.options import JsonOption, RigArgument, next_line, print_report
from model.errors import InputError


def measure(
    rig_file: RigArgument,
    sensors_file: Annotated[
        Path,
        typer.Option(
            "--sensors",
            metavar="SENSORS.csv",
            help="Accelerometers: places, inputs, sensitivities.",
        ),
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="MEASURED.uff|.csv", help="File to write.")
    ],
    device: Annotated[
        str | None,
        typer.Option(
            metavar="DEVICE", help="Sound card: jack, jack:CLIENT, or a device of PortAudio."
        ),
    ] = None,
    source: Annotated[
        Path | None,
        typer.Option(
            "--from",
            metavar="FILE|DIR",
            help="In place of --device: a stepped sine that was recorded, .wav, or measured, .csv.",
        ),
    ] = None,
    is_simulated: Annotated[
        bool,
        typer.Option(
            "--simulated",
            help="In place of --device: a plate that deviates from the rig's as --seed draws it.",
        ),
    ] = False,
    frequencies: Annotated[
        str | None,
        typer.Option(
            metavar="LO:HI:STEP",
            help="Whole frequencies in Hz; default: odd ones, 10 apart, within the rig's limits.",
        ),
    ] = None,
    level: Annotated[
        float | None,
        typer.Option(
            help="Largest sample of each output, 1 is full scale; default: 0.3, or less by the "
            "rig's limits."
        ),
    ] = None,
    periods: Annotated[
        int, typer.Option(metavar="N", help="Seconds of each run that count.", min=2, max=60)
    ] = 2,
    mass: Annotated[
        float | None,
        typer.Option(
            "--sensor-mass",
            metavar="G",
            help="Mass of a sensor that is moved, in grams; default: column mass_g of --sensors.",
            min=0,
        ),
    ] = None,
    resume: Annotated[
        bool,
        typer.Option("--resume", help="One sensor is moved: go on from what --output has."),
    ] = False,
    y_cable: Annotated[
        bool,
        typer.Option(
            "--y-cable", help="No output is left: that of the last ERA is the cable's, too."
        ),
    ] = False,
    stepped: Annotated[
        bool, typer.Option("--stepped", help="Check with single tones, one ERA at a time.")
    ] = False,
    seed: Annotated[
        int, typer.Option(metavar="N", help="Draw other phases, or another plate.", min=0)
    ] = 0,
    impedance: Annotated[
        bool,
        typer.Option(
            "--impedance",
            help="Measure an exciter instead: era measure --impedance --help.",
            show_default=False,
        ),
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Measure a plate through a sound card.

    Play on all ERAs at once and record accelerometers. A cable leads from the output after those of
    the ERAs, or beside the last of them (--y-cable), to the input after those of the sensors: it
    tells the delay, and lost blocks, whose run is repeated. Where all lines of --sensors have one
    input, one sensor is moved from line to line: the terminal says where to. The file is for era
    calibrate, and for era rig identify --measured.
    """
    from model.calibration.responses import are_places, read_sensors
    from model.config.fields import parse_frequencies
    from model.files.array_file import check_ending, check_place
    from model.rig.rig_file import load_rig
    from sim.desk.measuring.desk import Desk
    from sim.desk.measuring.measure import measure_at_once, open_desk

    check_place(output, example="measured.uff")
    check_ending(output, ".uff", ".unv", ".csv", what="measured responses")
    rig = load_rig(rig_file)
    lines = parse_frequencies(frequencies) if frequencies else None
    desk = Desk(rig, read_sensors(sensors_file, rig.plate, mass=mass, may_move=True), y_cable)
    is_moved = are_places(desk.sensors)
    if (device is not None) + (source is not None) + is_simulated != 1:
        raise InputError(
            "give --device, a sound card, or --from, what another has measured, or --simulated"
        )
    for option, is_wrong, needs in (
        ("--frequencies", source is not None and lines is not None, "--device"),
        ("--stepped", device is None and stepped, "--device"),
        ("--resume", device is None and resume, "--device"),
        ("--resume", resume and not is_moved, "one sensor that is moved, one input in all lines"),
        ("--stepped", stepped and is_moved, "sensors that stay where they are"),
        ("--stepped", stepped and y_cable, "an output of the cable's own"),
        ("--y-cable", device is None and y_cable, "--device"),
    ):
        if is_wrong:
            raise InputError(f"{option} needs {needs}; leave it out")
    rows: Sequence[str | None]
    is_whole = True
    if source is not None:
        from sim.desk.measuring.stepped_file import measured_from

        rows, answer = measured_from(source, desk, output)
    elif is_simulated:
        from sim.desk.measuring.simulated_plate import measured_by_simulation

        rows, answer = measured_by_simulation(desk, output, frequencies=lines, seed=seed)
    else:
        from sim.desk.measuring.moved_sensor import measure_by_moving

        opened = open_desk(desk, device or "", level=level, frequencies=lines, seed=seed)
        if is_moved:
            rows, answer, is_whole = measure_by_moving(
                desk, opened, output, periods=periods, is_resumed=resume
            )
        else:
            rows, answer = measure_at_once(
                desk, opened, output, periods=periods, is_stepped=stepped
            )
    if is_whole:
        next_words = ("calibrate", rig_file, output, "-o", output.with_name("calibrated.yaml"))
        rows = [*rows, next_line("era", *next_words)]
    print_report(rows, answer, as_json=as_json)
