"""The pages of protocol 4: a frame of each wire by hand, the files for masters and monitors."""

import json
import re
import textwrap
import zlib
from pathlib import Path
from typing import Any

import canopen
import cantools
import pytest

from drivers.playing import Playback
from drivers.protocol.sets import Command, Envelope, LayerSet
from era_haptics.lab.conformance.contract import CHECKS
from protocol_bytes import BYTES
from sim.amplifier.simulated_amplifier import SimulatedAmplifier
from sim.far_ends.can_amplifiers import ObjectServer

DOCS = Path(__file__).parents[2] / "docs" / "reference"

# Worked out from docs/decisions/0088-protocol-4.md and the standards, not by our codecs.
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
    limits = objects.read(0x2001, number, 0.0)
    assert int.from_bytes(limits, "little") == 10000


PAGE = (DOCS / "protocol.md").read_text("utf-8")


def rows_of(heading: str) -> list[list[str]]:
    """The cells of the table of protocol.md whose first row begins so, without its head."""
    table = PAGE.split(f"\n| {heading}")[1].partition("\n\n")[0]
    return [line.strip("| ").split(" | ") for line in table.splitlines()[2:]]


def envelope(*knots: tuple[int, int]) -> Envelope:
    """One whose knots are 10 ms apart."""
    return Envelope(100, knots)


SETS = (
    [LayerSet(0, 20, 0, (Command(0, 2200, 8000, 0),))],
    [LayerSet(0, 20, 0, (Command(0, 2200, 3000, 9000, onset=envelope((6000, 0))),))],
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
    names = ("t [ms]", "commit", "voice", "valid_for", "token")
    for name in names:
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


def test_memory_of_the_least_amplifier_is_its_sum() -> None:
    """The four terms of the page for one channel without knots, and for two with 32."""

    def memory(channels: int, knots: int, knot: int, voice: int) -> float:
        waiting = 8 * (3 + channels * (8 + 4 * knots))
        return 1151 + waiting + 12 * channels * (voice + 2 * knot * knots) + 100

    (stated,) = re.findall(r"That is (\d+) kB[^.]*, (\d+) kB[^.]* and (\d+) kB", PAGE)
    sums = memory(1, 0, 4, 40), memory(2, 32, 4, 40), memory(2, 32, 16, 40)
    assert [*map(int, stated)] == [round(each / 1000) for each in sums]


def test_checks_that_the_page_names_are_those_of_conformance() -> None:
    """Every name behind a mark, which vendors look for in a report."""
    named = set(re.findall(r"✓`(\w+)`", PAGE.partition("## Words")[2]))
    assert len(named) > 40
    assert named <= {check.name for check in CHECKS}


SHEET = json.loads((DOCS / "amplifier.json").read_text("utf-8"))


def packed(fields: list[Any], values: dict[str, Any]) -> list[int]:
    """The words of values by amplifier.json alone."""
    words: list[int] = []
    for field in fields:
        if field["kind"] == "number":
            size = 32 if SHEET["quantities"][field["quantity"]]["type"] == "u32" else 16
            number = values[field["name"]] % (1 << size)
            words += [number >> 16, number & 0xFFFF] if size == 32 else [number]
        elif field["kind"] == "bits":
            word = 0
            for part in field["parts"]:
                word = word << part["bits"] | values.get(part["name"], 0)
            words.append(word)
        else:
            words += values[field["name"]]
    return words


def unpacked(fields: list[Any], words: list[int]) -> dict[str, Any]:
    """The values of words by amplifier.json alone: numbers in their units."""
    values: dict[str, Any] = {}
    left = [*words]

    def number(name: str) -> float:
        quantity = SHEET["quantities"][name]
        word = left.pop(0)
        if quantity["type"] == "u32":
            word = word << 16 | left.pop(0)
        if quantity["type"] == "i16" and word > 0x7FFF:
            word -= 0x10000
        return (word - quantity["zero"]) / quantity["per_unit"]

    for field in fields:
        if field["kind"] == "number":
            values[field["name"]] = number(field["quantity"])
        elif field["kind"] == "bits":
            word = left.pop(0)
            for part in reversed(field["parts"]):
                values[part["name"]] = word & (1 << part["bits"]) - 1
                word >>= part["bits"]
        else:
            assert field["kind"] == "numbers"
            values[field["name"]] = [
                number(field["quantity"]) for _ in range(values[field["count"]])
            ]
    assert not left
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
    assert line["crc"]["check"] == zlib.crc32(b"123456789")
    stuffed = b"".join(bytes([len(piece) + 1]) + piece for piece in frame.split(b"\0"))
    sent = f"> {bytes([0, *stuffed, 0]).hex(' ').upper()}"
    assert sent == shown("serial", "Set, part 1 of 2")[0]

    status = unpacked(SHEET["messages"]["GetStatus"]["reply"], listed_words()["Status"])
    assert status["state"] == SHEET["states"]["OPERATION_ENABLED"]
    assert (status["watchdog_left"], status["temperature"], status["high_voltage"]) == (
        *(0.25, 25.0, 1800.0),
    )
    assert (status["clock"], status["token"]) == (0x60000000, 0x0102)
    assert status["levels"] == [0.33, 0.32, 0.0, 0.0]
    assert status["tokens"] == [0x0102, 0x0102, 0, 0x0101, 0, 0, 0, 0]


def test_data_name_the_registers_that_the_page_shows() -> None:
    """A commit is written and its reply read where the frames of modbus.md say so."""
    commit, status = shown("modbus", "Commit")[0], shown("modbus", "Commit")[2]
    registers = SHEET["modbus"]["registers"]["Commit"]
    place = slice(26, 31)  # behind transaction, protocol, length, unit and function
    assert int(commit[place].replace(" ", ""), 16) == registers["written_from"]
    assert int(status[place].replace(" ", ""), 16) == registers["reply_from"]


def test_each_read_of_the_status_object_is_a_status() -> None:
    """It uses up a Mark, as can.md says: the next subindex is of its own moment."""
    amplifier = SimulatedAmplifier("a", channels=4)
    objects = ObjectServer(amplifier, 1)
    (high,) = (at for at, word in enumerate(listed_words()["Status"], 1) if word == 0x6000)
    amplifier.handle("Mark", {}, 1.0)
    amplifier.withdraw_status()  # for all, without a reply
    shown = [int.from_bytes(objects.read(0x2002, high, 3.0), "little") for _ in range(2)]
    assert [round(each * 20 / 65536) for each in shown] == [1, 3]


def written_by_hand(page: str) -> str:
    """A page without the parts that `make pages` writes."""
    return re.sub(r"<!-- begin: written by .*?<!-- end -->\n", "", page, flags=re.DOTALL)


def test_pages_are_short() -> None:
    """What people write: 300 lines of the contract, and 100 of a wire; a table's rows are free."""
    lines = {
        page: written_by_hand((DOCS / f"{page}.md").read_text("utf-8")).count("\n")
        for page in BYTES
    }
    assert lines.pop("protocol") <= 300
    assert max(lines.values()) <= 100


def test_only_generated_lines_are_left_out_of_a_budget() -> None:
    """The marks go with what is between them."""
    page = "1\n<!-- begin: written by a b -->\n\nx\n\n<!-- end -->\n2\n"
    assert written_by_hand(page + page) == "1\n2\n1\n2\n"
