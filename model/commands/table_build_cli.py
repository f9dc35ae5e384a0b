"""`era table build`: from a rig to its table."""

import json
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from model.commands.options import JsonOption, MeshOption, RigArgument, next_line, progress_bar
from model.config.points import parse_frequencies, parse_pair
from model.counting import counted
from model.errors import InputError
from model.files.replacing import begins_with, check_ending, check_place, check_replaceable

if TYPE_CHECKING:
    from model.spectral.mesh import PlateMesh


def build(
    rig_file: RigArgument,
    output: Annotated[Path, typer.Option("--output", "-o", metavar="TABLE", help="File to write.")],
    frequencies: Annotated[
        str | None,
        typer.Option(
            metavar="LO:HI:STEP",
            help="Frequencies in Hz, both ends included; default: 40:500:10 within the rig's "
            "limits.frequency.",
        ),
    ] = None,
    drive_mode: Annotated[
        str, typer.Option("--mode", help="Default drive mode: switched or phased.")
    ] = "switched",
    grid: Annotated[
        str, typer.Option(metavar="NXxNY", help="Target cells along x and y.")
    ] = "12x9",
    mesh: MeshOption = None,
    workers: Annotated[int, typer.Option(min=1, max=256, help="Number of processes.")] = 1,
    as_json: JsonOption = False,
) -> None:
    """Solve the plate and write its table."""
    from model.drive_modes import DRIVE_MODES
    from model.finger.grid import Grid
    from model.rig.file import load_rig
    from model.table.build import TableProblem, solve_table
    from model.table.file import ZIP, save_table
    from model.table.table import default_drive_frequencies

    if drive_mode not in DRIVE_MODES:
        raise InputError(f"--mode must be one of {', '.join(DRIVE_MODES)}, got {drive_mode!r}")
    check_place(output, example="table.npz")
    check_ending(output, ".npz", what="a localization table")
    check_replaceable(output, is_own=begins_with(output, ZIP), what="localization table")
    rig = load_rig(rig_file, mesh=mesh)
    started = time.perf_counter()
    chosen = (
        parse_frequencies(frequencies) if frequencies else default_drive_frequencies(rig.limits)
    )
    problem = TableProblem(rig, chosen, Grid(*parse_pair(grid, what="--grid")))
    with progress_bar("parts") as progress:
        table = solve_table(problem, drive_mode=drive_mode, workers=workers, progress=progress)
    save_table(table, output)
    elapsed = time.perf_counter() - started
    error = 100 * float(table.discretisation_error.max())
    warning = _coarse(error, table.mesh)
    if as_json:
        answer = {
            "patterns": table.pattern_count,
            "cells": table.grid.cell_count,
            "drive_frequencies_hz": table.frequencies.tolist(),
            "mesh": [table.mesh.nx, table.mesh.ny],
            "element": table.mesh.element_name,
            "discretisation_error_percent": error,
            "mode": table.drive_mode,
            "fingerprint": table.fingerprint,
            "code_version": table.code_version,
            "exactly_known": [*rig.uncertainty.exactly_known],
            "build_time_s": elapsed,
            "files": [str(output)],
        }
        print(json.dumps(answer))
        _warn(warning)
        return
    print(
        f"{counted(table.pattern_count, 'pattern')} of "
        f"{counted(len(table.frequencies), 'frequency', plural='frequencies')} for "
        f"{counted(table.grid.cell_count, 'cell')}, built in {elapsed:.2f} s"
    )
    print(
        f"mesh {table.mesh}: error of the fields {error:.3g} %, estimated with "
        f"{table.reference_mesh}"
    )
    if note := rig.uncertainty.note:
        print(note)
    print(f"wrote {output} ({output.stat().st_size / 1e6:.1f} MB)")
    _warn(warning)
    print(next_line("era", "table", "show", output))


NOTED_ERROR = 5.0
"""Error of the fields [%] from which a mesh is called coarse, as large as that of a gain."""


def _coarse(error: float, mesh: "PlateMesh") -> str | None:
    """Warn of the error [%] of a mesh, None for a small one."""
    if error < NOTED_ERROR:
        return None
    return (
        f"mesh {mesh} is coarse: its fields are wrong by {error:.3g} %; what is promised takes "
        "this error into account and is lower for it; `mesh: auto` keeps it at 1 %"
    )


def _warn(warning: str | None) -> None:
    if warning:
        typer.echo(f"era: warning: {warning}", err=True)
