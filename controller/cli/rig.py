"""`era rig check`: whether a rig is wired and built as its file says; the group `era rig`."""

import json
from pathlib import Path
from typing import Annotated

import typer

from controller.cli.identify import identify
from model.counting import counted

rig_app = typer.Typer(no_args_is_help=True, help="Check and identify a rig.")

FAILED = 1


rig_app.command()(identify)


@rig_app.command()
def check(
    rig_file: Annotated[Path, typer.Argument(metavar="RIG", help="Rig file, e.g. RIG.yaml.")],
    measured: Annotated[
        Path, typer.Option(metavar="FILE", help="Responses of each channel: .csv or .uff.")
    ],
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
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON object and nothing else.")
    ] = False,
) -> None:
    """Check whether a rig is wired and built as its file says.

    Reads measured responses. Exit status 1 if the check fails.
    """
    import time

    from model.calibration.responses import responses_of
    from model.calibration.responses_file import read_functions
    from model.diagnosis import diagnosis_report
    from model.diagnosis.observation import Observation
    from model.diagnosis.verdict import diagnose
    from model.rig.file import load_rig

    rig = load_rig(rig_file, mesh=mesh)
    started = time.perf_counter()
    responses = responses_of(read_functions(measured), rig)
    observation = Observation(**vars(responses), has_phases=not without_phases)
    verdict = diagnose(rig, observation)
    elapsed = time.perf_counter() - started
    if as_json:
        exactly_known = [*rig.uncertainty.exactly_known]
        answer = {"exactly_known": exactly_known, "elapsed_s": elapsed}
        print(json.dumps({**diagnosis_report.as_json(verdict), **answer}))
    else:
        low, high = verdict.frequencies.min(), verdict.frequencies.max()
        print(
            f"{rig_file}: {counted(verdict.sensor_count, 'sensor')}, "
            f"{counted(len(verdict.frequencies), 'frequency', plural='frequencies')} "
            f"from {low:g} to {high:g} Hz, {elapsed:.1f} s"
        )
        if note := rig.uncertainty.note:
            print(note)
        print()
        print(
            "\n".join(
                [
                    *diagnosis_report.channel_table(verdict),
                    "",
                    *diagnosis_report.verdict_rows(verdict),
                    *diagnosis_report.difference_rows(verdict),
                ]
            )
        )
    if not verdict.is_well:
        raise typer.Exit(FAILED)
