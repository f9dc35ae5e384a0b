"""`era table query`: the pattern for a set of contacts, or a content for each finger."""

import json
import sys
from collections.abc import Iterator
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from model.commands.options import JsonOption, QuietOption, TableArgument, print_report
from model.config.points import parse_point
from model.errors import InputError

_MAX_LINE = 1 << 20  # characters of a question

table_app = typer.Typer(help="Build, query and check localization tables.")


def query(
    table_file: TableArgument,
    target: Annotated[
        list[str] | None,
        typer.Option(metavar="X,Y", help="Position of a target finger in metres; repeatable."),
    ] = None,
    quiet: QuietOption = None,
    own: Annotated[
        list[str] | None,
        typer.Option(
            metavar="X,Y[@LOW-HIGH]",
            help="Position of a finger in metres that is to feel a vibration of its own, and the "
            "lowest and highest frequency of it in Hz, or a single one; repeatable.",
        ),
    ] = None,
    swap_bands: Annotated[
        bool,
        typer.Option("--swap-bands", help="With --own: let fingers have each other's bands."),
    ] = False,
    drive_mode: Annotated[
        str | None,
        typer.Option("--mode", help="switched or phased; default: the table's."),
    ] = None,
    level: Annotated[
        float, typer.Option(metavar="DB_SL", help="Level at the target, dB SL.")
    ] = 20.0,
    envelopes: Annotated[
        bool, typer.Option("--envelopes", help="Shape onset and ending by envelopes.")
    ] = False,
    batch: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Questions as JSON lines, - for standard input; print one answer a line. Other "
            "options are the defaults of keys left out.",
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Find the pattern for target and quiet fingers.

    Or with --own a vibration for each of several fingers. Print frequency, level and phase of each
    ERA, and predicted levels and contrast.
    """
    from model.answer.answer_report import query_one
    from model.table.file import load_table

    if batch is not None:
        if target or quiet or own or swap_bands:
            raise InputError(
                "--target, --own, --quiet and --swap-bands must be left out with --batch"
            )
        defaults = {
            "level_db_sl": level,
            "mode": drive_mode,
            "envelopes": envelopes,
        }
        _query_batch(table_file, batch, defaults)
        return
    no_target = (
        "targets must be at least one, got none; give --target X,Y or --own X,Y, metres, or "
        "--batch FILE"
    )
    for is_wrong, said in (
        (swap_bands and not own, "--swap-bands must be given with --own"),
        (own and target, "--own must be given without --target"),
        (not (target or own), no_target),
    ):
        if is_wrong:
            raise InputError(said)
    given = {
        "targets": [parse_point(text, what="--target") for text in target or []],
        "own": [_own(text) for text in own or []],
        "quiet": [parse_point(text, what="--quiet") for text in quiet or []],
        "mode": drive_mode,
        "envelopes": envelopes,
        "bands_may_swap": swap_bands,
    }
    line = {key: value for key, value in given.items() if value} | {"level_db_sl": level}
    table = load_table(table_file)
    answer = query_one(table, line)
    rows = [
        *_rows_of_layers(answer),
        *_rows_of_fingers(answer),
        *_rows_of_measures(answer),
        "promised: what nine of ten plates within the rig's uncertainty give "
        f"({table.uncertainty})",
        f"solved in {1000 * answer['solve_time_s']:.1f} ms",
    ]
    print_report(rows, answer, as_json=as_json)


def _rows_of_layers(found: dict[str, Any]) -> Iterator[str]:
    """Yield the drive of each layer; beside others it is given by its frequency alone."""
    if len(found["layers"]) != 1:
        return
    (layer,) = found["layers"]
    for era, tone in layer["drive"].items():
        yield (
            f"{era:4s} {tone['frequency_hz']:7.2f} Hz  level {tone['level']:.4f}  "
            f"phase {tone['phase_deg']:.1f}°"
        )
    if layer["is_level_extrapolated"]:
        yield "level: the threshold is extrapolated at this frequency"


def _rows_of_fingers(found: dict[str, Any]) -> Iterator[str]:
    """Yield what each finger feels, and what was changed."""
    from model.answer.answer import verdict_shown

    yield "finger [m]         frequency       level    contrast  nominal  foreign level    exposure"
    for finger in found["fingers"]:
        layer = finger["layer"]
        frequency = None if layer is None else found["layers"][layer]["frequency_hz"]
        yield (
            f"{_place(finger):18s} {_cell(frequency, 'Hz'):>9s} "
            f"{_cell(finger['promised_level_db_sl'], 'dB SL'):>11s} "
            f"{_cell(finger['promised_contrast_db'], 'dB'):>11s} "
            f"{_cell(finger['contrast_db'], 'dB'):>8s} "
            f"{_cell(finger['foreign_level_db_sl'], 'dB SL'):>14s} "
            f"{finger['exposure_m_s2']:6.2f} m/s²  "
            f"{verdict_shown(finger['verdict'], is_foreign_felt=finger['is_foreign_felt'])}"
        )
    if found["promised_worst_db"] is not None:
        yield f"worst finger: {found['promised_worst_db']:.1f} dB promised"
    for line in found["applied"]:
        yield f"changed: {line}"


def _rows_of_measures(found: dict[str, Any]) -> Iterator[str]:
    """Yield what is computed of one vibration besides."""
    if "residual_db" not in found:
        return
    rows = [("residual after the end", found["residual_db"], "dB nominal")]
    if (awareness := found["is_imperceptible_to_quiet"]) is not None:
        rows.append(("contrast in the first 100 ms", found["transient_contrast_db"], "dB nominal"))
        yield f"quiet fingers: {'feel nothing' if awareness else 'may feel it'}"
    else:
        rows += [
            (
                "contrast to rest of the plate",
                found["layers"][0]["contrast_to_plate_db"],
                "dB nominal",
            ),
            ("  to its 95th percentile", found["surroundings_contrast_95_db"], "dB nominal"),
            ("area above half the target", 1e4 * found["area_above_half_m2"], "cm²"),
            ("energy within 5 cm", 100 * found["energy_share_near"], "%"),
        ]
    for name, value, unit in rows:
        yield f"{name:30s} {value:z6.1f} {unit}"


def _own(text: str) -> dict[str, Any]:
    """A finger with a content of its own, of X,Y[@LOW-HIGH]."""
    place, separator, band = text.partition("@")
    at = parse_point(place, what="--own")
    return {"at": at, "band_hz": _band(band)} if separator else {"at": at}


def _band(text: str) -> tuple[float, float]:
    """Lowest and highest frequency [Hz] of LOW-HIGH, or of one frequency."""

    low, separator, high = text.partition("-")
    try:
        return float(low), float(high if separator else low)
    except ValueError:
        raise InputError(
            "band of --own must be LOW-HIGH or a single frequency in Hz, such as @40-120 or @110, "
            f"got {text!r}"
        ) from None


def _place(finger: dict[str, Any]) -> str:
    x, y = finger["at_m"]
    return f"({x:g}, {y:g})"


def _cell(value: float | None, unit: str = "") -> str:
    return "-" if value is None else f"{value:.1f} {unit}".rstrip()


def _query_batch(table_file: Path, batch: Path, defaults: dict[str, Any]) -> None:
    """Answer line by line; exit with 1 at the end if a line had no answer.

    defaults: of keys that lines leave out.
    """
    from model.answer.answer_report import query_batch
    from model.table.file import load_table
    from registry.files import regular_file

    table = load_table(table_file)
    has_failed = False
    is_piped = batch == Path("-")
    try:
        with (
            nullcontext(sys.stdin)
            if is_piped
            else open(batch, encoding="utf-8", opener=regular_file)
        ) as lines:
            bounded = iter(partial(lines.readline, _MAX_LINE), "")
            for answer in query_batch(table, bounded, defaults):
                has_failed = has_failed or "error" in answer
                print(json.dumps(answer), flush=is_piped)
    except BrokenPipeError:
        raise  # of who reads the answers
    except OSError as error:
        raise InputError(
            f"--batch {batch} cannot be read: {error.strerror}; give a file of JSON lines"
        ) from error
    except UnicodeDecodeError as error:
        raise InputError(f"--batch {batch} must be UTF-8; save it as UTF-8") from error
    if has_failed:
        raise typer.Exit(1)
