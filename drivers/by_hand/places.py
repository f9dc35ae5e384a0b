"""Ports and interfaces of this machine at which amplifiers may be; CAN adapters on serial ports.

Nothing is sent to them, but for `with_slcan`: devices receive two characters, V and CR, and an
adapter is opened in listen-only mode, so nothing is sent on the bus.
"""

import re
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import serial
from serial.tools.list_ports import comports

from drivers.ports.serial_port import remedy_of
from drivers.urls import ADDRESS, BAUD, RTU_BAUD
from drivers.wires.can_bus.canopen import BITRATE, cob_id
from drivers.wires.can_bus.frames import NODE_MAX
from drivers.wires.can_bus.text import SLCAN, SLCAN_RATES, TextReader

_BAUD = 115_200  # ignored by USB devices, which most adapters are
_REPLY_TIMEOUT = 0.1  # s; USB adapters and their drivers delay bytes by 16 ms at most
_LISTENING_TIME = 0.2  # s; four heartbeats of 50 ms
_NODES = set(range(1, NODE_MAX + 1))
_VERSION = re.compile(rb"V([0-9A-Fa-f]{4})\r")
_END = re.compile(rb"[\r\x07]")  # done, or refused
_DONE = b"\r"


@dataclass(frozen=True)
class SlcanAdapter:
    """A detected adapter.

    version: of hardware and firmware, as reported; nodes: node numbers of amplifiers whose
    heartbeats were received; problem: why it could not listen, if so.
    """

    version: str
    nodes: tuple[int, ...] = ()
    problem: str | None = None


def detect_slcan(port: str) -> SlcanAdapter | None:
    """Detect the adapter on a serial port, or None. Blocks for half a second.

    Raises OSError if the port cannot be used.
    """
    with serial.Serial(
        port, _BAUD, timeout=_REPLY_TIMEOUT, write_timeout=_REPLY_TIMEOUT, exclusive=True
    ) as line:
        line.reset_input_buffer()
        line.write(b"V\r")
        found = _VERSION.search(_text_until(line, _VERSION))
        if found is None:
            return None
        version = found.group(1).decode()
        line.write(b"C\r")  # in case it was left open
        _text_until(line, _END)
        try:
            speed = b"S%d\r" % SLCAN_RATES.index(BITRATE)
            if not (_is_done(line, speed) and _is_done(line, b"L\r")):
                return SlcanAdapter(version, problem="no listen-only mode, so it was not opened")
            return SlcanAdapter(version, nodes=tuple(sorted(_heard(line))))
        finally:
            with suppress(serial.SerialException):
                line.write(b"C\r")
                line.flush()


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
    heard = adapter.nodes or ("none",)
    what = adapter.problem or f"heartbeats of nodes: {', '.join(map(str, heard))}"
    urls = tuple(f"can+slcan://{candidate.name}?bitrate={BITRATE}#{node}" for node in adapter.nodes)
    description = f"{candidate.description}: slcan adapter {adapter.version}, {what}"
    return Candidate(candidate.name, description, urls, is_slcan=True)


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
