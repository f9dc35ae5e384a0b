"""`era demo`: the whole chain on a simulated plate."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from controller.cli.daemon_cli import DASHBOARD
from model.commands.options import (
    ExactOption,
    JsonOption,
    SeedOption,
    next_line,
    print_report,
    seed_of_plate,
)
from model.errors import InputError
from model.quantities import counted

if TYPE_CHECKING:
    from controller.demo.recorder import TouchRow


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
            "amplifier in C on serial, after `make firmware`, whose plate does not move) or sim "
            "(none)."
        ),
    ] = "serial",
    touches: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="TUIO capture."),
    ] = None,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for the pictures.")] = Path(
        "out"
    ),
    exact: ExactOption = False,
    seed: SeedOption = None,
    as_json: JsonOption = False,
    dashboard: Annotated[
        str | None,
        typer.Option(
            metavar="[HOST:PORT]",
            help=f"Serve a page in the browser to touch the plate yourself; default: {DASHBOARD}.",
        ),
    ] = None,
) -> None:
    """Play recorded touches on a simulated plate; measure contrast.

    First one person, of whose fingers one feels it; then two, or on eight ERAs and more three, who
    each feel a vibration of their own. The plate deviates from the table's within the rig's
    uncertainty, the same for the same --seed; recorded places are shares of its size.
    """
    import asyncio
    import time

    from controller.demo.demonstration import (
        WIRES,
        Scene,
        check_page,
        example_scenes,
        run_demo,
        run_live,
        write_pictures,
    )
    from controller.sources.tuio import read_capture
    from model.rig.rig_file import example_rig_path, load_rig
    from model.table.table_file import cached_table

    if wire not in WIRES:
        raise InputError(f"--wire must be one of {', '.join(WIRES)}, got {wire}")
    if dashboard is not None and (touches is not None or as_json):
        raise InputError("--dashboard takes its touches from the page; omit --touches and --json")
    drawn = seed_of_plate(exact=exact, seed=seed)
    recorded = None if touches is None else Scene(read_capture(touches))
    own_rig, rig_file = rig_file, (rig_file or example_rig_path()).absolute()
    rig = load_rig(rig_file)
    started = time.perf_counter()
    table, _ = cached_table(rig)
    if dashboard is not None:
        from controller.gateway.gateway_settings import require_gateway

        require_gateway()
        check_page(dashboard)
        print("Open the URL below, press Arm, and touch the plate; Ctrl-C ends it.", flush=True)
        asyncio.run(run_live(rig_file, table, wire=wire, dashboard=dashboard, seed=drawn))
        return
    if not as_json:
        print(
            f"{rig_file.name}: table of {counted(len(rig.eras), 'ERA')} "
            f"{'on a mesh of' if rig.plate.surface is None else 'by'} {table.mesh}, "
            f"ready in {time.perf_counter() - started:.1f} s"
        )
        print(_HEADING, end="")
    rows = asyncio.run(
        run_demo(
            rig_file,
            table,
            wire=wire,
            scenes=example_scenes(rig) if recorded is None else [recorded],
            on_row=lambda row: None if as_json else print(_line(row), flush=True),
            seed=drawn,
        )
    )
    files = write_pictures(table, rows, out)
    further: tuple[str | Path, ...] = ("config", "init", "my_rig.yaml")
    if own_rig is not None:
        further = ("table", "build", own_rig, "-o", "table.npz")
    answer = {
        "wire": wire,
        "touches": [row.as_json() for row in rows],
        "files": [str(file) for file in files],
    }
    lines = [
        _summary(rows),
        _NO_BUS if wire == "sim" and len(rig.amplifiers) > 1 else None,
        *(f"wrote {file}" for file in files),
        next_line("era", *further),
    ]
    print_report(lines, answer, as_json=as_json)


_NO_BUS = (
    "the amplifiers of wire sim have no bus and start one after the other, which costs contrast; "
    "on --wire serial or can they start together"
)

_HEADING = (
    f"{'':51}{'felt contrast':^13}  {'level':^13} {'latency':>7}\n"
    f"{'':51}{'/ dB':^13}  {'/ dB SL':^13} {'/ ms':>7}\n"
    f" time  target / cm  others  {'ERAs':22} "
    f"{'prom.':>6} {'meas.':>6}  {'prom.':>6} {'meas.':>6}\n"
)

_MAX_NAMES = 4  # of ERAs in a row


def _line(row: "TouchRow") -> str:
    x, y = (100 * value for value in row.targets_m[0])
    others = len(row.fingers) - 1 if row.fingers else len(row.quiet)
    start = f"{row.time_s:5.1f}  {x:5.1f},{y:5.1f}  {others:6d}  "
    if row.reason is not None:
        return f"{start}silent: {row.reason}"
    by_frequency: dict[float, list[str]] = {}
    for era, tone in row.drive.items():
        by_frequency.setdefault(tone["frequency_hz"], []).append(era)
    eras = ", ".join(f"{_named(some)} {hertz:g} Hz" for hertz, some in by_frequency.items())
    pairs = (
        (row.promised_contrast_db, row.measured_contrast_db),
        (row.predicted_level_db_sl, row.measured_level_db_sl),
    )
    figures = "  ".join(f"{_number(one):>6s} {_number(other):>6s}" for one, other in pairs)
    note = "" if row.steady else "  still ringing"
    if row.measured_level_db_sl is None:
        short = "" if row.steady else f": it played for {row.played_s:.2f} s"
        note = f"  not measured{short}"
    for finger in row.fingers:
        if finger.at_m == row.targets_m[0]:
            note += f"  {finger.verdict}, of {counted(len(row.contents), 'content')}"
    return f"{start}{eras:22s} {figures} {_number(row.latency_ms):>7s}{note}"


def _named(eras: list[str]) -> str:
    return " ".join(eras) if len(eras) <= _MAX_NAMES else counted(len(eras), "ERA")


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
        "(nine of ten plates within the rig's uncertainty keep a promise; --seed draws another one)"
    )
