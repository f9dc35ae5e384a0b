"""The group `era rig`: `check`, whether a rig is wired and built as its file says; `identify`;
`show` and `merge` of what a fit found.

`era rig identify` finds the parameters of the plate in place. Both measure by the rig's own ERAs
and the sensors of its amplifiers, or read a file of responses.
"""

import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from itertools import compress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer

from model.commands.calibrate_cli import NO_FIT, check_rig_output, finish, write_fitted_rig
from model.commands.options import FAILED, JsonOption, print_report, progress_bar
from model.errors import InputError
from model.quantities import counted

if TYPE_CHECKING:
    from controller.plate_measurement import MeasuredPlate
    from model.estimate.measurement import Measurement
    from model.rig.rig import Rig

measure_by_card: "Callable[..., MeasuredPlate] | None" = None
"""Measures a plate through a sound card; set by the lab, which knows such cards."""

_NOT_EXPLAINED = (
    "chi² must be at most 2 for a plate that the model explains; no rig is written. Check that "
    "nothing touches the plate, and by era rig check that it is that of the file and wired as it "
    "says"
)
_NOT_KNOWN = (
    "modes must be those of the rig's plate to 2 standard deviations; no rig is written. Its "
    "fields between the sensors are not known: remove what is bonded to the plate, such as a frame "
    "along its edges, or use the rig as written; sensors inside the plate show where it differs"
)


def identify(
    rig_file: Annotated[
        Path, typer.Argument(metavar="RIG", help="Rig file, or the daemon's file that names it.")
    ],
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            metavar="RIG.fitted.yaml",
            help="File of the fitted rig, best in the folder of RIG.",
        ),
    ],
    url: Annotated[
        list[str] | None,
        typer.Option(
            metavar="[NAME=]URL", help="URL of an amplifier instead of the one in the rig file."
        ),
    ] = None,
    level: Annotated[
        float | None,
        typer.Option(
            help="Level of every tone, by default 0.1 of full stroke; by a sound card the largest "
            "sample of each output, by default 0.3; less if limits ask for it."
        ),
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="Play every tone on one ERA only: a third of the time.")
    ] = False,
    measured_file: Annotated[
        Path | None,
        typer.Option(
            "--measured",
            metavar="MEASURED.uff|.csv",
            help="Responses that era measure has written instead, as of a sensor that is moved.",
        ),
    ] = None,
    device: Annotated[
        str | None,
        typer.Option(
            metavar="DEVICE",
            help="Sound card that plays and records instead: jack, jack:CLIENT, or a device of "
            "PortAudio.",
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
            help="Whole frequencies in Hz that a sound card plays; default: odd ones, 10 apart.",
        ),
    ] = None,
    periods: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            help="Seconds of each run of a sound card that count; default: 2.",
            min=2,
            max=60,
        ),
    ] = None,
    untouched: Annotated[
        bool,
        typer.Option(
            "--yes", help="Nothing touches the plate, and nothing will: do not ask on a terminal."
        ),
    ] = False,
    seed: Annotated[
        int,
        typer.Option(
            metavar="N",
            help="Draw other fingers for the expected contrast, and a sound card's phases.",
            min=0,
        ),
    ] = 0,
    as_json: JsonOption = False,
) -> None:
    """Identify the plate in place by its own ERAs.

    Write its rig with what is left uncertain. Every ERA plays small tones of its own at the same
    time, the amplifiers' sensors listen. With --device a sound card plays multisines and records
    accelerometers, as era measure does, with its loop-back cable; with --measured nothing is
    played. Exit status 1, and no rig is written, where the model does not explain what was heard.
    """
    import time

    from controller.plate_measurement import observation_of
    from model.config.units import parse_frequencies
    from model.estimate import fit_report
    from model.estimate.identify import identification_errors
    from model.estimate.identify import identify as fit
    from model.estimate.rig_check import check_meaning
    from model.structure.modal_elasticity import check_measurable
    from model.study.verification import expected_contrast

    if measured_file is not None:
        played = {"--url": url, "--level": level, "--quick": quick or None, "--device": device}
        _refuse(played, rule="plays; leave it out beside --measured")
    if device is None:
        only = {"--sensors": sensors_file, "--frequencies": frequencies, "--periods": periods}
        _refuse(only, rule="needs --device")
    else:
        _refuse(
            {"--url": url, "--quick": quick or None},
            rule="is for amplifiers, leave it out beside --device",
        )
        if sensors_file is None:
            raise InputError("--device needs --sensors, a file of the accelerometers")
    tones = parse_frequencies(frequencies) if frequencies else None
    with rig_of_file(rig_file) as rig:
        check_measurable(rig.plate)
        assert rig.document is not None  # noqa: S101  it was read from a file
        source = Path(rig.document.source)
        check_rig_output(output, rig_file, source)
        if measured_file is None:
            require_untouched(is_known=untouched, has_terminal=not as_json)
        if measured_file is not None:
            measured = _measured_before(measured_file, rig)
        elif device is not None:
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
        else:
            measured = measured_by_amplifiers(rig, url or [], level=level, is_quick=quick)
    started = time.perf_counter()
    try:
        check_meaning(rig, observation_of(measured.measurement, rig))
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
        *fit_report.clock_rows(found),
        *fit_report.fit_rows(found),
        *fit_report.contrast_rows(expected),
    ]
    made = f"{source.name} identified in place by `era rig identify`:"
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
    """Raise InputError for options that say nothing to what measures."""
    for name, value in given.items():
        if value is not None:
            raise InputError(f"{name} {rule}")


