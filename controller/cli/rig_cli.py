"""The group `era rig`: `check` compares a rig with its file; `identify` fits the plate's
parameters; `show` and `merge` use the result of a fit.

`era rig identify` finds the parameters of the plate in place, through a sound card that plays and
records accelerometers, or from a file of responses. `era rig check` reads such a file.
"""

import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import compress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from model.commands.calibrate_cli import NO_FIT, check_rig_output, finish, write_fitted_rig
from model.commands.options import FAILED, JsonOption, RigArgument, print_report, progress_bar
from model.errors import InputError
from model.quantities import counted

if TYPE_CHECKING:
    from model.estimate.measurement import MeasuredPlate, Measurement
    from model.rig.rig import Rig

measure_by_card: "Callable[..., MeasuredPlate] | None" = None
"""Measures a plate through a sound card; set by the lab, which implements sound cards."""

_NOT_EXPLAINED = (
    "chi² must be at most 2 for a plate that the model explains; no rig is written. Check that "
    "nothing touches the plate, and run era rig check to verify that plate and wiring match the "
    "file"
)
_NOT_KNOWN = (
    "modes must match the rig's plate within 2 standard deviations; no rig is written. The fields "
    "between the sensors are unknown: remove parts bonded to the plate, such as a frame along its "
    "edges, or use the rig unchanged; sensors inside the plate locate the difference"
)


def identify(
    rig_file: RigArgument,
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            metavar="RIG.fitted.yaml",
            help="Output file for the fitted rig, preferably in the folder of RIG.",
        ),
    ],
    level: Annotated[
        float | None,
        typer.Option(
            help="Peak sample of each output, 0 to 1 of full scale. Default: 0.3, or less if the "
            "rig's limits require it."
        ),
    ] = None,
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
    import time

    from model.config.units import parse_frequencies
    from model.estimate import fit_report
    from model.estimate.identify import identification_errors
    from model.estimate.identify import identify as fit
    from model.estimate.rig_check import check_meaning
    from model.rig.rig_file import load_rig
    from model.structure.modal_elasticity import check_measurable
    from model.study.expected_contrast import expected_contrast

    if measured_file is not None:
        played = {"--level": level, "--device": device}
        _refuse(played, rule="plays; leave it out with --measured")
    elif device is None:
        raise InputError("give --device, a sound card, or --measured, a file of responses")
    if device is None:
        only = {"--sensors": sensors_file, "--frequencies": frequencies, "--periods": periods}
        _refuse(only, rule="needs --device")
    elif sensors_file is None:
        raise InputError("--device needs --sensors, a file of the accelerometers")
    tones = parse_frequencies(frequencies) if frequencies else None
    rig = load_rig(rig_file)
    check_measurable(rig.plate)
    check_rig_output(output, rig_file)
    if measured_file is not None:
        measured = _read_measured_plate(measured_file, rig)
    else:
        require_untouched(is_known=untouched, has_terminal=not as_json)
        assert measure_by_card is not None  # noqa: S101  the lab is loaded
        with progress_bar("runs") as progress:
            measured = measure_by_card(
                rig,
                device,
                sensors_file,
                frequencies=tones,
                level=level,
                periods=periods or 2,
                seed=seed,
                progress=progress,
            )
    started = time.perf_counter()
    try:
        check_meaning(rig, measured.measurement)
        with progress_bar("fits") as progress:
            found = fit(rig, measured.measurement, progress=progress)
    except InputError as error:
        typer.echo(f"era: {error}; no rig is written", err=True)
        raise typer.Exit(NO_FIT) from error
    expected = expected_contrast(rig, found.rig, seed=seed) if found.can_promise else []
    rows = [
        measured_line(rig, measured),
        *measured.notes,
        *fit_report.parameter_rows(found),
        *fit_report.fit_rows(found),
        *fit_report.contrast_rows(expected),
    ]
    made = f"{rig_file.name} identified in place by `era rig identify`:"
    files = (
        write_fitted_rig(output, (rig, found.rig), [made, *rows], identification_errors(found))
        if found.is_explained
        else []
    )
    report = fit_report.identification_json(found, expected) | measured_json(measured)
    reason = _NOT_EXPLAINED if found.is_known_well else _NOT_KNOWN
    finish(
        rows,
        report if as_json else None,
        files=files,
        elapsed=time.perf_counter() - started,
        refusal=None if found.is_explained else reason,
    )


def _refuse(given: Mapping[str, object], *, rule: str) -> None:
    """Raise InputError for given options that do not apply."""
    for name, value in given.items():
        if value is not None:
            raise InputError(f"{name} {rule}")


