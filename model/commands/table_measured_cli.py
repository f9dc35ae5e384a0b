"""`era table verify --device`: promised and measured contrast, printed and drawn."""

import json
import time
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from model.commands.options import progress_bar
from model.counting import counted
from model.errors import InputError
from model.files.replacing import check_picture

if TYPE_CHECKING:
    from model.table.promise_at_sensors import MeasuredVerification
    from model.table.table_check import CheckSettings


def verify_by_measuring(
    table_file: Path,
    rig_file: Path | None,
    settings: "CheckSettings",
    *,
    picture: Path | None,
    as_json: bool,
) -> None:
    """Measure promises of a table; exit with 1 where too few are kept."""
    from model.rig.file import load_rig
    from model.table.file import load_table
    from model.table.table_check import check_by_measuring, plain_rig

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
        table = load_table(table_file, fingerprint=rig.fingerprint)
    started = time.perf_counter()
    with progress_bar("patterns") as progress:
        found = check_by_measuring(table, rig, settings, progress=progress)
    elapsed = time.perf_counter() - started
    files = []
    if picture is not None:
        from model.figures import save_figure
        from model.figures.promise_picture import promise_figure

        save_figure(promise_figure(found), picture)
        files.append(str(picture))
    if as_json:
        report = found.as_json() | {"seed": settings.seed, "verify_time_s": elapsed}
        print(json.dumps(report | {"files": files}))
    else:
        _show(found)
        print(
            f"{counted(len(found.measured), 'pattern')} measured in {elapsed:.1f} s "
            f"(seed {settings.seed})"
        )
        if files:
            print(f"wrote {', '.join(files)}")
    if not found.is_passed:
        raise typer.Exit(1)


def _show(found: "MeasuredVerification") -> None:
    print("                                    felt contrast, dB            level, dB SL")
    print("target  quiet                  promised   median  measured  promised  measured")
    for each in found.measured:
        target, *quiet = each.promise.sensors
        print(
            f"{target:7s} {', '.join(quiet):20s} {each.promise.contrast_db:10.1f} "
            f"{each.promise.median_db:8.1f} {each.contrast_db:9.1f} "
            f"{each.promise.level_db_sl:9.1f} {each.level_db_sl:9.1f}  "
            f"{'kept' if each.is_kept else 'BROKEN'}"
        )
    print(
        f"promised contrast kept by {100 * found.kept_share:.0f} % of the patterns, nine of ten "
        f"are expected  {'passed' if found.is_passed else 'FAILED'}"
    )
