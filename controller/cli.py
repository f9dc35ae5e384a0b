"""The controller's share of the `era` command: demo."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from drivers.errors import CommandError, CommandRefused, FrameError, LinkError
from model.errors import InputError

if TYPE_CHECKING:
    from controller.demo.rows import TouchRow

app = typer.Typer()

EXIT_STATUS: dict[type[BaseException], int] = {
    InputError: 2,
    CommandError: 2,
    CommandRefused: 1,
    LinkError: 3,
    FrameError: 3,
}
"""Exit status of the errors that these commands raise on purpose."""


@app.callback()
def _controller() -> None:
    """Keep `demo` a command of its own while it is the only one."""


@app.command()
def demo(
    wire: Annotated[
        str,
        typer.Option(
            help="serial (a pseudo-terminal), modbus (TCP), can (socketcand) or sim (no wire)."
        ),
    ] = "serial",
    touches: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="A TUIO capture, or an evemu recording (.events)."),
    ] = None,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for the picture.")] = Path("out"),
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object, nothing else.")] = False,
) -> None:
    """Recorded touches in, felt vibrations out: the whole chain over a simulated plate."""
    import asyncio
    import time

    from controller.demo.run import WIRES, example_touches_path, run_demo, write_picture
    from model.rig_file import example_rig_path, load_rig
    from model.table_cache import cached_table

    if wire not in WIRES:
        raise InputError(f"--wire {wire}: there is no such wire yet; choose {' or '.join(WIRES)}")
    rig_file = example_rig_path()
    rig = load_rig(rig_file)
    started = time.perf_counter()
    table, table_file = cached_table(rig)
    if not as_json:
        print(
            f"{rig_file.name}: {len(table.patterns)} patterns of {len(rig.eras)} ERAs on a mesh "
            f"of {table.mesh}, ready in {time.perf_counter() - started:.1f} s"
        )
        print(_HEADING)
    rows = asyncio.run(
        run_demo(
            rig_file,
            table,
            wire=wire,
            touches=touches or example_touches_path(),
            on_row=lambda row: None if as_json else print(_line(row), flush=True),
        )
    )
    files = write_picture(table, rows, out)
    if as_json:
        print(
            json.dumps(
                {
                    "wire": wire,
                    "touches": [row.as_json() for row in rows],
                    "files": [str(file) for file in files],
                }
            )
        )
        return
    print(_summary(rows))
    for file in files:
        print(f"wrote {file}")
    if table_file is not None:
        print(f"Next: era table show {table_file}")


_HEADING = """\
                                                     contrast / dB       level / dB SL   latency
 time  target / cm  others  ERAs                    predicted measured   pred.  meas.      / ms"""


def _line(row: "TouchRow") -> str:
    x, y = (100 * value for value in row.target)
    start = f"{row.time:5.1f}  {x:5.1f},{y:5.1f}  {len(row.quiet):6d}  "
    played = row.played
    if played is None:
        return f"{start}silent: {row.reason}"
    eras = ", ".join(f"{era} {tone['frequency_hz']:g} Hz" for era, tone in played.drive.items())
    level = played.measured.level_db_sl if played.measured else None
    return (
        f"{start}{eras:24s}"
        f"{_number(played.pattern.contrast_db):>8s} {_number(played.measured_contrast_db):>8s} "
        f"{_number(played.pattern.level_db_sl):>8s} {_number(level):>6s} "
        f"{_number(1000 * played.latency):>9s}{'' if played.is_steady else '  still ringing'}"
    )


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f}"


def _summary(rows: "list[TouchRow]") -> str:
    """How well prediction and measurement agree over the touches that reached the steady state."""
    differences = [
        abs(row.played.pattern.contrast_db - row.played.measured_contrast_db)
        for row in rows
        if row.played is not None
        and row.played.is_steady
        and row.played.pattern.contrast_db is not None
        and row.played.measured_contrast_db is not None
    ]
    counted = f"{len(rows)} touches"
    if not differences:
        return counted
    return (
        f"{counted}; predicted and measured contrast differ by at most {max(differences):.1f} dB "
        f"over the {len(differences)} with other fingers on the plate"
    )
