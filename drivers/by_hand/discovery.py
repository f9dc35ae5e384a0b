"""Discovery: the serial ports and CAN interfaces of this machine, and the amplifiers on them.

Nothing is sent before ports are probed.
"""

import asyncio
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from serial.tools.list_ports import comports

from drivers.by_hand.reaching import identified
from drivers.errors import DriverError, FrameError, LinkTimeout
from drivers.protocol.records import Values
from drivers.urls import ADDRESS, BAUD, RTU_BAUD
from drivers.wires.can_frames import BITRATE

_NETWORK = Path("/sys/class/net")
_CAN_TYPE = "280"  # ARPHRD_CAN of Linux
_UNDESCRIBED = "n/a"  # by pyserial
_SPEEDS = (BAUD, 115_200)


@dataclass(frozen=True)
class Candidate:
    """A port or interface: the URLs to try, and the remedy if it is known to be unusable."""

    name: str
    description: str
    urls: tuple[str, ...]
    remedy: str | None = None


def candidates() -> list[Candidate]:
    """List the serial ports and CAN interfaces of this machine, usable or not."""
    return [*_serial_ports(), *_can_interfaces()]


def _serial_ports() -> Iterator[Candidate]:
    for port in sorted(comports()):
        path = port.device
        serial_urls = [f"serial://{path}?baud={speed}" for speed in _SPEEDS]
        modbus_url = f"modbus+rtu://{path}?baud={RTU_BAUD}#{ADDRESS}"
        description = "serial port" if port.description == _UNDESCRIBED else port.description
        yield Candidate(path, description, (*serial_urls, modbus_url))


def _can_interfaces() -> Iterator[Candidate]:
    if not _NETWORK.is_dir():
        return
    for interface in sorted(_NETWORK.iterdir()):
        kind = interface / "type"
        if not kind.is_file() or kind.read_text(encoding="ascii").strip() != _CAN_TYPE:
            continue
        name = interface.name
        state = (interface / "operstate").read_text(encoding="ascii").strip()
        remedy = None
        if state == "down":
            remedy = f"interface is down: sudo ip link set {name} up type can bitrate {BITRATE}"
        yield Candidate(name, "CAN interface", (f"can+socketcan://{name}#{ADDRESS}",), remedy)


Replies = Mapping[str, Values | DriverError]
"""Identity of each amplifier, or its problem, by URL."""


async def identify_all(urls: Iterable[str]) -> Replies:
    """Identify the amplifiers at these URLs, one after the other."""
    replies: dict[str, Values | DriverError] = {}
    for url in urls:
        try:
            async with identified(url) as amplifier:
                replies[url] = amplifier.identity
        except DriverError as problem:
            replies[url] = problem
    return replies


async def discover(
    urls: Sequence[str], *, probes: bool
) -> tuple[dict[str, Any], dict[str, DriverError]]:
    """List ports, interfaces and the amplifiers on them; returns that, and problems by URL.

    urls: identified too; probes: every port is sent identify requests.
    """
    places = candidates()
    replies = {**await identify_all(urls)}
    if probes:
        replies.update(await _probe(places))
    amplifiers = []
    for url, reply in replies.items():
        if not isinstance(reply, DriverError):
            amplifiers.append(
                {
                    "url": url,
                    "vendor": reply["vendor"],
                    "product": reply["product"],
                    "serial_number": reply["serial_number"],
                }
            )
    rows = [_row(place, replies) for place in places]
    problems: dict[str, DriverError] = {}
    for url in urls:
        reply = replies[url]
        if isinstance(reply, DriverError):
            problems[url] = reply
    return {"places": rows, "amplifiers": amplifiers}, problems


async def _probe(places: Iterable[Candidate]) -> Replies:
    """Identify the amplifiers at all usable places simultaneously.

    A mute place takes, for each of its URLs, the time in which a board may start.
    """
    usable_urls = [place.urls for place in places if place.remedy is None]
    replies: dict[str, Values | DriverError] = {}
    for place_replies in await asyncio.gather(*map(identify_all, usable_urls)):
        replies.update(place_replies)
    return replies


def _row(place: Candidate, replies: Replies) -> dict[str, Any]:
    amplifier_urls = []
    remedy = place.remedy
    for url in place.urls:
        reply = replies.get(url)
        if reply is None:
            continue
        if not isinstance(reply, DriverError):
            amplifier_urls.append(url)
        elif remedy is None and not isinstance(reply, LinkTimeout | FrameError):
            remedy = str(reply)  # the place is unusable; a mute one was sent a request
    return {
        "place": place.name,
        "description": place.description,
        "urls": list(place.urls),
        "answers": amplifier_urls,
        "remedy": remedy,
    }
