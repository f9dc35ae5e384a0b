"""Scripts for the firmware: serial frames at given times, and the samples that it makes of them."""

import struct
from collections.abc import Sequence
from pathlib import Path

from cobs import cobs

import hand_written as hand
from model.arrays import FloatArray
from moved_firmware import RATE, SERIAL, MovedFirmware

PER_MS = RATE // 1000
SESSION = 9

Script = Sequence[tuple[float, bytes]]
"""Requests by time [ms]."""


def request(kind: int, *words: int) -> bytes:
    """A request to address 1; kind: the number of its message."""
    return hand.frame(kind, words, sequence=7)


def arm(watchdog_ms: int = 2000) -> bytes:
    """An Arm of the session."""
    return request(hand.ARM, SESSION, watchdog_ms)


def apply(token: int, *commands: Sequence[int], ramp_ms: int = 0) -> bytes:
    """A set of layer 0 that plays at once."""
    layer = hand.layer(0, *commands, ramp=ramp_ms)
    return request(hand.SET, *hand.part(token, layer, session=SESSION, now=True))


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
    frames = [cobs.decode(part) for part in (sent + firmware.sent(SERIAL)).split(b"\0") if part]
    replies = [
        (frame[0], struct.unpack(f"<{len(frame[5:-4]) // 2}H", frame[5:-4]))
        for frame in frames
        if frame[0] & hand.REPLY
    ]
    return firmware.samples(), replies
