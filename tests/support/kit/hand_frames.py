"""Frames of protocol 4 on a serial line, written by hand from docs/reference/protocol.md.

They use none of the product's codecs: a frame is 00, COBS of (type, version, address, sequence as
u16, payload, CRC-32), 00; words are little-endian.
"""

import struct
import zlib
from collections.abc import Sequence

from cobs import cobs

VERSION = 4
REPLY = 0x80
HELLO, GET_CAPS, ARM, DISARM, SET, COMMIT, SILENCE, STOP = 1, 2, 3, 4, 5, 6, 7, 8
GET_STATUS, GET_FAULTS, CLEAR, PING, GET_ACHIEVED, NAK, EVENT = 9, 10, 11, 12, 13, 31, 30
MARK = 19
SWITCHED_OFF, SWITCHED_ON, ENABLED, STOPPED, REACTING, FAULT = 1, 3, 4, 5, 6, 7
WATCHDOG, ARC = 1, 4
"""Faults, by their numbers."""


def frame(
    kind: int, words: Sequence[int] = (), *, sequence: int, address: int = 1, version: int = VERSION
) -> bytes:
    """Return a frame with words as its payload; negative ones in two's complement."""
    unsigned_words = [word % 65536 for word in words]
    payload = struct.pack(f"<{len(words)}H", *unsigned_words)
    return raw_frame(kind, payload, sequence=sequence, address=address, version=version)


def raw_frame(
    kind: int, payload: bytes, *, sequence: int, address: int = 1, version: int = VERSION
) -> bytes:
    """Return a frame with a payload of bytes."""
    body = struct.pack("<BBBH", kind, version, address, sequence) + payload
    stuffed: bytes = cobs.encode(body + struct.pack("<L", zlib.crc32(body)))
    return b"\0" + stuffed + b"\0"


def tone(
    channel: int, frequency: float, level: float, phase: float = 0.0, *, keep_phase: bool = False
) -> list[int]:
    """Return the words of a command without envelopes, in Hz, full levels and degrees."""
    head = channel << 4 | keep_phase << 3
    steps_of_frequency = round(frequency * 20)
    steps_of_level = round(level * 10000)
    return [head, steps_of_frequency, steps_of_level, round(phase * 100)]


def layer(
    number: int,
    *commands: Sequence[int],
    ramp: int = 10,
    valid_for: int = 0,
    after: bool = False,
    renew: bool = False,
) -> list[int]:
    """Return the words of a layer of a set; ramp, valid_for [ms]."""
    words = [number << 7 | after << 6 | renew << 5 | len(commands), ramp, valid_for]
    for command in commands:
        words += command
    return words


def part(
    token: int, *layers: Sequence[int], session: int = 9, index: int = 0, parts: int = 1,
    now: bool = False,
) -> list[int]:  # fmt: skip
    """Return the words of a Set with these words of its stream."""
    words = [session, token, index << 8 | parts << 1 | now]
    for words_of_layer in layers:
        words += words_of_layer
    return words
