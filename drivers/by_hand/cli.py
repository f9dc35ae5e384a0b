"""The `era amp` commands: control one amplifier by hand."""

import json
import shlex
import sys
from collections.abc import Coroutine
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer

from drivers.errors import CommandError, CommandRefused, FrameError, LinkError

if TYPE_CHECKING:
    from drivers.conformance import CheckResult

_T = TypeVar("_T")

EXIT_STATUS: dict[type[BaseException], int] = {
    CommandError: 2,
    CommandRefused: 1,
    LinkError: 3,
    FrameError: 3,
}

# \b: these lines stay as they are.
_URLS = """\b
URLs:
  serial:///dev/ttyUSB0?baud=921600&address=1   a serial port, on Windows serial:///COM3
  serial+tcp://HOST:PORT                        a serial server with raw TCP
  modbus+tcp://HOST:PORT/UNIT                   Modbus over TCP; ?baud=19200 for a gateway
  modbus+rtu:///dev/ttyS1?baud=115200#UNIT      Modbus on a serial port
  can+socketcan://can0#NODE                     CAN on a network interface
  can+slcan:///dev/ttyACM0?bitrate=500000#NODE  CAN on a serial adapter
  can+socketcand://HOST:PORT/can0#NODE          CAN through a socketcand server
  can+python-can://INTERFACE/CHANNEL#NODE       CAN on any other interface of python-can
  sim://RIG.yaml                                a simulated amplifier of a rig
Quote URLs that contain ?, # or &.
"""

app = typer.Typer(no_args_is_help=True)
amp = typer.Typer(
    no_args_is_help=True, help="Control one amplifier by hand.", epilog=_URLS, rich_markup_mode=None
)
app.add_typer(amp, name="amp")


@app.callback()
def _group() -> None:
    """Keep `amp` a command group even if the app has no other."""


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
        help="Append every frame and request to FILE, with time and meaning.",
        show_default=False,
    ),
]


@amp.command()
def discover(
    url: Annotated[
        list[str] | None, typer.Argument(help="Identify at these URLs too.", show_default=False)
    ] = None,
    probe: Annotated[
        bool,
        typer.Option(help="Send an identify request to every port."),
    ] = True,
    slcan: Annotated[
        bool,
        typer.Option(
            "--slcan",
            help="Detect CAN adapters on serial ports by sending V and CR, which other devices may "
            "take for a command; then listen to their bus at 500 kbit/s.",
        ),
    ] = False,
    trace: Trace = None,
    json_: Json = False,
) -> None:
    """List serial ports, CAN interfaces and the amplifiers on them."""
    from drivers.by_hand.discovery import identify_all
    from drivers.discovery.places import candidates, with_slcan

    found_ports = [with_slcan(candidate) if slcan else candidate for candidate in candidates()]
    probed = [
        candidate
        for candidate in found_ports
        if candidate.remedy is None and not candidate.is_slcan
    ]
    usable = [one for candidate in probed for one in candidate.urls]
    found = _run(identify_all([*(url or []), *(usable if probe else [])]), trace)
    who = {one.url: one.identity for one in found if one.identity is not None}
    unusable = {one.url: one.problem for one in found if not one.was_sent}
    rows = [
        {
            "place": candidate.name,
            "description": candidate.description,
            "urls": list(candidate.urls),
            "heard": list(candidate.urls) if candidate.is_slcan else [],
            "answers": [one for one in candidate.urls if one in who],
            "remedy": candidate.remedy
            or next((unusable[one] for one in candidate.urls if one in unusable), None),
        }
        for candidate in found_ports
    ]
    amplifiers = [
        {"url": at, **{name: one[name] for name in ("vendor", "product", "serial_number")}}
        for at, one in who.items()
    ]
    if json_:
        print(json.dumps({"places": rows, "amplifiers": amplifiers}))
        return
    for row in rows:
        print(f"{row['place']}  {row['description']}")
        if row["remedy"]:
            print(f"  {row['remedy']}")
    if not rows:
        print("no serial port and no CAN interface found; plug in an adapter and try again")
    for one in found:
        if one.identity is None and one.url in (url or []):
            print(f"{one.url}: {one.problem}")
    for amplifier in amplifiers:
        print("  ".join(str(value) for value in amplifier.values()))
    heard = [one for candidate in found_ports if candidate.is_slcan for one in candidate.urls]
    if not amplifiers and heard:
        print(f"Next: era amp identify {shlex.quote(heard[0])}")
    elif not amplifiers:
        print("no amplifier found")
    else:
        print(f"Next: era amp identify {shlex.quote(amplifiers[0]['url'])}")


@amp.command()
def identify(url: Url, trace: Trace = None, json_: Json = False) -> None:
    """Show identity, capabilities and wire times."""
    from drivers.by_hand import actions

    _show(_run(actions.identify(url), trace), as_json=json_)


@amp.command()
def status(url: Url, trace: Trace = None, json_: Json = False) -> None:
    """Show state, levels and faults."""
    from drivers.by_hand import actions

    _show(_run(actions.status(url), trace), as_json=json_)


@amp.command()
def drive(
    url: Url,
    channel: Annotated[int, typer.Option(help="Output channel, from 0.")] = 0,
    frequency: Annotated[float, typer.Option(help="Mechanical frequency [Hz].")] = 110.0,
    level: Annotated[float, typer.Option(help="Level, 0 to 1 of full stroke.")] = 0.2,
    duration: Annotated[float, typer.Option("--for", help="Duration [s].")] = 0.5,
    trace: Trace = None,
    json_: Json = False,
) -> None:
    """Drive one channel, then disarm."""
    from drivers.by_hand import actions

    driven = actions.drive(
        url, channel=channel, frequency=frequency, level=level, duration=duration
    )
    _show(_run(driven, trace), as_json=json_)


