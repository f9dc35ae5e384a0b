"""`era daemon`, and its clients: `era status`, `arm`, `disarm`, `stop`, `touch`, `watch`."""

import json
import re
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperCommand

from drivers.errors import CommandError, CommandRefused, FrameError, LinkError
from model.counting import counted
from model.errors import InputError
from registry.suggestions import did_you_mean

if TYPE_CHECKING:
    from controller.api.client import Client
    from controller.api.client_protocol import Notification
    from controller.api.methods import StatusResult
    from controller.api.schema import RigSummary

app = typer.Typer()

EXIT_STATUS: dict[type[BaseException], int] = {
    InputError: 2,
    CommandError: 2,
    CommandRefused: 1,
    LinkError: 3,
    FrameError: 3,
}
"""Exit status of the errors that these commands raise on purpose."""

Socket = Annotated[
    Path | None,
    typer.Option("--socket", metavar="PATH", help="Where the daemon listens, if not as usual."),
]
Json = Annotated[bool, typer.Option("--json", help="One JSON object, nothing else.")]

DASHBOARD = "127.0.0.1:8137"
"""Where the page is served unless another place is named; the gateway's own default, too."""

_WATCHED = ["state", "contacts", "pattern", "silence", "link", "log"]
"""What `era watch` tells unless it is told what: amplifiers and latency would come without end."""

_REPEAT = 0.05  # s; a touch that is not repeated for 150 ms is lifted


class _DashboardCommand(TyperCommand):
    """Lets `--dashboard` stand without a place."""

    def parse_args(self, context: Any, arguments: list[str]) -> list[str]:
        """Put the usual place behind a `--dashboard` that is not followed by one."""
        filled = []
        for argument, following in zip_longest(arguments, arguments[1:], fillvalue=""):
            filled.append(argument)
            if argument == "--dashboard" and not re.search(r":\d+$", following):
                filled.append(DASHBOARD)
        return super().parse_args(context, filled)


@app.command(cls=_DashboardCommand)
def daemon(
    config: Annotated[
        Path, typer.Argument(metavar="CONFIG", help="era config init FILE --kind daemon makes one.")
    ],
    check: Annotated[
        bool, typer.Option("--check", help="Check the file and all it names; touch no amplifier.")
    ] = False,
    dashboard: Annotated[
        str | None,
        typer.Option(
            metavar="[HOST:PORT]",
            help=f"Serve the page there, or at {DASHBOARD}, by a process of its own.",
        ),
    ] = None,
) -> None:
    """Drive a plate by touches, all day; starts disarmed."""
    from controller.daemon.run import check_daemon, run_daemon

    if check:
        typer.echo(check_daemon(config))
        return
    run_daemon(config, dashboard=dashboard)


@app.command()
def status(socket: Socket = None, as_json: Json = False) -> None:
    """How the daemon, amplifiers and plate are. Exit status 0 in FAULT and COMM_LOST, too."""
    with _client(socket) as era:
        told = era.status()
    typer.echo(told.model_dump_json() if as_json else show_status(told))


@app.command()
def arm(
    lease: Annotated[
        float, typer.Option(metavar="S", min=1, max=60, help="How long without being renewed.")
    ] = 10.0,
    owner: Annotated[str, typer.Option(help="Who arms; others are told.")] = "era arm",
    once: Annotated[
        bool, typer.Option("--once", help="Do not stay and renew: disarmed when the lease is over.")
    ] = False,
    socket: Socket = None,
    as_json: Json = False,
) -> None:
    """High voltage on: touches are felt. Stays and renews the lease; Ctrl-C disarms."""
    with _client(socket) as era:
        granted = era.arm(owner, lease_s=lease)
        try:
            if as_json:
                typer.echo(granted.model_dump_json())
            else:
                how = f"for {granted.lease_s:g} s" if once else "until Ctrl-C"
                typer.echo(f"armed {how}; era stop stops everything at once")
            while not once:
                time.sleep(granted.lease_s / 3)
                _renew(era, granted.lease)
        except KeyboardInterrupt:
            era.disarm()
            if not as_json:
                typer.echo("disarmed")


