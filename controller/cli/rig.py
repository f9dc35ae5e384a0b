"""`era rig check`: whether a rig is wired and built as its file says; the group `era rig`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer

from controller.cli.identify import (
    identify,
    measured_by_amplifiers,
    measured_json,
    measured_line,
    require_untouched,
    rig_of_file,
)
from model.commands.options import JsonOption, print_report
from model.errors import InputError
from model.quantities import counted

if TYPE_CHECKING:
    from model.calibration.responses import Responses
    from model.identification.least_squares import MeasuredPlate
    from model.rig.rig import Rig

rig_app = typer.Typer(no_args_is_help=True, help="Check and identify a rig.")

FAILED = 1


rig_app.command()(identify)


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
    from dataclasses import replace

    from model.diagnosis import diagnosis_report
    from model.diagnosis.verdict import diagnose, judged_by_promises

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
        *diagnosis_report.channel_table(verdict),
        "",
        *diagnosis_report.verdict_rows(verdict),
        *diagnosis_report.difference_rows(verdict),
    ]
    exactly_known = [*rig.exactly_known]
    answer = {"exactly_known": exactly_known, "elapsed_s": elapsed}
    print_report(rows, {**diagnosis_report.as_json(verdict), **details, **answer}, as_json=as_json)
    if not verdict.is_well:
        raise typer.Exit(FAILED)


def _measured(
    rig_file: Path, urls: list[str], *, level: float | None, is_untouched: bool, has_terminal: bool
) -> "tuple[Rig, MeasuredPlate, Responses]":
    """Measure the plate by the sensors of its amplifiers."""
    from controller.plate_measurement import observation_of
    from model.structure.modal_elasticity import check_measurable

    with rig_of_file(rig_file) as (_, rig):
        check_measurable(rig.plate)
        require_untouched(is_known=is_untouched, has_terminal=has_terminal)
        plate = measured_by_amplifiers(rig, urls, level=level, is_quick=False)
    return rig, plate, observation_of(plate.measurement, rig)


def _read(measured: Path, rig_file: Path, *, mesh: str | None) -> "tuple[Rig, Responses]":
    """Read what was measured from a file."""
    from model.calibration.responses import read_measured, responses_of
    from model.rig.rig_file import load_rig

    rig = load_rig(rig_file, mesh=mesh)
    return rig, responses_of(read_measured(measured), rig)
