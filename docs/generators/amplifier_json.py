"""The protocol on serial lines and Modbus as JSON: docs/reference/amplifier.json.

All numbers are from `drivers.protocol.definition` and from the wires.
"""

import json
from collections.abc import Mapping
from typing import Any

from drivers.protocol.definition import (
    AHEAD_MAX,
    CLOCK_TURN,
    CLOCK_UNKNOWN,
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
    MAX_WORDS,
    MESSAGES,
    NAK,
    NAK_RECORD,
    NO_CHANNEL,
    QUANTITIES,
    REACTION,
    REFUSALS,
    RESERVED_MESSAGES,
    STAGED_LIFE,
    STATES,
    STATUS_FLAGS,
    VERSION,
)
from drivers.protocol.records import TEXT_MAX, Bits, Number, Numbers, Record, Rest, Rows, Text
from drivers.protocol.sets import MAX_PARTS, PART_WORDS
from drivers.wires.modbus_frames import (
    AREA,
    BOX,
    IDENTITY_COUNT,
    IDENTITY_REGISTER,
    READ,
    REPLY_OFFSET,
    WRITE,
)
from drivers.wires.serial_frames import PAYLOAD_MAX
from sim.amplifier.simulated_amplifier import AMPLIFIER_TRANSITIONS

_SERIAL: Mapping[str, Any] = {
    "line": {"baud": 921_600, "data_bits": 8, "parity": "none", "stop_bits": 1},
    "delimiter": 0,
    "stuffing": "COBS",
    "fields": [
        *({"name": name, "bytes": 1} for name in ("type", "version", "address")),
        {"name": "sequence", "bytes": 2},
        {"name": "payload", "bytes": f"0 to {PAYLOAD_MAX}", "of": "the words of the message"},
        {"name": "crc", "bytes": 4, "over": "type to payload"},
    ],
    "byte_order": "little",
    "reply_bit": 7,
    "hello_version": 0,
    "crc": {
        **{"width": 32, "polynomial": 0x04C11DB7, "initial": 0xFFFFFFFF, "xor": 0xFFFFFFFF},
        **{"reflected": True, "check": 0xCBF43926},
    },
}


def json_text() -> str:
    """Return the JSON file."""
    return json.dumps(_protocol(), indent=1, ensure_ascii=False) + "\n"


def _protocol() -> dict[str, Any]:
    records = {"layer": LAYER, "command": COMMAND, "envelope": ENVELOPE, "knot": KNOT}
    return {
        "version": VERSION,
        "limits": {
            **{"words_of_a_message": MAX_WORDS, "words_of_a_part": PART_WORDS},
            **{"parts_of_a_set": MAX_PARTS, "bytes_of_a_text": TEXT_MAX, "no_channel": NO_CHANNEL},
            **{"reply_s": REACTION, "staged_s": STAGED_LIFE, "clock_turn_s": CLOCK_TURN},
            **{"steps_ahead_of_a_commit": AHEAD_MAX, "clock_error_unknown": CLOCK_UNKNOWN},
        },
        "quantities": {
            name: {
                **{"type": each.wire, "min": each.minimum, "max": each.maximum},
                **{"per_unit": each.per_unit, "unit": each.unit, "zero": each.zero},
            }
            for name, each in QUANTITIES.items()
        },
        "records": {name: _fields(record) for name, record in records.items()},
        "messages": {
            "Hello": {"number": HELLO, "request": [], "reply": _fields(IDENTITY)},
            **{
                each.name: {
                    **{"number": each.number, "feeds": each.feeds},
                    **{"broadcast": each.is_broadcast, "request": _fields(each.request)},
                    **{"reply": _fields(each.reply)},
                    "states": {
                        f"{STATES[state]}": STATES[after]
                        for (state, name), after in AMPLIFIER_TRANSITIONS.items()
                        if name == each.name
                    },
                }
                for each in MESSAGES.values()
            },
            "Event": {"number": EVENT, "reply": _fields(EVENT_RECORD)},
            "Nak": {"number": NAK, "reply": _fields(NAK_RECORD)},
        },
        "reserved_numbers": [*RESERVED_MESSAGES],
        **{"states": STATES, "faults": FAULTS, "codes": REFUSALS, "features": FEATURES},
        "status_flags": STATUS_FLAGS,
        **{"serial": _SERIAL, "modbus": _modbus()},
    }


def _modbus() -> dict[str, Any]:
    return {
        **{"write_function": WRITE, "read_functions": [3, READ], "word_order": "big"},
        "layout": {
            "written": ["tag", "words of the request"],
            "reply": ["tag", "result: 0, or code · 256 + channel", "words of the reply", "zeros"],
        },
        **{"reply_area_registers": AREA, "registers_of_a_message": BOX},
        "identity": {"register": IDENTITY_REGISTER, "count": IDENTITY_COUNT},
        "registers": {
            name: {
                "written_from": BOX * each.number,
                "reply_from": BOX * each.number + REPLY_OFFSET,
            }
            for name, each in MESSAGES.items()
        },
    }


def _fields(record: Record) -> list[dict[str, Any]]:
    return [_field(each) for each in record.fields]


def _field(field: object) -> dict[str, Any]:
    """Return a field; its kind determines the number and the type of its words."""
    match field:
        case Number(name=name, quantity=quantity, is_added=is_added):
            added = {"added": True} if is_added else {}
            return {"name": name, "kind": "number", "quantity": quantity.name, **added}
        case Bits(parts=parts):
            # From the highest to the lowest used bits of the word.
            return {"kind": "bits", "parts": [{"name": each, "bits": bits} for each, bits in parts]}
        case Text(name=name):
            return {"name": name, "kind": "text"}
        case Numbers(name=name, count=count, quantity=quantity):
            return {"name": name, "kind": "numbers", "quantity": quantity.name, "count": count}
        case Rows(name=name, count=count, record=record):
            return {"name": name, "kind": "rows", "count": count, "fields": _fields(record)}
        case Rest(name=name):
            return {"name": name, "kind": "words to the end"}
    raise TypeError(type(field))
