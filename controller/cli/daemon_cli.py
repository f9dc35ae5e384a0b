"""`era daemon`, and the commands that are its clients.

Clients: `status`, `arm`, `disarm`, `stop`, `clear`, `reload`, `strength`, `touch`, `watch`,
`layout use`.
"""

import json
import re
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperCommand

from drivers.by_hand.cli import EXIT_STATUS
from drivers.errors import CommandRefused, LinkError
from model.commands.options import JsonOption, print_report
from model.errors import InputError
from registry.plugins import did_you_mean

if TYPE_CHECKING:
    from controller.api.client import Client
    from controller.api.methods import ArmResult
    from model.arrays import Point

Socket = Annotated[
    Path | None,
    typer.Option(
        "--socket", metavar="PATH", help="Socket of the daemon. Default: its default path."
    ),
]

DASHBOARD = "127.0.0.1:8137"
"""Default address of the page, same as for `era gateway`."""

_DEFAULT_TOPICS = ["state", "contacts", "pattern", "silence", "link", "log", "inputs"]
"""Default topics of `era watch`: all except periodic ones and the layout."""

_MORE_TOPICS = ["amplifiers", "latency", "strength", "layout"]

_RELOAD_TIMEOUT = 130.0  # s; the daemon gives up after 60 s, and another reload can come first
_REPEAT_INTERVAL = 0.05  # s; a touch that is not repeated for 150 ms is lifted
_MOVE_INTERVAL = 0.02  # s; of a moving finger's positions


class DashboardCommand(TyperCommand):
    """Makes the value of `--dashboard` optional."""

    def parse_args(self, context: Any, arguments: list[str]) -> list[str]:
        """Insert the default address after a `--dashboard` without one."""
        filled = []
        for argument, following in zip_longest(arguments, arguments[1:], fillvalue=""):
            filled.append(argument)
            if argument == "--dashboard" and not re.search(r":\d+$", following):
                filled.append(DASHBOARD)
        return super().parse_args(context, filled)


def daemon(
    config: Annotated[
        Path,
        typer.Argument(
            metavar="CONFIG", help="Daemon file; era config init FILE --kind daemon creates one."
        ),
    ],
    check: Annotated[
        bool,
        typer.Option("--check", help="Check the file and all files it names, without amplifiers."),
    ] = False,
    dashboard: Annotated[
        str | None,
        typer.Option(
            metavar="[HOST:PORT]",
            help=f"Serve the dashboard from a separate process; default: {DASHBOARD}.",
        ),
    ] = None,
    trace: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Append every frame on the wires to a file."),
    ] = None,
) -> None:
    """Run the daemon that drives a plate; starts disarmed."""
    from controller.daemon.daemon import check_daemon, run_daemon

    if check:
        typer.echo(check_daemon(config))
        return
    if dashboard is not None:
        from controller.gateway.gateway_settings import require_gateway

        require_gateway()
    run_daemon(config, dashboard=dashboard, trace=trace)


def status(socket: Socket = None, as_json: JsonOption = False) -> None:
    """The exit status is 0 even in a fault state."""

    with connected(socket) as era:
        status = era.status()
    from controller.cli.status_text import show_status

    typer.echo(status.model_dump_json() if as_json else show_status(status))


def arm(
    lease: Annotated[
        float,
        typer.Option(
            metavar="S", min=1, max=60, help="Duration of the lease in s without renewal."
        ),
    ] = 10.0,
    owner: Annotated[str, typer.Option(help="Name shown to other clients.")] = "era arm",
    once: Annotated[
        bool, typer.Option("--once", help="Exit immediately and let the lease expire.")
    ] = False,
    socket: Socket = None,
    as_json: JsonOption = False,
) -> None:
    """Keeps running to renew the lease; Ctrl-C disarms."""
    with connected(socket) as era:
        if once:
            granted = era.arm(owner, lease_s=lease)
            _print_lease(granted, f"for {granted.lease_s:g} s", as_json=as_json)
            return
        try:
            with era.armed(owner, lease_s=lease) as granted:
                _print_lease(granted, "until Ctrl-C", as_json=as_json)
                for _ in era.events():  # no topics: ends only by LeaseLost
                    pass
        except KeyboardInterrupt:
            if not as_json:
                typer.echo("ready: disarmed")


