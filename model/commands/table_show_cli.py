"""`era table show` and `era table verify`: what is in a table, and whether it is true."""

import json
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from model.commands.next_line import next_line
from model.commands.plate_cli import JsonOption, RigArgument
from model.commands.table_cli import TableArgument

if TYPE_CHECKING:
    from model.table.verify import Verification
    from model.table.weak_cells import WeakCells


def show(
    table_file: TableArgument,
    weak: Annotated[bool, typer.Option("--weak", help="List every weak cell.")] = False,
    as_json: JsonOption = False,
) -> None:
    """What is in a table: levels, weak cells, contrast. And how it was built."""
    from model.commands.progress import progress_bar
    from model.table.file import load_table
    from model.table.summary import summarize
    from model.table.weak_cells import find_weak_cells

    table = load_table(table_file)
    started = time.perf_counter()
    with progress_bar("cells") as progress:
        cells = find_weak_cells(table, progress=progress)
    with progress_bar("contact sets") as progress:
        summary = summarize(table, cells, progress=progress)
    elapsed = time.perf_counter() - started
    if as_json:
        print(json.dumps(summary | {"map": _map_as_json(cells)}))
        return
    _show_summary(summary)
    print()
    _show_map(cells, listed=weak)
    print(f"judged in {elapsed:.1f} s")
    print(_a_question(table_file, summary["plate_m"]))


def verify(
    table_file: TableArgument,
    rig_file: RigArgument,
    samples: Annotated[int, typer.Option(min=1, max=10_000, help="Answers to recompute.")] = 12,
    seed: Annotated[int, typer.Option(min=0, help="Of what is sampled.")] = 0,
    as_json: JsonOption = False,
) -> None:
    """Recompute a sample by the reference solver and in time. Exit status 1 on a miss."""
    from model.commands.progress import progress_bar
    from model.errors import InputError
    from model.files.replacing import begins_with
    from model.rig.file import load_rig
    from model.table.file import ZIP, load_table
    from model.table.verify import verify_table

    if begins_with(rig_file, ZIP) and not begins_with(table_file, ZIP):
        raise InputError(
            f"{rig_file} is a table and {table_file} is none: the table comes first, then the rig: "
            f"era table verify {rig_file} {table_file}"
        )
    rig = load_rig(rig_file)
    table = load_table(table_file, fingerprint=rig.fingerprint)
    started = time.perf_counter()
    with progress_bar("answers") as progress:
        found = verify_table(table, rig, samples=samples, seed=seed, progress=progress)
    elapsed = time.perf_counter() - started
    if as_json:
        print(json.dumps(_verification_as_json(found) | {"seed": seed, "verify_time_s": elapsed}))
    else:
        _show_verification(found)
        count = len(found.content) + len(found.answers)
        print(f"{count - found.misses} of {count} hold (seed {seed}), in {elapsed:.1f} s")
        if found.misses:
            print(next_line("era", "table", "build", rig_file, "-o", table_file))
    if found.misses:
        raise typer.Exit(1)


def _a_question(table_file: Path, plate: list[float]) -> str:
    """A first question to a table: one finger a quarter across the plate, another three."""
    length, width, _ = plate
    quarter, across = (f"{part * length:.3g},{part * width:.3g}" for part in (0.25, 0.75))
    return next_line("era", "table", "query", table_file, "--target", quarter, "--quiet", across)


