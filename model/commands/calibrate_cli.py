"""`era calibrate`: fit a rig to responses measured on it."""

import json
import time
from pathlib import Path
from typing import Annotated

import typer

from model.commands.options import JsonOption, MeshOption, RigArgument, next_line
from model.counting import counted
from model.errors import InputError
from model.files.replacing import check_ending, check_picture, check_place

NO_FIT = 1  # exit status


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
    from model.calibration import calibration_report
    from model.calibration.calibrate import calibrate as fit
    from model.calibration.responses import responses_of
    from model.calibration.responses_file import read_functions
    from model.config.document import read_document
    from model.diagnosis.consistency import check_consistency
    from model.files.array_file import whole_or_nothing
    from model.rig.file import rig_of

    check_place(output, example="rig2.yaml")
    check_ending(output, ".yaml", ".yml", what="a rig file")
    for taken in (rig_file, measured_file):
        if output.resolve() == taken.resolve():
            raise InputError(f"--output must differ from {taken}; choose another name")
    if picture is not None:
        check_picture(picture)
    document = read_document(rig_file)
    rig = rig_of(document, mesh=mesh)
    responses = responses_of(read_functions(measured_file), rig)
    started = time.perf_counter()
    check_consistency(rig, responses)
    calibration = fit(rig, responses, all_scales=all_scales)
    elapsed = time.perf_counter() - started
    rows = [
        *calibration_report.change_rows(calibration),
        *calibration_report.place_rows(calibration),
    ]
    notes = [
        *calibration_report.finding_rows(calibration),
        calibration_report.uncertainty_row(calibration),
        calibration_report.check_row(calibration),
    ]
    files = []
    if calibration.is_good:
        from model.rig.rewritten import rewritten_text

        comment = "\n".join(
            [f"{rig_file.name} calibrated with {measured_file.name} by `era calibrate`:"]
            + [f"  {row}" for row in [*rows, *notes]]
        )
        text = rewritten_text(document, rig, calibration.rig, comment=comment, mesh=mesh)
        with whole_or_nothing(output) as stream:
            stream.write(text.encode())
        files.append(str(output))
    if picture is not None:
        from model.figures import save_figure
        from model.figures.measured import calibration_figure

        save_figure(calibration_figure(calibration), picture)
        files.append(str(picture))
    if as_json:
        report = calibration_report.as_json(calibration, rig, files)
        print(json.dumps(report | {"solve_time_s": elapsed}))
    else:
        print(
            f"{measured_file}: {counted(len(responses.sensors), 'sensor')}, "
            f"{counted(len(responses.frequencies), 'frequency', plural='frequencies')} "
            f"from {responses.frequencies[0]:g} to {responses.frequencies[-1]:g} Hz, "
            f"{counted(responses.count, 'value')}; fitted in {elapsed:.1f} s"
        )
        print()
        print("\n".join([*rows, *calibration_report.gain_rows(calibration)]))
        print()
        print("\n".join(notes))
    if not calibration.is_good:
        typer.echo(
            "era: the fit must predict the measurement within 25 %; no rig is written. Check that "
            "it is this plate, places of sensors and ERAs, noise, phases as exp(+i omega t), and "
            "that the rig's mesh is as fine as auto",
            err=True,
        )
        raise typer.Exit(NO_FIT)
    if not as_json:
        print(f"wrote {', '.join(files)}")
        print(next_line("era", "table", "build", output, "-o", output.with_suffix(".npz")))
