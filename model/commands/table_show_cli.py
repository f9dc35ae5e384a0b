"""`era table show` and `era table verify`: a table's summary, and its answers by other methods."""

from collections.abc import Iterator, Mapping
from itertools import islice
from typing import TYPE_CHECKING, Annotated, Any

import typer

from model.commands.options import (
    FAILED,
    JsonOption,
    RigArgument,
    Stopwatch,
    TableArgument,
    next_line,
    print_report,
    progress_bar,
)
from model.errors import InputError
from model.files.output_paths import begins_with
from model.quantities import counted

if TYPE_CHECKING:
    from model.study.verification import Verification
    from model.study.weak_cells import WeakCells


_MAX_TOLERANCES = 3  # that are named as limits of the contrast

_MIN_COST = 0.05  # dB of a tolerance that is named


def show(
    table_file: TableArgument,
    weak: Annotated[bool, typer.Option("--weak", help="List every weak cell.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Show a table's levels, weak cells, contrast and origin."""
    from model.study.overview import find_overview, summarize
    from model.study.promise_cost import costs_of_tolerances
    from model.table.table_file import load_table

    table = load_table(table_file)
    with Stopwatch() as timed, progress_bar("questions") as progress:
        overview = find_overview(table, progress=progress)
        costs_db = costs_of_tolerances(table)
    cells = overview.cells
    summary = summarize(table, overview) | {"tolerance_costs_db": costs_db}
    length, width, _ = summary["plate_m"]
    target = f"{0.25 * length:.3g},{0.25 * width:.3g}"
    quiet = f"{0.75 * length:.3g},{0.75 * width:.3g}"
    rows = [
        *_summary_rows(summary, map_grid=str(cells.grid)),
        "",
        *_map_rows(cells, listed=weak),
        f"computed in {timed.elapsed:.1f} s",
        next_line("era", "table", "query", table_file, "--target", target, "--quiet", quiet),
    ]
    print_report(rows, summary | {"map": cells.as_json()}, as_json=as_json)


def _summary_rows(summary: dict[str, Any], *, map_grid: str) -> list[str]:
    """Format the summary of a table; map_grid: cells of the map to which the shares refer."""
    rows = {
        **_content_rows(summary),
        **_cell_rows(summary, map_grid),
        **_contrast_rows(summary),
        **_origin_rows(summary),
    }
    return [f"{name:20s} {value}" for name, value in rows.items()]


def _content_rows(summary: dict[str, Any]) -> dict[str, str]:
    """Return the plate, the frequencies and the patterns of a table, by name."""
    low, high = summary["frequency_range_hz"]
    threshold = str(summary["threshold"])
    measured_to = summary["threshold_measured_to_hz"]
    if high > measured_to:
        threshold += f", extrapolated above {measured_to:g} Hz"
    length, width, thickness = (1000 * side for side in summary["plate_m"])
    return {
        "plate": f"{length:g} x {width:g} x {thickness:g} mm",
        "ERAs": ", ".join(summary["eras"]),
        "frequencies": f"{summary['frequency_count']} from {low:g} to {high:g} Hz",
        "thresholds": threshold,
        "mode": f"{summary['mode']} by default",
        "patterns": f"{summary['patterns']} of one or two ERAs",
        "cells": f"{summary['cells']} ({summary['grid']})",
    }


def _cell_rows(summary: dict[str, Any], map_grid: str) -> dict[str, str]:
    """Return the shares of feasible, weak and dead cells, and the least level, by name."""
    from model.finger import FELT_DB_SL
    from model.study.weak_cells import WANTED_CONTRAST_DB as WANTED_DB

    feasible = _percent(summary["feasible_share"])
    weak = _percent(summary["weak_share"])
    dead = _percent(summary["dead_zone_share"])
    level = summary["least_level_at_full_stroke_db_sl"]
    return {
        "feasible cells": f"{feasible} of {map_grid} ({WANTED_DB:g} dB or more to the median "
        "finger)",
        "weak cells": f"{weak} of {map_grid} (below {WANTED_DB:g} dB to 10 % of fingers)",
        "dead zones": f"{dead} (below {FELT_DB_SL:g} dB SL at full stroke)",
        "least level": f"{level:.1f} dB SL at full stroke",
    }


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{100 * share:.3g} %"


def _contrast_rows(summary: dict[str, Any]) -> dict[str, str]:
    """Return the contrast to one, two and three other fingers, by name."""
    rows = {}
    for count in (1, 2, 3):
        median = _with_error(summary, f"promised_contrast_{count}_quiet_median")
        tenth = _with_error(summary, f"promised_contrast_{count}_quiet_tenth_percentile")
        nominal = _with_error(summary, f"contrast_{count}_quiet_median")
        name = f"contrast to {counted(count, 'other')}"
        rows[name] = f"median {median}, 10 % below {tenth}; nominal {nominal}"
    return rows


def _with_error(summary: dict[str, Any], key: str) -> str:
    """Format a contrast of a summary with its standard error."""
    contrast = summary[f"{key}_db"]
    return "-" if contrast is None else f"{contrast:.1f} ± {summary[f'{key}_error_db']:.1f} dB"


def _origin_rows(summary: dict[str, Any]) -> dict[str, str]:
    """Return the limiting tolerances, the mesh and the origin of a table, by name."""
    error = f"{summary['discretisation_error_percent']:.3g} %"
    return {
        "limited by": _limits_in_words(summary["tolerance_costs_db"]),
        "mesh": f"{summary['mesh_name']}, error of the fields {error}, estimated with "
        f"{summary['reference_mesh']}",
        "raster": summary["raster"],
        "built by": f"era-haptics {summary['code_version']}",
        "fingerprint": summary["fingerprint"],
    }


def _limits_in_words(costs_db: Mapping[str, float]) -> str:
    """Name the tolerances that cost most contrast; costs_db: by key, the most expensive first."""
    largest = []
    for key, cost in islice(costs_db.items(), _MAX_TOLERANCES):
        if cost >= _MIN_COST:
            largest.append(f"{key} {cost:.1f} dB")
    if not largest:
        return "no tolerance of the rig"
    return f"{', '.join(largest)} of promised contrast to 1 other (tolerances of the rig)"


def _map_rows(cells: "WeakCells", *, listed: bool) -> Iterator[str]:
    """Yield the map of a table; listed: with every weak cell."""
    import numpy as np

    from model.study.weak_cells import text_map

    yield "promised felt contrast, dB, to the median other finger; * marks weak cells"
    if np.isfinite(cells.errors_db).any():
        median, tenth = np.sqrt(np.nanmean(cells.errors_db**2, axis=1))
        yield f"± {median:.1f} dB from the sampled other fingers; 10th percentile ± {tenth:.1f} dB"
    yield from text_map(cells)
    if listed:
        yield "\nweak cells: center, contrast to the other finger: median, 10th percentile"
        for (x, y), median, tenth in zip(
            cells.centers[cells.weak],
            cells.median_db[cells.weak],
            cells.tenth_db[cells.weak],
            strict=True,
        ):
            yield f"({x:.4f}, {y:.4f}) m {median:7.1f} dB {tenth:7.1f} dB"


def verify(
    table_file: TableArgument,
    rig_file: RigArgument,
    samples: Annotated[
        int, typer.Option(min=1, max=10_000, help="Number of answers to recompute.")
    ] = 12,
    seed: Annotated[int, typer.Option(min=0, help="Random seed of the sample.")] = 0,
    as_json: JsonOption = False,
) -> None:
    """Verify a table against a direct solution.

    Compares a sample of answers, in the frequency domain and in the time domain. Exits with status
    1 if a check fails.
    """
    from model.rig.rig_file import load_rig
    from model.study.verification import verify_table
    from model.table.table_file import ZIP, load_table

    if begins_with(rig_file, ZIP) and not begins_with(table_file, ZIP):
        raise InputError(
            f"the table must come before the rig: era table verify {rig_file} {table_file}"
        )
    rig = load_rig(rig_file)
    table = load_table(table_file, rig=rig)
    with Stopwatch() as timed, progress_bar("answers") as progress:
        verification = verify_table(table, rig, samples=samples, seed=seed, progress=progress)
    failed = verification.failed_count
    count = len(verification.checks)
    rows = [
        *_verification_rows(verification, table.threshold),
        f"{count - failed} of {count} passed (seed {seed}) in {timed.elapsed:.1f} s",
    ]
    if failed:
        rows.append(next_line("era", "table", "build", rig_file, "-o", table_file))
    answer = verification.as_json() | {"seed": seed, "verify_time_s": timed.elapsed}
    print_report(rows, answer, as_json=as_json)
    if failed:
        raise typer.Exit(FAILED)


def _verification_rows(verification: "Verification", threshold: str) -> Iterator[str]:
    """Yield the checks of a table by solving, and their outcomes; threshold: set of all levels."""
    from model.finger import scale_in_words

    for check in verification.content:
        yield (
            f"{check.name:24s} {check.error:8.1e} relative L2 to the reference  "
            f"{_outcome(check.is_passed)}"
        )
    yield f"\n{scale_in_words(threshold)}"
    yield "                       level, dB SL         felt contrast, dB"
    yield "target, m        quiet  predicted  direct  predicted  direct  in time   tolerances"
    for answer in verification.answer_checks:
        x, y = answer.placed.targets[0]
        yield (
            f"({x:.3f}, {y:.3f})  {len(answer.placed.quiet):5d}  "
            f"{answer.predicted_level_db_sl:9.2f} {answer.direct_level_db_sl:7.2f}  "
            f"{answer.predicted_contrast_db:9.2f} {answer.direct_contrast_db:7.2f}  "
            f"{answer.contrast_in_time_db:7.2f}   "
            f"{answer.level_tolerance_db:.2f} {answer.contrast_tolerance_db:.2f} "
            f"{answer.time_tolerance_db:.2f}  {_outcome(answer.is_passed)}"
        )
    promise = verification.promise
    yield (
        f"\npromised contrast kept on {100 * promise.kept_share:.0f} % of "
        f"{promise.plate_count} plates within the uncertainty  {_outcome(promise.is_passed)}"
    )


def _outcome(is_passed: bool) -> str:
    return "passed" if is_passed else "FAILED"
