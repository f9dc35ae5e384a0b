"""The pages of protocol 4: a frame of each wire by hand, the files for masters and monitors."""

import json
import random
import re
import struct
import textwrap
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import canopen
import cantools
import pytest

from drivers.playing import Playback
from drivers.protocol.definition import (
    COMMAND,
    ENVELOPE,
    EVENT_RECORD,
    IDENTITY,
    KNOT,
    LAYER,
    MESSAGES,
    NAK_RECORD,
)
from drivers.protocol.records import Record
from drivers.protocol.sets import Command, Envelope, LayerSet
from era_haptics.lab.conformance.contract import CHECKS
from protocol_bytes import BYTES
from sim.amplifier.simulated_amplifier import SimulatedAmplifier
from sim.far_ends.canopen_objects import ObjectServer

DOCS = Path(__file__).parents[2] / "docs" / "reference"

# Worked out from docs/reference/protocol.md and the standards, not by our codecs.
BY_HAND = {
    ("serial", "Set, part 0 of 2, without a reply"): """
> 00 05 05 04 01 08 06 17 2A 02 01 04 02 02 02 14 04 F4 01 08 05 98 08 D0 07 01 02 18 0B 98 08 4C
  04 D8 DC 12 F9 90 2A 00
""",
    ("serial", "Set, part 1 of 2"): """
> 00 05 05 04 01 09 08 17 2A 02 01 04 01 82 02 14 04 F4 01 02 05 C0 12 C4 09 01 02 02 02 32 0A E8
  03 28 23 B8 0B FF FF 10 07 C0 12 B0 04 18 FC 03 01 0A 01 01 03 A0 01 01 07 20 03 59 DC C6 F5 00
< 00 05 85 04 01 09 04 02 01 06 01 01 05 44 50 2D 39 00
""",
    ("modbus", "Set, part 0 of 2, without a reply"): """
> 00 01 00 00 00 25 01 10 05 00 00 0F 1E 00 01 2A 17 01 02 00 04 00 02 00 14 01 F4 00 08 08 98 07
  D0 00 00 00 18 08 98 04 4C DC D8
< 00 01 00 00 00 06 01 10 05 00 00 0F
""",
    ("modbus", "Set, part 1 of 2"): """
> 00 02 00 00 00 3D 01 10 05 00 00 1B 36 00 02 2A 17 01 02 01 04 00 82 00 14 01 F4 00 02 12 C0 09
  C4 00 00 00 02 00 32 03 E8 23 28 0B B8 FF FF 00 10 12 C0 04 B0 FC 18 01 00 00 0A 00 00 01 A0 00
  00 03 20
> 00 03 00 00 00 06 01 04 05 80 00 05
< 00 02 00 00 00 06 01 10 05 00 00 1B
< 00 03 00 00 00 0D 01 04 0A 00 02 00 00 01 02 00 06 00 00
""",
    ("modbus", "The commit on RTU"): """
> 01 10 06 00 00 04 08 00 01 2A 17 01 02 60 00 54 89
< 01 10 06 00 00 04 C1 42
""",
    ("can", "Set, part 0 of 2, without a reply"): """
> 201 08 00 05 0E 17 2A 02 01
> 201 08 01 04 00 02 00 14 00
> 201 08 02 F4 01 08 00 98 08
> 201 08 03 D0 07 00 00 18 00
> 201 08 04 98 08 4C 04 D8 DC
""",
    ("can", "Set, part 1 of 2"): """
> 201 09 00 05 1A 17 2A 02 01
> 201 09 01 04 01 82 00 14 00
> 201 09 02 F4 01 02 00 C0 12
> 201 09 03 C4 09 00 00 02 00
> 201 09 04 32 00 E8 03 28 23
> 201 09 05 B8 0B FF FF 10 00
> 201 09 06 C0 12 B0 04 18 FC
> 201 09 07 00 01 0A 00 00 00
> 201 09 08 A0 01 00 00 20 03
< 181 09 00 05 03 02 01 06 00
< 181 09 01 00 00 00 00 00 00
""",
}


