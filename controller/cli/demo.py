"""`era demo`: the whole chain on a simulated plate."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from controller.cli.daemon_cli import DASHBOARD
from model.commands.options import (
    ExactOption,
    JsonOption,
    SeedOption,
    Stopwatch,
    next_line,
    print_report,
    progress_bar,
    seed_of_plate,
)
from model.errors import InputError
from model.quantities import counted

_MAX_NAMES = 4  # ERA names per row

if TYPE_CHECKING:
    from controller.demo.demonstration import DemoRun, Scene
    from controller.demo.touch_rows import TouchRow
    from model.rig.rig import Rig
    from model.table.table import LocalizationTable


def demo(
    rig_file: Annotated[
        Path | None,
        typer.Argument(
            metavar="RIG", help="Rig file. Default: the founding paper's plate.", show_default=False
        ),
    ] = None,
    *,
    wire: Annotated[
        str | None,
        typer.Option(
            help="Wire to the amplifiers: sim (no wire, in this process), or in real time serial "
            "(pseudo-terminal), modbus (TCP), can (socketcand), firmware (the C amplifier on "
            "serial, after `make firmware`) or cortex-m (the same on an emulated Cortex-M3, in "
            "QEMU). With firmware the plate does not move. Default: sim, or serial in real time.",
            show_default=False,
        ),
    ] = None,
    real_time: Annotated[
        bool,
        typer.Option(
            "--real-time",
            help="Play in real time with the amplifiers in a separate process, and measure "
            "latency.",
        ),
    ] = False,
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
            help=f"Serve a page to touch the plate in a browser. Default: {DASHBOARD}.",
        ),
    ] = None,
) -> None:
    """Play recorded touches on a simulated plate; measure contrast.

    Replays one person with a single target finger, then two people (three with eight or more ERAs),
    each feeling their own vibration. The simulated plate is drawn at random from the rig's
    tolerances (repeatable with --seed). Recorded touches are scaled to the plate. Time is virtual,
    so results do not depend on the machine. With --real-time, --dashboard or a wire other than sim,
    time is real; if the machine is too slow, the run is void and the exit status is 1.
    """
    from controller.demo.demonstration import SIM, WIRES, check_page
    from model.rig.rig_file import example_rig_path, load_rig

    if wire is not None and wire not in WIRES:
        raise InputError(f"--wire must be one of {', '.join(WIRES)}, got {wire}")
    if dashboard is not None and (touches is not None or as_json):
        raise InputError("--dashboard takes its touches from the page; omit --touches and --json")
    is_real_time = real_time or dashboard is not None or wire not in (None, SIM)
    if wire is None:
        wire = "serial" if is_real_time else SIM
    plate_seed = seed_of_plate(exact=exact, seed=seed)
    recording = None if touches is None else _read_touches(touches)
    played_rig = rig_file or example_rig_path()
    played_rig = played_rig.absolute()
    rig = load_rig(played_rig)
    table = _table_of(rig, played_rig, is_quiet=as_json or dashboard is not None)
    if dashboard is not None:
        from controller.gateway.gateway_settings import require_gateway

        require_gateway()
        check_page(dashboard)
        _serve_page(played_rig, table, wire, dashboard, plate_seed)
        return
    run = _play(
        played_rig,
        table,
        wire,
        recording,
        seed=plate_seed,
        is_real_time=is_real_time,
        is_quiet=as_json,
    )
    clock = "real" if is_real_time else "virtual"
    report: dict[str, object] = {"wire": wire, "clock": clock, "void": run.why_void}
    _print_result(run, report, table, out=out, own_rig=rig_file, as_json=as_json)


def _print_result(
    run: "DemoRun",
    report: dict[str, object],
    table: "LocalizationTable",
    *,
    out: Path,
    own_rig: Path | None,
    as_json: bool,
) -> None:
    """Draw the pictures of a run and print its result; exit with status 1 if it is void."""
    from controller.demo.demo_pictures import write_pictures

    report["touches"] = [row.as_json() for row in run.rows]
    if run.why_void is not None:
        print_report(_void_report(run), {**report, "files": []}, as_json=as_json)
        raise typer.Exit(1)
    pictures = write_pictures(table, run.rows, out)
    files = [str(file) for file in pictures.files]
    lines = [_summary(run.rows), *pictures.omitted]
    lines += [f"wrote {file}" for file in files]
    if own_rig is None:
        lines.append(next_line("era", "config", "init", "my_rig.yaml"))
    else:
        lines.append(next_line("era", "table", "build", own_rig, "-o", "table.npz"))
    print_report(lines, {**report, "files": files}, as_json=as_json)


def _read_touches(file: Path) -> "Scene":
    from controller.demo.demonstration import Scene
    from controller.sources.tuio_capture import read_capture

    return Scene(read_capture(file))


def _table_of(rig: "Rig", rig_file: Path, *, is_quiet: bool) -> "LocalizationTable":
    """Return the table of a rig from the cache, or build it; print how long it took.

    Also print whether C kernels or numpy compute the answers.
    """
    from model.compiled.kernels import arithmetic
    from model.table.table_file import cached_table

    with (
        Stopwatch() as timed,
        progress_bar("parts of the table", is_transient=True) as progress,
    ):
        table, _ = cached_table(rig, progress=progress)
    if not is_quiet:
        eras = counted(len(rig.eras), "ERA")
        solver = "on a mesh of" if rig.plate.surface is None else "by"
        print(
            f"{rig_file.name}: table of {eras} {solver} {table.mesh}, ready in "
            f"{timed.elapsed:.1f} s"
        )
        print(arithmetic())
    return table


def _serve_page(
    rig_file: Path, table: "LocalizationTable", wire: str, address: str, seed: int | None
) -> None:
    import asyncio

    from controller.demo.demonstration import run_live

    print("Open the URL below, press Arm, and touch the plate; Ctrl-C ends it.", flush=True)
    asyncio.run(run_live(rig_file, table, wire=wire, dashboard=address, seed=seed))


def _play(
    rig_file: Path,
    table: "LocalizationTable",
    wire: str,
    recording: "Scene | None",
    *,
    seed: int | None,
    is_real_time: bool,
    is_quiet: bool,
) -> "DemoRun":
    """Play a recording (default: the package's own); print a line for each touch."""
    import asyncio

    from controller.demo.demonstration import example_scenes, run_demo
    from model.rig.rig_file import load_rig
    from registry.virtual_time import VirtualTimeLoop

    rig = load_rig(rig_file)
    if not is_quiet:
        print(_heading(rig.threshold, has_latency=is_real_time), end="", flush=True)

    def print_row(row: "TouchRow") -> None:
        if not is_quiet:
            print(_line(row, has_latency=is_real_time), flush=True)

    playing = run_demo(
        rig_file,
        table,
        wire=wire,
        scenes=example_scenes(rig) if recording is None else [recording],
        on_row=print_row,
        seed=seed,
    )
    make_loop = None if is_real_time else VirtualTimeLoop
    with asyncio.Runner(loop_factory=make_loop) as runner:
        return runner.run(playing)


def _heading(threshold: str, *, has_latency: bool) -> str:
    """Return the heading of the rows: groups, units and columns."""
    from model.finger import scale_in_words

    indent = 51 * " "
    groups = f"{indent}{'felt contrast':^13}  {'level':^13}"
    units = f"{indent}{'/ dB':^13}  {'/ dB SL':^13}"
    if has_latency:
        groups += f" {'latency':>7}"
        units += f" {'/ ms':>7}"
    pair = " prom.   sim."
    columns = f" time  target / cm  others  {'ERAs':22} {pair}  {pair}"
    scale = f"{scale_in_words(threshold)}; contrasts are the lowest over all threshold sets"
    return "\n".join([scale, groups.rstrip(), units.rstrip(), columns, ""])


def _line(row: "TouchRow", *, has_latency: bool) -> str:
    """Return the row of a touch: position, tones, promised and measured figures, and notes."""
    x, y = row.targets_m[0]
    others = len(row.fingers) - 1 if row.fingers else len(row.quiet)
    start = f"{row.time_s:5.1f}  {100 * x:5.1f},{100 * y:5.1f}  {others:6d}  "
    if row.reason is not None:
        return f"{start}silent: {row.reason}"
    contrasts = f"{_number(row.promised_contrast_db):>6s} {_number(row.measured_contrast_db):>6s}"
    levels = f"{_number(row.predicted_level_db_sl):>6s} {_number(row.measured_level_db_sl):>6s}"
    line = f"{start}{_tones_text(row):22s} {contrasts}  {levels}"
    if has_latency:
        line += f" {_number(row.latency_ms):>7s}"
    return line + _notes(row)


def _tones_text(row: "TouchRow") -> str:
    """Return the frequencies of a touch, each with its ERAs."""
    eras_by_frequency: dict[float, list[str]] = {}
    for era, tone in row.drive.items():
        eras_by_frequency.setdefault(tone["frequency_hz"], []).append(era)
    tones = [f"{_named(eras)} {frequency:g} Hz" for frequency, eras in eras_by_frequency.items()]
    return ", ".join(tones)


def _notes(row: "TouchRow") -> str:
    """Return notes on an incomplete measurement and on the verdict of the finger."""
    note = ""
    if row.measured_level_db_sl is None:
        note = "  not measured"
        if not row.steady:
            note += f": it played for {row.played_s:.2f} s"
    elif not row.steady:
        note = "  still ringing"
    for finger in row.fingers:
        if finger.at_m == row.targets_m[0]:
            note += f"  {finger.verdict}, of {counted(len(row.contents), 'vibration')}"
    return note


def _named(eras: list[str]) -> str:
    return " ".join(eras) if len(eras) <= _MAX_NAMES else counted(len(eras), "ERA")


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f}"


def _summary(rows: "list[TouchRow]") -> str:
    """Count touches that kept the promise, among touches that reached the steady state."""
    judged = [row for row in rows if row.keeps_promise is not None]
    touches = counted(len(rows), "touch", plural="touches")
    if not judged:
        return touches
    kept_count = sum(bool(row.keeps_promise) for row in judged)
    share = kept_count / len(judged)
    return (
        f"{touches}; with other fingers on the plate, {kept_count} of {len(judged)} "
        f"({share:.0%}) had at least the promised contrast\n"
        "(90 % of plates within the rig's tolerances reach a promise; --seed draws another plate)"
    )


def _void_report(run: "DemoRun") -> list[str]:
    """Report that a run is void, and why."""
    touches = counted(len(run.rows), "touch", plural="touches")
    return [
        f"{touches}; no pictures were drawn; try again on a less busy machine or in virtual time",
        f"void: this machine was too slow ({run.why_void}): the figures do not count",
    ]
