"""Serial frames of protocol 4 written by hand from docs/decisions/0088-protocol-4.md.

None of the product's codecs is used: a frame is 00, COBS of (type, version, address, sequence as
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
SET_ADDRESS, MARK = 15, 19
SWITCHED_OFF, SWITCHED_ON, ENABLED, STOPPED, REACTING, FAULT = 1, 3, 4, 5, 6, 7
WATCHDOG, ARC = 1, 4
"""Faults, by their numbers."""


def frame(
    kind: int, words: Sequence[int] = (), *, sequence: int, address: int = 1, version: int = VERSION
) -> bytes:
    """Return a frame with words as its payload; negative ones in two's complement."""
    payload = struct.pack(f"<{len(words)}H", *(word % 65536 for word in words))
    return raw_frame(kind, payload, sequence=sequence, address=address, version=version)


def raw_frame(
    kind: int, payload: bytes, *, sequence: int, address: int = 1, version: int = VERSION
) -> bytes:
    """Return a frame with a payload of bytes."""
    body = struct.pack("<BBBH", kind, version, address, sequence) + payload
    stuffed: bytes = cobs.encode(body + struct.pack("<L", zlib.crc32(body)))
    return b"\0" + stuffed + b"\0"


def identity(*, serial: str = "7") -> bytes:
    """Return the payload of the reply to Hello: versions (bit 4), four texts with their lengths."""
    texts = b"".join(bytes([len(text)]) + text.encode() for text in ("v", "p", serial, "1"))
    return struct.pack("<H", 1 << 4) + texts


def status(
    state: int = ENABLED,
    *,
    fault: int = 0,
    high_voltage: bool | None = None,
    limited: bool = False,
    latch: int = 0,
    left: int = 250,
    clock: int = 0,
    token: int = 0,
    levels: Sequence[int] = (0, 0),
    tokens: Sequence[int] = (0, 0, 0, 0),
) -> list[int]:
    """Return the words of a status: of two channels and four layers, at 25 degrees and 1800 V."""
    is_driven = state in (ENABLED, SWITCHED_ON) or (state == STOPPED and any(levels))
    is_on = is_driven if high_voltage is None else high_voltage
    counts = len(levels) << 8 | len(tokens)
    flags = is_on | limited << 2
    head = [state, fault, flags, latch, left if state == ENABLED else 0, 250, 1800]
    return [*head, clock >> 16, clock & 0xFFFF, token, counts, *levels, *tokens]


def capabilities(*, layers: int = 4) -> list[int]:
    """Return the words of capabilities of two channels: every range as wide as it may be."""
    general = [
        2,
        layers,
        8,
        512,
        32,
        2,
        200,
        65535,
        1,
        10000,
        1,
        1,
        1000,
        65535,
        100,
        2000,
        1,
        1000,
        20,
    ]
    return [*general, *(200, 65535, 10000) * 2]


def tone(
    channel: int, frequency: float, level: float, phase: float = 0.0, *, keep_phase: bool = False
) -> list[int]:
    """Return the words of a command without envelopes, in Hz, full levels and degrees."""
    head = channel << 4 | keep_phase << 3
    return [head, round(frequency * 20), round(level * 10000), round(phase * 100)]


def layer(
    number: int,
    *commands: Sequence[int],
    ramp: int = 10,
    valid_for: int = 0,
    after: bool = False,
    renew: bool = False,
) -> list[int]:
    """Return the words of a layer of a set; ramp, valid_for [ms]."""
    head = number << 7 | after << 6 | renew << 5 | len(commands)
    return [head, ramp, valid_for, *(word for command in commands for word in command)]


def part(
    token: int, *layers: Sequence[int], session: int = 9, index: int = 0, parts: int = 1,
    now: bool = False,
) -> list[int]:  # fmt: skip
    """Return the words of a Set with these words of its stream."""
    head = [session, token, index << 8 | parts << 1 | now]
    return [*head, *(word for each in layers for word in each)]


def taken(
    token: int, *, staged: bool = True, played: bool = False, exact: bool = True, missing: int = 0
) -> list[int]:
    """Return the words of the reply to a Set."""
    return [token, exact << 2 | staged << 1 | played, missing]
