"""Scripts for the firmware: serial frames at given times, and the samples that it makes of them.

Frames are packed here from docs/decisions/0061, without the project's codec.
"""

import struct
import zlib
from collections.abc import Sequence
from pathlib import Path

from model.arrays import FloatArray
from moved_firmware import RATE, SERIAL, MovedFirmware

PER_MS = RATE // 1000
SESSION = 9
ARM, DISARM, SET, COMMIT, STOP, GET_STATUS, PING = 3, 4, 5, 6, 8, 9, 12
PART = 117  # words
NAK = 0x9F

Words = list[int]
Shape = tuple[float, Sequence[tuple[float, float]]]
"""An envelope: step [ms], and knots of level and phase [degrees]."""


def stuffed(frame: bytes) -> bytes:
    """COBS, between zeros."""
    pieces = frame.split(b"\0")
    return b"\0" + b"".join(bytes([len(piece) + 1]) + piece for piece in pieces) + b"\0"


def unstuffed(data: bytes) -> bytes:
    """The frame of what is between two zeros."""
    frame, at = b"", 0
    while at < len(data):
        frame += data[at + 1 : at + data[at]] + b"\0"
        at += data[at]
    return frame[:-1]


def request(kind: int, *words: int) -> bytes:
    """A request to address 1; kind: the number of its message."""
    frame = struct.pack(f"<BBBH{len(words)}H", kind, 3, 1, 7, *words)
    return stuffed(frame + struct.pack("<I", zlib.crc32(frame)))


def arm(watchdog_ms: int = 2000) -> bytes:
    """An Arm of the session."""
    return request(ARM, SESSION, watchdog_ms)


def _polar(level: float, phase: float) -> Words:
    hundredths = (round(100 * phase) + 18000) % 36000 - 18000
    return [round(10000 * level), hundredths & 0xFFFF]


def command(
    channel: int,
    frequency: float,
    level: float,
    phase: float = 0.0,
    *,
    keep_phase: bool = False,
    skip_ending: bool = False,
    onset: Shape | None = None,
    ending: Shape | None = None,
) -> Words:
    """A command: frequency [Hz], level in full levels, phase [degrees]."""
    flags = keep_phase << 3 | skip_ending << 2 | (onset is not None) << 1 | (ending is not None)
    words = [channel << 4 | flags, round(20 * frequency), *_polar(level, phase)]
    for shape in (onset, ending):
        if shape is not None:
            step, knots = shape
            words += [len(knots), round(10 * step)]
            words += [word for knot in knots for word in _polar(*knot)]
    return words


def layer(
    number: int, *commands: Words, ramp_ms: int = 0, valid_for_ms: int = 0, after: bool = False
) -> Words:
    """A layer of a set with these commands."""
    head = [number << 7 | after << 6 | len(commands), ramp_ms, valid_for_ms]
    return head + [word for each in commands for word in each]


def play(token: int, *layers: Words) -> bytes:
    """A set that plays at once, in as many parts as it needs."""
    words = [word for each in layers for word in each]
    parts = [words[at : at + PART] for at in range(0, len(words), PART)]
    return b"".join(
        request(SET, SESSION, token, index << 8 | len(parts) << 1 | 1, *part)
        for index, part in enumerate(parts)
    )


def apply(token: int, *commands: Words, ramp_ms: int = 0, valid_for_ms: int = 0) -> bytes:
    """A set of layer 0 that plays at once."""
    return play(token, layer(0, *commands, ramp_ms=ramp_ms, valid_for_ms=valid_for_ms))


Script = Sequence[tuple[float, bytes]]
"""Requests by time [ms]."""


def replay(
    folder: Path, script: Script, until_ms: float
) -> tuple[FloatArray, list[tuple[int, tuple[int, ...]]]]:
    """The samples of a script, and type and words of each reply; events are left out."""
    firmware = MovedFirmware(folder)
    sent = b""
    for at, frame in script:
        firmware.move(at / 1000)
        firmware.receive(SERIAL, frame)
        sent += firmware.sent(SERIAL)
    firmware.move(until_ms / 1000)
    frames = [unstuffed(part) for part in (sent + firmware.sent(SERIAL)).split(b"\0") if part]
    replies = [
        (frame[0], struct.unpack(f"<{len(frame[5:-4]) // 2}H", frame[5:-4]))
        for frame in frames
        if frame[0] & 0x80
    ]
    return firmware.samples(), replies