@amp.command()
def sensors(url: Url, trace: Trace = None, json_: Json = False) -> None:
    """Show what the sensors measure, and where."""
    from drivers.by_hand import actions

    _show_sensors(_run(actions.sensors(url), trace), as_json=json_)


@amp.command()
def measure(
    url: Url,
    frequency: Annotated[
        list[float],
        typer.Option("--frequency", help="Frequency of a tone [Hz]; once for each, up to 16."),
    ],
    window: Annotated[float, typer.Option(help="Time over which to measure [s].")] = 0.5,
    trace: Trace = None,
    json_: Json = False,
) -> None:
    """Measure amplitude and phase of tones at every sensor. Changes nothing that plays."""
    from drivers.by_hand import actions

    _show_sensors(_run(actions.measure(url, frequency, window), trace), as_json=json_)


@amp.command()
def stop(url: Url, trace: Trace = None, json_: Json = False) -> None:
    """Stop all channels at once. Latched until cleared.

    Exit status 0 only if the amplifier confirms that it is silent, else 3.
    """
    from drivers.by_hand import actions

    result = _run(actions.stop(url), trace, needs_trace=False)
    _show(result, as_json=json_)
    if result["silence"] != "confirmed_silent":
        raise typer.Exit(EXIT_STATUS[LinkError])
    if not json_:
        print(f"Next: era amp clear {shlex.quote(url)}")


@amp.command()
def address(
    url: Url,
    new: Annotated[int, typer.Argument(metavar="NEW", min=1, max=247, help="Address to take.")],
    serial_number: Annotated[
        str | None,
        typer.Option(
            metavar="TEXT", help="Of the amplifier to change, if several reply at the address."
        ),
    ] = None,
    trace: Trace = None,
    json_: Json = False,
) -> None:
    """Change the address, unit or node of an amplifier."""
    from drivers.by_hand import actions

    _show(_run(actions.set_address(url, new, serial_number), trace), as_json=json_)


@amp.command()
def clear(url: Url, trace: Trace = None, json_: Json = False) -> None:
    """Acknowledge a stop or fault. Leaves the amplifier disarmed."""
    from drivers.by_hand import actions

    _show(_run(actions.clear(url), trace), as_json=json_)


@amp.command()
def conformance(
    url: Url,
    write: Annotated[
        bool, typer.Option("--write", help="Drive the outputs too, without confirmation.")
    ] = False,
    level: Annotated[
        float | None,
        typer.Option(
            metavar="LEVEL",
            min=0.1,  # below it fractions are too close together for measured levels
            max=1.0,
            show_default=False,
            help="Level at which channels are driven, of full level; 0.2 if not given.",
        ),
    ] = None,
    trace: Trace = None,
    json_: Json = False,
) -> None:
    """Check that an amplifier fulfils the contract. Reads only, unless --write is given."""
    from drivers.conformance import LEVEL, judge

    level = LEVEL if level is None else level
    show = _no_result if json_ else _show_result
    report = _run(judge(url, drives=False, level=level, on_result=show), trace)
    if not write and not json_ and sys.stdin.isatty():
        write = typer.confirm(
            f"{report.not_run} more checks arm the amplifier and drive its channels at "
            f"{level:.0%} of full level. Continue?"
        )
    if write and report.overall != "failed":
        more = judge(url, drives=True, level=level, on_result=show, before=report)
        report = _run(more, trace)
    if json_:
        print(json.dumps(report.to_json()))
    else:
        print(report.summary)
        if report.not_run and report.overall != "failed":
            print(f"Next: era amp conformance {shlex.quote(url)} --write")
    if report.overall == "failed":
        raise typer.Exit(1)


def _no_result(result: "CheckResult") -> None:
    """Show nothing."""


def _show_result(result: "CheckResult") -> None:
    mark = result.result.value
    print(f"{mark.upper() if mark == 'failed' else mark:<7}  It {result.check.requirement}.")
    if result.reason:
        print(f"         {result.reason} ({result.check.place})")


def _run(work: Coroutine[Any, Any, _T], trace: Path | None, *, needs_trace: bool = True) -> _T:
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


def _show(result: dict[str, Any], *, as_json: bool) -> None:
    if as_json:
        print(json.dumps(result))
        return
    width = max(len(key) for key in result)
    for key, value in result.items():
        print(f"{key:{width}}  {in_words(value)}")


def _show_sensors(result: dict[str, Any], *, as_json: bool) -> None:
    """Show a result with a line for each sensor."""
    if as_json:
        print(json.dumps(result))
        return
    _show({key: value for key, value in result.items() if key != "sensors"}, as_json=False)
    for one in result["sensors"]:
        print(in_words(one))
    if not result["sensors"]:
        print("no sensors")


def in_words(value: Any) -> str:
    """Format a JSON value for reading: numbers to five digits, objects as `key value`."""
    match value:
        case bool():
            return "yes" if value else "no"
        case float():
            return f"{value:.5g}"
        case list():
            between = "; " if any(isinstance(one, dict) for one in value) else ", "
            return between.join(in_words(one) for one in value) or "none"
        case dict():
            words = {key: in_words(one) for key, one in value.items() if one is not None}
            return ", ".join(
                f"{key} ({text})" if isinstance(value[key], dict) else f"{key} {text}"
                for key, text in words.items()
            )
        case _:
            return str(value)
