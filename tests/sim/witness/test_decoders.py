"""The witness's decoders against the bytes of the pages, which were worked out by hand."""

import re
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from drivers.codec.modbus.crc import crc16
from sim.witness.capture import Direction
from sim.witness.decoded import Message, Reply, Request
from sim.witness.watched_wire import decoder_of

DOCS = Path(__file__).parents[3] / "docs" / "reference"
STATUS = {"state": 4, "fault": 0, "flags": 1, "watchdog_left": 250, "temperature": 250}
# What stands beside the bytes, in words: names of requests with their values, replies, Events.
MEANINGS: dict[str, list[tuple[str, dict[str, Any]]]] = {
    "Set": [
        ("Set", {"session": 0x2A17, "token": 0x0102, "index": 0, "parts": 1, "now": 0}),
        ("reply", {"token": 0x0102, "exact": 1, "staged": 1, "played": 0, "missing": 0}),
    ],
    "Commit": [
        ("Commit", {"session": 0x2A17, "token": 0x0102}),
        ("reply", STATUS | {"levels": [3300, 3200, 3600, 1800], "tokens": [0x0102] * 4 + [0] * 4}),
    ],
    "Hello": [("Hello", {}), ("reply", {"versions": 1 << 3, "serial_number": "SIM-a"})],
    "Arm": [("Arm", {"session": 0x2A17, "watchdog": 250}), ("reply", STATUS | {"token": 0})],
    "Ping of another session": [("Ping", {"session": 7}), ("refusal", {"code": 10})],
    "Stop along 5 ms, to all": [("Stop", {"ramp": 5})],
}
EVENTS = {
    "Arm": ("event", {"state": 4, "fault": 0, "channel": 255, "latch": 0}),
    "Stop along 5 ms, to all": ("event", {"state": 5, "fault": 0, "channel": 255, "latch": 1}),
}


def shown(page: str) -> Iterator[tuple[str, Direction, str]]:
    """Yield titles, directions and bytes of a page, as text."""
    title, pieces = "", list[tuple[str, Direction, str]]()
    for line in (DOCS / f"{page}.md").read_text(encoding="utf-8").splitlines():
        if line.startswith("    # "):
            title = line.removeprefix("    # ")
        elif title and line.startswith(("    > ", "    < ")):
            pieces.append((title, "amplifier" if line[4] == ">" else "host", line[6:]))
        elif pieces and re.fullmatch(r"      [0-9A-F ]+", line):
            pieces[-1] = (*pieces[-1][:2], f"{pieces[-1][2]} {line.strip()}")
    yield from pieces


def summary(message: Message) -> tuple[str, dict[str, Any]]:
    """Return what a message is, and its values; of one that is wrong what is said of it."""
    if isinstance(message, Request):
        return message.name, {"problem": True} if message.problem else message.values
    if isinstance(message, Reply):
        if message.refusal or message.problem:
            return "refusal", {"code": message.refusal or message.problem}
        return "reply", message.values or {}
    return message.what, {"text": message.text} if message.text else message.values


def slcan(direction: Direction, frame: str) -> bytes:
    """Return a frame of a page as a line of a serial adapter."""
    identifier, *data = frame.split()
    return f"t{identifier}{len(data)}{''.join(data)}\r".encode()


def socketcand(direction: Direction, frame: str) -> bytes:
    """Return a frame of a page as an element of socketcand."""
    identifier, *data = frame.split()
    if direction == "amplifier":
        return f"< send {identifier} {len(data)} {' '.join(data)} >".encode()
    return f"< frame {identifier} 1.25 {''.join(data)} >".encode()