@app.command()
def disarm(socket: Socket = None, as_json: Json = False) -> None:
    """Silent along a short ramp, then high voltage off."""
    with _client(socket) as era:
        era.disarm()
        _tell_state(era, as_json=as_json)


@app.command()
def stop(socket: Socket = None, as_json: Json = False) -> None:
    """Quick stop of everything; stays until era clear. No emergency stop: see the manual."""
    with _client(socket) as era:
        era.stop()
        _tell_state(era, as_json=as_json)


@app.command()
def clear(socket: Socket = None, as_json: Json = False) -> None:
    """Acknowledge a stop, or a fault whose cause is gone. Stays disarmed."""
    with _client(socket) as era:
        era.clear()
        _tell_state(era, as_json=as_json)


@app.command()
def touch(
    at: Annotated[list[str], typer.Argument(metavar="X,Y ...", help="Fingers on the plate [m].")],
    duration: Annotated[
        float, typer.Option("--for", metavar="S", min=0, max=3600, help="How long.")
    ] = 1.0,
    socket: Socket = None,
    as_json: Json = False,
) -> None:
    """Put fingers on the plate for a while. The last one is felt, the others are kept quiet."""
    from model.config.points import parse_point

    places = [parse_point(text, what="era touch") for text in at]
    with _client(socket) as era:
        _check_places(places, era.hello("era").rig)
        era.touch(places, source="era touch")
        end = time.monotonic() + duration
        time.sleep(min(duration, 2 * _REPEAT))
        told = era.status()
        while (left := end - time.monotonic()) > 0:
            era.touch(places, source="era touch")
            time.sleep(min(left, _REPEAT))
        era.touch([], source="era touch")
    typer.echo(told.model_dump_json() if as_json else show_status(told))


@app.command()
def watch(
    topics: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[TOPIC ...]",
            help=f"{', '.join(_WATCHED)} if none is named; also amplifiers, latency, layout.",
        ),
    ] = None,
    rate: Annotated[float, typer.Option(min=1, max=60, help="Of amplifiers and latency, Hz.")] = 1,
    socket: Socket = None,
    as_json: Annotated[bool, typer.Option("--json", help="A JSON object a line.")] = False,
) -> None:
    """Tell what happens as it happens, until Ctrl-C."""
    from typing import cast

    from controller.api.schema import Topic
    from controller.api.topics import TOPICS

    wanted = topics or _WATCHED
    unknown = [topic for topic in wanted if topic not in TOPICS]
    if unknown:
        raise InputError(
            f"there is no topic {unknown[0]!r}; {did_you_mean(unknown[0], TOPICS)}"
            f"known are {', '.join(TOPICS)}"
        )
    with _client(socket) as era:
        era.subscribe(*cast("list[Topic]", wanted), rate_hz=rate)
        now = era.status()
        for told in era.events():
            if as_json:
                said = {"topic": told.topic, "time_s": told.time, "lost": told.lost}
                typer.echo(json.dumps({**said, "data": told.data}))
            else:
                typer.echo(show_event(told, ahead=now.unix_time_s - now.time_s))


@contextmanager
def _client(socket: Path | None) -> "Iterator[Client]":
    """A connection; what the daemon refuses becomes an error with the exit status it deserves."""
    from controller.api.client import Client
    from controller.api.jsonrpc import ErrorCode, RpcError

    with Client.connect(socket, name="era") as era:
        try:
            yield era
        except RpcError as error:
            if error.code is ErrorCode.LINK:
                raise LinkError(str(error)) from error
            if error.code is ErrorCode.INVALID_PARAMS:
                raise InputError(str(error)) from error
            raise CommandRefused(str(error)) from error


def _renew(era: "Client", lease: str) -> None:
    """Keep a lease; where it was ended, say by what."""
    from controller.api.jsonrpc import ErrorCode, RpcError

    try:
        era.renew(lease)
    except RpcError as error:
        if error.code is not ErrorCode.LEASE:
            raise
        told = era.status()
        remedy = f"; {told.remedy}" if told.remedy else ""
        raise CommandRefused(f"not armed any more, {told.state}: {told.cause}{remedy}") from error


