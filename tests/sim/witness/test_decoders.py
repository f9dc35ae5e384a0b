"""The witness's decoders against the bytes of the pages, which were worked out by hand."""

import re
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from drivers.codec.modbus.crc import crc16
from sim.witness.can_decoder import CanDecoder
from sim.witness.capture import Direction
from sim.witness.decoded import (
    BootUp,
    Damaged,
    Event,
    Message,
    OtherHost,
    Progress,
    Reply,
    Request,
)
from sim.witness.modbus_decoder import ModbusDecoder
from sim.witness.serial_decoder import SerialDecoder
from sim.witness.watched_wire import Decoder

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
    "Arm": ("Event", {"state": 4, "fault": 0, "channel": 255, "latch": 0}),
    "Stop along 5 ms, to all": ("Event", {"state": 5, "fault": 0, "channel": 255, "latch": 1}),
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
    """Return what a message is, and its values."""
    match message:
        case Request(problem=""):
            return message.name, message.values
        case Reply(problem="", values=None) if message.refusal:
            return "refusal", {"code": message.refusal}
        case Reply(problem="", values=dict() as values):
            return "reply", values
        case Event():
            return "Event", message.values
        case _:
            return type(message).__name__, {}


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
    decoder: Decoder
    match kind:
        case "serial":
            decoder, page = SerialDecoder(), "serial"
        case "tcp" | "rtu":
            decoder, page = ModbusDecoder(over_tcp=kind == "tcp"), "modbus"
        case _:
            decoder, page = CanDecoder(kind), "can"
    titles = [*dict.fromkeys(title for title, _, _ in shown(page))]  # a second apart
    for number, (title, direction, text) in enumerate(shown(page)):
        if page == "modbus" and ("RTU" in title) != (kind == "rtu"):
            continue
        if page == "can":
            as_text = slcan if kind == "slcan" else socketcand
            data = as_text(direction, text)
        else:
            data = bytes.fromhex(text)
        for raw, message in decoder.feed(direction, titles.index(title) + 0.001 * number, data):
            assert raw
            if message is not None and not isinstance(message, Progress):
                yield title, message


@pytest.mark.parametrize("kind", ["serial", "tcp", "rtu", "slcan", "socketcand"])
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
        if any(name == "Event" for name, _ in messages):
            expected = [*expected[:1], EVENTS[begins], *expected[1:]]
        assert [name for name, _ in messages] == [name for name, _ in expected], title
        for (_, values), (_, must) in zip(messages, expected, strict=True):
            assert {name: values[name] for name in must} == must


def test_set_of_the_pages_has_the_words_of_the_first_page() -> None:
    """All layers and commands, as the page on messages writes them."""
    text = (DOCS / "protocol.md").read_text(encoding="utf-8").partition("## A finger joins")[2]
    shown_words = text.partition("The amplifier replies")[0]
    rows = re.findall(r"(?m)^ {4,6}((?:[0-9A-F]{4}[ ·]+)*[0-9A-F]{4})", shown_words)
    words = [int(word, 16) for row in rows for word in re.findall(r"[0-9A-F]{4}", row)]
    for kind in ("serial", "tcp", "slcan"):
        (message,) = [
            each for _, each in decoded(kind) if isinstance(each, Request) and each.name == "Set"
        ]
        assert message.values["stream"] == words[3:]


def tcp(unit: int, number: int, pdu: str) -> bytes:
    """Return an ADU of Modbus TCP: transaction, 0, length, unit, PDU."""
    data = bytes.fromhex(pdu)
    return struct.pack(">HHHB", number, 0, len(data) + 1, unit) + data


def one(decoder: Decoder, direction: Direction, data: bytes) -> Message | None:
    """Return the one message of bytes."""
    ((_, message),) = decoder.feed(direction, 0.0, data)
    return message


@pytest.mark.parametrize(
    ("response", "refusal", "problem"),
    [
        ("84 02", 1, ""),  # UNKNOWN_TYPE
        ("84 06", 7, ""),  # BUSY
        ("04 04 0008 0500", 5, ""),  # WRONG_STATE
        ("04 04 0009 0000", 0, "tag must be 8, got 9"),
        ("03 04 0008 0000", 0, "function must be 4, got 3"),
    ],
)
def test_modbus_replies_that_refuse_or_are_another(
    response: str, refusal: int, problem: str
) -> None:
    """After a Ping with tag 8 was written; numbers of refusals are by the page on messages."""
    decoder = ModbusDecoder(over_tcp=True)
    ping = one(decoder, "amplifier", tcp(1, 5, "10 0C00 0002 04 0008 0007"))
    assert isinstance(ping, Request)
    assert (ping.name, ping.values) == ("Ping", {"session": 7})
    assert one(decoder, "host", tcp(1, 5, "10 0C00 0002")) == Progress(ping.key, is_from_host=False)
    read = one(decoder, "amplifier", tcp(1, 6, "04 0C80 0002"))
    assert read == Progress(ping.key, is_from_host=True)
    reply = one(decoder, "host", tcp(1, 6, response))
    assert isinstance(reply, Reply)
    assert (reply.refusal, reply.problem) == (refusal, problem)
    assert reply.key == (None if problem else ping.key)


