"""`era table build`, `query`, `map`, `plot` and `export`: make a localization table and use it."""

import json
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from model.commands.options import (
    FAILED,
    FolderOption,
    JsonOption,
    MeshOption,
    QuietOption,
    RigArgument,
    SizeOption,
    Stopwatch,
    TableArgument,
    figure_size,
    next_line,
    parse_frequencies,
    parse_pair,
    parse_point,
    print_report,
    progress_bar,
)
from model.drive_modes import checked_mode, drive_modes_in_words
from model.errors import InputError
from model.files.output_paths import (
    begins_with,
    check_ending,
    check_picture,
    check_place,
    check_replaceable,
)
from model.quantities import counted

if TYPE_CHECKING:
    from model.study.contrast_maps import ContrastMap
    from model.table.table import LocalizationTable

_MAX_LINE = 1 << 20  # characters of a question in a batch
_MAX_EMPTY = 1000  # lines before the first question

_COARSE_ERROR = 5.0  # % of the fields; the error of a gain is as large

table_app = typer.Typer(help="Build, query and check localization tables.")


def build(
    rig_file: RigArgument,
    output: Annotated[Path, typer.Option("--output", "-o", metavar="TABLE", help="File to write.")],
    frequencies: Annotated[
        str | None,
        typer.Option(
            metavar="LO:HI:STEP",
            help="Frequencies in Hz, both ends included. Default: 40:500:10 within "
            "limits.frequency.",
        ),
    ] = None,
    drive_mode: Annotated[
        str,
        typer.Option(
            "--mode",
            help=f"Default drive mode of queries: {drive_modes_in_words()}.",
        ),
    ] = "phased",
    grid: Annotated[
        str, typer.Option(metavar="NXxNY", help="Number of target cells along x and y.")
    ] = "12x9",
    mesh: MeshOption = None,
    workers: Annotated[int, typer.Option(min=1, max=256, help="Number of processes.")] = 1,
    as_json: JsonOption = False,
) -> None:
    """Solve the plate and write its table."""
    from model.compiled.kernels import why_slow
    from model.finger import Grid
    from model.rig.rig_file import load_rig
    from model.table.table import default_drive_frequencies
    from model.table.table_file import ZIP, TableProblem, save_table, solve_table

    checked_mode(drive_mode, "--mode")
    check_place(output, example="table.npz")
    check_ending(output, ".npz", what="a localization table")
    check_replaceable(output, is_own=begins_with(output, ZIP), what="localization table")
    rig = load_rig(rig_file, mesh=mesh)
    if frequencies:
        drive_frequencies = parse_frequencies(frequencies)
    else:
        drive_frequencies = default_drive_frequencies(rig.limits)
    problem = TableProblem(rig, drive_frequencies, Grid(*parse_pair(grid, what="--grid")))
    with Stopwatch() as timed, progress_bar("parts") as progress:
        table = solve_table(problem, drive_mode=drive_mode, workers=workers, progress=progress)
    save_table(table, output)
    error = 100 * float(table.discretization_error.max())
    if rig.plate.surface is None:
        mesh_row = (
            f"mesh {table.mesh}: error of the fields {error:.3g} %, estimated with "
            f"{table.reference_mesh}"
        )
    else:
        mesh_row = f"{table.mesh}: error of the fields {error:.3g} %, by what others may add"
    rows = [
        f"{counted(table.pattern_count, 'pattern')} of "
        f"{counted(len(table.frequencies), 'frequency', plural='frequencies')} for "
        f"{counted(table.grid.cell_count, 'cell')}, built in {timed.elapsed:.2f} s",
        mesh_row,
        rig.uncertainty_note,
        f"wrote {output} ({output.stat().st_size / 1e6:.1f} MB)",
        next_line("era", "table", "show", output),
    ]
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
        "exactly_known": [*rig.exactly_known],
        "build_time_s": timed.elapsed,
        "files": [str(output)],
    }
    print_report(rows, answer, as_json=as_json)
    for warning in (*rig.surface_notes, _mesh_warning(table), why_slow()):
        if warning:
            typer.echo(f"era: warning: {warning}", err=True)


