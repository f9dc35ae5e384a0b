"""The `era amp` commands: control one amplifier by hand."""

import json
import shlex
import sys
from collections.abc import Coroutine
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated, Any, TypeVar

import typer

from drivers.errors import CommandError, CommandRefused, DriverError, FrameError, LinkError

_T = TypeVar("_T")

EXIT_STATUS: dict[type[BaseException], int] = {
    CommandError: 2,
    CommandRefused: 1,
    LinkError: 3,
    FrameError: 3,
}

# begin: written by docs/generators/urls_page.py help

# \b: these lines stay as they are.
_URL_HELP = """\b
URLs:
  serial:///dev/ttyUSB0?baud=921600&address=1   a serial port
  serial+tcp://HOST:PORT?baud=921600            a serial server with raw TCP
  modbus+tcp://HOST:PORT/UNIT                   Modbus over TCP; ?baud=38400 for a gateway
  modbus+rtu:///dev/ttyS1?baud=115200#UNIT      Modbus on a serial port
  can+slcan:///dev/ttyACM0?bitrate=500000#NODE  CAN on a serial adapter
  can+socketcand://HOST:PORT/can0#NODE          CAN through a socketcand server
  can+socketcan://can0#NODE                     CAN on a network interface
  can+python-can://INTERFACE/CHANNEL#NODE       CAN on any other interface of python-can
  sim://RIG.yaml                                a simulated amplifier of a rig
Quote URLs that contain ?, # or &.
"""

# end

app = typer.Typer(no_args_is_help=True)
amp = typer.Typer(
    no_args_is_help=True,
    help="Control one amplifier by hand.",
    epilog=_URL_HELP,
    rich_markup_mode=None,
)
app.add_typer(amp, name="amp")


@app.callback()
def _group() -> None:
    """Keep `amp` a command group, even as the only one of the app."""


Url = Annotated[
    str,
    typer.Argument(
        metavar="URL",
        help="Address of the amplifier, such as serial:///dev/ttyUSB0?baud=921600.",
        show_default=False,
    ),
]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]
Trace = Annotated[
    Path | None,
    typer.Option(
        "--trace",
        metavar="FILE",
        dir_okay=False,
        help="Append every frame and request to FILE, with its time and decoded content.",
        show_default=False,
    ),
]


@amp.command()
def discover(
    url: Annotated[
        list[str] | None, typer.Argument(help="Additional URLs to query.", show_default=False)
    ] = None,
    probe: Annotated[
        bool,
        typer.Option(help="Send an identify request to every port."),
    ] = True,
    trace: Trace = None,
    json_: Json = False,
) -> None:
    """List serial ports, CAN interfaces and the amplifiers on them."""
    from drivers.by_hand import discovery

    result, problems = run(discovery.discover(url or [], probes=probe), trace)
    if json_:
        print(json.dumps(result))
    else:
        _show_discovered(result, problems)
    for problem in problems.values():  # the first one decides, as for a single URL
        for kind, exit_status in EXIT_STATUS.items():
            if isinstance(problem, kind):
                raise typer.Exit(exit_status)


def _show_discovered(result: dict[str, Any], problems: dict[str, DriverError]) -> None:
    for row in result["places"]:
        print(f"{row['place']}  {row['description']}")
        if row["remedy"]:
            print(f"  {row['remedy']}")
    if not result["places"]:
        print("no serial port and no CAN interface found; plug in an adapter and try again")
    for url, problem in problems.items():
        print(f"{url}: {problem}")
    amplifiers = result["amplifiers"]
    for amplifier in amplifiers:
        print("  ".join(amplifier.values()))
    if amplifiers:
        print(f"Next: era amp identify {shlex.quote(amplifiers[0]['url'])}")
    else:
        print("no amplifier found")


@amp.command()
def identify(url: Url, trace: Trace = None, json_: Json = False) -> None:
    """Show identity, capabilities and round-trip time."""
    from drivers.by_hand.actions import identify_amplifier

    _act(identify_amplifier(url), trace=trace, json_=json_)


@amp.command()
def status(url: Url, trace: Trace = None, json_: Json = False) -> None:
    """Show state, levels and faults."""
    from drivers.by_hand import actions

    _act(actions.status(url), trace=trace, json_=json_)