def _measured_before(path: Path, rig: "Rig") -> "MeasuredPlate":
    """Responses of a file, where they are what they claim to be; raises InputError."""
    from controller.plate_measurement import MeasuredPlate
    from model.estimate.calibrate import check_consistency
    from model.estimate.measurement import measurement_of, read_measured

    measured = measurement_of(read_measured(path), rig)
    screened = check_consistency(rig, measured)
    dead = [*compress(measured.names, screened.dead_sensors)]
    live = screened.live(measured)
    return MeasuredPlate(
        live,
        None,
        None,
        tuple(
            {"sensor": each.name, "x_m": each.x, "y_m": each.y, "mass_g": 1e3 * each.mass}
            for each in live.sensors
        ),
        tuple(f"{name} has no signal, left out" for name in dead),
        {"values_beyond_limits": live.skipped},
    )


@contextmanager
def rig_of_file(path: Path) -> "Iterator[Rig]":
    """Read a rig's file, or that which a daemon's file names while its daemon cannot run.

    Raises InputError, also where the daemon runs: it holds the amplifiers.
    """
    from controller.daemon.config import daemon_config_of, is_daemon_document
    from controller.process.daemon_process import SocketLock
    from model.config.document import read_document
    from model.rig.rig_file import rig_of

    document = read_document(path)
    if not is_daemon_document(document):
        yield rig_of(document)
        return
    config = daemon_config_of(document)
    lock = SocketLock(config.socket)
    try:
        yield config.rig
    finally:
        lock.release()


def require_untouched(*, is_known: bool, has_terminal: bool) -> None:
    """Raise InputError, or typer.Abort, unless the user confirms that nothing touches the plate."""
    if is_known:
        return
    if not (has_terminal and sys.stdin.isatty()):
        raise InputError(
            "nothing may touch the plate while it is measured; look, and say so with --yes"
        )
    typer.confirm("Nothing touches the plate, and will not for a minute?", abort=True, err=True)


def measured_by_amplifiers(
    rig: "Rig", urls: list[str], *, level: float | None, is_quick: bool
) -> "MeasuredPlate":
    """Measure by the rig's amplifiers, and show the steps.

    urls: `[NAME=]URL` in place of those of the rig; level: of every tone, None for the usual one;
    is_quick: every tone on one ERA only. Raises DriverError and InputError.
    """
    import asyncio

    from controller.plate_measurement import PlateSelfMeasurement
    from drivers.opening import Lines

    at = _urls_of(rig, urls)

    async def measure() -> "MeasuredPlate":
        with progress_bar("steps") as progress:
            return await PlateSelfMeasurement(
                rig, Lines, at, level=level, is_quick=is_quick, progress=progress
            ).run()

    return asyncio.run(measure())


def _urls_of(rig: "Rig", texts: Sequence[str]) -> dict[str, str]:
    """Return the URL of each amplifier by name; texts: NAME=URL, or a URL where there is one.

    Raises InputError for an amplifier that the rig does not have.
    """
    found = dict(rig.amplifiers)
    for text in texts:
        name, equals, url = text.partition("=")
        if len(found) == 1 and "://" in name:
            (name,), equals, url = found, "=", text
        if not equals or name not in found:
            raise InputError(
                f"--url must be NAME=URL with one of {', '.join(rig.amplifiers)}, got {text}"
            )
        found[name] = url
    return found


