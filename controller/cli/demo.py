"""`era demo` and the group `era rig`."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

import drivers.cli
from controller.cli.layout import layout_app
from controller.cli.rig import rig_app
from model.commands.next_line import next_line
from model.commands.options import ExactOption, SeedOption, seed_of_plate
from model.counting import counted
from model.errors import InputError

if TYPE_CHECKING:
    from controller.demo.touch_row import TouchRow

app = typer.Typer()
app.add_typer(layout_app, name="layout")
app.add_typer(rig_app, name="rig")

EXIT_STATUS = {**drivers.cli.EXIT_STATUS, InputError: 2}
"""Exit status by error class."""


@app.callback()
def _controller() -> None:
    """Keep `demo` a command of its own while it is the only one."""


@app.command()
def demo(
    rig_file: Annotated[
        Path | None,
        typer.Argument(
            metavar="RIG", help="Rig file; without one the paper's plate.", show_default=False
        ),
    ] = None,
    *,
    wire: Annotated[
        str,
        typer.Option(
            help="Wire: serial (a pseudo-terminal), modbus (TCP), can (socketcand), firmware (the "
            "amplifier in C on serial, after `make firmware`) or sim (none)."
        ),
    ] = "serial",
    touches: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="TUIO capture, or evemu recording (.events)."),
    ] = None,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for the picture.")] = Path("out"),
    exact: ExactOption = False,
    seed: SeedOption = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON object and nothing else.")
    ] = False,
    dashboard: Annotated[
        bool,
        typer.Option(
            "--dashboard", help="Serve a page in the browser to touch the plate yourself."
        ),
    ] = False,
    drift: Annotated[
        bool,
        typer.Option("--drift", help="Play an hour in which the plate changes, in virtual time."),
    ] = False,
) -> None:
    """Play recorded touches on a simulated plate; measure contrast.

    The plate deviates from the table's within the rig's uncertainty, the same for the same --seed;
    recorded places are shares of its size. With --drift it is played for an hour of virtual time
    while it warms by 15 K, loosens a mount and gains a sticker, and is identified in service.
    """
    if drift:
        if wire not in ("serial", "sim") or touches is not None or exact or dashboard:
            raise InputError(
                "--drift plays on wire sim; omit --wire, --touches, --exact, and --dashboard"
            )
        _drift(rig_file, out, seed=seed, as_json=as_json)
        return
    import asyncio
    import time

    from controller.demo.run import (
        WIRES,
        example_touches_path,
        read_touches,
        run_demo,
        write_picture,
    )
    from model.rig.file import example_rig_path, load_rig
    from model.table.table_cache import cached_table

    if wire not in WIRES:
        raise InputError(f"--wire must be one of {', '.join(WIRES)}, got {wire}")
    if dashboard and (touches is not None or as_json):
        raise InputError("--dashboard takes its touches from the page; omit --touches and --json")
    drawn = seed_of_plate(exact=exact, seed=seed)
    recorded = read_touches(touches or example_touches_path())
    rig_file = rig_file or example_rig_path()
    rig = load_rig(rig_file)
    started = time.perf_counter()
    table, table_file = cached_table(rig)
    if dashboard:
        from controller.cli.daemon import DASHBOARD
        from controller.demo.live import run_live

        print("Open the URL below, press Arm, and touch the plate; Ctrl-C ends it.", flush=True)
        asyncio.run(run_live(rig_file, table, wire=wire, dashboard=DASHBOARD, seed=drawn))
        return
    if not as_json:
        print(
            f"{rig_file.name}: table of {counted(len(rig.eras), 'ERA')} on a mesh of {table.mesh}, "
            f"ready in {time.perf_counter() - started:.1f} s"
        )
        print(_HEADING, end="")
    rows = asyncio.run(
        run_demo(
            rig_file,
            table,
            wire=wire,
            touches=recorded,
            on_row=lambda row: None if as_json else print(_line(row), flush=True),
            seed=drawn,
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
    if wire == "sim" and len(rig.amplifiers) > 1:
        print(_NO_BUS)
    for file in files:
        print(f"wrote {file}")
    if table_file is not None:
        print(next_line("era", "table", "show", table_file))


def _drift(rig_file: Path | None, out: Path, *, seed: int | None, as_json: bool) -> None:
    import asyncio

    from controller.demo.drift import Event, run_drift
    from controller.demo.drift_picture import write_drift_picture
    from controller.demo.virtual_time import VirtualTimeLoop
    from model.rig.file import example_rig_path

    def show(event: Event) -> None:
        if not as_json:
            print(f"{event.time_s / 60:5.1f} min  {event.kind:11}  {event.text}", flush=True)

    with asyncio.Runner(loop_factory=VirtualTimeLoop) as runner:
        hour = runner.run(run_drift(rig_file or example_rig_path(), seed=seed or 0, on_event=show))
    file = write_drift_picture(hour, out)
    if as_json:
        print(json.dumps({**hour.as_json(), "files": [str(file)]}))
        return
    for change, after in hour.named.items():
        print(f"{change}: " + ("not named" if after is None else f"named after {after:.0f} s"))
    print(f"false alarms: {hour.false_alarms}")
    found = hour.as_json()
    for key, what in (("last_ten_minutes_db", "last ten minutes"), ("end_of_hour_db", "end")):
        figures = ", ".join(f"{way} {value:.1f} dB" for way, value in found[key].items())
        print(f"median contrast, {what}: {figures}")
    print(f"wrote {file}")


_NO_BUS = (
    "the amplifiers of wire sim have no bus and start one after the other, which costs contrast; "
    "on --wire serial or can they start together"
)

_HEADING = (
    f"{'':51}{'felt contrast':^13}  {'contrast / dB':^13}  {'level':^13} {'latency':>7}\n"
    f"{'':51}{'/ dB':^13}  {'first 100 ms':^13}  {'/ dB SL':^13} {'/ ms':>7}\n"
    f" time  target / cm  others  {'ERAs':22} "
    f"{'prom.':>6} {'meas.':>6}  {'pred.':>6} {'meas.':>6}  {'prom.':>6} {'meas.':>6}\n"
)


def _line(row: "TouchRow") -> str:
    x, y = (100 * value for value in row.targets_m[0])
    start = f"{row.time_s:5.1f}  {x:5.1f},{y:5.1f}  {len(row.quiet):6d}  "
    if row.reason is not None:
        return f"{start}silent: {row.reason}"
    by_frequency: dict[float, list[str]] = {}
    for era, tone in row.drive.items():
        by_frequency.setdefault(tone["frequency_hz"], []).append(era)
    eras = ", ".join(f"{' '.join(some)} {hertz:g} Hz" for hertz, some in by_frequency.items())
    pairs = (
        (row.robust_felt_contrast_db, row.measured_felt_contrast_db),
        (row.predicted_transient_contrast_db, row.measured_transient_contrast_db),
        (row.predicted_level_db_sl, row.measured_level_db_sl),
    )
    figures = "  ".join(f"{_number(one):>6s} {_number(other):>6s}" for one, other in pairs)
    latency = f"{_number(row.latency_ms):>7s}"
    return f"{start}{eras:22s} {figures} {latency}{'' if row.steady else '  still ringing'}"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f}"


def _summary(rows: "list[TouchRow]") -> str:
    """Count the touches that kept the promise, of those that reached the steady state."""
    kept = [row.keeps_promise for row in rows if row.keeps_promise is not None]
    touches = counted(len(rows), "touch", plural="touches")
    if not kept:
        return touches
    return (
        f"{touches}; of {len(kept)} with other fingers on the plate {sum(kept)} "
        f"({sum(kept) / len(kept):.0%}) felt at least the contrast promised\n"
        "(promised: what nine of ten plates within the rig's uncertainty give)"
    )
