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
    EVENT,
    EVENT_RECORD,
    FAULTS,
    FEATURES,
    HELLO,
    IDENTITY,
    KNOT,
    LAYER,
    MESSAGES,
    NAK,
    NAK_RECORD,
    QUANTITIES,
    REFUSALS,
    STATES,
    STATUS_FLAGS,
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


def frames(text: str) -> list[str]:
    """What goes over the line, a string for each frame; long ones go on in lines of their own."""
    return re.sub(r"\n {2}", " ", text).strip().splitlines()


def shown(page: str, title: str) -> list[str]:
    """The frames that `make pages` writes below a title of a page."""
    text = "\n".join(textwrap.dedent(write()) for write in BYTES[page].values())
    return frames(text.split(f"# {title}\n")[1].partition("\n#")[0])


def listed_words() -> dict[str, list[int]]:
    """The words that protocol.md lists, by message: of the set those of its last part."""
    messages: dict[str, list[int]] = {}
    name = ""
    for words, text in re.findall(
        r"^    ((?:[0-9A-F]{4} )+) +(.*)$", BYTES["protocol"]["join"](), re.MULTILINE
    ):
        title = re.match(r"(Set|Taken|Commit|Status): ", text)
        name = title[1] if title else name
        row = [int(word, 16) for word in words.split()]
        messages[name] = row if title else [*messages[name], *row]
    return messages


@pytest.mark.parametrize(("page", "title"), BY_HAND)
def test_frames_by_hand_are_those_of_both_codecs(page: str, title: str) -> None:
    """A message with many words, its reply, and a checksum where the wire has one."""
    by_hand = frames(BY_HAND[page, title])
    assert shown(page, title)[: len(by_hand)] == by_hand


def test_monitor_reads_the_frames_of_the_page_by_the_dbc() -> None:
    """`cantools` finds type, number and words of the last part, as protocol.md lists them."""
    database = cantools.database.load_file(DOCS / "amplifier.dbc")
    words: dict[str, object] = {}
    for frame in shown("can", "Set, part 1 of 2"):
        if frame.startswith(">"):
            identifier, data = int(frame[2:5], 16), bytes.fromhex(frame[6:])
            words |= database.decode_message(identifier, data)
    assert (words["number"], words["type"], words["words"]) == (9, "Set", 26)
    assert [words[f"word_{at}"] for at in range(26)] == listed_words()["Set"]


def test_master_finds_the_objects_of_the_eds_in_the_amplifier() -> None:
    """`canopen` reads it; every object has the subindices and sizes that the far end serves."""
    sheet = canopen.import_od(str(DOCS / "amplifier.eds"), node_id=1)
    objects = ObjectServer(SimulatedAmplifier("a", channels=4), 1)
    for index, entry in sheet.items():
        if index < 0x1000:
            continue
        if isinstance(entry, canopen.objectdictionary.ODVariable):
            assert len(objects.read(index, 0, 0.0)) == len(entry) // 8
            continue
        assert objects.read(index, 0, 0.0)[0] == len(entry) - 1 == max(entry)
        for subindex, each in entry.items():
            served = objects.read(index, subindex, 0.0)
            if each.data_type != canopen.objectdictionary.VISIBLE_STRING:
                assert len(served) == len(each) // 8
    number = list(sheet[0x2001].names).index("limits 3 level_max")
    assert int.from_bytes(objects.read(0x2001, number, 0.0), "little") == 10000


PAGE = (DOCS / "protocol.md").read_text("utf-8")


def rows_of(heading: str) -> list[list[str]]:
    """The cells of the table of protocol.md whose first row begins so, without its head."""
    table = PAGE.split(f"\n| {heading}")[1].partition("\n\n")[0]
    return [line.strip("| ").split(" | ") for line in table.splitlines()[2:]]


SETS = (
    [LayerSet(0, 20, 0, (Command(0, 2200, 8000, 0),))],
    [LayerSet(0, 20, 0, (Command(0, 2200, 3000, 9000, onset=Envelope(100, ((6000, 0),))),))],
    [
        LayerSet(0, 0, 0, (Command(0, 2200, 8000, 0),)),
        LayerSet(0, 20, 0, (Command(0, 3000, 4000, 0),)),
    ],
    [
        LayerSet(0, 0, 0, (Command(0, 2200, 8000, 0),)),
        LayerSet(0, 20, 0, (Command(0, 2200, 6000, 9000, keep_phase=True),)),
    ],
)
"""What the rows of the table of levels say."""


@pytest.mark.parametrize(("number", "sets"), [*enumerate(SETS)])
def test_levels_by_hand_are_those_of_the_playback(number: int, sets: list[LayerSet]) -> None:
    """A row of the page, calculated by its two formulas: a level every 5 ms."""
    _, *levels = rows_of("level of the channel after")[number]
    playback = Playback(1, 8)
    for token, one in enumerate(sets, 1):
        playback.commit([one], token, 0.0)
    for at, level in enumerate(map(float, levels)):
        playback.advance(0.005 * at)
        assert playback.level(0, 0.005 * at) == pytest.approx(level, abs=6e-5)


