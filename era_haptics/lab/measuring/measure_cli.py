"""`era measure` and `era outputs`: measure a plate, an exciter, and the wiring of a sound card."""

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import typer
from typer.core import TyperCommand
from typer.main import get_command

from controller.cli import rig_cli
from model.commands.options import JsonOption, RigArgument, next_line, print_report
from model.errors import InputError

if TYPE_CHECKING:
    from era_haptics.lab.measuring.impedance import Circuit, ImpedanceSetup
    from model.estimate.measurement import MeasuredPlate


def _measure_plate(*given: Any, **named: Any) -> "MeasuredPlate":
    from era_haptics.lab.measuring.measure import measure_plate

    return measure_plate(*given, **named)


rig_cli.measure_by_card = _measure_plate


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
            metavar="DEVICE", help="Sound card: jack, jack:CLIENT, or a PortAudio device."
        ),
    ] = None,
    source: Annotated[
        Path | None,
        typer.Option(
            "--from",
            metavar="FILE|DIR",
            help="Instead of --device: recorded (.wav) or measured (.csv) stepped sine.",
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
            help="Integer frequencies in Hz; default: odd ones, 10 apart, within the rig's limits.",
        ),
    ] = None,
    level: Annotated[
        float | None,
        typer.Option(
            help="Peak sample of each output, 1 is full scale; default: 0.3, or less if the "
            "rig's limits require it."
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
            help="Mass of a moved sensor in grams; default: column mass_g of --sensors.",
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
            "--y-cable", help="No free output: the loop-back shares the output of the last ERA."
        ),
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

    Plays on all ERAs simultaneously and records accelerometers. A loop-back cable leads from the
    output after those of the ERAs (or from that of the last ERA, --y-cable) to the input after
    those of the sensors. It reveals the delay and lost blocks; runs with lost blocks are repeated.
    If all rows of --sensors have the same input, one sensor is moved from row to row, and the
    terminal prompts for each move. The resulting file is for era calibrate and era rig identify
    --measured.
    """
    from era_haptics.lab.measuring.measure import measure_at_once, open_desk
    from era_haptics.lab.measuring.sound_card import Desk, are_positions, read_sensors
    from model.config.units import parse_frequencies
    from model.files.output_paths import check_ending, check_place
    from model.rig.rig_file import load_rig

    check_place(output, example="measured.uff")
    check_ending(output, ".uff", ".unv", ".csv", what="measured responses")
    rig = load_rig(rig_file)
    lines = parse_frequencies(frequencies) if frequencies else None
    desk = Desk(rig, read_sensors(sensors_file, rig.plate, mass=mass, may_move=True), y_cable)
    is_moved = are_positions(desk.sensors)
    if (device is not None) + (source is not None) + is_simulated != 1:
        raise InputError(
            "give --device (a sound card), --from (a file from another program) or --simulated"
        )
    for option, is_wrong, needs in (
        ("--frequencies", source is not None and lines is not None, "--device"),
        ("--resume", device is None and resume, "--device"),
        ("--resume", resume and not is_moved, "one moved sensor, with the same input in all rows"),
        ("--y-cable", device is None and y_cable, "--device"),
    ):
        if is_wrong:
            raise InputError(f"{option} needs {needs}; leave it out")
    rows: Sequence[str | None]
    is_whole = True
    if source is not None:
        from era_haptics.lab.measuring.other_sources import measured_from

        rows, answer = measured_from(source, desk, output)
    elif is_simulated:
        from era_haptics.lab.measuring.other_sources import measured_by_simulation

        rows, answer = measured_by_simulation(desk, output, frequencies=lines, seed=seed)
    else:
        from era_haptics.lab.measuring.measure import measure_by_moving

        opened = open_desk(desk, device or "", level=level, frequencies=lines, seed=seed)
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


app = typer.Typer(add_completion=False, rich_markup_mode=None)

FLAG = "--impedance"


@app.command()
def impedance(
    is_impedance: Annotated[
        bool, typer.Option(FLAG, help="Measure an exciter, not a plate.", show_default=False)
    ] = True,
    device: Annotated[
        str | None,
        typer.Option(
            metavar="DEVICE",
            help="Sound card: jack, jack:CLIENT, or a PortAudio device; without it, files only.",
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="Z.csv", help="File to write the impedance to."),
    ] = None,
    free_file: Annotated[
        Path | None,
        typer.Option("--free", metavar="FREE.csv", help="Impedance of the exciter hanging free."),
    ] = None,
    glued_file: Annotated[
        Path | None,
        typer.Option("--glued", metavar="GLUED.csv", help="Impedance when glued to a heavy base."),
    ] = None,
    weight: Annotated[
        float | None,
        typer.Option(metavar="G", help="Weight of the whole exciter in grams.", min=0.1),
    ] = None,
    scale_error: Annotated[
        float, typer.Option(metavar="G", help="Standard error of the scale in grams.", min=0)
    ] = 0.1,
    coil: Annotated[
        float | None,
        typer.Option(
            "--coil-mass",
            metavar="G",
            help="Coil mass in grams from the data sheet, if only one run is given.",
            min=0.01,
        ),
    ] = None,
    base: Annotated[
        float | None,
        typer.Option(metavar="GRAMS", help="Mass of the base; default: heavy.", min=1),
    ] = None,
    series: Annotated[
        float, typer.Option(metavar="OHM", help="Resistor in series with the exciter.", min=0.1)
    ] = 10.0,
    series_error: Annotated[
        float,
        typer.Option(metavar="PERCENT", help="Tolerance of the resistor.", min=0, max=50),
    ] = 5.0,
    inputs: Annotated[
        str,
        typer.Option(
            metavar="A,B",
            help="Inputs before the exciter and across the resistor; a single number: it is moved.",
        ),
    ] = "1,2",
    input_error: Annotated[
        float,
        typer.Option(
            metavar="PERCENT",
            help="Largest difference between the inputs' gains; none for a moved input.",
            min=0,
            max=50,
        ),
    ] = 1.0,
    level: Annotated[
        float, typer.Option(help="Peak sample of output 1, 1 is full scale.", min=1e-4, max=1.0)
    ] = 0.1,
    periods: Annotated[
        int, typer.Option(metavar="N", help="Seconds that count.", min=2, max=60)
    ] = 4,
    as_json: JsonOption = False,
) -> None:
    """Measure an exciter's impedance from 10 to 1000 Hz and derive its circuit.

    Output 1 drives the exciter in series with a resistor to ground. Measure once hanging free and
    once glued to a heavy base, and weigh it. Prints the exciter's rig-file keys, each with its 90 %
    confidence interval.
    """
    from era_haptics.lab.measuring.impedance import (
        CIRCUIT_NAMES,
        LINES,
        ImpedanceSetup,
        exciter_values,
        fit_circuit,
        measured_impedance,
        read_impedance,
        write_impedance,
    )
    from era_haptics.lab.measuring.sound_card import open_card
    from model.files.output_paths import check_ending, check_place

    circuits = {
        name: fit_circuit(*read_impedance(path), what=f"--{name} {path}")
        for name, path in (("free", free_file), ("glued", glued_file))
        if path is not None
    }
    if (device is None) != (output is None):
        missing = "--device" if device is None else "--output"
        raise InputError(f"{missing} is missing; a measurement needs both, files need neither")
    taken = _inputs(inputs)
    bench = ImpedanceSetup(
        weight and 1e-3 * weight,
        coil and 1e-3 * coil,
        math.inf if base is None else 1e-3 * base,
        1e-3 * scale_error,
        series,
        1e-2 * series_error,
        1e-2 * input_error * (len(taken) - 1),
    )
    if device is not None and output is not None:
        check_place(output, example="free.csv")
        check_ending(output, ".csv", what="an impedance")
        if len(circuits) == 2:
            raise InputError("--free and --glued are both given; omit the one to be measured")
        name = {"glued": "free", "free": "glued"}.get("".join(circuits), "measured")
        with closing(open_card(device, outputs=1, inputs=max(taken), limit=level)) as card:
            found = measured_impedance(
                card, inputs=taken, series=series, level=level, periods=periods, move=_moved
            )
        circuits[name] = fit_circuit(
            *found, what=device
        )  # do not write an impedance that is not an exciter's
        write_impedance(output, *found)
    runs = circuits.get("free", circuits.get("measured")), circuits.get("glued")
    values = exciter_values(*runs, bench)
    by_light = {}
    if "glued" in circuits and weight is not None and base is None:
        lighter = exciter_values(*runs, replace(bench, base=1e-3 * _LIGHT))
        by_light = {name: lighter[name][0] / values[name][0] - 1 for name in values}
    again = next_line(
        "era", "measure", FLAG, "--device", str(device), "--free", output or "", "-o",
        (output or Path("free.csv")).with_stem("glued"), "--weight", "GRAMS", "--series",
        f"{series:g}",
    )  # fmt: skip
    rows = [
        f"{len(LINES)} frequencies; wrote {output}" if output else None,
        *_rows(circuits, values, bench),
        *_warnings(circuits, values, by_light),
        again if "measured" in circuits else None,
    ]
    answer = {
        "runs": {
            name: dict(zip(CIRCUIT_NAMES, each.values.tolist(), strict=True))
            | {"misfit": each.misfit}
            for name, each in circuits.items()
        },
        "resonance_is": "mounted" if "glued" in circuits else "free",
        "values": {
            name: {"value": value, "half_width_90": width}
            for name, (value, width) in values.items()
        },
        "files": [] if output is None else [str(output)],
        "change_by_light_base": by_light,
    }
    print_report(rows, answer, as_json=as_json)


_LIGHT = 300.0  # g, a base that is not heavy


def _inputs(text: str) -> tuple[int, ...]:
    found = tuple(int(part) if part.strip().isdecimal() else 0 for part in text.split(","))
    if len(found) > 2 or len(set(found)) < len(found) or min(found) < 1:
        raise InputError(f"--inputs must be one or two numbers from 1, such as 1,2, got {text}")
    return found


def _moved(place: str) -> None:
    typer.prompt(f"Connect the input {place}, and press Enter", "", show_default=False, err=True)


_UNITS = {
    "resonance": (1.0, "Hz"),
    "q": (1.0, ""),
    "force_factor": (1.0, ""),
    "resistance": (1.0, ""),
    "inductance": (1e3, "mH"),
    "coil_mass": (1e3, "g"),
    "weight": (1e3, "g"),
}
"""Exciter keys of a rig file, and the units in which they are printed."""

_BY_BASE = ("resonance", "coil_mass", "stiffness", "force_factor")


def _rows(
    circuits: "Mapping[str, Circuit]",
    values: Mapping[str, tuple[float, float]],
    bench: "ImpedanceSetup",
) -> Iterator[str]:
    for name, each in circuits.items():
        yield (
            f"{name}: resonance {each['resonance']:.4g} Hz, Q_ms {each['q']:.3g}, R "
            f"{each['resistance']:.4g} ohm; misfit of the circuit {100 * each.misfit:.2g} %"
        )
    yield (
        f"Q_es {values['q_es'][0]:.3g}; exciter keys with 90 % confidence intervals, for a "
        f"resistor within {100 * bench.series_error:g} % and inputs within "
        f"{100 * bench.input_error:g} %:"
    )
    for key, (factor, unit) in _UNITS.items():
        if key in values:
            value, width = (factor * each for each in values[key])
            text = f"{key}: {value:.4g} {unit}".rstrip()
            held = f"± {width:.2g} {unit}".rstrip() if width else "as given, exactly"
            yield f"    {text:28s} # {held}"
        if key == "resonance":
            yield f"    resonance_is: {'mounted' if 'glued' in circuits else 'free'}"


def _warnings(
    circuits: "Mapping[str, Circuit]",
    values: Mapping[str, tuple[float, float]],
    by_light: Mapping[str, float],
) -> Iterator[str]:
    if "force_factor" not in values:
        yield "force factor and masses need --weight, and --glued or --coil-mass"
        if "glued" not in circuits:
            yield (
                "resonance is that of coil and magnet, which both move; a rig's is lower, of the "
                "coil alone: by the square root of the magnet's fraction of the weight"
            )
    if by_light:
        changes = ", ".join(
            f"{name} {100 * by_light[name]:+.2g} %" for name in _BY_BASE if name in by_light
        )
        yield f"assumes a heavy base; with --base {_LIGHT:g} grams: {changes}"


class MeasureCommand(TyperCommand):
    """`era measure`; a flag selects another command with its own options."""

    variants: ClassVar = {FLAG: get_command(app)}

    def make_context(
        self, info_name: str | None, args: list[str], parent: Any = None, **extra: Any
    ) -> Any:
        """Return the context of this command, or of the one selected by a flag."""
        for flag, variant in self.variants.items():
            if flag in args:
                return variant.make_context(info_name, args, parent, **extra)
        return super().make_context(info_name, args, parent, **extra)


_WRONG = 1


def outputs(
    rig_file: RigArgument,
    device: Annotated[
        str,
        typer.Option(
            metavar="DEVICE", help="Sound card: jack, jack:CLIENT, or a PortAudio device."
        ),
    ],
    beside: Annotated[
        int | None,
        typer.Option(
            metavar="INPUT",
            help="Input of an accelerometer that you place next to each actuator in turn.",
            min=1,
        ),
    ] = None,
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
            help="Number of outputs to test; default: that of the rig.",
            min=1,
        ),
    ] = None,
    level: Annotated[
        float, typer.Option(help="Peak sample of each output, 1 is full scale.")
    ] = 0.1,
    frequency: Annotated[
        float | None,
        typer.Option(
            metavar="HZ", help="Frequency of the tone to feel in Hz; default: nearest to 160."
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Find which output drives which actuator.

    Plays a soft tone on one output after the other, and asks which actuator moved. With --beside,
    an accelerometer (of any sensitivity) detects this, and also dead, loose or reversed actuators.
    Exits with status 1 for those, and if channels differ from the rig's and are not written.
    """
    from era_haptics.lab.measuring.outputs import find_outputs

    rows, answer, is_right = find_outputs(
        rig_file, device, beside=beside, output=output, count=count, level=level,
        frequency=frequency,
    )  # fmt: skip
    print_report(rows, answer, as_json=as_json)
    if not is_right:
        raise typer.Exit(_WRONG)
