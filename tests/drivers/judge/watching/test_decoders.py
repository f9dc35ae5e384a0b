"""The witness's decoders against bytes that were written by hand."""

import struct
from typing import Any

import pytest

from drivers.wires.modbus_frames import framed
from era_haptics.lab.witness.capture import Direction, Message, Reply, Request
from era_haptics.lab.witness.witness import DECODERS


def summary(message: Message) -> tuple[str, dict[str, Any]]:
    """Return what a message is, and its values; of one that is wrong what is said of it."""
    if isinstance(message, Request):
        return message.name, {"problem": True} if message.problem else message.values
    if isinstance(message, Reply):
        if message.refusal or message.problem:
            return "refusal", {"code": message.refusal or message.problem}
        return "reply", message.values or {}
    return message.what, {"text": message.text} if message.text else message.values


def can(frame: str) -> bytes:
    """Return a frame as a line of a serial adapter."""
    identifier, *data = frame.split()
    return f"t{identifier}{len(data)}{''.join(data)}\r".encode()


def tcp(number: int, pdu: str) -> bytes:
    """Return an ADU of Modbus TCP for unit 1: transaction, 0, length, unit, PDU."""
    data = bytes.fromhex(pdu)
    return struct.pack(">HHHB", number, 0, len(data) + 1, 1) + data


def rtu(adu: str) -> bytes:
    """Return an ADU of RTU with its checksum."""
    unit, *pdu = bytes.fromhex(adu)
    return framed(unit, bytes(pdu), is_rtu=True)


Heard = tuple[str, bytes, str, dict[str, Any]]
"""A direction, bytes, and the message that they complete: "" for none."""
PING: tuple[Heard, ...] = (
    (">", tcp(5, "10 0C00 0003 06 0008 0007 0000"), "Ping", {"session": 7, "rate": 0}),
    ("<", tcp(5, "10 0C00 0003"), "carried out", {}),
    (">", tcp(6, "04 0C80 0002"), "read on", {}),
)
"""With tag 8 and session 7."""
PART = rtu("01 04 04")
"""The first of a response: its checksum is the first register, the tag."""
WHOLE = rtu(
    "01 04 32 9F55 0000 0004 0000 0001 0000 00FA 00FA 0708 36FF DBDF 32"
    "0A 0408 07C0 081B 17B9 06B8 320A 0000 0000 0000 0000 0000 0000 0000"
)
"""A status of which 13 bytes, from the 27th on, are a frame of unit 10 with its checksum."""
OFF = "0000 0000 0001 0000 0000 0000 0000 00FA 0708 0000 0101 0000 0000 0000 0000"
"""Registers of a status without a tag: state 1, one channel and one layer."""
TONES = ("201 04 00 11 05 01 00 64 00", "201 04 01 02 00 D0 07 E8 03")
"""Measure, two tones."""
MEASURE = {"reading": 1, "window": 100, "tones": 2, "frequencies": [2000, 1000]}
TALKS: dict[str, tuple[str, tuple[Heard, ...]]] = {
    "unknown type": ("modbus-tcp", (*PING, ("<", tcp(6, "84 02"), "refusal", {"code": 1}))),
    "busy": ("modbus-tcp", (*PING, ("<", tcp(6, "84 06"), "refusal", {"code": 7}))),
    "wrong state": (
        "modbus-tcp",
        (*PING, ("<", tcp(6, "04 04 0008 0500"), "refusal", {"code": 5})),
    ),
    "reply with another tag": (
        "modbus-tcp",
        (*PING, ("<", tcp(6, "04 04 0009 0000"), "refusal", {"code": "tag must be 8, got 9"})),
    ),
    "response of another function": (
        "modbus-tcp",
        (
            *PING,
            ("<", tcp(6, "03 04 0008 0000"), "refusal", {"code": "function must be 4, got 3"}),
        ),
    ),
    "gateway that finds no amplifier": ("modbus-tcp", (PING[0], ("<", tcp(5, "90 0B"), "", {}))),
    "status without a write": (
        "modbus-tcp",
        (
            (">", tcp(1, "04 0980 000F"), "GetStatus", {}),
            ("<", tcp(1, f"04 1E {OFF}"), "reply", {"state": 1}),
        ),
    ),
    "function 23": (
        "modbus-tcp",
        ((">", tcp(1, "17 0980 0002 0C00 0002 04 0008 0007"), "a read", {"problem": True}),),
    ),
    "function 6": ("modbus-tcp", ((">", tcp(1, "06 0C00 0008"), "a read", {"problem": True}),)),
    "write amid a message": (
        "modbus-tcp",
        ((">", tcp(1, "10 0C01 0001 02 0008"), "a read", {"problem": True}),),
    ),
    "broadcast on RTU": (
        "modbus-rtu",
        ((">", rtu("00 10 0800 0002 04 0003 0005"), "Stop", {"ramp": 5}),),
    ),
    "parts, the first with a checksum of its own": (
        "modbus-rtu",
        (
            (
                ">",
                rtu(f"01 10 0C00 0003 06 {PART[3:].hex()} 0007 0000"),
                "Ping",
                {"session": 7, "rate": 0},
            ),
            ("<", rtu("01 10 0C00 0003"), "carried out", {}),
            (">", rtu("01 04 0C80 0002"), "read on", {}),
            ("<", PART, "", {}),
            ("<", rtu(f"{PART.hex()} 0000")[len(PART) :], "reply", {}),
        ),
    ),
    "response of which a piece has a checksum of its own": (
        "modbus-rtu",
        (
            (">", rtu("01 10 0C00 0003 06 9F55 B882 0000"), "Ping", {"session": 0xB882}),
            ("<", rtu("01 10 0C00 0003"), "carried out", {}),
            (">", rtu("01 04 0C80 0019"), "read on", {}),
            ("<", WHOLE[:26], "", {}),
            ("<", WHOLE[26:39], "", {}),
            ("<", WHOLE[39:], "reply", {"state": 4}),
        ),
    ),
    "frames in any order, and a copy": (
        "slcan",
        (
            (">", can(TONES[1]), "", {}),
            (">", can(TONES[0]), "Measure", MEASURE),
            (">", can(TONES[0]), "", {}),
        ),
    ),
    "frame that does not come": (
        "slcan",
        (
            (">", can(TONES[0]), "", {}),
            (
                *(">", can("201 05 00 0C 02 07 00 00 00"), "damaged"),
                {"text": "message 4 without all frames"},
            ),
        ),
    ),
    "echo, and another host": (
        "slcan",
        (
            (">", can("201 01 00 0C 02 07 00 00 00"), "Ping", {"session": 7, "rate": 0}),
            ("<", can("201 01 00 0C 02 07 00 00 00"), "", {}),
            ("<", can("201 02 00 03 02 17 2A FA 00"), "other host", {"text": "Arm"}),
        ),
    ),
    "boot-up": ("slcan", (("<", b"t701100\r", "boot", {}),)),
    "reset by NMT": ("slcan", ((">", b"t00028101\r", "boot", {}),)),
}


@pytest.mark.parametrize("talk", TALKS)
def test_decoders_read_what_no_page_shows(talk: str) -> None:
    """Refusals, late and damaged frames, other hosts; numbers are by the page on messages."""
    kind, pieces = TALKS[talk]
    decoder = DECODERS[kind]()
    for arrow, data, what, values in pieces:
        direction: Direction = "amplifier" if arrow == ">" else "host"
        heard = [message for _, message in decoder.feed(direction, 0.001, data)]
        name, found = summary(heard[0]) if heard and heard[0] is not None else ("", {})
        assert name == what
        assert {each: found[each] for each in values} == values
