"""The group `era rig`: check and identify a rig.

`identify` fits the plate's parameters to responses that a sound card records, or that a file
contains. `show` and `merge` use the result of a fit. `check` compares responses with the rig file.
"""

import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import compress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from era_haptics.lab.measuring.measure_cli import PeakOption
from model.commands.calibrate_cli import NO_FIT, check_rig_output, finish, write_fitted_rig
from model.commands.options import (
    FAILED,
    FittedRigOption,
    JsonOption,
    RigArgument,
    print_report,
    progress_bar,
)
from model.errors import InputError
from model.quantities import counted

if TYPE_CHECKING:
    from model.estimate.identify import Identification
    from model.estimate.measurement import MeasuredPlate, Measurement
    from model.rig.rig import Rig


def identify(
    rig_file: RigArgument,
    output: FittedRigOption,
    level: PeakOption = None,
    measured_file: Annotated[
        Path | None,
        typer.Option(
            "--measured",
            metavar="MEASURED.uff|.csv",
            help="Read the responses from a file written by era measure instead of playing.",
        ),
    ] = None,
    device: Annotated[
        str | None,
        typer.Option(
            metavar="DEVICE",
            help='Sound card that plays and records: PortAudio number, "NAME" or "NAME, HOST API".',
        ),
    ] = None,
    sensors_file: Annotated[
        Path | None,
        typer.Option(
            "--sensors", metavar="SENSORS.csv", help="Accelerometers at the sound card's inputs."
        ),
    ] = None,
    frequencies: Annotated[
        str | None,
        typer.Option(
            metavar="LO:HI:STEP",
            help="Frequencies to play, integers in Hz. Default: odd frequencies, 10 Hz apart.",
        ),
    ] = None,
    periods: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            help="Number of 1 s periods evaluated in each run. Default: 2.",
            min=2,
            max=60,
        ),
    ] = None,
    untouched: Annotated[
        bool,
        typer.Option("--yes", help="Skip the prompt; confirms that nothing touches the plate."),
    ] = False,
    seed: Annotated[
        int,
        typer.Option(
            metavar="N",
            help="Random seed of the played phases and of the fingers for the expected contrast.",
            min=0,
        ),
    ] = 0,
    as_json: JsonOption = False,
) -> None:
    """Identify the mounted plate, and write a fitted rig.

    The new rig file states the remaining uncertainty. With --device, a sound card plays multisines
    and records accelerometers, with the same loop-back cable as for era measure. With --measured,
    nothing is played. Exits with status 1 and writes no rig if the model does not explain the
    responses.
    """
    from era_haptics.lab.measuring.measure import measure_plate
    from model.commands.options import parse_frequencies
    from model.rig.rig_file import load_rig
    from model.structure.modal_elasticity import check_measurable

    card: tuple[str, Path] | None = None  # the sound card, and the file of its sensors
    if measured_file is not None:
        played = {"--level": level, "--device": device}
        _reject(played, rule="plays; leave it out with --measured")
    elif device is None:
        raise InputError("give --device, a sound card, or --measured, a file of responses")
    if device is None:
        recorded = {"--sensors": sensors_file, "--frequencies": frequencies, "--periods": periods}
        _reject(recorded, rule="needs --device")
    elif sensors_file is None:
        raise InputError("--device needs --sensors, a file of the accelerometers")
    else:
        card = device, sensors_file
    tones = parse_frequencies(frequencies) if frequencies else None
    rig = load_rig(rig_file)
    check_measurable(rig.plate)
    check_rig_output(output, rig_file)
    if measured_file is not None:
        measured = _read_measured_plate(measured_file, rig)
    elif card is not None:
        _require_untouched(is_confirmed=untouched, has_terminal=not as_json)
        with progress_bar("runs") as progress:
            measured = measure_plate(
                rig,
                *card,
                frequencies=tones,
                level=level,
                periods=periods or 2,
                seed=seed,
                progress=progress,
            )
    _identify_measured(rig, rig_file, measured, output=output, seed=seed, as_json=as_json)


