"""Print the C header of protocol 3: `firmware_header.py > firmware/core/protocol.h`.

Numbers of states, faults, refusals and messages, ranges of quantities, the place of each field in
the words of a record, and what the words of each request may be.
"""

import re
import sys
import textwrap
from collections.abc import Iterator, Mapping

from drivers.protocol.records import Bits, Number, Real, Record
from drivers.protocol.table import (
    COMMAND,
    ENVELOPE,
    EVENT,
    EVENT_RECORD,
    FAULTS,
    FEATURES,
    HELLO,
    KNOT,
    LAYER,
    MAX_WORDS,
    MESSAGES,
    NAK,
    NAK_RECORD,
    NO_CHANNEL,
    QUANTITIES,
    REFUSALS,
    SHORTENED_FADE,
    STAGED_LIFE,
    STATES,
    STATUS,
    STATUS_FLAGS,
    VERSION,
)

_HEAD = """\
// SPDX-License-Identifier: MIT
//
// Protocol 3 in numbers, made by docs/generators/firmware_header.py: do not edit it. A message is a
// row of 16-bit words (docs/decisions/0061-protocol-3.md). RECORD_FIELD is the place of a field in
// the words of a record, RECORD_WORDS their number without what varies; small fields share the word
// RECORD_BITS, out of which FIELD_OF takes one. Ranges of quantities are those of the wire, 0 to
// 65535 where nothing is said.

#ifndef PROTOCOL_H
#define PROTOCOL_H

#include <stdbool.h>
#include <stdint.h>

#define FIELD_OF(bits, field) ((bits) >> field##_SHIFT & field##_MASK)
"""
_RECORDS: Mapping[str, Record] = {
    **{message.name: message.request for message in MESSAGES.values()},
    "Capabilities": MESSAGES["GetCaps"].reply,
    "Status": STATUS,
    "Taken": MESSAGES["Set"].reply,
    "Faults": MESSAGES["GetFaults"].reply,
    "Achieved": MESSAGES["GetAchieved"].reply,
    **{"Event": EVENT_RECORD, "Nak": NAK_RECORD},
    **{"Layer": LAYER, "Command": COMMAND, "EnvelopeHead": ENVELOPE, "Knot": KNOT},
}
_CODES = {"channel": "BAD_CHANNEL", "token": "BAD_TOKEN"}  # of words out of range, by quantity


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
        _block("enum", *(_layout(name, record) for name, record in _RECORDS.items())),
        _requests(),
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
    constants = {
        **{"PROTOCOL_VERSION": VERSION, "WORDS_MAX": MAX_WORDS, "NO_CHANNEL": NO_CHANNEL},
        "STAGED_LIFE_MS": round(STAGED_LIFE * 1000),
        "SHORTENED_FADE_MS": round(SHORTENED_FADE * 1000),
    }
    for each in QUANTITIES.values():
        if each.minimum:
            constants[f"WIRE_{each.name}_MIN"] = each.minimum
        if each.maximum not in (0xFFFF, 0xFFFFFFFF):
            constants[f"WIRE_{each.name}_MAX"] = each.maximum
        if each.per_unit != 1:
            constants[f"{each.name}_PER_UNIT"] = each.per_unit
    return constants


def _enum(name: str, prefix: str, values: Mapping[str, int]) -> str:
    return _block(f"enum {name}".strip(), _numbers(prefix, values))


def _block(head: str, *numbers: str) -> str:
    return f"{head} {{\n{''.join(numbers)}}};\n"


def _numbers(prefix: str, values: Mapping[str, int]) -> str:
    """Return the names of values with their numbers, in lines of their own."""
    listed = ", ".join(f"{prefix}{_upper(each)}_=_{value}" for each, value in values.items())
    lines = textwrap.fill(listed, 99, initial_indent="    ", subsequent_indent="    ")
    return f"{lines},\n".replace("_=_", " = ")


def _layout(name: str, record: Record) -> str:
    """Return the places of the fields of a record up to the first of variable length."""
    places, bits, at = dict[str, int](), dict[str, int](), 0
    for field in record.fields:
        if field in record.added:
            break
        places["BITS" if isinstance(field, Bits) else field.name] = at
        if not isinstance(field, Number | Bits | Real):
            break
        at += field.words
        bits = _bits(field) if isinstance(field, Bits) else bits
    return _numbers(f"{_upper(name)}_", {**places, "WORDS": at, **bits}) if places else ""


def _bits(field: Bits) -> dict[str, int]:
    places, shift = dict[str, int](), sum(width for _, width in field.parts)
    for name, width in field.parts:
        shift -= width
        places[f"{name}_SHIFT"], places[f"{name}_MASK"] = shift, (1 << width) - 1
    return places


def _requests() -> str:
    """Return the rows of a table: what the words of each request may be."""
    rows = []
    for message in MESSAGES.values():
        fields = [*_fields(message.request)]
        has_tail = len(fields) < len(message.request.fields)
        flags = (message.is_broadcast, message.feeds, has_tail)
        shown = [str(flag).lower() for flag in flags]
        rows.append(
            f"    [{message.number}] = {{{', '.join(shown)}, {len(fields)}, "
            f"{{{', '.join(fields) or '{0, 0, 0}'}}}}},"
        )
    return (
        "// Each request: whether it may be a broadcast, feeds the watchdog, has words behind its\n"
        "// fields; how many fields; lowest and highest value of each, and the number with which\n"
        "// others are refused.\n"
        "#define REQUEST_TABLE \\\n" + " \\\n".join(rows) + "\n"
    )


def _fields(record: Record) -> Iterator[str]:
    for field in record.fields:
        if isinstance(field, Number):
            code = REFUSALS[_CODES.get(field.quantity.name, "BAD_VALUE")]
            yield f"{{{field.quantity.minimum}, {field.quantity.maximum}, {code}}}"
        elif isinstance(field, Bits):
            width = sum(width for _, width in field.parts)
            yield f"{{0, {(1 << width) - 1}, {REFUSALS['BAD_VALUE']}}}"


if __name__ == "__main__":
    sys.stdout.write(header())
