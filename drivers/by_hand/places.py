"""Ports and interfaces of this machine at which amplifiers may be; CAN adapters on serial ports.

Nothing is sent to them, but for `with_slcan`: devices receive two characters, V and CR, and an
adapter is opened in listen-only mode, so nothing is sent on the bus.
"""

import asyncio
import re
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import serial
from serial.tools.list_ports import comports

from drivers.by_hand.reaching import identified
from drivers.errors import DriverError, FrameError, LinkTimeout
from drivers.ports import remedy_of
from drivers.protocol.records import Values
from drivers.urls import ADDRESS, BAUD, RTU_BAUD
from drivers.wires.can_frames import BITRATE, NODE_MAX, SLCAN, SLCAN_RATES, TextReader, cob_id

_BAUD = 115_200  # ignored by USB devices, which most adapters are
_REPLY_TIMEOUT = 0.1  # s; USB adapters and their drivers delay bytes by 16 ms at most
_LISTENING_TIME = 0.2  # s; four heartbeats of 50 ms
_NODES = set(range(1, NODE_MAX + 1))
_VERSION = re.compile(rb"V([0-9A-Fa-f]{4})\r")
_END = re.compile(rb"[\r\x07]")  # done, or refused
_DONE = b"\r"


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
    is_serial: bool = False
    is_slcan: bool = False


def candidates() -> list[Candidate]:
    """List the serial ports and CAN interfaces of this machine, usable or not."""
    return [*_serial_ports(), *_can_interfaces()]


def with_slcan(candidate: Candidate) -> Candidate:
    """Turn a serial port into a CAN adapter if it replies as one.

    Blocks; see `drivers.by_hand.places` for what is sent. Its amplifiers are not identified.
    """
    if not candidate.is_serial:
        return candidate
    try:
        adapter = detect_slcan(candidate.name)
    except (OSError, ValueError) as problem:
        return replace(candidate, remedy=f"{candidate.name} cannot be used: {remedy_of(problem)}")
    if adapter is None:
        return candidate
    return replace(adapter, description=f"{candidate.description}: {adapter.description}")


def detect_slcan(port: str) -> Candidate | None:
    """Detect the adapter on a serial port, or None. Blocks for half a second.

    With its version of hardware and firmware, and the nodes whose heartbeats were received, or why
    it could not listen. Raises OSError if the port cannot be used.
    """
    with serial.Serial(
        port, _BAUD, timeout=_REPLY_TIMEOUT, write_timeout=_REPLY_TIMEOUT, exclusive=True
    ) as line:
        line.reset_input_buffer()
        line.write(b"V\r")
        found = _VERSION.search(_text_until(line, _VERSION))
        if found is None:
            return None
        line.write(b"C\r")  # in case it was left open
        _text_until(line, _END)
        nodes, what = list[int](), "no listen-only mode, so it was not opened"
        try:
            speed = b"S%d\r" % SLCAN_RATES.index(BITRATE)
            if _is_done(line, speed) and _is_done(line, b"L\r"):
                nodes = sorted(_heard(line))
                what = f"heartbeats of nodes: {', '.join(map(str, nodes)) or 'none'}"
        finally:
            with suppress(serial.SerialException):
                line.write(b"C\r")
                line.flush()
    urls = tuple(f"can+slcan://{port}?bitrate={BITRATE}#{node}" for node in nodes)
    return Candidate(port, f"slcan adapter {found[1].decode()}, {what}", urls, is_slcan=True)


def _is_done(line: serial.Serial, command: bytes) -> bool:
    line.write(command)
    return _text_until(line, _END).startswith(_DONE)


def _text_until(line: serial.Serial, end: re.Pattern[bytes]) -> bytes:
    """Read until a match or the timeout."""
    text, deadline = b"", time.monotonic() + _REPLY_TIMEOUT
    while not end.search(text) and time.monotonic() < deadline:
        text += line.read(max(1, line.in_waiting))
    return text


def _heard(line: serial.Serial) -> set[int]:
    """Return the nodes whose heartbeats are received."""
    reader, deadline = TextReader(SLCAN), time.monotonic() + _LISTENING_TIME
    heard: set[int] = set()
    while time.monotonic() < deadline:
        for frame in reader.feed(line.read(max(1, line.in_waiting))):
            heard.add(frame.id - cob_id("heartbeat"))
    return heard & _NODES


def _serial_ports() -> Iterator[Candidate]:
    for port in sorted(comports()):
        path = port.device
        urls = tuple(f"serial://{path}?baud={speed}" for speed in _SPEEDS)
        urls += (f"modbus+rtu://{path}?baud={RTU_BAUD}#{ADDRESS}",)
        description = "serial port" if port.description == _UNDESCRIBED else port.description
        yield Candidate(path, description, urls, is_serial=True)


def _can_interfaces() -> Iterator[Candidate]:
    if not _NETWORK.is_dir():
        return
    for interface in sorted(_NETWORK.iterdir()):
        kind = interface / "type"
        if not kind.is_file() or kind.read_text(encoding="ascii").strip() != _CAN_TYPE:
            continue
        name = interface.name
        is_up = (interface / "operstate").read_text(encoding="ascii").strip() != "down"
        urls = (f"can+socketcan://{name}#{ADDRESS}",)
        remedy = f"interface is down: sudo ip link set {name} up type can bitrate {BITRATE}"
        yield Candidate(name, "CAN interface", urls, remedy=None if is_up else remedy)


Found = Mapping[str, Values | DriverError]
"""By URL the identity of the amplifier there, or what is wrong."""


async def identify_all(urls: Iterable[str]) -> Found:
    """Identify the amplifiers at these URLs, one after the other."""
    found: dict[str, Values | DriverError] = {}
    for url in urls:
        try:
            async with identified(url) as amplifier:
                found[url] = amplifier.identity
        except DriverError as problem:
            found[url] = problem
    return found


async def discover(
    urls: Sequence[str], *, probes: bool, slcan: bool
) -> tuple[dict[str, Any], dict[str, DriverError]]:
    """List ports, interfaces and the amplifiers on them; returns that, and problems by URL.

    urls: identified too; probes: every port is sent identify requests; slcan: CAN adapters on
    serial ports are detected.
    """
    places = [with_slcan(place) if slcan else place for place in candidates()]
    probed = [
        place.urls for place in places if probes and place.remedy is None and not place.is_slcan
    ]
    found = await identify_all(urls)
    # Of mute places each URL takes the time in which a board may start.
    for identified_there in await asyncio.gather(*map(identify_all, probed)):
        found = {**found, **identified_there}
    amplifiers = [
        {"url": url, **{name: identity[name] for name in ("vendor", "product", "serial_number")}}
        for url, identity in found.items()
        if not isinstance(identity, DriverError)
    ]
    rows = [_row(place, found) for place in places]
    problems = {url: who for url in urls if isinstance(who := found[url], DriverError)}
    return {"places": rows, "amplifiers": amplifiers}, problems


def _row(place: Candidate, found: Found) -> dict[str, Any]:
    replies = {url: found[url] for url in place.urls if url in found}
    unusable = (
        str(reply)
        for reply in replies.values()
        # Others were sent a request, and did not reply to it.
        if isinstance(reply, DriverError) and not isinstance(reply, LinkTimeout | FrameError)
    )
    return {
        "place": place.name,
        "description": place.description,
        "urls": list(place.urls),
        "heard": list(place.urls) if place.is_slcan else [],
        "answers": [url for url, who in replies.items() if not isinstance(who, DriverError)],
        "remedy": place.remedy or next(unusable, None),
    }
