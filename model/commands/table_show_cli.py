"""`era table show` and `era table verify`: a table's summary, and checks of its answers.

A table is verified by other methods of solution, or by measuring on the plate itself.
"""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from model.commands.options import (
    JsonOption,
    Stopwatch,
    TableArgument,
    next_line,
    print_report,
    progress_bar,
)
from model.errors import InputError
from model.files.output_paths import begins_with, check_picture
from model.quantities import counted

if TYPE_CHECKING:
    from model.study.contrast_maps import WeakCells
    from model.study.promise_at_sensors import CheckSettings, MeasuredVerification
    from model.study.verification import Verification

check_by_card: "Callable[..., MeasuredVerification] | None" = None
"""Plays promises of a table through a sound card; set by the lab, which knows such cards."""


def show(
    table_file: TableArgument,
    weak: Annotated[bool, typer.Option("--weak", help="List every weak cell.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Show levels, weak cells, contrast and origin of a table."""
    from model.study.overview import find_overview, summarize
    from model.table.table_file import load_table

    table = load_table(table_file)
    with Stopwatch() as timed, progress_bar("questions") as progress:
        overview = find_overview(table, progress=progress)
    summary, cells = summarize(table, overview), overview.cells
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
    from model.study.contrast_maps import WANTED_CONTRAST_DB as WANTED_DB

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
            f"median {with_error(f'promised_contrast_{others}_quiet_median')}, one in ten "
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


def _map_rows(cells: "WeakCells", *, listed: bool) -> Iterator[str]:
    """Yield the map of a table; listed: with every weak cell."""
    import numpy as np

    from model.study.contrast_maps import text_map

    yield "promised felt contrast, dB, to the median other finger; * marks weak cells"
    if np.isfinite(cells.errors_db).any():
        median, tenth = np.sqrt(np.nanmean(cells.errors_db**2, axis=1))
        yield f"± {median:.1f} dB by the choice of other fingers, to one in ten ± {tenth:.1f} dB"
    yield from text_map(cells)
    if listed:
        yield "\nweak cells: centre, contrast to the median other finger, to one in ten"
        for (x, y), median, tenth in zip(
            cells.centres[cells.weak],
            cells.median_db[cells.weak],
            cells.tenth_db[cells.weak],
            strict=True,
        ):
            yield f"({x:.4f}, {y:.4f}) m {median:7.1f} dB {tenth:7.1f} dB"


def verify(
    table_file: TableArgument,
    rig_file: Annotated[
        Path | None,
        typer.Argument(
            metavar="RIG",
            help="Rig file; with --device its wiring, by default ERAs in order; --url needs it.",
        ),
    ] = None,
    device: Annotated[
        str | None,
        typer.Option(metavar="DEVICE", help="Measure instead, through this sound card."),
    ] = None,
    sensors_file: Annotated[
        Path | None,
        typer.Option(
            "--sensors", metavar="SENSORS.csv", help="Accelerometers at its inputs, as of measure."
        ),
    ] = None,
    url: Annotated[
        str | None,
        typer.Option(metavar="URL", help="Amplifier that plays, in place of the sound card."),
    ] = None,
    level: Annotated[
        float | None,
        typer.Option(
            metavar="LEVEL",
            help="Level of the loudest ERA with --device, 0..1 of its stroke: with a RIG half of "
            "what its limits allow by default; without one to be stated, and the limit.",
        ),
    ] = None,
    picture: Annotated[
        Path | None,
        typer.Option(metavar="PROMISED.png", help="Draw promised and measured, with --device."),
    ] = None,
    samples: Annotated[int, typer.Option(min=1, max=10_000, help="Answers to recompute.")] = 12,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the sample.")] = 0,
    as_json: JsonOption = False,
) -> None:
    """Verify a table against a direct solution.

    Solve the plate at each frequency, and in time; with --device play patterns and compare what
    accelerometers measure with what nine of ten plates promise. Exit with 1 if a check fails.
    """
    from model.table.table_file import ZIP

    if rig_file is not None and begins_with(rig_file, ZIP) and not begins_with(table_file, ZIP):
        raise InputError(
            f"the table must come before the rig: era table verify {rig_file} {table_file}"
        )
    if device is not None:
        from model.study.promise_at_sensors import CheckSettings

        if sensors_file is None:
            raise InputError("--sensors is missing: a file of the accelerometers at the inputs")
        if url is not None and rig_file is None:
            raise InputError(
                "the rig is missing, with limits and wiring of the amplifier at --url: "
                f"era table verify {table_file} RIG.yaml --device {device} --url {url}"
            )
        settings = CheckSettings(device, sensors_file, url, samples, seed, level)
        _verify_by_measuring(table_file, rig_file, settings, picture=picture, as_json=as_json)
        return
    for option, given in (("--sensors", sensors_file), ("--url", url), ("--picture", picture)):
        if given is not None:
            raise InputError(f"{option} is of a measurement; give --device too")
    if rig_file is None:
        raise InputError(f"the rig is missing: era table verify {table_file} RIG.yaml")
    _verify_by_solving(table_file, rig_file, samples=samples, seed=seed, as_json=as_json)


def _verify_by_solving(
    table_file: Path, rig_file: Path, *, samples: int, seed: int, as_json: bool
) -> None:
    from model.rig.rig_file import load_rig
    from model.study.verification import verify_table
    from model.table.table_file import load_table

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


def _verify_by_measuring(
    table_file: Path,
    rig_file: Path | None,
    settings: "CheckSettings",
    *,
    picture: Path | None,
    as_json: bool,
) -> None:
    """Measure promises of a table; exit with 1 where too few are kept."""
    from model.rig.rig_file import load_rig
    from model.study.promise_at_sensors import plain_rig
    from model.table.table_file import load_table

    if picture is not None:
        check_picture(picture)
    if rig_file is None:
        if settings.level is None:
            raise InputError(
                "limits must be known: give the rig too, or --level, which no output will exceed; "
                "a table has none"
            )
        table = load_table(table_file)
        rig = plain_rig(table, level=settings.level)
    else:
        rig = load_rig(rig_file)
        table = load_table(table_file, rig=rig)
    assert check_by_card is not None  # noqa: S101  the lab is loaded
    with Stopwatch() as timed, progress_bar("patterns") as progress:
        found = check_by_card(table, rig, settings, progress=progress)
    files = []
    if picture is not None:
        from model.figures import promise_figure, save_figure

        save_figure(promise_figure(found), picture)
        files.append(str(picture))
    rows = [
        *_measured_rows(found, table.threshold),
        f"{counted(len(found.measured), 'pattern')} measured in {timed.elapsed:.1f} s "
        f"(seed {settings.seed})",
        f"wrote {', '.join(files)}" if files else None,
    ]
    answer = {"seed": settings.seed, "verify_time_s": timed.elapsed, "files": files}
    print_report(rows, found.as_json() | answer, as_json=as_json)
    if not found.is_passed:
        raise typer.Exit(1)


def _measured_rows(found: "MeasuredVerification", threshold: str) -> Iterator[str]:
    """Yield what was promised and measured of each pattern; threshold: set of all levels."""
    from model.finger import scale_in_words

    yield scale_in_words(threshold)
    yield "                                    felt contrast, dB            level, dB SL"
    yield "target  quiet                  promised   median  measured  promised  measured"
    for each in found.measured:
        target, *quiet = each.sensors
        yield (
            f"{target:7s} {', '.join(quiet):20s} {each.contrast_db:10.1f} "
            f"{each.median_db:8.1f} {each.measured_contrast_db:9.1f} "
            f"{each.level_db_sl:9.1f} {each.measured_level_db_sl:9.1f}  "
            f"{'kept' if each.is_kept else 'BROKEN'}"
        )
    yield (
        f"promised contrast kept by {100 * found.kept_share:.0f} % of the patterns, nine of ten "
        f"are expected  {'passed' if found.is_passed else 'FAILED'}"
    )
