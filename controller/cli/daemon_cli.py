"""`era daemon`, the commands that are its clients, and how they show status and events.

Clients: `status`, `arm`, `disarm`, `stop`, `clear`, `forget`, `reload`, `strength`, `touch`,
`watch`, `layout use`. `show_status` and `show_event` format what the daemon reports for people.
"""

import json
import re
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import datetime
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperCommand

from controller.api.link import Notification
from controller.api.methods import StatusResult
from controller.api.schema import AmplifierStatus, ContactStatus, LearningSummary, headline
from drivers.by_hand.cli import EXIT_STATUS, in_words
from drivers.errors import CommandRefused, LinkError
from drivers.protocol.definition import READINGS
from model.commands.options import JsonOption, print_report
from model.errors import InputError
from model.quantities import counted
from registry.plugins import did_you_mean

if TYPE_CHECKING:
    from controller.api.client import Client
    from controller.api.methods import ArmResult
    from controller.api.schema import RigSummary

Socket = Annotated[
    Path | None,
    typer.Option("--socket", metavar="PATH", help="Socket of the daemon; default: the usual path."),
]

DASHBOARD = "127.0.0.1:8137"
"""Default address of the page, as of `era gateway`."""

_DEFAULT_TOPICS = ["state", "contacts", "pattern", "silence", "link", "log", "plate", "inputs"]
"""Topics of `era watch`: all but those that are published without end, and the whole layout."""

_MORE_TOPICS = ["amplifiers", "latency", "strength", "layout"]

_RELOAD_TIMEOUT = 130.0  # s; the daemon gives up after 60 s, and another may be reloading
_REPEAT_INTERVAL = 0.05  # s; a touch that is not repeated for 150 ms is lifted


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
            metavar="CONFIG", help="Daemon file; create one by era config init FILE --kind daemon."
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
            help=f"Serve the page from a separate process; default: {DASHBOARD}.",
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
        from controller.gateway.settings import require_gateway

        require_gateway()
    run_daemon(config, dashboard=dashboard, trace=trace)


def status(socket: Socket = None, as_json: JsonOption = False) -> None:
    """Exit status 0 in a fault, too."""

    with connected(socket) as era:
        status = era.status()
    typer.echo(status.model_dump_json() if as_json else show_status(status))


def arm(
    lease: Annotated[
        float, typer.Option(metavar="S", min=1, max=60, help="Lease without renewal.")
    ] = 10.0,
    owner: Annotated[str, typer.Option(help="Name shown to other clients.")] = "era arm",
    once: Annotated[
        bool, typer.Option("--once", help="Exit at once and let the lease expire.")
    ] = False,
    socket: Socket = None,
    as_json: JsonOption = False,
) -> None:
    """Stays and renews the lease; Ctrl-C disarms."""
    with connected(socket) as era:
        if once:
            granted = era.arm(owner, lease_s=lease)
            _print_lease(granted, f"for {granted.lease_s:g} s", as_json=as_json)
            return
        try:
            with era.armed(owner, lease_s=lease) as granted:
                _print_lease(granted, "until Ctrl-C", as_json=as_json)
                for _ in era.events():  # of none; raises LeaseLost
                    pass
        except KeyboardInterrupt:
            if not as_json:
                typer.echo("ready: disarmed")


def of_method(method: str) -> Callable[..., None]:
    """The command of a method of the API, which shows the state after it."""

    def call(socket: Socket = None, as_json: JsonOption = False) -> None:
        with connected(socket) as era:
            getattr(era, method)()
            _print_state(era, as_json=as_json)

    return call


def strength(
    name: Annotated[
        str | None, typer.Argument(metavar="[SOURCE|CLIENT|REGION]", help="Default: show all.")
    ] = None,
    gain_db: Annotated[
        float | None, typer.Argument(metavar="[DB]", help="-40 to 0; default: show what is set.")
    ] = None,
    socket: Socket = None,
    as_json: JsonOption = False,
) -> None:
    """It is kept by this name; what layout and limits allow is 0."""
    with connected(socket) as era:
        strengths = (era.status() if name is None else era.strength(name, gain_db)).strengths
    print_report(
        [f"{each}: {gain:g} dB" for each, gain in strengths.items()],
        {"strengths": strengths},
        as_json=as_json,
    )


def touch(
    at: Annotated[
        list[str] | None, typer.Argument(metavar="[X,Y ...]", help="Fingers on the plate [m].")
    ] = None,
    replay: Annotated[
        Path | None, typer.Option(metavar="FILE", help="TUIO capture to send instead of fingers.")
    ] = None,
    port: Annotated[
        int, typer.Option(help="UDP port of the daemon's source tuio: on this machine.")
    ] = 3333,
    duration: Annotated[
        float, typer.Option("--for", metavar="S", min=0, max=3600, help="Duration.")
    ] = 1.0,
    socket: Socket = None,
    as_json: JsonOption = False,
) -> None:
    """Put fingers on the plate for a while, and show the status.

    Each feels what the layout has at its place; without a layout the last one feels a buzz, and
    the others are quiet. With --replay send a recorded TUIO stream to the daemon at its pace.
    """
    import asyncio

    from controller.sources.tuio import read_capture, replay_capture
    from model.config.fields import parse_point

    if (at is None) == (replay is None):
        raise InputError("era touch must have either fingers, such as 0.10,0.05, or --replay FILE")
    if replay is not None:
        asyncio.run(replay_capture(read_capture(replay), "127.0.0.1", port))
        return
    positions = [parse_point(text, what="era touch") for text in at or ()]
    with connected(socket) as era:
        _check_positions(positions, era.hello("era").rig)
        started_at = time.monotonic()
        _hold(era, positions, started_at + duration / 2)
        status = era.status()  # right after a touch, whose contact lasts for 150 ms
        _hold(era, positions, started_at + duration)
        era.touch([], source="era touch")
    typer.echo(status.model_dump_json() if as_json else show_status(status))


