"""The `era amp` commands: talk to one amplifier by hand."""

import json
import shlex
import sys
from collections.abc import Coroutine
from typing import TYPE_CHECKING, Annotated, Any

import typer

from drivers.errors import CommandError, CommandRefused, FrameError, LinkError

if TYPE_CHECKING:
    from drivers.conformance import Check, CheckResult

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
  serial://HOST:PORT  rfc2217://HOST:PORT       a serial server
  hwgrep://VENDOR:PRODUCT                       the serial port of a USB adapter
  modbus+tcp://HOST:PORT/UNIT                   Modbus over TCP, behind a gateway ?baud=19200
  modbus+rtu:///dev/ttyS1?baud=115200#UNIT      Modbus on a serial port
  can+socketcan://can0#NODE                     CAN on an interface of the system
  can+slcan:///dev/ttyACM0?bitrate=500000#NODE  CAN on a serial adapter
  can+socketcand://HOST:PORT/can0#NODE          CAN by a server
  sim://RIG.yaml                                a simulated amplifier of a rig
Put one with ?, # or & into quotes, or the shell makes something else of these.
"""

app = typer.Typer(no_args_is_help=True)
amp = typer.Typer(
    no_args_is_help=True, help="Talk to one amplifier by hand.", epilog=_URLS, rich_markup_mode=None
)
app.add_typer(amp, name="amp")


@app.callback()
def _group() -> None:
    """Keeps `amp` a group of its own, also where this app stands alone."""


Url = Annotated[
    str,
    typer.Argument(
        metavar="URL",
        help="serial:///dev/ttyUSB0?baud=921600, or another as era amp --help lists them.",
        show_default=False,
    ),
]
Json = Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")]


@amp.command()
def discover(
    url: Annotated[
        list[str] | None, typer.Argument(help="Ask here as well.", show_default=False)
    ] = None,
    probe: Annotated[
        bool,
        typer.Option(help="Ask at every port who is there; nothing else is sent."),
    ] = True,
    slcan: Annotated[
        bool,
        typer.Option(
            "--slcan",
            help="Ask first whether a serial port is a CAN adapter, by the characters V and CR, "
            "which a device of another kind may take for a command of its own; then listen to its "
            "bus at 500 kbit/s, onto which nothing is written.",
        ),
    ] = False,
    json_: Json = False,
) -> None:
    """List serial ports, CAN interfaces and who answers on them."""
    import asyncio

    from drivers.discovery.search import ask, candidates, with_slcan

    places = [with_slcan(place) if slcan else place for place in candidates()]
    asked = [place for place in places if place.remedy is None and not place.is_slcan]
    usable = [one for place in asked for one in place.urls]
    found = asyncio.run(ask([*(url or []), *(usable if probe else [])]))
    who = {one.url: one.identity for one in found if one.identity is not None}
    unusable = {one.url: one.problem for one in found if not one.was_asked}
    rows = [
        {
            "place": place.place,
            "description": place.description,
            "urls": list(place.urls),
            "heard": list(place.urls) if place.is_slcan else [],
            "answers": [one for one in place.urls if one in who],
            "remedy": place.remedy
            or next((unusable[one] for one in place.urls if one in unusable), None),
        }
        for place in places
    ]
    amplifiers = [
        {
            "url": at,
            "vendor": one.vendor,
            "product": one.product,
            "serial_number": one.serial_number,
        }
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
        print("no serial port and no CAN interface: plug an adapter in, and look again")
    for one in found:
        if one.identity is None and one.url in (url or []):
            print(f"{one.url}: {one.problem}")
    for amplifier in amplifiers:
        print("  ".join(str(value) for value in amplifier.values()))
    heard = [one for place in places if place.is_slcan for one in place.urls]
    if not amplifiers and heard:
        print(f"Next: era amp identify {shlex.quote(heard[0])}")
    elif not amplifiers:
        print("no amplifier answered")
    else:
        print(f"Next: era amp identify {shlex.quote(amplifiers[0]['url'])}")


@amp.command()
def identify(url: Url, json_: Json = False) -> None:
    """Who the amplifier is and what it can play. Also what its wire allows."""
    from drivers import amp_actions

    _show(_run(amp_actions.identify(url)), as_json=json_)


@amp.command()
def status(url: Url, json_: Json = False) -> None:
    """How the amplifier is, and what went wrong with it."""
    from drivers import amp_actions

    _show(_run(amp_actions.status(url)), as_json=json_)


@amp.command()
def drive(
    url: Url,
    channel: Annotated[int, typer.Option(help="Output of the amplifier, from 0.")] = 0,
    frequency: Annotated[float, typer.Option(help="Mechanical frequency in Hz.")] = 110.0,
    level: Annotated[float, typer.Option(help="0 to 1 of full stroke.")] = 0.2,
    duration: Annotated[float, typer.Option("--for", help="How long, in s.")] = 0.5,
    json_: Json = False,
) -> None:
    """Let one channel vibrate for a while. Ends silent and disarmed, whatever happens."""
    from drivers import amp_actions

    driven = amp_actions.drive(
        url, channel=channel, frequency=frequency, level=level, duration=duration
    )
    _show(_run(driven), as_json=json_)


@amp.command()
def stop(url: Url, json_: Json = False) -> None:
    """Quick stop: silent at once. Refuses to play until it is cleared."""
    from drivers import amp_actions

    _show(_run(amp_actions.stop(url)), as_json=json_)
    if not json_:
        print(f"Next: era amp clear {shlex.quote(url)}")


@amp.command()
def clear(url: Url, json_: Json = False) -> None:
    """Acknowledge a stop, or a fault whose cause is gone. The amplifier stays disarmed."""
    from drivers import amp_actions

    _show(_run(amp_actions.clear(url)), as_json=json_)


@amp.command()
def conformance(
    url: Url,
    write: Annotated[
        bool, typer.Option("--write", help="Drive the outputs too, without asking first.")
    ] = False,
    json_: Json = False,
) -> None:
    """Check that an amplifier keeps the contract. Looks only, unless told to drive its channels."""
    import asyncio

    from drivers.conformance import CHECKS, LEVEL

    looking = tuple(check for check in CHECKS if not check.drives)
    driving = tuple(check for check in CHECKS if check.drives)
    outcomes = asyncio.run(_conform(url, looking, quiet=json_))
    if not write and not json_ and sys.stdin.isatty():
        write = typer.confirm(
            f"{len(driving)} more checks arm it and let its channels vibrate at {LEVEL:.0%} of "
            "full stroke. Go on?"
        )
    if write and all(outcome.problem is None for outcome in outcomes):
        outcomes += asyncio.run(_conform(url, driving, quiet=json_))
    broken = [outcome for outcome in outcomes if outcome.problem is not None]
    left_out = len(CHECKS) - len(outcomes)
    if json_:
        rows = [
            {"check": one.check.name, "proves": one.check.proves, "problem": one.problem}
            for one in outcomes
        ]
        print(json.dumps({"url": url, "kept": not broken, "left_out": left_out, "checks": rows}))
    else:
        print(f"{len(outcomes) - len(broken)} kept, {len(broken)} broken, {left_out} left out")
        if left_out:
            print(f"Next: era amp conformance {shlex.quote(url)} --write")
    if broken:
        raise typer.Exit(1)


async def _conform(url: str, checks: "tuple[Check, ...]", *, quiet: bool) -> "list[CheckResult]":
    from drivers.amp_actions import conform

    outcomes = []
    async for outcome in conform(url, checks):
        outcomes.append(outcome)
        if not quiet:
            mark = "kept  " if outcome.problem is None else "BROKEN"
            print(f"{mark}  It {outcome.check.proves}.")
            if outcome.problem is not None:
                print(f"        {outcome.problem}")
    return outcomes


def _run(result: Coroutine[Any, Any, dict[str, Any]]) -> dict[str, Any]:
    import asyncio

    return asyncio.run(result)


def _show(result: dict[str, Any], *, as_json: bool) -> None:
    if as_json:
        print(json.dumps(result))
        return
    width = max(len(key) for key in result)
    for key, value in result.items():
        print(f"{key:{width}}  {in_words(value)}")


def in_words(value: Any) -> str:
    """A value of JSON as people read it: of a number what counts, of an object what it has."""
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
                f"{key} ({told})" if isinstance(value[key], dict) else f"{key} {told}"
                for key, told in words.items()
            )
        case _:
            return str(value)
