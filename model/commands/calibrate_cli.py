"""`era calibrate`: fit a rig to responses measured on it.

The file of a fitted rig and the end of the report are shared by all commands that fit a rig.
"""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from model.commands.options import (
    FittedRigOption,
    JsonOption,
    MeshOption,
    RigArgument,
    Stopwatch,
    next_line,
    print_report,
    progress_bar,
)
from model.errors import InputError
from model.files.output_paths import check_ending, check_picture, check_place, check_replaceable
from model.quantities import counted

if TYPE_CHECKING:
    from model.config.document import KeyPath
    from model.rig.rig import Rig

NO_FIT = 1
"""Exit status if a fit does not explain the measurement."""

_HEADING = re.compile(rb"# .* by `era (calibrate|outputs|rig identify|rig merge)`:\s*$|\Z")
"""First line of a file that a command fitted, or of an empty one."""

_NO_FIT = (
    "the fit must predict the measurement within 25 %; no rig is written. Check that the rig "
    "describes this plate, the positions of sensors and ERAs, noise, the sign of phases "
    "(exp(+i omega t)), and that the rig's mesh is as fine as auto"
)

_UNCHECKED = (
    "the fit must be checked with a sensor that it does not use; no rig is written. A wrong plate "
    "can explain few responses, too: measure at {least} positions or more, preferably at eight"
)

_DEAD = (
    "every ERA that is driven must move the plate, {eras} did not; no rig is written. Find the "
    "cause with era rig check, or remove the ERA from the rig"
)


def check_rig_output(output: Path, *inputs: Path) -> None:
    """Raise InputError unless a fitted rig can be written to a path.

    A rig that was fitted before is replaced; a file that a person wrote, or that the command
    reads (`inputs`), is not.
    """
    check_place(output, example="rig2.yaml")
    check_ending(output, ".yaml", ".yml", what="a rig file")
    for file in inputs:
        if output.resolve() == file.resolve():
            raise InputError(f"--output must differ from {file}; choose another name")
    if output.is_file():
        with output.open("rb") as stream:
            is_fitted = _HEADING.match(stream.readline()) is not None
        check_replaceable(output, is_own=is_fitted, what="rig that `era` fitted")


def write_fitted_rig(
    output: Path,
    rigs: "tuple[Rig, Rig]",
    comment: Sequence[str],
    errors: "Mapping[KeyPath, float]",
) -> list[str]:
    """Write a fitted rig with the original file as its base, and return the files written.

    rigs: before and after the fit; comment: a heading that `_HEADING` matches, then the report;
    errors: standard errors by key path.
    """
    from model.rig.rig_writing import save_fitted

    save_fitted(output, *rigs, comment="\n  ".join(comment), errors=errors)
    return [str(output)]


def finish(
    rows: Sequence[str],
    report: dict[str, Any] | None,
    *,
    files: Sequence[str],
    elapsed: float,
    refusal: str | None,
) -> None:
    """Print the report of a fit, as text or as JSON if there is a report object.

    files: those written, the rig first; elapsed: time of the fit [s]; refusal: why no rig was
    written, None if it was. Exits with `NO_FIT` on a refusal.
    """
    answer = (report or {}) | {"solve_time_s": elapsed, "files": list(files)}
    print_report(rows, answer, as_json=report is not None)
    if refusal is not None:
        typer.echo(f"era: {refusal}", err=True)
        raise typer.Exit(NO_FIT)
    if report is None:
        print(f"\nwrote {', '.join(files)}; fitted in {elapsed:.1f} s")
        table = Path(files[0]).with_suffix(".npz")
        print(next_line("era", "table", "build", files[0], "-o", table))


def calibrate(
    rig_file: RigArgument,
    measured_file: Annotated[
        Path, typer.Argument(metavar="MEASURED", help="Responses, .uff, .unv or .csv.")
    ],
    output: FittedRigOption,
    mesh: MeshOption = None,
    all_scales: Annotated[
        bool,
        typer.Option(
            "--scales", help="Estimate the scale of every sensor, not only of suspicious ones."
        ),
    ] = False,
    picture: Annotated[
        Path | None,
        typer.Option(
            metavar="FIT.png", help="Plot the measurement, and the model before and after the fit."
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Fit a rig to measured responses.

    Writes the fitted values to a separate file and prints them with their standard errors.
    """
    from model.estimate.calibrate import calibrate as fit
    from model.estimate.calibration_report import (
        calibration_json,
        change_rows,
        check_rows,
        finding_rows,
        gain_rows,
    )
    from model.estimate.calibration_result import calibration_errors
    from model.estimate.measurement import LEAST_SENSORS
    from model.response_files import measurement_of, read_measured
    from model.rig.rig_file import load_rig

    check_rig_output(output, rig_file, measured_file)
    if picture is not None:
        check_picture(picture)
    rig = load_rig(rig_file, mesh=mesh)
    measurement = measurement_of(read_measured(measured_file), rig)
    with Stopwatch() as timed, progress_bar("fits") as progress:
        calibration = fit(rig, measurement, all_scales=all_scales, progress=progress)
    rows = change_rows(calibration)
    notes = [*finding_rows(calibration), *check_rows(calibration)]
    refusal = None
    if not calibration.is_good:
        refusal = _NO_FIT if calibration.held_out else _UNCHECKED.format(least=LEAST_SENSORS + 1)
    elif calibration.dead_eras:
        refusal = _DEAD.format(eras=", ".join(calibration.dead_eras))
    files: list[str] = []
    if refusal is None:
        origin = f"{rig_file.name} calibrated with {measured_file.name} by `era calibrate`:"
        errors = calibration_errors(calibration)
        files = write_fitted_rig(output, (rig, calibration.rig), [origin, *rows, *notes], errors)
    if picture is not None:
        from model.figures.calibration import calibration_figure
        from model.figures.style import save_figure

        save_figure(calibration_figure(calibration), picture)
        files.append(str(picture))
    heading = (
        f"{measured_file}: {counted(len(measurement.sensors), 'sensor')}, "
        f"{counted(len(measurement.frequencies), 'frequency', plural='frequencies')} "
        f"from {measurement.frequencies[0]:g} to {measurement.frequencies[-1]:g} Hz, "
        f"{counted(measurement.count, 'value')}"
    )
    report = calibration_json(calibration, rig) | {"values_beyond_limits": measurement.skipped}
    finish(
        [heading, "", *rows, *gain_rows(calibration), "", *notes],
        report if as_json else None,
        files=files,
        elapsed=timed.elapsed,
        refusal=refusal,
    )
