"""Score patterns of any origin on the project's data set.

python -m benchmarks.contrast score FILE
python -m benchmarks.contrast export -o DIR
"""

import json
from pathlib import Path
from typing import Annotated

import typer

from model.commands.options import JsonOption
from model.errors import InputError

app = typer.Typer(help="Score patterns on the contrast benchmark.")


@app.command("score")
def score_entry(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Patterns by contact set, JSON.")],
    in_time: Annotated[
        bool,
        typer.Option("--in-time", help="Also play each pattern on a plate that vibrates in time."),
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Score the patterns of a file on held-out plates.

    The score is the felt contrast that nine of ten of them give.
    """
    from benchmarks.contrast.data_set import VERSION, checksum
    from benchmarks.contrast.entry import read_entry
    from benchmarks.contrast.score import score, summary
    from model.commands.options import progress_bar

    name, excitations = read_entry(file)
    with progress_bar("contact sets") as progress:
        scores = score(excitations, in_time=in_time, progress=progress)
    rows = summary(scores)
    if as_json:
        print(
            json.dumps(
                {
                    "name": name,
                    "version": VERSION,
                    "checksum": checksum(),
                    "rows": rows,
                    "sets": {
                        key: {
                            "contrast_db": each.contrast_db,
                            "level_db_sl": each.level_db_sl,
                            "in_time_db": each.in_time_db,
                        }
                        for key, each in scores.items()
                    },
                }
            )
        )
        return
    print(f"{name}: data set {VERSION}, sha256 {checksum()[:16]}")
    print("plate         quiet  sets  missed  nine of ten / dB  worst tenth / dB  in time / dB")
    for row in rows:
        timed = "-" if row["in_time_db"] is None else f"{row['in_time_db']:.1f}"
        print(
            f"{row['plate']:13} {row['quiet']:5d} {row['sets']:5d} {row['missed']:7d} "
            f"{row['contrast_db']:17.1f} {row['tenth_percentile_db']:17.1f} {timed:>13}"
        )


@app.command("export")
def export_data_set(
    folder: Annotated[
        Path, typer.Option("--output", "-o", metavar="DIR", help="Folder to write into.")
    ],
) -> None:
    """Write the data set and the rig of each plate."""
    from benchmarks.contrast.data_set import FILE, data_set

    folder.mkdir(parents=True, exist_ok=True)
    for name, content in (
        (FILE.name, FILE.read_text(encoding="utf-8")),
        *((f"{each.name}.yaml", each.rig_text) for each in data_set().plates.values()),
    ):
        (folder / name).write_text(content, encoding="utf-8")
        print(f"wrote {folder / name}")


if __name__ == "__main__":
    try:
        app()
    except InputError as error:
        raise SystemExit(f"error: {error}") from None
