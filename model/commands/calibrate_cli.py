"""`era calibrate`: fit a rig to responses measured on it."""

from pathlib import Path
from typing import Annotated

import typer

from model.commands.fitted_rig_cli import check_rig_output, finish, write_fitted_rig
from model.commands.options import JsonOption, MeshOption, RigArgument, Stopwatch, progress_bar
from model.files.replacing import check_picture
from model.quantities import counted

_NO_FIT = (
    "the fit must predict the measurement within 25 %; no rig is written. Check that it is this "
    "plate, places of sensors and ERAs, noise, phases as exp(+i omega t), and that the rig's mesh "
    "is as fine as auto"
)


_UNCHECKED = (
    "the fit must be checked by a sensor that it was not shown; no rig is written. Few responses "
    "are explained by a wrong plate as well: measure at {least} places or more, better at eight"
)

_DEAD = (
    "every ERA that is played must move the plate, {eras} did not; no rig is written. Find out why "
    "by era rig check, or remove it from the rig"
)


def calibrate(
    rig_file: RigArgument,
    measured_file: Annotated[
        Path, typer.Argument(metavar="MEASURED", help="Responses, .uff, .unv or .csv.")
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="RIG2.yaml", help="Rig file to write.")
    ],
    mesh: MeshOption = None,
    all_scales: Annotated[
        bool, typer.Option("--scales", help="Estimate every sensor's scale, not only wrong ones.")
    ] = False,
    picture: Annotated[
        Path | None, typer.Option(metavar="FIT.png", help="Draw measured, before and after.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Fit a rig to measured responses.

    Write a new rig, and print its values with their uncertainties.
    """
    from model.calibration import calibrate as calibration_report
    from model.calibration.calibrate import calibrate as fit
    from model.calibration.responses import LEAST_SENSORS, read_measured, responses_of
    from model.config.document import read_document
    from model.diagnosis.consistency import check_consistency
    from model.rig.file import rig_of

    check_rig_output(output, rig_file, measured_file)
    if picture is not None:
        check_picture(picture)
    document = read_document(rig_file)
    rig = rig_of(document, mesh=mesh)
    responses = responses_of(read_measured(measured_file), rig)
    with Stopwatch() as timed, progress_bar("fits") as progress:
        screened = check_consistency(rig, responses)
        calibration = fit(rig, responses, screened, all_scales=all_scales, progress=progress)
    rows = calibration_report.change_rows(calibration)
    notes = [
        *calibration_report.finding_rows(calibration),
        *calibration_report.check_rows(calibration),
    ]
    refusal = None
    if not calibration.is_good:
        refusal = _NO_FIT if calibration.held_out else _UNCHECKED.format(least=LEAST_SENSORS + 1)
    elif calibration.dead_eras:
        refusal = _DEAD.format(eras=", ".join(calibration.dead_eras))
    made = f"{rig_file.name} calibrated with {measured_file.name} by `era calibrate`:"
    files = (
        write_fitted_rig(output, document, (rig, calibration.rig), [made, *rows, *notes], mesh=mesh)
        if refusal is None
        else []
    )
    if picture is not None:
        from model.figures import save_figure
        from model.figures.measured import calibration_figure

        save_figure(calibration_figure(calibration), picture)
        files.append(str(picture))
    heading = (
        f"{measured_file}: {counted(len(responses.sensors), 'sensor')}, "
        f"{counted(len(responses.frequencies), 'frequency', plural='frequencies')} "
        f"from {responses.frequencies[0]:g} to {responses.frequencies[-1]:g} Hz, "
        f"{counted(responses.count, 'value')}"
    )
    finish(
        [
            heading,
            "",
            *rows,
            *calibration_report.calibration_report_gain_rows(calibration),
            "",
            *notes,
        ],
        calibration_report.as_json(calibration, rig) | {"values_beyond_limits": responses.skipped}
        if as_json
        else None,
        files=files,
        elapsed=timed.elapsed,
        refusal=refusal,
    )