def frames_of(text: str) -> list[str]:
    """The frames on the line, one string per frame; long frames continue on indented lines."""
    return re.sub(r"\n {2}", " ", text).strip().splitlines()


def page_frames(page: str, title: str) -> list[str]:
    """The frames that `make pages` writes below a title of a page."""
    text = "\n".join(textwrap.dedent(write()) for write in BYTES[page].values())
    _, section = text.split(f"# {title}\n")
    return frames_of(section.partition("\n#")[0])


def words_of_page() -> dict[str, list[int]]:
    """The words that protocol.md lists, by message: those of the last part of the set."""
    messages: dict[str, list[int]] = {}
    name = ""
    row = re.compile(r"^    ((?:[0-9A-F]{4} )+) +(.*)$", re.MULTILINE)
    for words, comment in row.findall(BYTES["protocol"]["join"]()):
        title = re.match(r"(Set|Taken|Commit|Status): ", comment)
        if title:
            name = title[1]
            messages[name] = []
        messages[name] += [int(word, 16) for word in words.split()]
    return messages


@pytest.mark.parametrize(("page", "title"), BY_HAND)
def test_frames_by_hand_are_those_of_both_codecs(page: str, title: str) -> None:
    """A message with many words, its reply, and a checksum where the wire has one."""
    expected = frames_of(BY_HAND[page, title])

    assert page_frames(page, title)[: len(expected)] == expected


def test_monitor_reads_the_frames_of_the_page_with_the_dbc() -> None:
    """`cantools` finds type, number and words of the last part, as protocol.md lists them."""
    database = cantools.database.load_file(DOCS / "amplifier.dbc")
    signals: dict[str, object] = {}
    for frame in page_frames("can", "Set, part 1 of 2"):
        if frame.startswith(">"):
            identifier, data = int(frame[2:5], 16), bytes.fromhex(frame[6:])
            signals |= database.decode_message(identifier, data)

    assert (signals["number"], signals["type"], signals["words"]) == (9, "Set", 26)
    assert [signals[f"word_{number}"] for number in range(26)] == words_of_page()["Set"]


@pytest.fixture(scope="module")
def eds() -> canopen.ObjectDictionary:
    """The sheet as a CANopen master reads it."""
    return canopen.import_od(str(DOCS / "amplifier.eds"), node_id=1)


def test_amplifier_serves_the_objects_of_the_eds(eds: canopen.ObjectDictionary) -> None:
    """Every object has the subindices and sizes of the sheet."""
    objects = ObjectServer(SimulatedAmplifier("a", channels=4), 1)
    own_objects = {index: entry for index, entry in eds.items() if index >= 0x1000}
    for index, entry in own_objects.items():
        if isinstance(entry, canopen.objectdictionary.ODVariable):
            assert len(objects.read(index, 0, 0.0)) == len(entry) // 8, hex(index)
            continue
        highest_subindex = objects.read(index, 0, 0.0)[0]
        assert highest_subindex == len(entry) - 1 == max(entry), hex(index)
        for subindex, variable in entry.items():
            value = objects.read(index, subindex, 0.0)
            if variable.data_type != canopen.objectdictionary.VISIBLE_STRING:
                assert len(value) == len(variable) // 8, (hex(index), subindex)


PAGE = (DOCS / "protocol.md").read_text("utf-8")


def rows_of(heading: str) -> list[list[str]]:
    """The cells of the table of protocol.md with this heading, without its first rows."""
    table = PAGE.split(f"\n| {heading}")[1].partition("\n\n")[0]
    return [line.strip("| ").split(" | ") for line in table.splitlines()[2:]]


def play(ramp: int, *command: int, **options: Any) -> LayerSet:
    """A set with one command for channel 0: frequency, level and phase."""
    return LayerSet(0, ramp, 0, (Command(0, *command, **options),))


# The sets that the rows of the table of levels describe.
SETS = [
    [play(20, 2200, 8000, 0)],
    [play(20, 2200, 3000, 9000, onset=Envelope(100, ((6000, 0),)))],
    [play(0, 2200, 8000, 0), play(20, 3000, 4000, 0)],
    [play(0, 2200, 8000, 0), play(20, 2200, 6000, 9000, keep_phase=True)],
]