@amp.command()
def drive(
    url: Url,
    channel: Annotated[int, typer.Option(help="Output channel, from 0.")] = 0,
    frequency: Annotated[float, typer.Option(help="Mechanical frequency in Hz.")] = 110.0,
    level: Annotated[float, typer.Option(help="Level, 0 to 1 of full stroke.")] = 0.2,
    duration: Annotated[float, typer.Option("--for", help="Duration in s.")] = 0.5,
    trace: Trace = None,
    json_: Json = False,
) -> None:
    """Drive one channel, then disarm."""
    from drivers.by_hand import actions

    work = actions.drive(url, channel, frequency, level, duration)
    _act(work, trace=trace, json_=json_)


@amp.command()
def stop(url: Url, trace: Trace = None, json_: Json = False) -> None:
    """Stop all channels immediately. The stop is latched until it is cleared.

    Exit status 0 only if the amplifier confirms that it is silent, else 3.
    """
    from drivers.by_hand import actions

    result = _act(actions.stop(url), trace=trace, json_=json_, needs_trace=False)
    if result["silence"] != "confirmed_silent":
        raise typer.Exit(EXIT_STATUS[LinkError])
    if not json_:
        print(f"Next: era amp clear {shlex.quote(url)}")


@amp.command()
def address(
    url: Url,
    new: Annotated[
        int,
        typer.Argument(metavar="NEW", min=1, max=247, help="New address, unit or node number."),
    ],
    serial_number: Annotated[
        str | None,
        typer.Option(
            metavar="TEXT",
            help="Serial number of the amplifier to change, if several reply at the address.",
        ),
    ] = None,
    trace: Trace = None,
    json_: Json = False,
) -> None:
    """Change the address, unit or node of an amplifier."""
    from drivers.by_hand.actions import set_address

    _act(set_address(url, new, serial_number), trace=trace, json_=json_)


@amp.command()
def clear(url: Url, trace: Trace = None, json_: Json = False) -> None:
    """Acknowledge a stop or fault. Leaves the amplifier disarmed."""
    from drivers.by_hand import actions

    _act(actions.clear(url), trace=trace, json_=json_)


def run(work: Coroutine[Any, Any, _T], trace: Path | None, *, needs_trace: bool = True) -> _T:
    """Run a coroutine that uses an amplifier and return its result; trace: file for its frames."""
    import asyncio

    from drivers.trace import tracing

    with ExitStack() as stack:
        try:
            if trace is not None:
                stack.enter_context(tracing(trace))
        except CommandError as error:
            if needs_trace:
                work.close()
                raise
            print(f"era: warning: {error}; not traced", file=sys.stderr)
        return asyncio.run(work)


_UNKNOWN_IF_NONE = ("clock_error_s",)
"""Rows that are shown without a value, too."""


def _act(
    action: Coroutine[Any, Any, dict[str, Any]],
    *,
    trace: Path | None,
    json_: bool,
    needs_trace: bool = True,
) -> dict[str, Any]:
    """Run an action and show its result as rows."""
    result = run(action, trace, needs_trace=needs_trace)
    if json_:
        print(json.dumps(result))
        return result
    rows = {}
    for key, value in result.items():
        if value is None and key in _UNKNOWN_IF_NONE:
            rows[key] = "unknown"
        elif value not in (None, ""):
            rows[key] = value
    width = max(map(len, rows))
    for key, value in rows.items():
        print(f"{key:{width}}  {in_words(value)}")
    return result


def in_words(value: Any) -> str:
    """Format a JSON value for reading: numbers to five digits, objects as `key value`."""
    match value:
        case bool():
            return "yes" if value else "no"
        case float():
            return f"{value:.5g}"
        case list():
            separator = "; " if any(isinstance(item, dict) for item in value) else ", "
            return separator.join(map(in_words, value)) or "none"
        case dict():
            return _object_in_words(value)
        case _:
            return str(value)


def _object_in_words(values: dict[str, Any]) -> str:
    parts = []
    for key, value in values.items():
        if isinstance(value, dict):
            parts.append(f"{key} ({in_words(value)})")
        elif value is not None:
            parts.append(f"{key} {in_words(value)}")
    return ", ".join(parts)