def of_method(method: str) -> Callable[..., None]:
    """Make a command that calls an API method and prints the resulting state."""

    def call(socket: Socket = None, as_json: JsonOption = False) -> None:
        from controller.api.schema import headline

        with connected(socket) as era:
            getattr(era, method)()
            status = era.status()
            answer = {"state": status.state, "cause": status.cause, "remedy": status.remedy}
            print_report([headline(status.state, status.cause)], answer, as_json=as_json)

    return call


def strength(
    name: Annotated[
        str | None,
        typer.Argument(
            metavar="[SOURCE|CLIENT|REGION]",
            help="Name whose strength to set or show. Default: show all.",
        ),
    ] = None,
    gain_db: Annotated[
        float | None,
        typer.Argument(
            metavar="[DB]", help="Strength in dB, -40 to 0. Default: show the current strength."
        ),
    ] = None,
    socket: Socket = None,
    as_json: JsonOption = False,
) -> None:
    """0 dB is the level that layout and limits allow."""
    with connected(socket) as era:
        if name is None:
            strengths = era.status().strengths
        else:
            strengths = era.strength(name, gain_db).strengths
    lines = [f"{gain_name}: {gain:g} dB" for gain_name, gain in strengths.items()]
    print_report(lines, {"strengths": strengths}, as_json=as_json)


def touch(
    at: Annotated[
        list[str],
        typer.Argument(metavar="X,Y[:X,Y] ...", help="Position or path of each finger, in meters."),
    ],
    duration: Annotated[
        float, typer.Option("--for", metavar="S", min=0, max=3600, help="Duration in s.")
    ] = 1.0,
    socket: Socket = None,
    as_json: JsonOption = False,
) -> None:
    """Put fingers on the plate for a while, and show the status.

    A finger with several points moves along the lines between them, at constant speed, as in `era
    touch 0.05,0.18:0.30,0.18 --for 2`. Each finger feels the layout's effect at its position.
    Without a layout, the last finger feels a buzz and the others are quiet.
    """
    from model.commands.options import parse_point

    paths = []
    for text in at:
        paths.append([parse_point(point, what="era touch") for point in text.split(":")])
    with connected(socket) as era:
        plate = era.hello("era").rig
        for path in paths:
            _check_on_plate(path, length=plate.length_m, width=plate.width_m)
        started_at = time.monotonic()
        _report_fingers(era, paths, started_at, duration, until=duration / 2)
        status = era.status()  # right after a touch, whose contact lasts for 150 ms
        _report_fingers(era, paths, started_at, duration, until=duration)
        era.touch([], source="era touch")
    from controller.cli.status_text import show_status

    typer.echo(status.model_dump_json() if as_json else show_status(status))


def _check_on_plate(path: Sequence["Point"], *, length: float, width: float) -> None:
    """Raise InputError for points outside the plate, which the daemon would only count."""
    from model.config.units import in_meters

    for x, y in path:
        if 0 <= x <= length and 0 <= y <= width:
            continue
        remedy = in_meters(x, y, length=length, width=width)
        remedy = remedy or "; coordinates start at its south-west corner"
        raise InputError(
            f"era touch must be on the plate of {length:g} m by {width:g} m, "
            f"got {x:g},{y:g}{remedy}"
        )


def _report_fingers(
    era: "Client",
    paths: Sequence[Sequence["Point"]],
    started_at: float,
    duration: float,
    *,
    until: float,
) -> None:
    """Report the fingers of `era touch` repeatedly, and once more at the end.

    started_at: of time.monotonic() [s]; until [s]: time since then; duration [s]: of a whole path.
    """
    is_moving = any(len(path) > 1 for path in paths)
    interval = _MOVE_INTERVAL if is_moving else _REPEAT_INTERVAL
    while True:
        elapsed = min(time.monotonic() - started_at, until)
        share = elapsed / duration if duration else 0.0
        era.touch([position_on(path, share) for path in paths], source="era touch")
        if elapsed >= until:
            return
        time.sleep(min(until - elapsed, interval))


