"""`era measure`: frequency responses of a plate through a sound card."""

import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from model.commands.options import JsonOption, RigArgument, next_line, print_report

if TYPE_CHECKING:
    from sim.desk.measuring.measure import Measured, Stepped

DEFAULT_LEVEL = 0.3


def measure(
    rig_file: RigArgument,
    device: Annotated[
        str,
        typer.Option(
            metavar="DEVICE", help="Sound card: jack, jack:CLIENT, or a device of PortAudio."
        ),
    ],
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
    frequencies: Annotated[
        str | None,
        typer.Option(
            metavar="LO:HI:STEP",
            help="Whole frequencies in Hz; default: odd ones, 10 apart, within the rig's limits.",
        ),
    ] = None,
    level: Annotated[
        float, typer.Option(help="Largest sample of each output, 1 is full scale.")
    ] = DEFAULT_LEVEL,
    periods: Annotated[
        int, typer.Option(metavar="N", help="Seconds of each run that count.", min=2, max=60)
    ] = 2,
    stepped: Annotated[
        bool, typer.Option("--stepped", help="Check with single tones, one ERA at a time.")
    ] = False,
    seed: Annotated[int, typer.Option(metavar="N", help="Draw other phases.", min=0)] = 0,
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
    the ERAs to the input after those of the sensors: it tells the delay, and lost blocks, whose run
    is repeated. The file is for era calibrate.
    """
    from model.calibration.responses_file import write_responses_csv, write_responses_uff
    from model.commands.options import progress_bar
    from model.config.points import parse_frequencies
    from model.files.replacing import check_ending, check_place
    from model.rig.file import load_rig
    from sim.desk.measuring.live_plot import live_plot
    from sim.desk.measuring.measure import check_by_steps, open_desk
    from sim.desk.measuring.measure import measure as measured_by

    check_place(output, example="measured.uff")
    check_ending(output, ".uff", ".unv", ".csv", what="measured responses")
    rig = load_rig(rig_file)
    lines = parse_frequencies(frequencies) if frequencies else None
    started = time.perf_counter()
    check: Stepped | None = None
    with open_desk(rig, sensors_file, device, level=level, frequencies=lines, seed=seed) as (
        desk,
        card,
        multisine,
    ):
        with live_plot(multisine, desk.sensors) as show:
            found = measured_by(desk, card, multisine, periods=periods, show=show)
        if stepped:
            with progress_bar("tones") as progress:
                check = check_by_steps(desk, card, found, level=level, progress=progress)
        rate = card.rate
    write = write_responses_csv if output.suffix.lower() == ".csv" else write_responses_uff
    write(output, found.responses, rig)
    elapsed = time.perf_counter() - started
    rows = [
        *_rows(found, check, rate=rate),
        f"measured in {elapsed:.1f} s; wrote {output}",
        next_line("era", "calibrate", rig_file, output, "-o", rig_file.with_stem("calibrated")),
    ]
    answer = _as_json(found, check) | {"measure_time_s": elapsed, "files": [str(output)]}
    print_report(rows, answer, as_json=as_json)


def _as_json(found: "Measured", check: "Stepped | None") -> dict[str, Any]:
    import numpy as np

    names = found.responses.sensors
    return {
        "frequencies_hz": found.responses.frequencies.tolist(),
        "latency_s": found.latency,
        "repeated_runs": found.repeated,
        "sensors": {
            name: {
                "coherence_median": float(np.median(found.coherence[:, n])),
                "coherence_min": float(found.coherence[:, n].min()),
                "noise_relative": float(np.median(found.std[:, n])),
                "square_law_relative": float(found.even[n]),
            }
            for n, name in enumerate(names)
        },
        "stepped": None if check is None else check.as_json(),
    }


def _rows(found: "Measured", check: "Stepped | None", *, rate: float) -> Iterator[str]:
    """Yield how well responses were measured."""
    import numpy as np

    lines = found.responses.frequencies
    yield (
        f"{len(lines)} frequencies from {lines[0]:g} to {lines[-1]:g} Hz; delay of the sound card "
        f"{1e3 * found.latency:.3f} ms ({found.latency * rate:.1f} samples); "
        f"{found.repeated} runs repeated for lost blocks"
    )
    yield "sensor      coherence   lowest   noise    square law"
    for n, name in enumerate(found.responses.sensors):
        yield (
            f"{name:10s} {np.median(found.coherence[:, n]):10.4f} "
            f"{found.coherence[:, n].min():8.4f} {100 * np.median(found.std[:, n]):6.2f} % "
            f"{100 * found.even[n]:8.2f} %"
        )
    if check is not None:
        yield (
            f"stepped tones differ by {check.level_db[0]:.3f} dB rms, {check.level_db[1]:.2f} dB "
            f"at most, and {check.phase_deg[0]:.2f}° rms, {check.phase_deg[1]:.1f}° at most"
        )