@pytest.mark.parametrize(("number", "sets"), [*enumerate(SETS)])
def test_levels_by_hand_are_those_of_the_playback(number: int, sets: list[LayerSet]) -> None:
    """A row of the page, calculated by its two formulas: a level every 5 ms."""
    _, *cells = rows_of("level of the channel after")[number]
    playback = Playback(1, 8)
    for token, layer_set in enumerate(sets, 1):
        playback.commit([layer_set], token, 0.0)

    levels = []
    for step in range(len(cells)):
        playback.advance(0.005 * step)
        levels.append(playback.level(0, 0.005 * step))

    assert levels == pytest.approx([float(cell) for cell in cells], abs=6e-5)


def test_angles_by_hand_are_those_of_the_voices() -> None:
    """n times clock modulo 2^32 is the angle of f times the clock's time, in whole turns."""
    for frequency, n, clock, product, angle in rows_of("| n | clock"):
        reading, _, since = clock.partition(", after ")
        hertz, seconds = float(frequency.split()[0]), int(reading, 16) * 20 / 2**32
        assert int(n) == hertz * 20
        assert int(product, 16) == int(n) * int(reading, 16) % 2**32
        turns = hertz * seconds % 1
        assert int(product, 16) / 2**32 == pytest.approx(turns, abs=1e-6)
        assert float(angle.rstrip("°")) == pytest.approx(360 * turns, abs=5e-3)
        number, unit = since.split()
        page_seconds = float(number) * (1e-3 if unit == "ms" else 1.0)
        assert page_seconds == pytest.approx(seconds, rel=1e-3)


# Headings of the page without a rule of their own for amplifiers.
UNCHECKED = {"terms", "example", "encoding", "messages", "output", "memory", "the-host"}


def test_every_section_with_rules_has_a_check() -> None:
    """A vendor follows the anchor from a failed check to the page."""
    headings = re.findall(r"^##+ (.*)$", PAGE, re.MULTILINE)
    anchors = {heading.lower().replace(" ", "-") for heading in headings}
    checked = set()
    for check in CHECKS:
        page, anchor = check.place.split("#")
        if page == "protocol.md":
            checked.add(anchor)

    assert len(checked) > 15
    assert checked == anchors - UNCHECKED


SHEET = json.loads((DOCS / "amplifier.json").read_text("utf-8"))


PARTS = {"Layer": LAYER, "Command": COMMAND, "Envelope": ENVELOPE, "Knot": KNOT}
RECORDS: dict[str, tuple[list[Any], Record]] = {
    "Hello": (SHEET["messages"]["Hello"]["reply"], IDENTITY),
    "Event": (SHEET["messages"]["Event"]["reply"], EVENT_RECORD),
    "Nak": (SHEET["messages"]["Nak"]["reply"], NAK_RECORD),
}
for name, record in PARTS.items():
    RECORDS[name] = (SHEET["records"][name.lower()], record)
for name, message in MESSAGES.items():
    entry = SHEET["messages"][name]
    RECORDS[f"{name}, request"] = (entry["request"], message.request)
    RECORDS[f"{name}, reply"] = (entry["reply"], message.reply)
ROWS = 3


def packed(fields: list[Any], values: Mapping[str, Any]) -> list[int]:
    """The words of values by amplifier.json alone."""
    words: list[int] = []
    for field in fields:
        value = values.get(field.get("name"))
        match field["kind"]:
            case "number":
                is_long = SHEET["quantities"][field["quantity"]]["type"] == "u32"
                words += [value >> 16, value & 0xFFFF] if is_long else [value & 0xFFFF]
            case "bits":
                packed_bits = 0
                for part in field["parts"]:
                    packed_bits = packed_bits << part["bits"] | values.get(part["name"], 0)
                words.append(packed_bits)
            case "f32":
                words += struct.unpack(">HH", struct.pack(">f", value))
            case "text":
                raw = value.encode()
                words.append(len(raw))
                words += struct.unpack(f">{(len(raw) + 1) // 2}H", raw + b"\0" * (len(raw) % 2))
            case "rows":
                words += [word for row in value for word in packed(field["fields"], row)]
            case "numbers" | "words to the end":
                words += [number & 0xFFFF for number in value]
            case kind:
                pytest.fail(f"kind must be known, got {kind}")
    return words