def _identify_measured(
    rig: "Rig",
    rig_file: Path,
    measured: "MeasuredPlate",
    *,
    output: Path,
    seed: int,
    as_json: bool,
) -> None:
    """Fit a rig to a measurement, write the fitted rig if it explains it, and print the report."""
    import time

    from model.estimate import identification_report
    from model.estimate.identify import MAX_CHI2, MAX_MODE_SHIFT, identification_errors
    from model.study.expected_contrast import expected_contrast

    started = time.perf_counter()
    identification = _fitted(rig, measured.measurement)
    expected = []
    if identification.can_promise:
        with progress_bar("contact sets") as progress:
            expected = expected_contrast(rig, identification.rig, seed=seed, progress=progress)
    rows = [
        _measured_line(rig, measured),
        *measured.notes,
        *identification_report.parameter_rows(identification),
        *identification_report.fit_rows(identification),
        *identification_report.contrast_rows(expected),
    ]
    files = []
    refusal: str | None = None
    if identification.is_explained:
        comment = [f"{rig_file.name} identified in place by `era rig identify`:", *rows]
        errors = identification_errors(identification)
        files = write_fitted_rig(output, (rig, identification.rig), comment, errors)
    elif identification.is_known_well:
        refusal = (
            f"chi² must be at most {MAX_CHI2:g} for a plate that the model explains; no rig is "
            "written. Check that nothing touches the plate, and run era rig check to verify that "
            "plate and wiring match the file"
        )
    else:
        refusal = (
            f"modes must match the rig's plate within {MAX_MODE_SHIFT:g} standard deviations; no "
            "rig is written. The fields between the sensors are unknown: remove parts bonded to "
            "the plate, such as a frame along its edges, or use the rig unchanged; sensors away "
            "from the edges locate the difference"
        )
    report: dict[str, Any] | None = None
    if as_json:
        report = identification_report.identification_json(identification, expected)
        report |= _measured_json(measured)
    elapsed = time.perf_counter() - started
    finish(rows, report, files=files, elapsed=elapsed, refusal=refusal)


def _fitted(rig: "Rig", measurement: "Measurement") -> "Identification":
    """Fit a rig to a measurement; exit with `NO_FIT` if that fails."""
    from model.estimate.identify import identify as fit
    from model.estimate.rig_check import check_meaning

    try:
        check_meaning(rig, measurement)
        with progress_bar("fits") as progress:
            return fit(rig, measurement, progress=progress)
    except InputError as error:
        typer.echo(f"era: {error}; no rig is written", err=True)
        raise typer.Exit(NO_FIT) from error


def _reject(options: Mapping[str, object], *, rule: str) -> None:
    """Raise InputError if one of some options was given, since none applies."""
    for name, value in options.items():
        if value is not None:
            raise InputError(f"{name} {rule}")


def _read_measured_plate(path: Path, rig: "Rig") -> "MeasuredPlate":
    """Read responses, and leave out sensors without a signal.

    Raises InputError for inconsistent responses.
    """
    from model.estimate.measurement import MeasuredPlate
    from model.estimate.screening import check_consistency
    from model.response_files import measurement_of, read_measured

    measurement = measurement_of(read_measured(path), rig)
    screened = check_consistency(rig, measurement)
    live = screened.live(measurement)
    sensors = []
    for sensor in live.sensors:
        mass_g = 1e3 * sensor.mass
        sensors.append({"sensor": sensor.name, "x_m": sensor.x, "y_m": sensor.y, "mass_g": mass_g})
    dead_sensors = compress(measurement.names, screened.dead_sensors)
    return MeasuredPlate(
        live,
        level=None,
        duration=None,
        sensors=tuple(sensors),
        notes=tuple(f"{name} has no signal, left out" for name in dead_sensors),
        details={"values_beyond_limits": live.skipped},
    )


def _require_untouched(*, is_confirmed: bool, has_terminal: bool) -> None:
    """Raise InputError, or typer.Abort, unless the user confirms that nothing touches the plate."""
    if is_confirmed:
        return
    if not (has_terminal and sys.stdin.isatty()):
        raise InputError(
            "nothing must touch the plate during the measurement; check it, and confirm with --yes"
        )
    typer.confirm("Will the plate be free of contact for the next minute?", abort=True, err=True)


def _measured_line(rig: "Rig", measured: "MeasuredPlate") -> str:
    """Return a summary of the measurement in one line."""
    measurement = measured.measurement
    eras = counted(len(rig.eras), "ERA")
    sensors = counted(len(measurement.sensors), "sensor")
    tones = counted(len(measurement.frequencies), "tone")
    low = measurement.frequencies[0]
    high = measurement.frequencies[-1]
    line = f"{eras}, {sensors}, {tones} from {low:g} to {high:g} Hz"
    if measured.level is not None:
        line += f" at a level of {measured.level:.3g}"
    line += f", {counted(measurement.count, 'response')}"
    if measured.duration is not None:
        line += f" in {measured.duration:.1f} s"
    return line


def _measured_json(measured: "MeasuredPlate") -> dict[str, object]:
    """Return the measurement settings for JSON output."""
    measurement = measured.measurement
    return {
        "sensors": list(measured.sensors),
        "sensors_unused": list(measured.notes),
        "frequencies_hz": measurement.frequencies.tolist(),
        "level": measured.level,
        "responses": measurement.count,
        "measure_time_s": measured.duration,
        **measured.details,
    }


rig_app = typer.Typer(no_args_is_help=True, help="Check and identify a rig.")
rig_app.command()(identify)


