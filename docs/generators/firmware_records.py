"""The C header of what an amplifier sends, firmware/core/records.h.

Each record as a struct, and a function that appends its words: the firmware fills in fields by
their names, and the table says in which words they go.
"""

import textwrap
from collections.abc import Iterable, Iterator, Mapping
from itertools import groupby
from typing import TypeGuard

from drivers.protocol.definition import COMMAND, EVENT_RECORD, MESSAGES, NAK_RECORD
from drivers.protocol.records import Bits, Field, Number, Numbers, Record, Rows

_HEAD = """\
// SPDX-License-Identifier: MIT
//
// What an amplifier sends, made by docs/generators/firmware_records.py: do not edit it. Each record
// of protocol 4 is a struct, and a function that appends its words; RECORD_WORDS is their number
// with so many of what varies. A field that is not filled in is sent as 0. Readings, which a board
// takes, are a struct of their own.

#ifndef RECORDS_H
#define RECORDS_H

#include "words.h"

"""
_SENT: Mapping[str, Record] = {
    "capabilities": MESSAGES["GetCaps"].reply,
    "status": MESSAGES["GetStatus"].reply,
    "taken": MESSAGES["Set"].reply,
    "faults": MESSAGES["GetFaults"].reply,
    "achieved": MESSAGES["GetAchieved"].reply,
    "event": EVENT_RECORD,
    "nak": NAK_RECORD,
}
_READING_HEAD = "// Of a value in its unit, as WORD_OF_TEMPERATURE(25) of 25 degrees.\n"
_TYPES = {"u16": "uint16_t", "i16": "int16_t", "u32": "uint32_t"}


def records_header(sent: Mapping[str, Record] = _SENT) -> str:
    """Return the text of the header of records by name."""
    made = [text for name, record in sent.items() for text in _record(name, record)]
    return f"{_HEAD}{''.join(made)}#endif\n"


def _record(name: str, record: Record) -> Iterator[str]:
    """Return the rows of a record; then its struct, the number of its words, and its function."""
    for field in record.fields:
        if isinstance(field, Rows):
            yield from _record(_row(field), field.record)
    members = [*_members(each for each in record.fields if not _is_reading(each))]
    if readings := "".join(map(_reading, filter(_is_reading, record.fields))):
        yield f"struct readings {{\n{readings}}};\n"
        yield f"{_READING_HEAD}{''.join(map(_word_of, filter(_is_reading, record.fields)))}\n"
        members.append("    struct readings readings;\n")
    yield f"struct wire_{name} {{\n{''.join(members)}}};\n"
    if any(isinstance(field, Numbers | Rows) for field in record.fields):
        counts, number = _number_of_words(record)
        yield f"#define {name.upper()}_WORDS({counts}) ({number})\n"
    yield (
        f"static inline void put_{name}(struct words *words, const struct wire_{name} *from)\n"
        f"{{\n{''.join(_statements(record))}}}\n\n"
    )


def _row(field: Rows) -> str:
    """Return the name of a row: that of the field in the singular."""
    return "command" if field.record is COMMAND else field.name.removesuffix("s")


def _is_reading(field: Field) -> TypeGuard[Number]:
    return isinstance(field, Number) and bool(field.meaning)


def _reading(field: Number) -> str:
    """Return the line of a reading, with its unit and meaning."""
    meaning = field.meaning + "; 0: not measured" * field.is_added
    return f"    {_TYPES[field.quantity.wire]} {field.name}; // {field.quantity.scale}, {meaning}\n"


def _word_of(field: Number) -> str:
    """Return the macro of a reading's word, from its value in the unit."""
    quantity, name = field.quantity, field.name.upper()
    origin = f" + {quantity.zero}" if quantity.zero else ""
    return f"#define WORD_OF_{name}(value) ((value) * {quantity.per_unit}{origin})\n"


def _members(fields: Iterable[Field]) -> Iterator[str]:
    """Return the lines of the members of a struct, those of one type together."""
    typed = [member for field in fields for member in _typed(field)]
    for kind, members in groupby(typed, key=lambda member: member[0]):
        names = [name for _, name in members]
        if kind.endswith("*"):
            yield from (f"    {kind}{name};\n" for name in names)
        else:
            yield _wrapped(f"{kind} {', '.join(names)};")


def _typed(field: Field) -> list[tuple[str, str]]:
    """Return type and name of each member that a field becomes."""
    match field:
        case Number():
            return [(_TYPES[field.quantity.wire], field.name)]
        case Bits():
            return [("bool" if bits == 1 else "uint8_t", name) for name, bits in field.parts]
        case Numbers():
            return [("const uint16_t *", field.name)]
        case Rows():
            return [(f"const struct wire_{_row(field)} *", field.name)]
        case _:
            raise TypeError(f"{field.name} must have a form in C, got {type(field).__name__}")


def _number_of_words(record: Record) -> tuple[str, str]:
    """Return the names of what is counted, and how many words there are, as terms of C."""
    fixed = sum(len([*_values(field)]) for field in record.fields)
    counts, terms = list[str](), [f"{fixed}"]
    for field in record.fields:
        if isinstance(field, Numbers | Rows):
            counts.append(str(field.count))
            each = sum(len([*_values(inner)]) for inner in _inside(field))
            terms.append(f"{each} * ({field.count})" if each > 1 else f"({field.count})")
    return ", ".join(counts), " + ".join(terms)


def _inside(field: Numbers | Rows) -> tuple[Field, ...]:
    return field.record.fields if isinstance(field, Rows) else (Number("", field.quantity),)


def _statements(record: Record) -> Iterator[str]:
    """Return the statements that append the words of a record."""
    for is_fixed, fields in groupby(record.fields, lambda each: isinstance(each, Number | Bits)):
        if is_fixed:
            yield _wrapped(f"PUT(words, {', '.join(v for each in fields for v in _values(each))});")
            continue
        for field in fields:
            if isinstance(field, Numbers):
                yield f"    put_all(words, from->{field.name}, from->{field.count});\n"
            elif isinstance(field, Rows):
                yield f"    for (unsigned i = 0; i < from->{field.count}; i++)\n"
                yield f"        put_{_row(field)}(words, &from->{field.name}[i]);\n"


def _values(field: Field) -> Iterator[str]:
    """Return the words of a field of fixed length, as C computes them; ~: no line ends there."""
    if isinstance(field, Bits):
        parts = zip(field.parts, field.shifts, strict=True)
        shifted = [f"from->{name}{f'~<<~{by}' if by else ''}" for (name, _), by in parts]
        yield f"(uint16_t)({' | '.join(shifted)})"
    elif isinstance(field, Number):
        name = f"from->{'readings.' * _is_reading(field)}{field.name}"
        match field.quantity.wire:
            case "u32":
                yield f"(uint16_t)({name} >> 16)"
                yield f"(uint16_t){name}"
            case "i16":
                yield f"(uint16_t){name}"
            case _:
                yield name


def _wrapped(text: str) -> str:
    """Return a statement in lines of at most 99 characters, indented."""
    lines = textwrap.wrap(
        text,
        99,
        initial_indent=" " * 4,
        subsequent_indent=" " * 8,
        break_on_hyphens=False,
        break_long_words=False,
    )
    return "".join(f"{line}\n" for line in lines).replace("~", " ")