def _mesh_warning(table: "LocalizationTable") -> str | None:
    """Return a warning if the fields of a table have large errors, else None."""
    from model.structure.surface import WELL_KNOWN

    error = 100 * float(table.discretization_error.max())
    if error < _COARSE_ERROR:
        return None
    if table.plate.surface is None:
        return (
            f"mesh {table.mesh} is coarse: its fields have errors of {error:.3g} %, which lower "
            "the promises; `mesh: auto` chooses a mesh for about 1 %"
        )
    frequency = max(
        WELL_KNOWN * table.frequencies[-1], 2 * table.mesh.highest_frequency(table.plate)
    )
    return (
        f"surface: fields from {table.mesh} have errors of {error:.3g} %, which lower the "
        f"promises; export modes up to {frequency:.0f} Hz"
    )


def query(
    table_file: TableArgument,
    target: Annotated[
        list[str] | None,
        typer.Option(metavar="X,Y", help="Position of a target finger in meters (repeatable)."),
    ] = None,
    quiet: QuietOption = None,
    own: Annotated[
        list[str] | None,
        typer.Option(
            metavar="X,Y[@LOW-HIGH]",
            help="Finger with its own vibration: position in meters and, optionally, a band "
            "LOW-HIGH or one frequency in Hz (repeatable).",
        ),
    ] = None,
    swap_bands: Annotated[
        bool,
        typer.Option("--swap-bands", help="With --own: allow bands to be swapped between fingers."),
    ] = False,
    drive_mode: Annotated[
        str | None,
        typer.Option("--mode", help="Drive mode, as for era table build. Default: the table's."),
    ] = None,
    level: Annotated[
        float, typer.Option(metavar="DB_SL", help="Level at the target, dB SL.")
    ] = 20.0,
    envelopes: Annotated[
        bool, typer.Option("--envelopes", help="Shape onset and ending with envelopes.")
    ] = False,
    batch: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Read queries from FILE (JSON Lines, - for standard input); print one "
            "result per line. Other options set the defaults for missing keys.",
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Find the pattern for target and quiet fingers.

    With --own, find a separate vibration for each of several fingers. Prints frequency, level and
    phase of each ERA, and predicted levels and contrast.
    """
    from model.answer.answer_report import query_one
    from model.table.table_file import load_table

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
    if swap_bands and not own:
        raise InputError("--swap-bands must be given with --own")
    if own and target:
        raise InputError("--own must be given without --target")
    if not (target or own):
        raise InputError(
            "targets must be at least one, got none; give --target X,Y or --own X,Y, meters, or "
            "--batch FILE"
        )
    keys = {
        "targets": [parse_point(text, what="--target") for text in target or []],
        "own": [_own(text) for text in own or []],
        "quiet": [parse_point(text, what="--quiet") for text in quiet or []],
        "mode": drive_mode,
        "envelopes": envelopes,
        "bands_may_swap": swap_bands,
    }
    line = {key: value for key, value in keys.items() if value} | {"level_db_sl": level}
    table = load_table(table_file)
    answer = query_one(table, line)
    rows = [
        *_rows_of_layers(answer),
        *_rows_of_fingers(answer, table.threshold_sets),
        *_rows_of_measures(answer),
        f"≥ and ≤ hold for 90 % of plates within the rig's uncertainty ({table.uncertainty})",
        f"solved in {1000 * answer['solve_time_s']:.1f} ms",
    ]
    print_report(rows, answer, as_json=as_json)


def _own(text: str) -> dict[str, Any]:
    """Parse X,Y[@LOW-HIGH], a finger with its own vibration."""
    position, separator, band = text.partition("@")
    finger: dict[str, Any] = {"at": parse_point(position, what="--own")}
    if separator:
        finger["band_hz"] = _band(band)
    return finger


def _band(text: str) -> tuple[float, float]:
    """Parse LOW-HIGH, or a single frequency, to the lowest and highest frequency [Hz]."""
    low, separator, high = text.partition("-")
    try:
        return float(low), float(high if separator else low)
    except ValueError:
        raise InputError(
            "band of --own must be LOW-HIGH or a single frequency in Hz, such as @40-120 or @110, "
            f"got {text!r}"
        ) from None


def _rows_of_layers(answer: dict[str, Any]) -> Iterator[str]:
    """Yield the drive of a single layer; with several, the fingers' rows show the frequencies."""
    if len(answer["layers"]) != 1:
        return
    (layer,) = answer["layers"]
    for era, tone in layer["drive"].items():
        yield (
            f"{era:4s} {tone['frequency_hz']:7.2f} Hz  level {tone['level']:.4f}  "
            f"phase {tone['phase_deg']:.1f}°"
        )
    if layer["is_level_extrapolated"]:
        yield "level: the threshold is extrapolated at this frequency"


def _rows_of_fingers(answer: dict[str, Any], threshold_sets: Sequence[str]) -> Iterator[str]:
    """Yield one line per finger with its vibration and verdict, then the changes made.

    threshold_sets: names, the rig's set first.
    """
    from model.answer.answer import verdict_shown
    from model.finger import scale_in_words

    yield f"{scale_in_words(threshold_sets[0])}; contrasts are the lowest over all threshold sets"
    yield "finger [m]         frequency     level ≥  contrast ≥  nominal      foreign ≤    exposure"
    for finger in answer["fingers"]:
        layer = finger["layer"]
        frequency = None if layer is None else answer["layers"][layer]["frequency_hz"]
        yield (
            f"{_place(finger):18s} {_cell(frequency, 'Hz'):>9s} "
            f"{_cell(finger['promised_level_db_sl'], 'dB SL'):>11s} "
            f"{_cell(finger['promised_contrast_db'], 'dB'):>11s} "
            f"{_cell(finger['contrast_db'], 'dB'):>8s} "
            f"{_cell(finger['rig_foreign_level_db_sl'], 'dB SL'):>14s} "
            f"{finger['exposure_m_s2']:6.2f} m/s²  "
            f"{verdict_shown(finger['verdict'], is_foreign_felt=finger['is_foreign_felt'])}"
        )
    if answer["promised_worst_db"] is not None:
        yield f"worst finger: at least {answer['promised_worst_db']:.1f} dB"
    for line in answer["applied"]:
        yield f"changed: {line}"


def _rows_of_measures(answer: dict[str, Any]) -> Iterator[str]:
    """Yield the further measures of an answer with one vibration."""
    if "residual_db" not in answer:
        return
    rows = [("residual after the end", answer["residual_db"], "dB nominal")]
    is_imperceptible = answer["is_imperceptible_to_quiet"]
    if is_imperceptible is not None:
        rows.append(("contrast in the first 100 ms", answer["transient_contrast_db"], "dB nominal"))
        effect = "not felt, 10 dB below all threshold sets" if is_imperceptible else "may feel it"
        yield f"quiet fingers: {effect}"
    else:
        rows += [
            (
                "contrast to rest of the plate",
                answer["layers"][0]["contrast_to_plate_db"],
                "dB nominal",
            ),
            ("  to its 95th percentile", answer["surroundings_contrast_95_db"], "dB nominal"),
            ("area above half the target", 1e4 * answer["area_above_half_m2"], "cm²"),
            ("energy within 5 cm", 100 * answer["energy_share_near"], "%"),
        ]
    for name, value, unit in rows:
        yield f"{name:30s} {value:z6.1f} {unit}"


def _place(finger: dict[str, Any]) -> str:
    x, y = finger["at_m"]
    return f"({x:g}, {y:g})"


def _cell(value: float | None, unit: str = "") -> str:
    return "-" if value is None else f"{value:.1f} {unit}".rstrip()


def _query_batch(table_file: Path, batch: Path, defaults: dict[str, Any]) -> None:
    """Answer line by line; exit with 1 at the end if a line had no answer.

    defaults: values for keys that a line leaves out.
    """
    from model.answer.answer_report import query_batch
    from model.table.table_file import load_table

    table = load_table(table_file)
    is_piped = batch == Path("-")
    has_failed = False
    try:
        with _lines_of_batch(batch, is_piped=is_piped) as lines:
            for answer in query_batch(table, lines, defaults):
                has_failed = has_failed or "error" in answer
                print(json.dumps(answer), flush=is_piped)
    except BrokenPipeError:
        raise  # the program that reads the answers has ended
    except OSError as error:
        raise InputError(
            f"--batch {batch} cannot be read: {error.strerror}; give a file of JSON lines"
        ) from error
    except UnicodeDecodeError as error:
        raise InputError(f"--batch {batch} must be UTF-8; save it as UTF-8") from error
    if has_failed:
        raise typer.Exit(FAILED)


@contextmanager
def _lines_of_batch(batch: Path, *, is_piped: bool) -> Iterator[Iterator[str]]:
    """Yield the questions in a file, or on standard input; long lines are cut."""
    from registry.files import regular_file

    if is_piped:
        yield iter(partial(sys.stdin.readline, _MAX_LINE), "")
        return
    with open(batch, encoding="utf-8", opener=regular_file) as file:
        yield _questions_of(batch, iter(partial(file.readline, _MAX_LINE), ""))


def _questions_of(batch: Path, lines: Iterator[str]) -> Iterator[str]:
    """Yield the lines of a file.

    Raises InputError for another kind of file: if the first line with text is no JSON object.
    """
    empty_lines: list[str] = []
    got = "none"
    for line in lines:
        if line.lstrip().startswith("{"):
            return chain(empty_lines, [line], lines)
        if line.strip() or len(empty_lines) > _MAX_EMPTY:
            got = "another kind of file"
            break
        empty_lines.append(line)
    raise InputError(
        f'--batch {batch}: must have a question on each line, such as {{"target": [0.08, 0.06]}}, '
        f"got {got}; give a file of JSON lines"
    )


def contrast_map(
    table_file: TableArgument,
    quiet: Annotated[
        list[str],
        typer.Option(metavar="X,Y", help="Position of a quiet finger in meters (repeatable)."),
    ],
    modes: Annotated[
        str | None,
        typer.Option(metavar="MODE,MODE", help="Drive modes to compare. Default: the table's."),
    ] = None,
    level: Annotated[
        float, typer.Option(metavar="DB_SL", help="Level at each position, dB SL.")
    ] = 20.0,
    grid: Annotated[
        str | None,
        typer.Option(metavar="NXxNY", help="Positions along x and y. Default: the table's cells."),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="FILE", help="Picture (.png .svg .pdf), or .csv."),
    ] = None,
    size: SizeOption = None,
    as_json: JsonOption = False,
) -> None:
    """Map promised contrast between each position and the quiet fingers."""
    from model.finger import Grid
    from model.study.contrast_maps import map_contrast
    from model.table.table_file import load_table

    inches = figure_size(size)
    is_csv = output is not None and output.suffix.lower() == ".csv"
    if output is not None:
        if is_csv:
            check_place(output, example="map.csv")
        else:
            check_picture(output, instead=", or .csv for a table")
    fingers = [parse_point(text, what="--quiet") for text in quiet]
    places = Grid(*parse_pair(grid, what="--grid")) if grid else None
    table = load_table(table_file)
    with Stopwatch() as timed, progress_bar("places") as progress:
        contrast = map_contrast(
            table,
            fingers,
            drive_modes=[mode.strip() for mode in modes.split(",")] if modes else (),
            level_db_sl=level,
            grid=places,
            progress=progress,
        )
    if output is not None and is_csv:
        from model.files.csv_file import write_columns

        write_columns(output, contrast.columns)
    elif output is not None:
        from model.figures.style import save_figure
        from model.figures.table_pictures import contrast_map_figure

        save_figure(contrast_map_figure(table, contrast), output, inches=inches)
    words = [word for text in quiet for word in ("--quiet", text)]
    target = f"{contrast.x[0]:.3g},{contrast.y[0]:.3g}"
    written = "" if output is None else f"; wrote {output}"
    rows = [
        *_map_rows(contrast),
        f"computed in {timed.elapsed:.1f} s{written}",
        next_line("era", "table", "query", table_file, "--target", target, *words),
    ]
    files = [] if output is None else [str(output)]
    answer = contrast.as_json() | {"solve_time_s": timed.elapsed, "files": files}
    print_report(rows, answer, as_json=as_json)


