"""`era table show` and `era table verify`: a table's summary, and its answers by other methods."""

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Annotated, Any

import typer

from model.commands.options import (
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

if TYPE_CHECKING:
    from model.study.verification import Verification
    from model.study.weak_cells import WeakCells


_LIMITS_SHOWN = 3
_SHOWN_FROM = 0.05  # dB


def show(
    table_file: TableArgument,
    weak: Annotated[bool, typer.Option("--weak", help="List every weak cell.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Show a table's levels, weak cells, contrast and origin."""
    from model.study.overview import find_overview, summarize
    from model.study.promise_cost import tolerance_costs
    from model.table.table_file import load_table

    table = load_table(table_file)
    with Stopwatch() as timed, progress_bar("questions") as progress:
        overview = find_overview(table, progress=progress)
        costs = tolerance_costs(table)
    cells = overview.cells
    summary = summarize(table, overview) | {"tolerance_costs_db": costs}
    length, width, _ = summary["plate_m"]
    quarter, across = (f"{part * length:.3g},{part * width:.3g}" for part in (0.25, 0.75))
    rows = [
        *_summary_rows(summary, mapped=str(cells.grid)),
        "",
        *_map_rows(cells, listed=weak),
        f"computed in {timed.elapsed:.1f} s",
        next_line("era", "table", "query", table_file, "--target", quarter, "--quiet", across),
    ]
    print_report(rows, summary | {"map": cells.as_json()}, as_json=as_json)


def _summary_rows(summary: dict[str, Any], *, mapped: str) -> list[str]:
    """Format the summary of a table; mapped: cells of the map that the shares are of."""
    from model.finger import FELT_DB_SL
    from model.study.weak_cells import WANTED_CONTRAST_DB as WANTED_DB

    def percent(key: str) -> str:
        return "-" if summary[key] is None else f"{100 * summary[key]:.3g} %"

    low, high = summary["frequency_range_hz"]
    measured_to = summary["threshold_measured_to_hz"]
    beyond = f", extrapolated above {measured_to:g} Hz" if high > measured_to else ""
    threshold = f"{summary['threshold']}{beyond}"
    length, width, thickness = (1000 * side for side in summary["plate_m"])

    def with_error(key: str) -> str:
        value, error = summary[f"{key}_db"], summary[f"{key}_error_db"]
        return "-" if value is None else f"{value:.1f} ± {error:.1f} dB"

    contrast = [
        (
            f"contrast to {others} other{'s' if others > 1 else ''}",
            f"median {with_error(f'promised_contrast_{others}_quiet_median')}, 10 % "
            f"below {with_error(f'promised_contrast_{others}_quiet_tenth_percentile')}; "
            f"nominal {with_error(f'contrast_{others}_quiet_median')}",
        )
        for others in (1, 2, 3)
    ]
    rows = [
        ("plate", f"{length:g} x {width:g} x {thickness:g} mm"),
        ("ERAs", ", ".join(summary["eras"])),
        ("frequencies", f"{summary['frequency_count']} from {low:g} to {high:g} Hz"),
        ("thresholds", threshold),
        ("mode", f"{summary['mode']} by default"),
        ("patterns", f"{summary['patterns']} of one or two ERAs"),
        ("cells", f"{summary['cells']} ({summary['grid']})"),
        (
            "feasible cells",
            f"{percent('feasible_share')} of {mapped} ({WANTED_DB:g} dB or more to the median "
            "finger)",
        ),
        (
            "weak cells",
            f"{percent('weak_share')} of {mapped} (below {WANTED_DB:g} dB to one finger in ten)",
        ),
        ("dead zones", f"{percent('dead_zone_share')} (below {FELT_DB_SL:g} dB SL at full stroke)"),
        ("least level", f"{summary['least_level_at_full_stroke_db_sl']:.1f} dB SL at full stroke"),
        *contrast,
        ("limited by", _limits_in_words(summary["tolerance_costs_db"])),
        (
            "mesh",
            f"{summary['mesh_name']}, error of the fields "
            f"{summary['discretisation_error_percent']:.3g} %, estimated with "
            f"{summary['reference_mesh']}",
        ),
        ("raster", summary["raster"]),
        ("built by", f"era-haptics {summary['code_version']}"),
        ("fingerprint", summary["fingerprint"]),
    ]
    return [f"{name:20s} {value}" for name, value in rows]


def _limits_in_words(costs_db: Mapping[str, float]) -> str:
    """Name the tolerances that cost most contrast; costs_db: by key, the most expensive first."""
    largest = []
    for key, cost in list(costs_db.items())[:_LIMITS_SHOWN]:
        if cost >= _SHOWN_FROM:
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
            cells.centres[cells.weak],
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
        found = verify_table(table, rig, samples=samples, seed=seed, progress=progress)
    count = len(found.checks)
    rows = [
        *_verification_rows(found, table.threshold),
        f"{count - found.failed_count} of {count} passed (seed {seed}) in {timed.elapsed:.1f} s",
        next_line("era", "table", "build", rig_file, "-o", table_file)
        if found.failed_count
        else None,
    ]
    answer = found.as_json() | {"seed": seed, "verify_time_s": timed.elapsed}
    print_report(rows, answer, as_json=as_json)
    if found.failed_count:
        raise typer.Exit(1)


def _verification_rows(found: "Verification", threshold: str) -> Iterator[str]:
    """Yield the checks of a table by solving, and their outcomes; threshold: set of all levels."""
    from model.finger import scale_in_words

    for check in found.content:
        yield (
            f"{check.name:24s} {check.error:8.1e} relative L2 to the reference  "
            f"{'passed' if check.is_passed else 'FAILED'}"
        )
    yield f"\n{scale_in_words(threshold)}"
    yield "                       level, dB SL         felt contrast, dB"
    yield "target, m        quiet  predicted  direct  predicted  direct  in time   tolerances"
    for answer in found.answer_checks:
        x, y = answer.placed.targets[0]
        yield (
            f"({x:.3f}, {y:.3f})  {len(answer.placed.quiet):5d}  "
            f"{answer.predicted_level_db_sl:9.2f} {answer.direct_level_db_sl:7.2f}  "
            f"{answer.predicted_contrast_db:9.2f} {answer.direct_contrast_db:7.2f}  "
            f"{answer.contrast_in_time_db:7.2f}   "
            f"{answer.level_tolerance_db:.2f} {answer.contrast_tolerance_db:.2f} "
            f"{answer.time_tolerance_db:.2f}  {'passed' if answer.is_passed else 'FAILED'}"
        )
    promise, plates = found.promise, f"{found.promise.plate_count} plates within the uncertainty"
    yield (
        f"\npromised contrast kept on {100 * promise.kept_share:.0f} % of {plates}  "
        f"{'passed' if promise.is_passed else 'FAILED'}"
    )