def position_on(path: Sequence["Point"], share: float) -> "Point":
    """Return the position [m] on straight lines between points, after a share of their length."""
    import numpy as np

    points = np.array(path)
    steps = np.diff(points, axis=0)
    lengths = np.hypot(*steps.T)
    distances = np.append(0.0, np.cumsum(lengths))
    x, y = [float(np.interp(share * distances[-1], distances, column)) for column in points.T]
    return x, y


def watch(
    topics: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[TOPIC ...]",
            help=f"Default: {', '.join(_DEFAULT_TOPICS)}; also {', '.join(_MORE_TOPICS)}.",
        ),
    ] = None,
    rate: Annotated[
        float,
        typer.Option(
            min=1, max=60, help="Rate of the topics amplifiers, latency and strength in Hz."
        ),
    ] = 1,
    socket: Socket = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON object per line.")
    ] = False,
) -> None:
    """Print events until Ctrl-C."""
    from typing import cast

    from controller.api.methods import TOPICS
    from controller.api.schema import Topic

    selected = topics or _DEFAULT_TOPICS
    unknown = [topic for topic in selected if topic not in TOPICS]
    if unknown:
        raise InputError(
            f"unknown topic {unknown[0]!r}; {did_you_mean(unknown[0], TOPICS)}"
            f"choose from {', '.join(TOPICS)}"
        )
    with connected(socket) as era:
        era.subscribe(*cast("list[Topic]", selected), rate_hz=rate)
        now = era.status()
        for event in era.events():
            if as_json:
                head = {"topic": event.topic, "time_s": event.time, "lost": event.lost}
                typer.echo(json.dumps({**head, "data": event.data}))
            else:
                from controller.cli.status_text import show_event

                ahead = now.unix_time_s - now.time_s
                typer.echo(show_event(event, ahead=ahead, threshold=now.threshold))


def reload(socket: Socket = None, as_json: JsonOption = False) -> None:
    """Exit status 1 if the files are rejected; nothing changes in that case."""
    with connected(socket, timeout=_RELOAD_TIMEOUT) as era:
        done = era.reload()
    outcome = "reloaded" if done.reloaded else "rejected; nothing changed"
    rows = [outcome, *(f"  {reason}" for reason in done.reasons)]
    print_report(rows, done.model_dump(), as_json=as_json)
    if not done.reloaded:
        raise typer.Exit(EXIT_STATUS[CommandRefused])


@contextmanager
def connected(socket: Path | None, *, timeout: float | None = None) -> "Iterator[Client]":
    """Connect; translate errors of the daemon to errors with exit status.

    timeout [s]: for each call, the client's own if None.
    """
    from controller.api.client import Client
    from controller.api.jsonrpc import ErrorCode, NotSilent, RpcError
    from controller.api.link import RESPONSE_TIMEOUT

    with Client.connect(socket, name="era", timeout=timeout or RESPONSE_TIMEOUT) as era:
        try:
            yield era
        except RpcError as error:
            if error.code is ErrorCode.LINK or isinstance(error, NotSilent):
                raise LinkError(str(error)) from error
            if error.code is ErrorCode.INVALID_PARAMS:
                raise InputError(str(error)) from error
            raise CommandRefused(str(error)) from error


def _print_lease(granted: "ArmResult", how_long: str, *, as_json: bool) -> None:
    if as_json:
        typer.echo(granted.model_dump_json())
    else:
        typer.echo(f"on: armed {how_long}; era stop stops all amplifiers")


layout_app = typer.Typer(no_args_is_help=True, help="Check or choose surface layouts.")


@layout_app.command()
def use(
    name: Annotated[str, typer.Argument(metavar="NAME", help="One of the daemon's layouts.")],
    socket: Socket = None,
    as_json: JsonOption = False,
) -> None:
    """Switch to another one of the daemon's layouts.

    Continuous effects under resting fingers change immediately.
    """
    with connected(socket) as era:
        used = era.layout(name)
    names = ", ".join(used.layouts)
    print_report([f"layout {used.layout} of {names}"], used.model_dump(), as_json=as_json)