def _show_summary(summary: dict[str, Any]) -> None:
    def percent(key: str) -> str:
        return "-" if summary[key] is None else f"{100 * summary[key]:.3g} %"

    def decibels(key: str) -> str:
        return "-" if summary[key] is None else f"{summary[key]:.1f} dB"

    low, high = summary["frequencies_hz"]
    length, width, thickness = (1000 * side for side in summary["plate_m"])
    contrast = [
        (
            f"contrast to {others} other{'s' if others > 1 else ''}",
            f"median {decibels(f'contrast_{others}_quiet_median_db')}, one in ten below "
            f"{decibels(f'contrast_{others}_quiet_tenth_percentile_db')}",
        )
        for others in (1, 2, 3)
    ]
    rows = [
        ("plate", f"{length:g} x {width:g} x {thickness:g} mm"),
        ("ERAs", ", ".join(summary["eras"])),
        ("frequencies", f"{summary['frequency_count']} from {low:g} to {high:g} Hz"),
        ("mode", f"{summary['mode']}, unless a query or a daemon asks for another"),
        ("patterns", f"{summary['patterns']} of one or two ERAs"),
        ("cells", f"{summary['cells']} ({summary['grid']})"),
        ("feasible cells", f"{percent('feasible_share')} (12 dB to the median other finger)"),
        ("weak cells", f"{percent('weak_share')} (less than 12 dB to one other finger in ten)"),
        ("dead zones", f"{percent('dead_zone_share')} (below 12 dB SL at full stroke)"),
        ("least level", f"{summary['least_level_at_full_stroke_db_sl']:.1f} dB SL at full stroke"),
        *contrast,
        ("patterns alike", f"{percent('alike_pattern_pairs_share')} of pairs (correlation > 0.95)"),
        (
            "mesh",
            f"{summary['mesh']}, fields within {summary['discretisation_error_percent']:.3g} % of "
            f"{summary['reference_mesh']}",
        ),
        ("raster", summary["raster"]),
        ("built by", f"era-haptics {summary['code_version']}"),
        ("fingerprint", summary["fingerprint"]),
    ]
    for name, value in rows:
        print(f"{name:20s} {value}")


def _show_map(cells: "WeakCells", *, listed: bool) -> None:
    from model.table.weak_cells import text_map

    print("contrast in dB from each cell to the median other finger; * marks weak cells")
    for line in text_map(cells):
        print(line)
    if listed:
        print()
        print("weak cells: centre, contrast to the median other finger, to one in ten")
        for (x, y), median, tenth in zip(
            cells.centres[cells.weak],
            cells.median_db[cells.weak],
            cells.tenth_db[cells.weak],
            strict=True,
        ):
            print(f"({x:.4f}, {y:.4f}) m {median:7.1f} dB {tenth:7.1f} dB")


def _map_as_json(cells: "WeakCells") -> dict[str, Any]:
    return {
        "grid": str(cells.grid),
        "centres_m": cells.centres.tolist(),
        "median_contrast_db": _numbers(cells.median_db.tolist()),
        "tenth_percentile_contrast_db": _numbers(cells.tenth_db.tolist()),
        "is_weak": cells.weak.tolist(),
        "is_feasible": cells.feasible.tolist(),
    }


def _numbers(values: list[float]) -> list[float | None]:
    """JSON has no infinity and nothing that is not a number."""
    return [value if abs(value) < float("inf") else None for value in values]


def _show_verification(found: "Verification") -> None:
    for check in found.content:
        print(
            f"{check.what:24s} {check.error:8.1e} relative L2 to the direct solve  "
            f"{_verdict(check.holds)}"
        )
    print()
    print("                       level, dB SL         contrast, dB")
    print("target, m        quiet  predicted  direct  predicted  direct  in time   tolerances")
    for answer in found.answers:
        x, y = answer.question.targets[0]
        print(
            f"({x:.3f}, {y:.3f})  {len(answer.question.quiet):5d}  "
            f"{answer.pattern.level_db_sl:9.2f} {answer.direct_level_db_sl:7.2f}  "
            f"{answer.predicted_contrast_db:9.2f} {answer.direct_contrast_db:7.2f}  "
            f"{answer.contrast_in_time_db:7.2f}   "
            f"{answer.level_tolerance_db:.2f} {answer.contrast_tolerance_db:.2f} "
            f"{answer.time_tolerance_db:.2f}  {_verdict(answer.holds)}"
        )


def _verdict(holds: bool) -> str:
    return "holds" if holds else "MISS"


def _verification_as_json(found: "Verification") -> dict[str, Any]:
    return {
        "content": [
            {"what": check.what, "relative_error": check.error, "holds": check.holds}
            for check in found.content
        ],
        "answers": [
            {
                "target_m": list(answer.question.targets[0]),
                "quiet_m": [list(place) for place in answer.question.quiet],
                "predicted_level_db_sl": answer.pattern.level_db_sl,
                "direct_level_db_sl": answer.direct_level_db_sl,
                "level_tolerance_db": answer.level_tolerance_db,
                "predicted_contrast_db": answer.predicted_contrast_db,
                "direct_contrast_db": answer.direct_contrast_db,
                "contrast_tolerance_db": answer.contrast_tolerance_db,
                "contrast_in_time_db": answer.contrast_in_time_db,
                "time_tolerance_db": answer.time_tolerance_db,
                "holds": answer.holds,
            }
            for answer in found.answers
        ],
        "misses": found.misses,
    }
