"""`era measure` and `era outputs`: measure a plate, and the wiring of a sound card."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from model.commands.options import JsonOption, RigArgument, next_line, print_report
from model.errors import InputError

PeakOption = Annotated[
    float | None,
    typer.Option(
        help="Peak sample of each output, 0 to 1 of full scale. Default: 0.3, or less if the "
        "rig's limits require it."
    ),
]


def measure(
    rig_file: RigArgument,
    sensors_file: Annotated[
        Path,
        typer.Option(
            "--sensors",
            metavar="SENSORS.csv",
            help="List of accelerometers with positions, inputs and sensitivities.",
        ),
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="MEASURED.uff|.csv", help="File to write.")
    ],
    device: Annotated[
        str | None,
        typer.Option(
            metavar="DEVICE", help='Sound card: PortAudio number, "NAME" or "NAME, HOST API".'
        ),
    ] = None,
    is_simulated: Annotated[
        bool,
        typer.Option(
            "--simulated",
            help="Instead of --device: simulate a plate drawn at random from the rig's tolerances.",
        ),
    ] = False,
    frequencies: Annotated[
        str | None,
        typer.Option(
            metavar="LO:HI:STEP",
            help="Frequencies to play, integers in Hz. Default: odd frequencies within the rig's "
            "limits, 10 Hz apart.",
        ),
    ] = None,
    level: PeakOption = None,
    periods: Annotated[
        int,
        typer.Option(
            metavar="N", help="Number of 1 s periods evaluated in each run.", min=2, max=60
        ),
    ] = 2,
    mass: Annotated[
        float | None,
        typer.Option(
            "--sensor-mass",
            metavar="G",
            help="Mass of a moved sensor in grams. Default: column mass_g of --sensors.",
            min=0,
        ),
    ] = None,
    resume: Annotated[
        bool,
        typer.Option("--resume", help="Resume the measurement of a moved sensor from --output."),
    ] = False,
    y_cable: Annotated[
        bool,
        typer.Option(
            "--y-cable",
            help="Loop back the output of the last ERA, for a sound card without a free output.",
        ),
    ] = False,
    seed: Annotated[
        int,
        typer.Option(
            metavar="N",
            help="Random seed of the played phases and of the simulated plate.",
            min=0,
        ),
    ] = 0,
    as_json: JsonOption = False,
) -> None:
    """Measure a plate through a sound card.

    Plays on all ERAs simultaneously and records accelerometers. A loop-back cable must connect the
    output after the ERA outputs (with --y-cable, the last ERA output) to the input after the sensor
    inputs. It reveals the delay and lost blocks; runs with lost blocks are repeated. If all rows of
    --sensors have the same input, one sensor is moved from row to row, and the terminal prompts for
    each move. Use the file with era calibrate or era rig identify --measured.
    """
    from era_haptics.lab.measuring.desk import Desk
    from era_haptics.lab.measuring.measure import measure_at_once, open_desk
    from era_haptics.lab.measuring.moved_sensor import measure_by_moving
    from era_haptics.lab.measuring.sensor_file import are_positions, read_sensors
    from model.commands.options import parse_frequencies
    from model.files.output_paths import check_ending, check_place
    from model.rig.rig_file import load_rig

    check_place(output, example="measured.uff")
    check_ending(output, ".uff", ".unv", ".csv", what="measured responses")
    rig = load_rig(rig_file)
    lines = parse_frequencies(frequencies) if frequencies else None
    desk = Desk(rig, read_sensors(sensors_file, rig.plate, mass=mass, may_move=True), y_cable)
    is_moved = are_positions(desk.sensors)
    if (device is None) != is_simulated:
        raise InputError("give either --device (a sound card) or --simulated")
    for option, is_wrong, needs in (
        ("--resume", is_simulated and resume, "--device"),
        ("--resume", resume and not is_moved, "one moved sensor, with the same input in all rows"),
        ("--y-cable", is_simulated and y_cable, "--device"),
    ):
        if is_wrong:
            raise InputError(f"{option} needs {needs}; leave it out")
    rows: Sequence[str | None]
    is_whole = True
    if device is None:
        from era_haptics.lab.measuring.simulated_measurement import measured_by_simulation

        rows, answer = measured_by_simulation(desk, output, frequencies=lines, seed=seed)
    else:
        opened = open_desk(desk, device, level=level, frequencies=lines, seed=seed)
        if is_moved:
            rows, answer, is_whole = measure_by_moving(
                desk, opened, output, periods=periods, is_resumed=resume
            )
        else:
            rows, answer = measure_at_once(desk, opened, output, periods=periods)
    if is_whole:
        next_words = ("calibrate", rig_file, output, "-o", output.with_name("calibrated.yaml"))
        rows = [*rows, next_line("era", *next_words)]
    print_report(rows, answer, as_json=as_json)


_WRONG = 1


def outputs(
    rig_file: RigArgument,
    device: Annotated[
        str,
        typer.Option(
            metavar="DEVICE", help='Sound card: PortAudio number, "NAME" or "NAME, HOST API".'
        ),
    ],
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            metavar="RIG.wired.yaml",
            help="Write a fitted rig with these channels.",
        ),
    ] = None,
    count: Annotated[
        int | None,
        typer.Option(
            "--outputs",
            metavar="N",
            help="Number of outputs to test. Default: the rig's.",
            min=1,
        ),
    ] = None,
    level: Annotated[
        float, typer.Option(help="Peak sample of each output, 0 to 1 of full scale.")
    ] = 0.1,
    frequency: Annotated[
        float | None,
        typer.Option(
            metavar="HZ",
            help="Frequency of the tone in Hz. Default: the allowed frequency nearest to 160.",
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Find which output drives which actuator.

    Plays a soft tone on each output in turn and prompts for the actuator that moved. Exits with
    status 1 if an actuator is missing, or if channels differ from the rig's and --output is
    missing.
    """
    from era_haptics.lab.measuring.outputs import find_outputs

    rows, answer, is_right = find_outputs(
        rig_file, device, output=output, count=count, level=level, frequency=frequency
    )
    print_report(rows, answer, as_json=as_json)
    if not is_right:
        raise typer.Exit(_WRONG)
