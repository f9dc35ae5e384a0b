"""All of docs/reference/amplifier.json by a reader that knows nothing else, against the codecs."""

import json
import random
import struct
import zlib
from pathlib import Path
from typing import Any

import pytest

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
    READING_STATES,
    REFUSALS,
    SENSOR_UNITS,
    STATES,
    STATUS_FLAGS,
    sensor_reading,
)
from drivers.protocol.records import Record

SHEET = json.loads(
    (Path(__file__).parents[2] / "docs" / "reference" / "amplifier.json").read_text("utf-8")
)
RECORDS: dict[str, tuple[list[Any], Record]] = {
    "Hello": (SHEET["messages"]["Hello"]["reply"], IDENTITY),
    "Event": (SHEET["messages"]["Event"]["reply"], EVENT_RECORD),
    "Nak": (SHEET["messages"]["Nak"]["reply"], NAK_RECORD),
    "sensor_of_a_reading": (SHEET["records"]["sensor_of_a_reading"], sensor_reading(1)),
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


def drawn(fields: list[Any], rng: random.Random) -> tuple[dict[str, Any], list[int]]:
    """Values of fields within their ranges, and the words that the sheet makes of them."""
    values: dict[str, Any] = {}
    words: list[int] = []
    counts = {field.get("count") for field in fields}

    def number(name: str) -> int:
        quantity = SHEET["quantities"][name]
        return rng.randint(quantity["min"], quantity["max"])

    def word(quantity: str, value: int) -> list[int]:
        if SHEET["quantities"][quantity]["type"] == "u32":
            return [value >> 16, value & 0xFFFF]
        return [value & 0xFFFF]

    for field in fields:
        name = field.get("name")
        match field["kind"]:
            case "number":
                values[name] = ROWS if name in counts else number(field["quantity"])
                words += word(field["quantity"], values[name])
            case "bits":
                packed = 0
                for part in field["parts"]:
                    one = ROWS if part["name"] in counts else rng.getrandbits(part["bits"])
                    values[part["name"]] = one
                    packed = packed << part["bits"] | one
                words.append(packed)
            case "f32":
                (values[name],) = struct.unpack(">f", struct.pack(">f", rng.uniform(0, 1000)))
                words += struct.unpack(">HH", struct.pack(">f", values[name]))
            case "text":
                values[name] = "".join(rng.choices("aZ 9-µ", k=rng.randint(0, 15)))
                raw = values[name].encode()
                words.append(len(raw))
                words += struct.unpack(f">{(len(raw) + 1) // 2}H", raw + b"\0" * (len(raw) % 2))
            case "numbers":
                values[name] = [number(field["quantity"]) for _ in range(ROWS)]
                words += [each & 0xFFFF for each in values[name]]
            case "rows":
                count = ROWS if isinstance(field["count"], str) else field["count"]
                rows = [drawn(field["fields"], rng) for _ in range(count)]
                values[name] = [row for row, _ in rows]
                words += [each for _, row in rows for each in row]
            case "words to the end":
                values[name] = [rng.getrandbits(16) for _ in range(ROWS)]
                words += values[name]
            case kind:
                pytest.fail(f"kind must be known, got {kind}")
    return values, words


@pytest.mark.parametrize("name", RECORDS)
def test_every_record_is_read_as_the_data_pack_it(name: str) -> None:
    """Requests, replies, Events, Naks and parts of them, with values anywhere in their ranges."""
    fields, record = RECORDS[name]
    rng = random.Random(name)
    for _ in range(20):
        values, words = drawn(fields, rng)
        assert record.unpack(words, is_strict=True) == values


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
    tables |= {"status_flags": STATUS_FLAGS, "sensor_units": SENSOR_UNITS}
    tables["reading_states"] = READING_STATES
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
