"""Scripts for the firmware: serial frames at given samples, and the samples that it makes of them.

Frames are packed here from the wire page, without the project's codec.
"""

import struct
import subprocess
import zlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from model.arrays import FloatArray

RATE = 16000  # samples per second
PER_MS = RATE // 1000
CHANNELS = 4
SESSION = 9
FULL_STROKE = 32767  # of a sample

HELLO, ARM, APPLY, LOAD_ENVELOPE = 1, 3, 7, 13
NAK = 0x9F
KEEP_PHASE, SHAPED = 1, 4


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


def request(kind: int, payload: bytes = b"") -> bytes:
    """A request to address 1; kind: the type of its message."""
    frame = struct.pack("<BBBH", kind, 2, 1, 7) + payload
    return stuffed(frame + struct.pack("<I", zlib.crc32(frame)))


def arm(watchdog_ms: int = 2000) -> bytes:
    """An Arm of the session."""
    return request(ARM, struct.pack("<HH", watchdog_ms, SESSION))


def command(
    channel: int,
    frequency: float,
    level: float,
    phase: float = 0.0,
    *,
    flags: int = 0,
    onset: int = 0,
    ending: int = 0,
) -> bytes:
    """A command: frequency [Hz], level in full strokes, phase [degrees]."""
    numbers = round(frequency * 20), round(level * 10000), round(phase * 100)
    if not (onset or ending):
        return struct.pack("<BBHHh", channel, flags, *numbers)
    return struct.pack("<BBHHhBB", channel, flags | SHAPED, *numbers, onset, ending)


def apply(token: int, *commands: bytes, ramp_ms: int = 0, valid_for_ms: int = 0) -> bytes:
    """An Apply of these commands."""
    head = struct.pack("<HHHHB", SESSION, token, ramp_ms, valid_for_ms, len(commands))
    return request(APPLY, head + b"".join(commands))


def load(slot: int, step_ms: float, *knots: tuple[float, float]) -> bytes:
    """A LoadEnvelope; knots: level and phase [degrees]."""
    packed = (struct.pack("<Hh", round(10000 * a), round(100 * b)) for a, b in knots)
    head = struct.pack("<BHB", slot, round(step_ms * 10), len(knots))
    return request(LOAD_ENVELOPE, head + b"".join(packed))


Script = Sequence[tuple[float, bytes]]
"""Requests by time [ms]."""


def _text(script: Script, until_ms: float) -> bytes:
    lines = [*script, (until_ms, request(HELLO))]
    return b"".join(
        b"%d %s\n" % (round(at * PER_MS), frame.hex().upper().encode()) for at, frame in lines
    )


def _samples(path: Path) -> FloatArray:
    """Samples (n, channels) in full strokes."""
    return np.fromfile(path, "<i2").reshape(-1, CHANNELS) / FULL_STROKE


def replay(
    folder: Path, script: Script, until_ms: float
) -> tuple[FloatArray, list[tuple[int, bytes]]]:
    """The samples of a script on this machine, and type and payload of each reply but the last."""
    path = folder / "samples"
    done = subprocess.run(
        [folder / "era-replay", "--pipe", "--samples", path],
        input=_text(script, until_ms),
        stdout=subprocess.PIPE,
        check=True,
    )
    frames = [unstuffed(part) for part in done.stdout.split(b"\0") if part]
    return _samples(path), [(frame[0], frame[5:-4]) for frame in frames[:-1]]