def _hold(era: "Client", positions: list[tuple[float, float]], end: float) -> None:
    """Repeat fingers until a time [s] of time.monotonic(), and there once more."""
    while True:
        era.touch(positions, source="era touch")
        left = end - time.monotonic()
        if left <= 0:
            return
        time.sleep(min(left, _REPEAT_INTERVAL))


def watch(
    topics: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[TOPIC ...]",
            help=f"Default: {', '.join(_DEFAULT_TOPICS)}; also {', '.join(_MORE_TOPICS)}.",
        ),
    ] = None,
    rate: Annotated[
        float, typer.Option(min=1, max=60, help="Rate of amplifiers, latency and strength [Hz].")
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
                typer.echo(show_event(event, ahead=now.unix_time_s - now.time_s))


def reload(socket: Socket = None, as_json: JsonOption = False) -> None:
    """Exit status 1 if they are refused; all is as before then."""
    with connected(socket, timeout=_RELOAD_TIMEOUT) as era:
        done = era.reload()
    outcome = "reloaded" if done.reloaded else "refused; all is as before"
    rows = [outcome, *(f"  {reason}" for reason in done.reasons)]
    print_report(rows, done.model_dump(), as_json=as_json)
    if not done.reloaded:
        raise typer.Exit(EXIT_STATUS[CommandRefused])


@contextmanager
def connected(socket: Path | None, *, timeout: float | None = None) -> "Iterator[Client]":
    """Connect; translate refusals of the daemon to errors with their exit status.

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
        typer.echo(f"on: armed {how_long}; era stop stops everything at once")


def _check_positions(positions: "list[tuple[float, float]]", rig: "RigSummary") -> None:
    """Refuse fingers beyond the plate, which the daemon would only reject and count."""
    from model.config.fields import in_metres

    for x, y in positions:
        if not (0 <= x <= rig.length_m and 0 <= y <= rig.width_m):
            raise InputError(
                f"era touch must be on the plate of {rig.length_m:g} m by {rig.width_m:g} m, got "
                f"{x:g},{y:g}"
                + (
                    in_metres(x, y, length=rig.length_m, width=rig.width_m)
                    or "; coordinates start at its south-west corner"
                )
            )


def _print_state(era: "Client", *, as_json: bool) -> None:
    from controller.api.schema import headline

    status = era.status()
    answer = {"state": status.state, "cause": status.cause, "remedy": status.remedy}
    print_report([headline(status.state, status.cause)], answer, as_json=as_json)


layout_app = typer.Typer(no_args_is_help=True, help="Check surface layouts, or choose one.")


@layout_app.command()
def use(
    name: Annotated[str, typer.Argument(metavar="NAME", help="One of the daemon's layouts.")],
    socket: Socket = None,
    as_json: JsonOption = False,
) -> None:
    """Use one of the daemon's layouts; what lasts at resting fingers follows it at once."""
    with connected(socket) as era:
        used = era.layout(name)
    names = ", ".join(used.layouts)
    print_report([f"layout {used.layout} of {names}"], used.model_dump(), as_json=as_json)


def show_event(event: Notification, *, ahead: float) -> str:
    """Format an event; ahead: offset of the wall clock to the daemon's [s]."""
    at = datetime.fromtimestamp(event.time + ahead).isoformat(timespec="milliseconds")[11:]
    lost = f"  ({event.lost} lost)" if event.lost else ""
    return f"{at}  {event.topic:10s} {in_words(event.data)}{lost}"


def show_status(status: StatusResult) -> str:
    """Format a status."""
    left = status.lease_left_s
    armed = None if left is None else f"{status.armed_by}, {left:.1f} s left"
    lines = [
        *(
            f"touch {each.name}: {each.state}: {each.problem}"
            for each in status.inputs
            if each.problem
        ),
        headline(status.state, status.cause),
        *_given(("  remedy: {}", status.remedy), ("  {}", _loss(status))),
        *_given(("  slow: {}", status.slow_reason)),
        *_given(("  armed by {}", armed)),
        *_given(("  layout {}", status.layout and _layout(status))),
        *map(_contact, status.contacts),
        *[f"  strength {name}: {gain:g} dB" for name, gain in status.strengths.items() if gain],
        *_given(("  silent: {}", status.silence_reason if status.contacts else None)),
        *([] if status.learning is None else _learning(status.learning)),
    ]
    lines += [
        f"  ERA {era}: {tone.frequency_hz:g} Hz, level {tone.level:.3f}, {tone.phase_deg:g} deg"
        for drive in status.layers.values()
        for era, tone in drive.items()
    ]
    for amplifier in status.amplifiers:
        reports = [f"    {each.cause}; {each.remedy}" for each in amplifier.reports]
        lines += [_amplifier(amplifier), *reports]
    latency = status.latency_ms
    if latency.median is not None:
        lines.append(
            f"  latency of {counted(latency.count, 'touch', plural='touches')}: "
            f"median {latency.median:.2f} ms, 99 % {latency.p99:.2f} ms, "
            f"99.9 % {latency.p999:.2f} ms"
        )
    for reason, count in status.rejected_touches.items():
        example = status.rejected_examples.get(reason)
        newest = f" ({example})" if example else ""
        lines.append(f"  rejected touches, {reason.replace('_', ' ')}: {count}{newest}")
    lines += _given(
        ("  clicks that came too late: {}", status.clicks_too_late or None),
        ("  lost events: {}", sum(status.lost_events.values()) or None),
    )
    return "\n".join([*lines, f"  state {status.state}, up for {status.uptime_s:.0f} s"])


def _layout(status: StatusResult) -> str:
    """Return the layout in use, and which there are if there are several."""
    others = f" (of {', '.join(status.layouts)})" if len(status.layouts) > 1 else ""
    return f"{status.layout}{others}"


def _given(*texts: tuple[str, object]) -> list[str]:
    """Texts with their values, but for those whose value is None or False."""
    return [text.format(value) for text, value in texts if value is not None and value is not False]


def _loss(status: StatusResult) -> str | None:
    """What is to be assumed of amplifiers that are lost, if any are."""
    if status.lost_for_s is None:
        return None
    watchdog = f"its watchdog silences it after {status.watchdog_s:g} s without heartbeats"
    if status.assume_energised:
        silences = [each.silence for each in status.amplifiers if each.silence is not None]
        if any(each.silence == "may_play" and each.may_play_for_s is None for each in silences):
            watchdog = "nothing that is known silences it: switch it off"
        return f"ASSUME ENERGISED: a lost amplifier may still be playing; {watchdog}"
    return f"unreachable for {status.lost_for_s:.1f} s: {watchdog}, unconfirmed"


def _contact(contact: ContactStatus) -> str:
    """Format a finger and what it feels."""
    from model.answer.answer import OWN, verdict_shown

    verdict = verdict_shown(contact.verdict, is_foreign_felt=contact.is_foreign_felt)
    details = _given(
        (" {:.1f} dB SL", contact.level_db_sl),
        (", at least {:.1f} dB over the others", contact.promised_contrast_db),
        (", {:g} Hz", contact.frequency_hz),
        (", effect {}", contact.effect),
        (", feels {}", None if contact.feels == contact.effect else contact.feels),
        (", others at most {:.1f} dB SL", contact.foreign_level_db_sl),
        (", {}", None if verdict == OWN else verdict),
        (": {}", contact.held_back),
        (", load {:.1f}", None if contact.load == 1 else contact.load),
    )
    return (
        f"  finger {contact.source} {contact.id} at {contact.x_m:.3f}, {contact.y_m:.3f} m: "
        f"{contact.role or 'not driven'}{''.join(details)}"
    )


def _learning(learning: LearningSummary) -> list[str]:
    """Format what is learned of the plate."""
    state = learning.state.replace("_", " ")
    last, took = learning.last_estimate_s, learning.latency_ms.median
    within = "".join(_given((", median {:.0f} ms after a measurement", took)))
    ago = "".join(_given((", last estimated {:.0f} s ago", last)))
    measured = (
        f"{counted(learning.readings, 'pattern')} measured{ago}; "
        f"{counted(learning.corrections, 'correction')} of answers{within}"
    )
    return [
        f"  plate {state.upper() if learning.cautious else state}: {learning.cause}",
        *_given(("    answers promise what a plate that is not known gives", learning.cautious)),
        *_given(("    remedy: {}", learning.remedy)),
        *_given(("    {}", measured if learning.readings else None)),
    ]


def _amplifier(amplifier: AmplifierStatus) -> str:
    """Format an amplifier's last status."""
    details = _given(
        ("{}", amplifier.state),
        ("does not reply", amplifier.degraded),
        ("LOST", amplifier.lost),
        ("closed because another was lost", amplifier.closed_with_lost),
        ("{}", amplifier.silence and amplifier.silence.words),
        ("fault {}", None if amplifier.fault == "NONE" else amplifier.fault),
        *(
            (
                f"{each.label} {{:.{each.decimals}f}} {each.quantity.unit}".rstrip(),
                getattr(amplifier, each.key),
            )
            for each in READINGS
            if "status" in each.views
        ),
        ("last reply {:.2f} s ago", amplifier.reply_age_s),
        ("no reply yet", amplifier.reply_age_s is None),
    )
    return f"  amplifier {amplifier.name} ({amplifier.url}): {', '.join(details)}"
