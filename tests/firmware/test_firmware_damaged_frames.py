"""The firmware under damaged frames on every line, built with sanitizers.

`make firmware-test` has 20 000 for each line, under the sanitizer of addresses as well, and
200 000 with --long.
"""

import os
import random
import struct
import zlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pytest
from cobs import cobs

import hand_written as hand
from drivers.protocol.definition import STATES, STATUS_FLAGS, VERSION
from drivers.wires.can_frames import REQUEST, SLCAN, CanFrame, segments
from drivers.wires.modbus_frames import framed
from firmware_machine import CAN, MODBUS, SERIAL, TCP, MovedFirmware, RandomHost, values_of
from real_wires import damage

COUNT = int(os.environ.get("FRAMES", "1000"))
LINES = {"serial": SERIAL, "rtu": MODBUS, "tcp": TCP, "can": CAN}
OPERATIONAL = b"O\rt0002" + b"0100\r"

Bodies = Iterator[bytes]


def on_serial(number: int, words: Sequence[int], sequence: int) -> Bodies:
    """A frame without its checksum."""
    yield struct.pack(f"<BBBH{len(words)}H", number, VERSION, 1, sequence % 65536, *words)


def on_modbus(number: int, words: Sequence[int], sequence: int) -> Bodies:
    """PDUs of a write and of the read of its reply."""
    count = len(words) + 1
    head = struct.pack(">BHHB", 16, 256 * number, count, 2 * count)
    yield head + struct.pack(f">{count}H", sequence % 65536, *words)
    yield struct.pack(">BHH", 3, 256 * number + 128, 122)


def on_can(number: int, words: Sequence[int], sequence: int) -> Bodies:
    """Frames of a message, with their identifiers."""
    for data in segments(sequence % 255 + 1, number, words):
        yield struct.pack("<H", REQUEST + 1) + data


def objects_and_management(draw: random.Random) -> Bodies:
    """A frame to the objects of a node, most of which are there, or of network management."""
    yield struct.pack("<HB", 0x601, draw.randrange(256)) + bytes(
        [draw.randrange(4), 0x20, draw.randrange(32), *draw.randbytes(4)]
    )
    yield struct.pack("<HBB", 0, draw.choice([1, 1, 1, 128, 129, 130]), 0)


def can_line(body: bytes) -> bytes:
    """The text of a frame."""
    can_id = int.from_bytes(body[:2], "little") & 0x7FF
    return SLCAN.encode(CanFrame(can_id, body[2:10]))


def on_line(body: bytes) -> bytes:
    """A frame with its checksum."""
    return b"\0" + cobs.encode(body + struct.pack("<I", zlib.crc32(body))) + b"\0"


WIRES: dict[str, tuple[Callable[..., Bodies], Callable[[bytes], bytes]]] = {
    "serial": (on_serial, on_line),
    "rtu": (on_modbus, lambda body: framed(1, body, is_rtu=True)),
    "tcp": (on_modbus, lambda body: struct.pack(">HHHB", 7, 0, len(body) + 1, 1) + body),
    "can": (on_can, can_line),
}
"""The bodies of a request on each wire, and the frame of a body, with a good checksum."""


@pytest.mark.parametrize("wire", LINES)
def test_damaged_frames_leave_a_valid_amplifier(wire: str, moved: Callable[..., Path]) -> None:
    """Half of the requests are whole, so that it plays; damaged ones have a good checksum mostly.

    Its states, levels, watchdog and high voltage keep what the protocol says of them. It plays: a
    set for at least 500 damaged frames, and for 30 to 50 of them where a request is one frame. On
    CAN a request is five frames, so that there are five times fewer requests, and nearly none of
    those that may be damaged is whole: of the three or four of a set 0.5 each, not 0.65.
    """
    draw, firmware = random.Random(wire), MovedFirmware(moved())
    host = RandomHost(draw, values_of(firmware, hand.GET_CAPS))
    bodies, frame_of = WIRES[wire]
    time, latch, clock, sequence, damaged, tokens = 0.0, 0, 0, 0, 0, set[int]()
    while damaged < COUNT:
        if wire == "can":
            firmware.receive(CAN, OPERATIONAL)
        for number, words in host.requests(latch, clock):
            sequence += 1
            sent = [*bodies(number, words, sequence)]
            if wire == "can" and draw.random() < 0.05:
                sent += objects_and_management(draw)
            may_be_damaged = draw.random() < 0.5
            for body in sent:
                is_whole = not may_be_damaged or draw.random() < 0.3
                frame = frame_of(body if is_whole else damage(body, draw)[:250])
                frame = damage(frame, draw) if not is_whole and draw.random() < 0.1 else frame
                damaged += not is_whole
                firmware.receive(LINES[wire], frame)
                if wire == "rtu":  # which ends its frames with silence
                    time += draw.choice([0.002, 0.002, 0.002, 0.021])
                    firmware.move(time)
        time += 0.3 if draw.random() < 0.02 else draw.choice([0.0, 0.001, 0.002, 0.01])
        firmware.move(time)
        status = values_of(firmware, hand.GET_STATUS)
        is_on = bool(status["flags"] & 1 << STATUS_FLAGS["high_voltage"])
        is_armed = status["state"] == STATES["OPERATION_ENABLED"]
        assert status["state"] in STATES.values()
        assert max(status["levels"]) <= 10_000 * is_on
        assert is_on or not is_armed
        assert (status["watchdog_left"] > 0) <= is_armed
        latch, clock = status["latch"], status["clock"]
        tokens.add(status["token"])
    assert len(tokens) > COUNT / 500
