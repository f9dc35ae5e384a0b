"""`era table`: build, show and query a localization table."""

import json
import time
from pathlib import Path
from typing import Annotated, Any

import typer

from model.plate_cli import JsonOption, MeshOption, RigArgument

table_app = typer.Typer(help="The localization table: what makes one finger feel it, not others.")

TableArgument = Annotated[Path, typer.Argument(metavar="TABLE", help="A table file, e.g. T.npz.")]


@table_app.command()
def build(
    rig_file: RigArgument,
    output: Annotated[Path, typer.Option("--output", "-o", metavar="TABLE", help="File to write.")],
    frequencies: Annotated[
        str, typer.Option(metavar="LO:HI:STEP", help="Frequencies in Hz, both ends included.")
    ] = "60:320:10",
    mode: Annotated[str, typer.Option(help="Drive mode: switched.")] = "switched",
    grid: Annotated[
        str, typer.Option(metavar="NXxNY", help="Target cells along x and y.")
    ] = "12x9",
    mesh: MeshOption = None,
    as_json: JsonOption = False,
) -> None:
    """Solve the plate and write its localization table."""
    from model.localization import Grid
    from model.points import parse_frequencies, parse_pair
    from model.rig_file import load_rig
    from model.table import build_table
    from model.table_file import save_table

    rig = load_rig(rig_file, mesh=mesh)
    started = time.perf_counter()
    table = build_table(
        rig,
        frequencies=parse_frequencies(frequencies),
        grid=Grid(*parse_pair(grid, what="--grid")),
        mode=mode,
    )
    save_table(table, output)
    elapsed = time.perf_counter() - started
    if as_json:
        print(
            json.dumps(
                {
                    "patterns": len(table.patterns),
                    "cells": table.grid.cell_count,
                    "frequencies_hz": table.frequencies.tolist(),
                    "mesh": [table.mesh.nx, table.mesh.ny],
                    "mode": table.mode,
                    "fingerprint": table.fingerprint,
                    "build_time_s": elapsed,
                    "files": [str(output)],
                }
            )
        )
        return
    print(
        f"{len(table.patterns)} patterns for {table.grid.cell_count} cells on a {table.mesh} mesh, "
        f"built in {elapsed:.2f} s"
    )
    print(f"wrote {output} ({output.stat().st_size / 1e6:.1f} MB)")
    print(f"Next: era table show {output}")


@table_app.command()
def show(table_file: TableArgument, as_json: JsonOption = False) -> None:
    """What is in a table: provenance, levels that can be had, dead zones, contrast."""
    from model.table_file import load_table
    from model.table_summary import summarize

    summary = summarize(load_table(table_file))
    if as_json:
        print(json.dumps(summary))
        return
    width = max(len(key) for key in summary)
    for key, value in summary.items():
        print(f"{key:{width}}  {_shown(value)}")
    print(f"Next: era table query {table_file} --target X,Y --quiet X,Y")


@table_app.command()
def query(
    table_file: TableArgument,
    target: Annotated[str, typer.Option(metavar="X,Y", help="The finger to feel it, metres.")],
    quiet: Annotated[
        list[str] | None, typer.Option(metavar="X,Y", help="A finger not to feel it; repeatable.")
    ] = None,
    mode: Annotated[
        str | None, typer.Option(help="Drive mode; must be the table's.", show_default=False)
    ] = None,
    level: Annotated[
        float, typer.Option(metavar="DB_SL", help="Wanted level at the target, dB SL.")
    ] = 20.0,
    as_json: JsonOption = False,
) -> None:
    """Which ERAs, at which frequencies and levels, make one finger feel it and the others not."""
    from model.errors import InputError
    from model.points import parse_point
    from model.table_file import load_table

    table = load_table(table_file)
    if mode is not None and mode != table.mode:
        raise InputError(
            f"{table_file} was built for mode {table.mode}, not {mode}; build one with "
            f"era table build RIG -o TABLE --mode {mode}"
        )
    quiet_points = [parse_point(text, what="--quiet") for text in quiet or []]
    target_point = parse_point(target, what="--target")
    started = time.perf_counter()
    pattern = table.answer(target_point, quiet=quiet_points, level_db_sl=level)
    elapsed = time.perf_counter() - started
    drive = table.drive_of(pattern.excitation)
    if as_json:
        print(
            json.dumps(
                {
                    "drive": drive,
                    "level_db_sl": pattern.level_db_sl,
                    "contrast_db": pattern.contrast_db,
                    "quiet_level_db_sl": pattern.quiet_level_db_sl,
                    "ramp_s": pattern.ramp,
                    "mode": table.mode,
                    "solve_time_s": elapsed,
                }
            )
        )
        return
    for era, tone in drive.items():
        print(
            f"{era:4s} {tone['frequency_hz']:7.2f} Hz  level {tone['level']:.4f}  "
            f"phase {tone['phase_deg']:g}°"
        )
    print(f"level at the target      {pattern.level_db_sl:6.1f} dB SL")
    if pattern.contrast_db is not None:
        print(f"contrast to the others   {pattern.contrast_db:6.1f} dB")
        print(f"loudest quiet finger     {pattern.quiet_level_db_sl:6.1f} dB SL")
    print(f"found in {1000 * elapsed:.1f} ms")


def _shown(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)