def _check_places(places: "list[tuple[float, float]]", rig: "RigSummary") -> None:
    """Refuse fingers beyond the plate, which the daemon would only count."""
    from model.config.points import in_metres

    for x, y in places:
        if not (0 <= x <= rig.length_m and 0 <= y <= rig.width_m):
            raise InputError(
                f"era touch {x:g},{y:g} is beyond the plate, which is {rig.length_m:g} m by "
                f"{rig.width_m:g} m"
                + (
                    in_metres(x, y, length=rig.length_m, width=rig.width_m)
                    or "; places count from its south-west corner"
                )
            )


def _tell_state(era: "Client", *, as_json: bool) -> None:
    told = era.status()
    if as_json:
        typer.echo(json.dumps({"state": told.state, "cause": told.cause, "remedy": told.remedy}))
    else:
        typer.echo(f"{told.state}: {told.cause}")


def show_event(told: "Notification", *, ahead: float) -> str:
    """What has happened, for people to read; ahead: of the wall clock before the daemon's [s]."""
    from drivers.cli import in_words

    at = datetime.fromtimestamp(told.time + ahead).isoformat(timespec="milliseconds")[11:]
    lost = f"  ({told.lost} lost)" if told.lost else ""
    return f"{at}  {told.topic:10s} {in_words(told.data)}{lost}"


def show_status(told: "StatusResult") -> str:
    """A status for people to read."""
    lines = [f"{told.state}: {told.cause}"]
    if told.remedy:
        lines.append(f"  what to do: {told.remedy}")
    if told.lost_for_s is not None:
        watchdog = f"its watchdog silences it after {told.watchdog_s:g} s without commands"
        lines.append(
            f"  ASSUME ENERGISED: an amplifier that was lost may still be playing; {watchdog}"
            if told.assume_energised
            else f"  out of reach for {told.lost_for_s:.1f} s: {watchdog}, which nothing confirms"
        )
    if told.armed_by is not None and told.lease_left_s is not None:
        lines.append(f"  armed by {told.armed_by}, {told.lease_left_s:.1f} s left")
    for contact in told.contacts:
        level = "" if contact.level_db_sl is None else f" {contact.level_db_sl:.1f} dB SL"
        contrast = "" if contact.contrast_db is None else f", contrast {contact.contrast_db:.1f} dB"
        effect = "" if contact.effect is None else f", effect {contact.effect}"
        lines.append(
            f"  finger {contact.source} {contact.id} at {contact.x_m:.3f}, {contact.y_m:.3f} m: "
            f"{contact.role or 'nothing is played'}{level}{contrast}{effect}"
        )
    if told.silent_because is not None and told.contacts:
        lines.append(f"  silent: {told.silent_because}")
    elif told.contacts and told.state == "READY_TO_SWITCH_ON":
        lines.append("  silent: nobody has armed it; era arm does")
    if told.plain_because is not None:
        lines.append(f"  plain ramps: {told.plain_because}")
    for era, tone in told.drive.items():
        lines.append(
            f"  ERA {era}: {tone.frequency_hz:g} Hz, level {tone.level:.3f}, {tone.phase_deg:g} deg"
        )
    for amplifier in told.amplifiers:
        parts = [amplifier.state] if amplifier.state else []
        if amplifier.lost:
            parts.append("LOST")
        if amplifier.closed_with_lost:
            parts.append("closed with the lost one")
        if amplifier.fault not in (None, "NONE"):
            parts.append(f"fault {amplifier.fault}")
        if amplifier.temperature_c is not None:
            parts.append(f"{amplifier.temperature_c:.1f} degC")
        if amplifier.reply_age_s is not None:
            parts.append(f"heard {amplifier.reply_age_s:.2f} s ago")
        else:
            parts.append("never heard")
        lines.append(f"  amplifier {amplifier.name} ({amplifier.url}): {', '.join(parts)}")
    latency = told.latency_ms
    if latency.median is not None:
        lines.append(
            f"  latency of {counted(latency.count, 'command')}: median {latency.median:.2f} ms, "
            f"99 % {latency.p99:.2f} ms, 99.9 % {latency.p999:.2f} ms"
        )
    for reason, count in told.rejected_touches.items():
        lines.append(f"  rejected touches, {reason.replace('_', ' ')}: {count}")
    lines.append(f"  up for {told.uptime_s:.0f} s")
    return "\n".join(lines)
