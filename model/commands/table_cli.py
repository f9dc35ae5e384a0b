"""`era table query`: what to play so that one finger feels it and the others do not."""

import json
from pathlib import Path
from typing import Annotated

import typer

from model.commands.plate_cli import JsonOption

table_app = typer.Typer(help="The localization table: felt by one finger, not by others.")

TableArgument = Annotated[Path, typer.Argument(metavar="TABLE", help="A table file, e.g. T.npz.")]


def query(
    table_file: TableArgument,
    target: Annotated[
        list[str] | None,
        typer.Option(metavar="X,Y", help="The finger to feel it, metres; repeatable."),
    ] = None,
    quiet: Annotated[
        list[str] | None, typer.Option(metavar="X,Y", help="A finger not to feel it; repeatable.")
    ] = None,
    drive_mode: Annotated[
        str | None,
        typer.Option(
            "--mode", help="Drive mode: switched, graded, signed or phased; default: the table's."
        ),
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
    """Which ERAs make one finger feel it and the others not. At which frequencies and levels."""
    from model.config.points import parse_point
    from model.errors import InputError
    from model.table.file import load_table
    from model.table.query import prepared_timing, query_as_json
    from model.table.question import Question

    if batch is not None:
        if target or quiet:
            raise InputError("--batch holds the contacts already; leave --target and --quiet out")
        _answer_batch(table_file, batch)
        return
    if not target:
        raise InputError(
            "nobody is to feel anything: say who with --target X,Y, metres, or give many questions "
            "with --batch FILE"
        )
    question = Question(
        targets=tuple(parse_point(text, what="--target") for text in target),
        quiet=tuple(parse_point(text, what="--quiet") for text in quiet or []),
        level_db_sl=level,
        drive_mode=drive_mode,
        eras_at_most=eras,
        envelopes=envelopes,
    )
    table = load_table(table_file)
    table.prepare(drive_mode)
    answer = query_as_json(table, question, prepared_timing(table))
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
        print(f"  to 95 % of that plate  {answer['surroundings_contrast_95_db']:6.1f} dB or more")
        print(f"half as strong or more on{1e4 * answer['area_above_half_m2']:6.0f} cm²")
        print(f"of its energy within 5 cm{100 * answer['energy_share_near']:6.0f} %")
    print(f"left after its end       {answer['left_after_db']:6.1f} dB")
    print(f"found in {1000 * answer['solve_time_s']:.1f} ms")


def _answer_batch(table_file: Path, batch: Path) -> None:
    """Answer line by line as they are read; status 1 at the end if any had no answer."""
    from model.errors import InputError
    from model.table.file import load_table
    from model.table.query import query_batch

    table = load_table(table_file)
    failed = False
    try:
        with batch.open(encoding="utf-8") as lines:
            for answer in query_batch(table, lines):
                failed = failed or "error" in answer
                print(json.dumps(answer))
    except OSError as error:
        raise InputError(
            f"--batch {batch} cannot be read: {error.strerror}; give a file with a question a line"
        ) from error
    except UnicodeDecodeError as error:
        raise InputError(f"--batch {batch} is no text in UTF-8; save it as UTF-8") from error
    if failed:
        raise typer.Exit(1)