def measured_line(rig: "Rig", measured: "MeasuredPlate") -> str:
    """What was measured, in one line."""
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
    """How it was measured, for programs."""
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
    """Show the values of a fit next to those of its base.

    The base is the rig file that the fit began with. Values are in SI units, as the rig file states
    them, and those of the fit have standard errors.
    """
    from model.rig.rig_file import load_rig
    from model.rig.rig_writing import fitted_rows

    rig = load_rig(fitted)
    changes = fitted_rows(rig)
    assert rig.document is not None  # noqa: S101  it was read from a file
    assert rig.document.over is not None  # noqa: S101  else there were no rows
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
    """A value of a rig file for people: five digits of a number, the count of rows."""
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

    It has the values of the fit and all other keys of the rig file that the fit began with, without
    its comments. The table of the fitted rig serves it, too.
    """
    from model.files.array_file import whole_or_nothing
    from model.rig.rig_file import load_rig

    check_rig_output(output, fitted)
    rig = load_rig(fitted)
    assert rig.document is not None  # noqa: S101  it was read from a file
    if rig.document.over is None:
        raise InputError(f"{fitted} must be a fitted rig, with a `base`; this one is whole")
    text = f"# {fitted.name} merged by `era rig merge`:\n\n{rig.document.whole_text}"
    with whole_or_nothing(output) as stream:
        stream.write(text.encode())
    print(f"wrote {output}")


@rig_app.command()
def check(
    rig_file: Annotated[
        Path, typer.Argument(metavar="RIG", help="Rig file, or the daemon's file that names it.")
    ],
    measured: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Responses of each channel: .csv or .uff."),
    ] = None,
    url: Annotated[
        list[str] | None,
        typer.Option(
            metavar="[NAME=]URL", help="Amplifier whose sensors measure the plate, here and now."
        ),
    ] = None,
    level: Annotated[
        float | None,
        typer.Option(help="Level of every tone with --url, by default 0.1 of full stroke."),
    ] = None,
    untouched: Annotated[
        bool,
        typer.Option(
            "--yes", help="Nothing touches the plate, and nothing will: do not ask on a terminal."
        ),
    ] = False,
    without_phases: Annotated[
        bool,
        typer.Option(
            "--without-phases",
            help="Ignore the phases of the file, which do not refer to the drive.",
        ),
    ] = False,
    mesh: Annotated[
        str | None, typer.Option(metavar="NxM", help="Mesh instead of the one in the rig file.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Check whether a rig is wired and built as its file says.

    With --url the amplifiers play small tones and their own sensors listen; with --measured
    responses are read from a file. Exit status 1 if the check fails.
    """
    import time

    from model.estimate import rig_check
    from model.estimate.rig_check import diagnose, judged_by_promises

    if (measured is None) == (url is None):
        raise InputError("give --url, of an amplifier with sensors, or --measured, a file")
    details: dict[str, object] = {}
    rows: list[str | None] = []
    if url is not None:
        if mesh is not None:
            raise InputError("--mesh is of --measured; write mesh into the rig file")
        rig, plate, observation = _measured(
            rig_file, url, level=level, is_untouched=untouched, has_terminal=not as_json
        )
        details, rows = measured_json(plate), [measured_line(rig, plate), *plate.notes]
    else:
        if level is not None:
            raise InputError("--level is of --url; leave it out beside --measured")
        rig, observation = _read(cast("Path", measured), rig_file, mesh=mesh)
    if without_phases:
        observation = replace(observation, has_phases=False)
    started = time.perf_counter()
    # Sensors of amplifiers are of unknown scale.
    verdict = judged_by_promises(diagnose(rig, observation, has_form=url is None), rig)
    elapsed = time.perf_counter() - started
    low, high = verdict.frequencies.min(), verdict.frequencies.max()
    rows += [
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
    exactly_known = [*rig.exactly_known]
    answer = {"exactly_known": exactly_known, "elapsed_s": elapsed}
    print_report(rows, {**rig_check.as_json(verdict), **details, **answer}, as_json=as_json)
    if not verdict.is_well:
        raise typer.Exit(FAILED)


def _measured(
    rig_file: Path, urls: list[str], *, level: float | None, is_untouched: bool, has_terminal: bool
) -> "tuple[Rig, MeasuredPlate, Measurement]":
    """Measure the plate by the sensors of its amplifiers."""
    from controller.plate_measurement import observation_of
    from model.structure.modal_elasticity import check_measurable

    with rig_of_file(rig_file) as rig:
        check_measurable(rig.plate)
        require_untouched(is_known=is_untouched, has_terminal=has_terminal)
        plate = measured_by_amplifiers(rig, urls, level=level, is_quick=False)
    return rig, plate, observation_of(plate.measurement, rig)


def _read(measured: Path, rig_file: Path, *, mesh: str | None) -> "tuple[Rig, Measurement]":
    """Read what was measured from a file."""
    from model.estimate.measurement import measurement_of, read_measured
    from model.rig.rig_file import load_rig

    rig = load_rig(rig_file, mesh=mesh)
    return rig, measurement_of(read_measured(measured), rig)