def decoded(kind: str) -> Iterator[tuple[str, Message]]:
    """Yield the messages of a page with their titles."""
    page = {"serial": "serial", "slcan": "can", "socketcand": "can"}.get(kind, "modbus")
    decoder = decoder_of(kind)
    titles = [*dict.fromkeys(title for title, _, _ in shown(page))]  # a second apart
    for number, (title, direction, text) in enumerate(shown(page)):
        if page == "modbus" and ("RTU" in title) != (kind == "modbus-rtu"):
            continue
        if page == "can":
            as_text = slcan if kind == "slcan" else socketcand
            data = as_text(direction, text)
        else:
            data = bytes.fromhex(text)
        for raw, message in decoder.feed(direction, titles.index(title) + 0.001 * number, data):
            assert raw
            if message is not None and getattr(message, "what", "event") == "event":
                yield title, message


@pytest.mark.parametrize("kind", ["serial", "modbus-tcp", "modbus-rtu", "slcan", "socketcand"])
def test_bytes_of_the_pages_mean_what_stands_beside_them(kind: str) -> None:
    """Each request, reply, refusal and Event, on every wire; none is damaged."""
    found: dict[str, list[tuple[str, dict[str, Any]]]] = {}
    for title, message in decoded(kind):
        found.setdefault(title, []).append(summary(message))
    assert found
    for title, messages in found.items():
        named = title.replace("The commit on RTU", "Commit")
        (begins,) = [each for each in MEANINGS if named.startswith(each)]
        expected = MEANINGS[begins]
        if any(name == "event" for name, _ in messages):
            expected = [*expected[:1], EVENTS[begins], *expected[1:]]
        assert [name for name, _ in messages] == [name for name, _ in expected], title
        for (_, values), (_, must) in zip(messages, expected, strict=True):
            assert {name: values[name] for name in must} == must


def tcp(number: int, pdu: str) -> bytes:
    """Return an ADU of Modbus TCP for unit 1: transaction, 0, length, unit, PDU."""
    data = bytes.fromhex(pdu)
    return struct.pack(">HHHB", number, 0, len(data) + 1, 1) + data


def rtu(adu: str) -> bytes:
    """Return an ADU of RTU with its checksum."""
    return bytes.fromhex(adu) + crc16(bytes.fromhex(adu))


def can(frame: str) -> bytes:
    """Return a frame as a line of a serial adapter."""
    return slcan("amplifier", frame)


Heard = tuple[str, bytes, str, dict[str, Any]]
"""A direction, bytes, and the message that they complete: "" for none."""
PING: tuple[Heard, ...] = (
    (">", tcp(5, "10 0C00 0002 04 0008 0007"), "Ping", {"session": 7}),
    ("<", tcp(5, "10 0C00 0002"), "carried out", {}),
    (">", tcp(6, "04 0C80 0002"), "read on", {}),
)
"""With tag 8 and session 7."""
PART = rtu("01 04 04")
"""The first of a response: its checksum is the first register, the tag."""
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
            (">", rtu(f"01 10 0C00 0002 04 {PART[3:].hex()} 0007"), "Ping", {"session": 7}),
            ("<", rtu("01 10 0C00 0002"), "carried out", {}),
            (">", rtu("01 04 0C80 0002"), "read on", {}),
            ("<", PART, "", {}),
            ("<", rtu(f"{PART.hex()} 0000")[len(PART) :], "reply", {}),
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
                *(">", can("201 05 00 0C 01 07 00 00 00"), "damaged"),
                {"text": "message 4 without all frames"},
            ),
        ),
    ),
    "echo, and another host": (
        "slcan",
        (
            (">", can("201 01 00 0C 01 07 00 00 00"), "Ping", {"session": 7}),
            ("<", can("201 01 00 0C 01 07 00 00 00"), "", {}),
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
    decoder = decoder_of(kind)
    for arrow, data, what, values in pieces:
        direction: Direction = "amplifier" if arrow == ">" else "host"
        heard = [message for _, message in decoder.feed(direction, 0.001, data)]
        name, found = summary(heard[0]) if heard and heard[0] is not None else ("", {})
        assert name == what
        assert {each: found[each] for each in values} == values