def test_timeline_is_that_of_the_playback() -> None:
    """A set that waits for an onset, the token of each moment, a renewal, the end and silence."""
    for name in ("t [ms]", "commit", "voice", "valid_for", "token"):
        assert f"\n    {name} " in PAGE
    assert "0            30            60     70           120          160" in PAGE
    assert "220   230" in PAGE
    playback, onset = Playback(1, 8), Envelope(200, ((5000, 0), (8000, 0)))
    playback.commit([LayerSet(0, 0, 200, (Command(0, 2200, 6000, 0, onset=onset),))], 1, 0.0)
    playback.commit([LayerSet(0, 10, 100, (Command(0, 2200, 3000, 0),), after=True)], 2, 0.03)
    tokens = {}
    for moment in (0.03, 0.0599, 0.0601, 0.119):
        playback.advance(moment)
        tokens[moment] = playback.tokens.get(0, 0)
    playback.commit([LayerSet(0, 0, 100, renew=True)], 3, 0.12)
    for moment in (0.161, 0.2199, 0.2201):
        playback.advance(moment)
        tokens[moment] = playback.tokens.get(0, 0)
    assert [*tokens.values()] == [1, 1, 2, 2, 2, 2, 0]
    assert playback.silent_from == pytest.approx(0.23)


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
        unit = 1e-3 if since.endswith("ms") else 1.0
        assert float(since.split()[0]) * unit == pytest.approx(seconds, rel=1e-3)


UNCHECKED = {"terms", "example", "encoding", "messages", "output", "memory", "the-host"}
"""Headings of the page without rules of an amplifier that another heading lacks."""


def test_every_section_with_rules_has_a_check() -> None:
    """By the anchors that checks refer to, which a vendor follows from a failure."""
    headings = re.findall(r"^##+ (.*)$", PAGE, re.MULTILINE)
    anchors = {heading.lower().replace(" ", "-") for heading in headings}
    places = [check.place.split("#") for check in CHECKS]
    checked = {anchor for page, anchor in places if page == "protocol.md"}
    assert len(checked) > 15
    assert checked == anchors - UNCHECKED


SHEET = json.loads((DOCS / "amplifier.json").read_text("utf-8"))


RECORDS: dict[str, tuple[list[Any], Record]] = {
    "Hello": (SHEET["messages"]["Hello"]["reply"], IDENTITY),
    "Event": (SHEET["messages"]["Event"]["reply"], EVENT_RECORD),
    "Nak": (SHEET["messages"]["Nak"]["reply"], NAK_RECORD),
    **{
        name: (SHEET["records"][name.lower()], record)
        for name, record in {
            **{"Layer": LAYER, "Command": COMMAND, "Envelope": ENVELOPE, "Knot": KNOT}
        }.items()
    },
    **{
        f"{name}, request": (SHEET["messages"][name]["request"], m.request)
        for name, m in MESSAGES.items()
    },
    **{
        f"{name}, reply": (SHEET["messages"][name]["reply"], m.reply)
        for name, m in MESSAGES.items()
    },
}
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
                words += [each & 0xFFFF for each in value]
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


def test_data_alone_pack_the_set_and_read_the_status_of_the_page() -> None:
    """A reader that knows nothing but amplifier.json makes the bytes of serial.md by COBS and CRC.

    The last part of the set: layer 1 with an onset, layer 2 silenced, layer 3 renewed.
    """
    record, line, set_ = SHEET["records"], SHEET["serial"], SHEET["messages"]["Set"]
    loud = {"channel": 0, "onset": 1, "frequency": 4800, "level": 2500, "phase": 0}
    stream = [
        *packed(record["layer"], {"layer": 1, "count": 2, "ramp": 20, "valid_for": 500}),
        *packed(record["command"], loud),
        *packed(record["envelope"], {"knots": 2, "step": 50}),
        *packed(record["knot"], {"level": 1000, "phase": 9000}),
        *packed(record["knot"], {"level": 3000, "phase": -1}),
        *packed(
            record["command"], {"channel": 1, "frequency": 4800, "level": 1200, "phase": -1000}
        ),
        *packed(record["layer"], {"layer": 2, "ramp": 10, "valid_for": 0}),
        *packed(record["layer"], {"layer": 3, "renew": 1, "ramp": 0, "valid_for": 800}),
    ]
    head = {"session": 0x2A17, "token": 0x0102, "index": 1, "parts": 2, "now": 0}
    words = packed(set_["request"], {**head, "stream": stream})
    contents = {"type": set_["number"], "version": SHEET["version"], "address": 1, "sequence": 9}
    frame = b""
    for field in line["fields"]:
        if field["name"] == "payload":
            frame += b"".join(word.to_bytes(2, line["byte_order"]) for word in words)
        elif field["name"] == "crc":
            frame += zlib.crc32(frame).to_bytes(field["bytes"], line["byte_order"])
        else:
            frame += contents[field["name"]].to_bytes(field["bytes"], line["byte_order"])
    stuffed = b"".join(bytes([len(piece) + 1]) + piece for piece in frame.split(b"\0"))
    sent = f"> {bytes([0, *stuffed, 0]).hex(' ').upper()}"
    assert sent == shown("serial", "Set, part 1 of 2")[0]

    status = {"state": SHEET["states"]["OPERATION_ENABLED"], "fault": 0, "flags": 1, "latch": 0}
    status |= {"watchdog_left": 250, "temperature": 250, "high_voltage": 1800}
    status |= {"clock": 0x60000000, "token": 0x0102, "channels": 4, "layers": 8}
    tokens = [0x0102, 0x0102, 0, 0x0101, 0, 0, 0, 0]
    first = [each for each in SHEET["messages"]["GetStatus"]["reply"] if not each.get("added")]
    words = packed(first, {**status, "levels": [3300, 3200, 0, 0], "tokens": tokens})
    assert words == listed_words()["Status"][: len(words)]  # readings that were added follow