def drawn(fields: list[Any], rng: random.Random) -> dict[str, Any]:
    """Values of fields anywhere in their ranges."""
    values: dict[str, Any] = {}
    counts = {field.get("count") for field in fields}

    def number(name: str) -> int:
        quantity = SHEET["quantities"][name]
        return rng.randint(quantity["min"], quantity["max"])

    for field in fields:
        name = field.get("name")
        match field["kind"]:
            case "number":
                values[name] = ROWS if name in counts else number(field["quantity"])
            case "bits":
                for part in field["parts"]:
                    is_count = part["name"] in counts
                    values[part["name"]] = ROWS if is_count else rng.getrandbits(part["bits"])
            case "f32":
                (values[name],) = struct.unpack(">f", struct.pack(">f", rng.uniform(0, 1000)))
            case "text":
                values[name] = "".join(rng.choices("aZ 9-µ", k=rng.randint(0, 15)))
            case "numbers":
                values[name] = [number(field["quantity"]) for _ in range(ROWS)]
            case "rows":
                count = ROWS if isinstance(field["count"], str) else field["count"]
                values[name] = [drawn(field["fields"], rng) for _ in range(count)]
            case _:
                values[name] = [rng.getrandbits(16) for _ in range(ROWS)]
    return values


def serial_frame(message: Mapping[str, Any], words: list[int], sequence: int) -> bytes:
    """A frame on the serial line with COBS and CRC, by amplifier.json alone."""
    line = SHEET["serial"]
    header = {"type": message["number"], "version": SHEET["version"], "address": 1}
    header["sequence"] = sequence
    frame = b""
    for field in line["fields"]:
        match field["name"]:
            case "payload":
                frame += b"".join(word.to_bytes(2, line["byte_order"]) for word in words)
            case "crc":
                frame += zlib.crc32(frame).to_bytes(field["bytes"], line["byte_order"])
            case name:
                frame += header[name].to_bytes(field["bytes"], line["byte_order"])
    pieces = [bytes([len(piece) + 1]) + piece for piece in frame.split(b"\0")]
    return bytes([0, *b"".join(pieces), 0])


def test_set_is_packed_from_the_data_alone() -> None:
    """A program that reads nothing but amplifier.json makes the bytes of serial.md.

    The last part of the set: layer 1 with an onset, layer 2 silenced, layer 3 renewed.
    """
    rows: list[tuple[str, dict[str, int]]] = [
        ("layer", {"layer": 1, "count": 2, "ramp": 20, "valid_for": 500}),
        ("command", {"channel": 0, "onset": 1, "frequency": 4800, "level": 2500, "phase": 0}),
        ("envelope", {"knots": 2, "step": 50}),
        ("knot", {"level": 1000, "phase": 9000}),
        ("knot", {"level": 3000, "phase": -1}),
        ("command", {"channel": 1, "frequency": 4800, "level": 1200, "phase": -1000}),
        ("layer", {"layer": 2, "ramp": 10, "valid_for": 0}),
        ("layer", {"layer": 3, "renew": 1, "ramp": 0, "valid_for": 800}),
    ]
    stream: list[int] = []
    for name, values in rows:
        stream += packed(SHEET["records"][name], values)
    message = SHEET["messages"]["Set"]
    head = {"session": 0x2A17, "token": 0x0102, "index": 1, "parts": 2, "now": 0}

    frame = serial_frame(message, packed(message["request"], {**head, "stream": stream}), 9)

    assert f"> {frame.hex(' ').upper()}" == page_frames("serial", "Set, part 1 of 2")[0]


@pytest.mark.parametrize("name", RECORDS)
def test_every_record_is_read_as_the_data_pack_it(name: str) -> None:
    """Requests, replies, Events, Naks and parts of them, with values anywhere in their ranges."""
    fields, record = RECORDS[name]
    rng = random.Random(name)
    for _ in range(20):
        values = drawn(fields, rng)
        assert record.unpack(packed(fields, values), is_strict=True) == values