def _read_measured_plate(path: Path, rig: "Rig") -> "MeasuredPlate":
    """Read responses, and leave out sensors without a signal.

    Raises InputError for inconsistent responses.
    """
    from model.estimate.calibrate import check_consistency
    from model.estimate.measurement import MeasuredPlate, measurement_of, read_measured

    measurement = measurement_of(read_measured(path), rig)
    screened = check_consistency(rig, measurement)
    dead_sensors = compress(measurement.names, screened.dead_sensors)
    live = screened.live(measurement)
    return MeasuredPlate(
        live,
        level=None,
        duration=None,
        sensors=tuple(
            {
                "sensor": sensor.name,
                "x_m": sensor.x,
                "y_m": sensor.y,
                "mass_g": 1e3 * sensor.mass,
            }
            for sensor in live.sensors
        ),
        notes=tuple(f"{name} has no signal, left out" for name in dead_sensors),
        details={"values_beyond_limits": live.skipped},
    )


def require_untouched(*, is_known: bool, has_terminal: bool) -> None:
    """Raise InputError, or typer.Abort, unless the user confirms that nothing touches the plate."""
    if is_known:
        return
    if not (has_terminal and sys.stdin.isatty()):
        raise InputError(
            "nothing must touch the plate during the measurement; check it, and confirm with --yes"
        )
    typer.confirm("Will the plate be free of contact for the next minute?", abort=True, err=True)


def measured_line(rig: "Rig", measured: "MeasuredPlate") -> str:
    """Return a summary of the measurement in one line."""
    from model.quantities import counted

    measurement = measured.measurement
    low, high = measurement.frequencies[0], measurement.frequencies[-1]
    level = "" if measured.level is None else f" at a level of {measured.level:.3g}"
    duration = "" if measured.duration is None else f" in {measured.duration:.1f} s"
    return (
        f"{counted(len(rig.eras), 'ERA')}, {counted(len(measurement.sensors), 'sensor')}, "
        f"{counted(len(measurement.frequencies), 'tone')} from {low:g} to {high:g} Hz{level}, "
        f"{counted(measurement.count, 'response')}{duration}"
    )


def measured_json(measured: "MeasuredPlate") -> dict[str, object]:
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
    changes = fitted_rows(rig)
    assert rig.document is not None  # noqa: S101  it was read from a file
    assert rig.document.over is not None  # noqa: S101  there are rows
    base = str(rig.document.over.data["base"])
    table = [
        (
            key,
            "-" if before is None else _value_text(before),
            "left out" if after is None else _value_text(after),
            "" if error is None else f"± {error:.3g}",
        )
        for key, before, after, error in changes
    ]
    heading = ("", base, fitted.name, "standard error")
    widths = [max(map(len, column)) for column in zip(heading, *table, strict=True)]
    rows = [
        "  ".join(f"{cell:{width}}" for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in (heading, *table)
    ]
    names = ("key", "base", "fitted", "standard_error")
    answer = {"base": base, "changes": [dict(zip(names, each, strict=True)) for each in changes]}
    print_report(rows, answer, as_json=as_json)


def _value_text(value: object) -> str:
    """Format a value of a rig file: numbers with five digits, tables as their row count."""
    match value:
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

    from model.estimate import rig_check
    from model.estimate.rig_check import diagnose, judged_by_promises

    rig, observation = _read(measured, rig_file, mesh=mesh)
    if without_phases:
        observation = replace(observation, has_phases=False)
    started = time.perf_counter()
    verdict = judged_by_promises(diagnose(rig, observation, has_form=True), rig)
    elapsed = time.perf_counter() - started
    low, high = verdict.frequencies.min(), verdict.frequencies.max()
    rows: list[str | None] = [
        f"{rig_file}: {counted(len(verdict.sensors), 'sensor')}, "
        f"{counted(len(verdict.frequencies), 'frequency', plural='frequencies')} "
        f"from {low:g} to {high:g} Hz, {elapsed:.1f} s",
        rig.uncertainty_note,
        "",
        *rig_check.channel_table(verdict),
        "",
        *rig_check.verdict_rows(verdict),
        *rig_check.difference_rows(verdict),
    ]
    answer = {"exactly_known": [*rig.exactly_known], "elapsed_s": elapsed}
    print_report(rows, {**rig_check.as_json(verdict), **answer}, as_json=as_json)
    if not verdict.is_well:
        raise typer.Exit(FAILED)


def _read(measured: Path, rig_file: Path, *, mesh: str | None) -> "tuple[Rig, Measurement]":
    """Read a measurement from a file."""
    from model.estimate.measurement import measurement_of, read_measured
    from model.rig.rig_file import load_rig

    rig = load_rig(rig_file, mesh=mesh)
    return rig, measurement_of(read_measured(measured), rig)
