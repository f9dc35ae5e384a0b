"""Detection of slcan adapters on serial ports, and of the amplifiers on their bus.

Other devices receive two characters, V and CR, and nothing more. The adapter is opened in
listen-only mode, so nothing is sent on the bus.
"""

import re
import time
from contextlib import suppress
from dataclasses import dataclass

import serial

from drivers.codec.can_bus.adapter_text import SLCAN, SLCAN_RATES, TextReader
from drivers.codec.can_bus.canopen import BITRATE, cob_id
from drivers.codec.can_bus.segments import NODE_MAX

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