def test_modbus_gateway_that_finds_no_amplifier_is_no_reply() -> None:
    """Exceptions 10 and 11 are not the amplifier's."""
    decoder = ModbusDecoder(over_tcp=True)
    decoder.feed("amplifier", 0.0, tcp(1, 5, "10 0C00 0002 04 0008 0007"))
    assert one(decoder, "host", tcp(1, 5, "90 0B")) is None


def test_modbus_status_is_read_without_a_write() -> None:
    """Any master can look at GetCaps, GetStatus and GetFaults; the tag is 0 then."""
    decoder = ModbusDecoder(over_tcp=True)
    request = one(decoder, "amplifier", tcp(3, 1, "04 0980 000F"))
    assert isinstance(request, Request)
    assert (request.name, request.address) == ("GetStatus", 3)
    words = "0000 0000 0001 0000 0000 0000 0000 00FA 0708 0000 0101 0000 0000 0000 0000"
    reply = one(decoder, "host", tcp(3, 1, f"04 1E {words}"))
    assert isinstance(reply, Reply)
    assert reply.values is not None
    assert (reply.key, reply.values["state"]) == (request.key, 1)


@pytest.mark.parametrize(
    "pdu", ["17 0980 0002 0C00 0002 04 0008 0007", "06 0C00 0008", "10 0C01 0001 02 0008"]
)
def test_modbus_writes_that_are_no_message_are_named(pdu: str) -> None:
    """Other functions, and writes that do not begin where a message does."""
    request = one(ModbusDecoder(over_tcp=True), "amplifier", tcp(1, 1, pdu))
    assert isinstance(request, Request)
    assert request.problem


def test_modbus_broadcast_has_no_reply_on_rtu() -> None:
    """Stop for unit 0; over TCP unit 0 is a unit."""
    body = bytes.fromhex("00 10 0800 0002 04 0003 0005")
    stop = one(ModbusDecoder(over_tcp=False), "amplifier", body + crc16(body))
    assert isinstance(stop, Request)
    assert (stop.name, stop.address, stop.key) == ("Stop", 0, None)


PING = ("201 01 00 0C 01 07 00 00 00",)
ARM = ("201 02 00 03 02 17 2A FA 00",)
SILENCE = ("201 03 00 07 02 09 00 05 00",)
READING = ("201 04 00 11 05 01 00 64 00", "201 04 01 02 00 D0 07 E8 03")  # Measure, two tones


def heard(direction: Direction, *frames: str, decoder: CanDecoder | None = None) -> list[Message]:
    """Return the messages of frames."""
    decoder = decoder or CanDecoder("slcan")
    found = [decoder.feed(direction, 0.001, slcan(direction, each)) for each in frames]
    return [message for each in found for _, message in each if message is not None]


def test_can_message_has_its_frames_in_any_order() -> None:
    """It is whole with the last of them, and a copy of a frame has no effect."""
    (message,) = heard("amplifier", *reversed(READING), READING[0])
    assert isinstance(message, Request)
    assert message.values == {"reading": 1, "window": 100, "tones": 2, "frequencies": [2000, 1000]}


def test_can_message_without_a_frame_is_damaged() -> None:
    """The next number says so; the next message is whole."""
    damaged, ping = heard("amplifier", READING[0], "201 05 00 0C 01 07 00 00 00")
    assert damaged == Damaged("message 4 without all frames")
    assert isinstance(ping, Request)


def test_can_requests_of_another_host_are_no_echo() -> None:
    """What the bus brings is the host's own request, or another host's."""
    decoder = CanDecoder("slcan")
    heard("amplifier", *PING, decoder=decoder)
    assert heard("host", *PING, decoder=decoder) == []
    assert heard("host", *ARM, decoder=decoder) == [OtherHost(1, "Arm")]
    assert heard("host", *SILENCE, decoder=decoder) == [OtherHost(1, "Silence")]


@pytest.mark.parametrize(
    ("direction", "frame"), [("host", "t701100\r"), ("amplifier", "t00028101\r")]
)
def test_can_node_that_starts_anew_is_noted(direction: Direction, frame: str) -> None:
    """It sends its boot-up, or a master resets it (NMT 129)."""
    assert one(CanDecoder("slcan"), direction, frame.encode()) == BootUp(1)