@rig_app.command()
def show(
    fitted: Annotated[Path, typer.Argument(metavar="FITTED", help="File of a fitted rig.")],
    as_json: JsonOption = False,
) -> None:
    """Compare fitted values with the base rig file.

    The base is the rig file that the fit started from. Values are in SI units. Fitted values have
    standard errors.
    """
    from model.rig.rig_file import load_rig
    from model.rig.rig_writing import fitted_rows

    rig = load_rig(fitted)
    fitted_values = fitted_rows(rig)
    assert rig.document is not None  # noqa: S101  it was read from a file
    assert rig.document.over is not None  # noqa: S101  there are rows
    base = str(rig.document.over.data["base"])
    table = [("", base, fitted.name, "standard error")]
    changes = []
    for key, base_value, value, error in fitted_values:
        error_text = "" if error is None else f"± {error:.3g}"
        base_text = _value_text(base_value, default="-")
        table.append((key, base_text, _value_text(value, default="left out"), error_text))
        changes.append({"key": key, "base": base_value, "fitted": value, "standard_error": error})
    print_report(_aligned(table), {"base": base, "changes": changes}, as_json=as_json)


def _aligned(table: Sequence[Sequence[str]]) -> list[str]:
    """Return the lines of a table, with each column as wide as its widest cell."""
    columns = zip(*table, strict=True)
    widths = [max(map(len, column)) for column in columns]
    lines = []
    for row in table:
        cells = [cell.ljust(width) for cell, width in zip(row, widths, strict=True)]
        lines.append("  ".join(cells).rstrip())
    return lines


def _value_text(value: object, *, default: str = "None") -> str:
    """Format a value of a rig file: numbers with five digits, tables as their row count.

    default: text of a missing value.
    """
    match value:
        case None:
            return default
        case float():
            return f"{value:.5g}"
        case [[*_], *_]:
            return counted(len(value), "row")
        case list():
            return f"[{', '.join(map(_value_text, value))}]"
    return str(value)


@rig_app.command()
def merge(
    fitted: Annotated[Path, typer.Argument(metavar="FITTED", help="File of a fitted rig.")],
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="RIG.yaml", help="Rig file to write.")
    ],
) -> None:
    """Write one rig file from a fitted rig and its base.

    It has the fitted values and all other keys of the base, without comments. The table of the
    fitted rig remains valid for it.
    """
    from model.files.array_file import whole_or_nothing
    from model.rig.rig_file import load_rig

    check_rig_output(output, fitted)
    rig = load_rig(fitted)
    assert rig.document is not None  # noqa: S101  it was read from a file
    if rig.document.over is None:
        raise InputError(f"{fitted} must be a fitted rig, with a `base`, got a complete one")
    text = f"# {fitted.name} merged by `era rig merge`:\n\n{rig.document.whole_text}"
    with whole_or_nothing(output) as stream:
        stream.write(text.encode())
    print(f"wrote {output}")


@rig_app.command()
def check(
    rig_file: RigArgument,
    measured: Annotated[
        Path, typer.Option(metavar="FILE", help="Responses of each channel: .csv or .uff.")
    ],
    without_phases: Annotated[
        bool,
        typer.Option(
            "--without-phases",
            help="Ignore phases, for a file whose phases are not relative to the drive.",
        ),
    ] = False,
    mesh: Annotated[
        str | None, typer.Option(metavar="NxM", help="Mesh instead of the one in the rig file.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Check the wiring and construction of a rig against its file.

    Compares measured responses with the rig. Exits with status 1 if the check fails.
    """
    import time

    from model.estimate import check_report
    from model.estimate.rig_check import diagnose, judged_by_promises

    rig, observation = _read(measured, rig_file, mesh=mesh)
    if without_phases:
        observation = replace(observation, has_phases=False)
    started = time.perf_counter()
    verdict = judged_by_promises(diagnose(rig, observation, has_form=True), rig)
    elapsed = time.perf_counter() - started
    low = verdict.frequencies.min()
    high = verdict.frequencies.max()
    sensors = counted(len(verdict.sensors), "sensor")
    frequencies = counted(len(verdict.frequencies), "frequency", plural="frequencies")
    rows: list[str | None] = [
        f"{rig_file}: {sensors}, {frequencies} from {low:g} to {high:g} Hz, {elapsed:.1f} s",
        rig.uncertainty_note,
        "",
        *check_report.channel_table(verdict),
        "",
        *check_report.verdict_rows(verdict),
        *check_report.difference_rows(verdict),
    ]
    report = {
        **check_report.as_json(verdict),
        "exactly_known": [*rig.exactly_known],
        "elapsed_s": elapsed,
    }
    print_report(rows, report, as_json=as_json)
    if not verdict.is_well:
        raise typer.Exit(FAILED)


def _read(measured: Path, rig_file: Path, *, mesh: str | None) -> "tuple[Rig, Measurement]":
    """Read a measurement from a file."""
    from model.response_files import measurement_of, read_measured
    from model.rig.rig_file import load_rig

    rig = load_rig(rig_file, mesh=mesh)
    return rig, measurement_of(read_measured(measured), rig)