def _map_rows(contrast: "ContrastMap") -> Iterator[str]:
    """Yield a map for each drive mode, largest y first, each with its percentiles."""
    import numpy as np

    for mode, promised in contrast.promised_db.items():
        yield f"{mode}: promised felt contrast to the quiet fingers, dB"
        for row in promised[::-1]:
            yield "".join("   -" if np.isnan(value) else f"{value:4.0f}" for value in row)
        finite = promised[np.isfinite(promised)]
        nominal = contrast.nominal_db[mode]
        if len(finite):
            low, median, high = np.percentile(finite, [10, 50, 90])
            median_nominal = np.median(nominal[np.isfinite(nominal)])
            yield (
                f"median {median:.1f} dB, 10th percentile {low:.1f}, 90th percentile {high:.1f}; "
                f"median nominal {median_nominal:.1f}"
            )
        yield ""


def plot(
    table_file: TableArgument,
    output: FolderOption,
    to: Annotated[
        Literal["png", "svg", "pdf"], typer.Option("--format", help="Format of the pictures.")
    ] = "png",
    size: SizeOption = None,
    as_json: JsonOption = False,
) -> None:
    """Draw a table's weak cells, levels, contrast and a sample answer."""
    from model.figures.style import save_figure
    from model.figures.table_pictures import table_figures
    from model.study.overview import find_overview
    from model.table.table_file import load_table

    inches = figure_size(size)
    table = load_table(table_file)
    output.mkdir(parents=True, exist_ok=True)
    files = []
    with Stopwatch() as timed:
        with progress_bar("questions") as progress:
            overview = find_overview(table, progress=progress)
        for name, figure in table_figures(table, overview):
            path = output / f"{name}.{to}"
            save_figure(figure, path, inches=inches)
            files.append(str(path))
    rows = [
        f"{timed.elapsed:.1f} s; wrote",
        *(f"  {file}" for file in files),
        next_line("era", "table", "show", table_file, "--weak"),
    ]
    print_report(rows, {"files": files}, as_json=as_json)


