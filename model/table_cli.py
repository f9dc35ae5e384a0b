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
    mode: Annotated[
        str, typer.Option(help="Drive mode to answer in: switched, graded, signed or phased.")
    ] = "switched",
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
    from model.table_build import build_table
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
    target: Annotated[
        list[str] | None,
        typer.Option(metavar="X,Y", help="The finger to feel it, metres; repeatable."),
    ] = None,
    quiet: Annotated[
        list[str] | None, typer.Option(metavar="X,Y", help="A finger not to feel it; repeatable.")
    ] = None,
    mode: Annotated[
        str | None,
        typer.Option(help="switched, graded, signed or phased; the table's own if not given."),
    ] = None,
    level: Annotated[
        float, typer.Option(metavar="DB_SL", help="Wanted level at the target, dB SL.")
    ] = 20.0,
    eras: Annotated[
        int, typer.Option(metavar="N", help="How many ERAs mode switched may drive.")
    ] = 2,
    envelopes: Annotated[
        bool,
        typer.Option("--envelopes", help="The amplifiers play envelopes: shape onset and ending."),
    ] = False,
    batch: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Questions as JSON lines; answers one to a line."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Which ERAs, at which frequencies and levels, make one finger feel it and the others not."""
    from model.errors import InputError
    from model.points import parse_point
    from model.question import Question
    from model.table_file import load_table
    from model.table_query import answer_as_json, prepared_timing

    if batch is not None:
        if target or quiet:
            raise InputError("--batch holds the contacts already; leave --target and --quiet out")
        _answer_batch(table_file, batch)
        return
    question = Question(
        targets=tuple(parse_point(text, what="--target") for text in target or []),
        quiet=tuple(parse_point(text, what="--quiet") for text in quiet or []),
        level_db_sl=level,
        mode=mode,
        eras_at_most=eras,
        envelopes=envelopes,
    )
    table = load_table(table_file)
    table.prepare(mode)
    answer = answer_as_json(table, question, prepared_timing(table))
    if as_json:
        print(json.dumps(answer))
        return
    for era, tone in answer["drive"].items():
        print(
            f"{era:4s} {tone['frequency_hz']:7.2f} Hz  level {tone['level']:.4f}  "
            f"phase {tone['phase_deg']:.1f}°"
        )
    print(f"level at the target      {answer['level_db_sl']:6.1f} dB SL")
    if answer["contrast_db"] is not None:
        unaware = "unaware" if answer["quiet_is_unaware"] else "may feel it"
        print(f"contrast to the others   {answer['contrast_db']:6.1f} dB")
        print(f"  in nine of ten plates  {answer['robust_contrast_db']:6.1f} dB or more")
        print(f"  in the first 100 ms    {answer['transient_contrast_db']:6.1f} dB")
        print(f"loudest quiet finger     {answer['quiet_level_db_sl']:6.1f} dB SL, {unaware}")
        print(f"leaves them unaware up to{answer['usable_level_db_sl']:6.1f} dB SL")
    else:
        print(f"to the plate around it   {answer['surroundings_contrast_db']:6.1f} dB")
    print(f"left after its end       {answer['left_after_db']:6.1f} dB")
    print(f"found in {1000 * answer['solve_time_s']:.1f} ms")


def _answer_batch(table_file: Path, batch: Path) -> None:
    """Answer line by line as they are read; status 1 at the end if any had no answer."""
    from model.errors import InputError
    from model.table_file import load_table
    from model.table_query import answer_lines

    table = load_table(table_file)
    failed = False
    try:
        with batch.open(encoding="utf-8") as lines:
            for answer in answer_lines(table, lines):
                failed = failed or "error" in answer
                print(json.dumps(answer))
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"--batch {batch} cannot be read: {error}") from error
    if failed:
        raise typer.Exit(1)


def _shown(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)