@pytest.mark.parametrize("name", RECORDS)
def test_every_record_is_read_as_the_data_pack_it(name: str) -> None:
    """Requests, replies, Events, Naks and parts of them, with values anywhere in their ranges."""
    fields, record = RECORDS[name]
    rng = random.Random(name)
    for _ in range(20):
        values = drawn(fields, rng)
        assert record.unpack(packed(fields, values), is_strict=True) == values


def test_numbers_and_names_are_all_there() -> None:
    """Of messages, quantities, states, faults, codes, features, flags and units."""
    numbers = {"Hello": HELLO, "Event": EVENT, "Nak": NAK}
    numbers |= {name: each.number for name, each in MESSAGES.items()}
    assert {name: each["number"] for name, each in SHEET["messages"].items()} == numbers
    for name, each in MESSAGES.items():
        listed = SHEET["messages"][name]
        assert (listed["feeds"], listed["broadcast"]) == (each.feeds, each.is_broadcast)
    assert SHEET["quantities"].keys() == QUANTITIES.keys()
    for name, quantity in QUANTITIES.items():
        listed = SHEET["quantities"][name]
        for integer in (quantity.minimum, quantity.maximum):
            value = (integer - listed["zero"]) / listed["per_unit"]
            assert value == pytest.approx(quantity.from_wire(integer))
        assert (listed["type"], listed["unit"]) == (quantity.wire, quantity.unit)
    tables = {"states": STATES, "faults": FAULTS, "codes": REFUSALS, "features": FEATURES}
    tables["status_flags"] = STATUS_FLAGS
    assert {name: SHEET[name] for name in tables} == {
        name: json.loads(json.dumps(each)) for name, each in tables.items()
    }


def test_check_of_serial_frames_follows_from_its_parameters() -> None:
    """Bit by bit as the parameters say, against zlib and the value that the sheet states."""
    crc = SHEET["serial"]["crc"]
    assert crc["reflected"]
    polynomial = int(f"{crc['polynomial']:0{crc['width']}b}"[::-1], 2)
    register = crc["initial"]
    for byte in b"123456789":
        register ^= byte
        for _ in range(8):
            register = register >> 1 ^ (polynomial if register & 1 else 0)
    assert register ^ crc["xor"] == crc["check"] == zlib.crc32(b"123456789")


def test_registers_hold_what_the_layout_lists() -> None:
    """A commit of modbus.md: registers of its number, a tag before the request and its reply."""
    sheet = SHEET["modbus"]
    for name, each in sheet["registers"].items():
        number = SHEET["messages"][name]["number"]
        assert each == {"written_from": 0x100 * number, "reply_from": 0x100 * number + 0x80}
    written = bytes.fromhex("0600 0004 08 0001 2A17 0102 6000")  # place, count, bytes, registers
    assert struct.unpack_from(">H", written)[0] == sheet["registers"]["Commit"]["written_from"]
    tag, *words = struct.unpack_from(">4H", written, 5)
    assert sheet["layout"]["written"] == ["tag", "words of the request"]
    assert (tag, MESSAGES["Commit"].request.unpack(words, is_strict=True)) == (
        *(1, {"session": 0x2A17, "token": 0x0102, "at": 0x6000}),
    )
    tag, result, *words = struct.unpack(">5H", bytes.fromhex("0002 0000 0102 0006 0000"))
    assert [each.partition(":")[0] for each in sheet["layout"]["reply"]] == [
        *("tag", "result", "words of the reply", "zeros"),
    ]
    taken = MESSAGES["Set"].reply.unpack(words, is_strict=False)
    assert (tag, result, taken["token"], taken["staged"], taken["played"]) == (2, 0, 0x0102, 1, 0)


def test_each_read_of_the_status_object_is_a_status() -> None:
    """It uses up a Mark, as can.md says: the next subindex is of its own moment."""
    amplifier = SimulatedAmplifier("a", channels=4)
    objects = ObjectServer(amplifier, 1)
    (high,) = (at for at, word in enumerate(listed_words()["Status"], 1) if word == 0x6000)
    amplifier.handle("Mark", {}, 1.0)
    amplifier.withdraw_status()  # for all, without a reply
    shown = [int.from_bytes(objects.read(0x2002, high, 3.0), "little") for _ in range(2)]
    assert [round(each * 20 / 65536) for each in shown] == [1, 3]
