"""The C header of protocol 4, firmware/core/protocol.h.

Numbers of states, faults, refusals and messages, ranges of quantities, the place of each field in
the words of a request, and what those words may be. Replies: `firmware_records.py`.
"""

import re
import textwrap
from collections.abc import Iterator, Mapping

from drivers.protocol.definition import (
    AHEAD_MAX,
    CLOCK_TURN,
    COMMAND,
    EVENT,
    FAULTS,
    FEATURES,
    HELLO,
    LAYER,
    MAX_WORDS,
    MESSAGES,
    NAK,
    NO_CHANNEL,
    QUANTITIES,
    REFUSALS,
    SHORTENED_FADE,
    STAGED_LIFE,
    STATES,
    STATUS_FLAGS,
    VERSION,
    Message,
)
from drivers.protocol.records import Bits, Number, Record
from drivers.wires.can_frames import CANOPEN

_HEAD = """\
// SPDX-License-Identifier: MIT
//
// Protocol 4 in numbers, made by docs/generators/firmware_header.py: do not edit it. A message is a
// row of 16-bit words (docs/reference/protocol.md). REQUEST_FIELD is the place of a field in
// the words of a request; small fields share a word, out of which FIELD_OF takes one. Ranges of
// quantities are those of the wire. Replies are in records.h.

#ifndef PROTOCOL_H
#define PROTOCOL_H

#include <stdbool.h>
#include <stdint.h>

#define FIELD_OF(bits, field) ((bits) >> field##_SHIFT & field##_MASK)
"""
_RANGES = (
    *("frequency_PER_UNIT", "WIRE_level_MAX", "level_PER_UNIT"),
    *("WIRE_phase_MIN", "WIRE_phase_MAX", "phase_PER_UNIT", "WIRE_ramp_MAX", "WIRE_valid_for_MAX"),
    *("WIRE_watchdog_MIN", "WIRE_watchdog_MAX", "WIRE_envelope_step_MAX"),
)
"""What the firmware uses of quantities; requests are checked by their table."""
_CODES = {"channel": "BAD_CHANNEL", "token": "BAD_TOKEN"}  # of words out of range, by quantity
_BREAK = "\\\n"
_TABLE = """\
// Each request: whether it may be a broadcast, feeds the watchdog and so names its session where,
// has words behind its fields; how many fields; lowest and highest value of each, and how others
// are refused.
#define REQUEST_FIELDS_MAX {most}
#define WITHIN(lowest, highest, code) {{.low = lowest, .high = highest, .nak = NAK_##code}}
#define REQUEST_TABLE"""


def header() -> str:
    """Return the text of the header."""
    parts = [
        _HEAD,
        _enum("", "", _constants()),
        _enum("state", "", STATES),
        _enum("fault", "FAULT_", FAULTS),
        _enum("nak", "NAK_", {"NONE": 0, **REFUSALS}),
        _enum("message", "MESSAGE_", _messages()),
        _enum("", "FLAG_", {name: 1 << bit for name, bit in STATUS_FLAGS.items()}),
        _enum("", "FEATURE_", {name: 1 << bit for name, bit in FEATURES.items()}),
        _block("enum", *_places(), *_rows()),
        _requests(),
        _emergencies(),
        "#endif\n",
    ]
    return "\n".join(part for part in parts if part)


def _upper(name: str) -> str:
    return re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).upper()


def _messages() -> Mapping[str, int]:
    numbers = {message.name: message.number for message in MESSAGES.values()}
    return {"Hello": HELLO, **numbers, "Event": EVENT, "Nak": NAK}


def _constants() -> Mapping[str, int]:
    """Return the numbers of the contract, with ranges of quantities and their steps per unit."""
    ranges = {
        name: number
        for each in QUANTITIES.values()
        for name, number in (
            (f"WIRE_{each.name}_MIN", each.minimum),
            (f"WIRE_{each.name}_MAX", each.maximum),
            (f"{each.name}_PER_UNIT", each.per_unit),
        )
    }
    return {
        **{"PROTOCOL_VERSION": VERSION, "WORDS_MAX": MAX_WORDS, "NO_CHANNEL": NO_CHANNEL},
        "STAGED_LIFE_MS": round(STAGED_LIFE * 1000),
        "SHORTENED_FADE_MS": round(SHORTENED_FADE * 1000),
        **{"CLOCK_TURN": round(CLOCK_TURN), "AHEAD_MAX": AHEAD_MAX},
        **{name: ranges[name] for name in _RANGES},
    }