def export(
    table_file: TableArgument,
    to: Annotated[
        Literal["mat", "csv"],
        typer.Option("--format", help="mat: for MATLAB and Octave; csv: text."),
    ],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="FILE", help="File to write.")],
    content: Annotated[
        Literal["patterns", "fields"] | None,
        typer.Option(
            help="Rows of a CSV file: patterns by finger positions, or fields on the sampling grid."
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Write a table for other programs.

    docs/reference/table-file.md describes the content.
    """
    from model.study.table_export import export_csv, export_mat
    from model.table.table_file import load_table

    if content is not None and to == "mat":
        raise InputError("--content must be left out with --format mat, which holds everything")
    check_place(output, example=f"table.{to}")
    check_ending(output, f".{to}", what=f"a file of --format {to}")
    table = load_table(table_file)
    if to == "mat":
        export_mat(table, output)
        reader = f"load('{output}') in MATLAB or Octave, scipy.io.loadmat in Python"
    else:
        export_csv(table, output, content=content or "patterns")
        reader = f"open {output} in a spreadsheet, or pandas.read_csv('{output}')"
    size = f"{output.stat().st_size / 1e6:.1f} MB"
    rows = [f"wrote {output} ({size})", f"Next: {reader}"]
    print_report(rows, {"files": [str(output)]}, as_json=as_json)