def _enum(name: str, prefix: str, values: Mapping[str, int]) -> str:
    return _block(f"enum {name}".strip(), _numbers(prefix, values))


def _block(head: str, *numbers: str) -> str:
    return f"{head} {{\n{''.join(numbers)}}};\n"


def _numbers(prefix: str, values: Mapping[str, int]) -> str:
    """Return the names of values with their numbers, in lines of their own."""
    listed = ", ".join(f"{prefix}{_upper(each)}_=_{value}" for each, value in values.items())
    lines = textwrap.fill(listed, 99, initial_indent="    ", subsequent_indent="    ")
    return f"{lines},\n".replace("_=_", " = ")


def _places() -> Iterator[str]:
    """Return the places of the fields of each request up to the first of variable length."""
    for message in MESSAGES.values():
        places, at = dict[str, int](), 0
        for field in message.request.fields:
            places["BITS" if isinstance(field, Bits) else field.name] = at
            if not isinstance(field, Number | Bits):
                break
            at += 2 if isinstance(field, Number) and field.quantity.wire == "u32" else 1
        if places:
            yield _numbers(f"{_upper(message.name)}_", {**places, **_shared(message.request)})


def _rows() -> Iterator[str]:
    """Return what the words of a set are made of that several fields share."""
    yield _numbers("LAYER_", _shared(LAYER))
    yield _numbers("COMMAND_", _shared(COMMAND))


def _shared(record: Record) -> dict[str, int]:
    """Return shift and mask of each field that shares a word, and the largest such word."""
    numbers = dict[str, int]()
    for field in record.fields:
        if isinstance(field, Bits):
            for (name, width), shift in zip(field.parts, field.shifts, strict=True):
                numbers[f"{name}_SHIFT"], numbers[f"{name}_MASK"] = shift, (1 << width) - 1
            numbers["BITS_MAX"] = _most(field)
    return numbers


def _most(field: Bits) -> int:
    return (1 << sum(width for _, width in field.parts)) - 1


def _requests() -> str:
    """Return the rows of a table: what the words of each request may be."""
    lines = [line for message in MESSAGES.values() for line in _request(message)]
    most = max(len([*_words(message.request)]) for message in MESSAGES.values())
    return f"{_TABLE.format(most=most)}{''.join(f' {_BREAK}{line}' for line in lines)}\n"


def _request(message: Message) -> Iterator[str]:
    """Return the lines of a request: what is not 0 of it."""
    name, words = _upper(message.name), [*_words(message.request)]
    stated = {
        "is_broadcast": message.is_broadcast,
        "feeds": message.feeds,
        "has_tail": len(words) < len(message.request.fields),
    }
    named = [f".{key} = true" for key, is_so in stated.items() if is_so]
    if message.feeds:
        named.append(f".session = {name}_SESSION")
    named.append(f".fields = {len(words)}")
    if words:
        named.append(f".field = {{{', '.join(words)}}}")
    text = f"[MESSAGE_{name}] = {{{', '.join(named)}}},".replace(" = ", "~=~")
    for line in textwrap.wrap(text, 97, initial_indent=" " * 4, subsequent_indent=" " * 8):
        yield line.replace("~", " ")


def _words(record: Record) -> Iterator[str]:
    """Return the range of each word of a request, and how others are refused; ~: no line ends."""
    for field in record.fields:
        if isinstance(field, Number):
            code = _CODES.get(field.quantity.name, "BAD_VALUE")
            yield f"WITHIN({field.quantity.minimum},~{field.quantity.maximum},~{code})"
        elif isinstance(field, Bits):
            yield f"WITHIN(0,~{_most(field)},~BAD_VALUE)"


def _emergencies() -> str:
    """Return the rows of a table: what a CANopen node says of each fault."""
    rows = [
        f"    [FAULT_{name}] = {{.code = 0x{each['code']:04X}, "
        f".error_register = 0x{each['error_register']:02X}}},"
        for name, each in CANOPEN["emergencies"].items()
    ]
    head = "// Of each fault: code of the emergency, and the error register meanwhile (CiA 301).\n"
    return f"{head}#define EMERGENCY_TABLE {''.join(f' {_BREAK}{row}' for row in rows).lstrip()}\n"
