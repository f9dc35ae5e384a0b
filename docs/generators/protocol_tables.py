"""The tables of docs/reference/{protocol,modbus,can}.md, from `drivers.protocol.definition`."""

import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import chain
from typing import get_args

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
    READINGS,
    REFUSALS,
    STATES,
    STATUS,
    STATUS_FLAGS,
)
from drivers.protocol.records import (
    Bits,
    Number,
    Numbers,
    Record,
    Rest,
    Rows,
    Text,
    View,
)
from drivers.wires.can_frames import CANOPEN
from sim.amplifier.simulated_amplifier import AMPLIFIER_TRANSITIONS
from word_names import word_names

_REPLIES: Mapping[str, Record] = {
    **{"Capabilities": MESSAGES["GetCaps"].reply, "Status": STATUS},
    **{"Taken": MESSAGES["Set"].reply, "Faults": MESSAGES["GetFaults"].reply},
    **{"Achieved": MESSAGES["GetAchieved"].reply, "Measured": MESSAGES["GetMeasured"].reply},
}
_OTHERS: Mapping[str, Record] = {
    **{"layer": LAYER, "command": COMMAND, "envelope": ENVELOPE, "knot": KNOT},
    **{f"Event, {EVENT}": EVENT_RECORD, f"Nak, {NAK}": NAK_RECORD, "Identity": IDENTITY},
}
_MEANINGS = {
    **{"NOT_READY": "starting, replies if it can"},
    **{"SWITCH_ON_DISABLED": "**disarmed**, high voltage off"},
    **{"READY_TO_SWITCH_ON": "passed at once"},
    **{"SWITCHED_ON": "high voltage on, falling silent after a Disarm"},
    **{"OPERATION_ENABLED": "**armed**: plays, watchdog running"},
    **{"QUICK_STOP_ACTIVE": "**stopped**, latched; high voltage off once silent"},
    **{"FAULT_REACTION_ACTIVE": "falling silent because of a fault"},
    **{"FAULT": "silent, high voltage off, latched"},
    **{"NONE": "", "WATCHDOG": "not fed in time", "OVER_TEMPERATURE": "", "OVER_VOLTAGE": ""},
    **{"ARC": "", "CHANNEL": "one channel failed; all fall silent", "INTERNAL": ""},
    **{"INTERLOCK": "opened in 3, 4 or 5; gone once closed", "OVER_CURRENT": ""},
    **{"UNKNOWN_TYPE": "no such message, or a feature that is not there"},
    **{"BAD_LENGTH": "words are missing or too many"},
    **{"BAD_VALUE": "a number out of range, or a bit that must be 0"},
    **{"BAD_CHANNEL": "no such channel, or twice in a layer"},
    **{"WRONG_STATE": "not in this state, or Arm with the interlock open"},
    **{"BAD_TOKEN": "0, not newer, or not staged"},
    **{"BUSY": "the host repeats the request after 5 ms, at most twice"},
    **{"UNSUPPORTED_VERSION": "of the frame: serial lines alone"},
    **{"WRONG_SESSION": "another's, or one that has ended"},
    **{"WRONG_LATCH": "Clear names another stop or fault than the last"},
    **{"INCOMPLETE": "of a set under Commit"},
    **{"output": "full level is a linear amplifier's output, not the stroke of a motion"},
    **{"events": "it sends Events on this wire"},
    **{"levels_measured": "the levels of Status are measured, not computed"},
    **{"interlock": "it has an interlock", "electrical": "GetMeasured"},
    **{"address": "SetAddress", "mark": "Mark"},
    **{"high_voltage": "", "interlock_open": ""},
    **{"limited": "a sum was limited since the last Status"},
}


_WIDTH = 160


def _table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    lines = [head, ["---"] * len(head), *([str(cell) for cell in row] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _side_by_side(head: Sequence[str], rows: Sequence[Sequence[object]], parts: int) -> str:
    """Return a table in parts that stand beside each other."""
    height = -(-len(rows) // parts)
    filled = [*rows, *[("",) * len(head)] * (height * parts - len(rows))]
    columns = (filled[height * part : height * (part + 1)] for part in range(parts))
    return _table((*head,) * parts, [[*chain(*row)] for row in zip(*columns, strict=True)])


def quantities() -> str:
    """Return the steps and ranges, a row for all quantities that have the same."""
    groups: dict[tuple[object, ...], list[str]] = {}
    for each in QUANTITIES.values():
        row = f"{each.minimum} to {each.maximum}", each.scale
        groups.setdefault(row, []).append(each.name)
    rows = [(", ".join(names), *row) for row, names in groups.items()]
    return _side_by_side(("quantity", "integers", "one step is"), rows, 3)


def heads() -> str:
    """Return the bits of words that are shared, as a picture: a letter for each bit."""
    shared = {"Set": MESSAGES["Set"].request, "layer": LAYER, "command": COMMAND}
    shared |= {"Taken": MESSAGES["Set"].reply, "Status": STATUS}
    lines = ["bit      " + " ".join(f"{bit:2}" for bit in range(15, -1, -1))]
    for name, record in shared.items():
        (bits,) = (field for field in record.fields if isinstance(field, Bits))
        letters = dict(zip("abcde", bits.parts, strict=False))
        row = [letter for letter, (_, count) in letters.items() for _ in range(count)]
        row = ["0"] * (16 - len(row)) + row
        legend = " · ".join(f"{letter} {part}" for letter, (part, _) in letters.items())
        lines.append(f"{name:9}" + " ".join(f"{cell:>2}" for cell in row) + f"   {legend}")
    return textwrap.indent("\n".join(lines), "    ")


def messages() -> str:
    """Return the messages with the words of their requests."""

    def rows() -> Iterator[Sequence[object]]:
        yield "Hello", HELLO, "–", "Identity", "", ""
        for each in MESSAGES.values():
            reply = next(name for name, record in _REPLIES.items() if record is each.reply)
            marks = ["yes" if mark else "" for mark in (each.feeds, each.is_broadcast)]
            yield each.name, each.number, layout(each.request) or "–", reply, *marks

    return _table(
        ("message", "number", "words of the request", "reply", "feeds", "broadcast"), rows()
    )


def records() -> str:
    """Return the words of replies and of the parts of a set."""
    rows = ((name, layout(record)) for name, record in {**_OTHERS, **_REPLIES}.items())
    return _table(("record", "words"), rows)


def readings() -> str:
    """Return the readings of Status, and where they are shown."""
    rows = (
        (
            *(each.name, f"`{each.key}`", f"`era_amplifier_{each.metric}`"),
            *("yes" if view in each.views else "" for view in get_args(View)),
            each.meaning + "; null: not stated" * each.is_added,
        )
        for each in READINGS
    )
    return _table(("reading", "key", "metric", "`era status`", "dashboard", ""), rows)


def layout(record: Record) -> str:
    """Return the words of a record in their order, each field with its quantity or bits."""
    return " · ".join(map(_field, record.fields))


def _field(field: object) -> str:
    match field:
        case Number(name=name, quantity=quantity, words=words, is_added=is_added):
            kind = "" if name == quantity.name else f": {quantity.name}"
            marks = "; ".join(["2 words"] * (words - 1) + ["added"] * is_added)
            return name + kind + (f" ({marks})" if marks else "")
        case Bits(parts=parts):
            return "[" + ", ".join(f"{name} {bits}" for name, bits in parts) + "]"
        case Text(name=name):
            return f"{name}: text"
        case Numbers(name=name, count=count, quantity=quantity):
            return f"{name}: {quantity.name}, each of {count}"
        case Rows(name=name, count=count, record=record):
            if record is COMMAND:
                return f"{name}: a command, each of {count}"
            of = "the reading" if isinstance(count, int) else count
            return f"{name}, each of {of}: ({layout(record)})"
        case Rest(name=name):
            return f"{name}: words to the end"
    raise TypeError(type(field))


def transitions() -> str:
    """Return the state after each request, by state."""
    groups: dict[tuple[str, ...], list[str]] = {}
    for name in MESSAGES:
        row = tuple(
            "–"
            if (after := AMPLIFIER_TRANSITIONS.get((state, name))) is None
            else str(STATES[after])
            for state in STATES
        )
        groups.setdefault(row, []).append(name)
    rows = ((", ".join(names), *row) for row, names in groups.items())
    return _table(("request", *(f"in {number}" for number in STATES.values())), rows)


def _list(title: str, named: Mapping[str, int]) -> str:
    """Return names and numbers as a sentence, with meanings where the name is not enough."""
    listed = (
        f"{name} {number}" + (f" ({_MEANINGS[name]})" if _MEANINGS[name] else "")
        for name, number in named.items()
    )
    text = f"- **{title}**: {', '.join(listed)}."
    return textwrap.fill(text, _WIDTH, subsequent_indent="  ", break_on_hyphens=False)


def mailboxes() -> str:
    """Return the registers of each message on Modbus."""
    cells = [(each.name, 256 * each.number, 256 * each.number + 128) for each in MESSAGES.values()]
    return _side_by_side(("message", "written from", "reply from register"), cells, 2)


def emergencies() -> str:
    """Return the error code and error register of each fault on CAN."""
    rows = (
        (name, FAULTS[name], f"{each['code']:04X}", f"{each['error_register']:02X}")
        for name, each in CANOPEN["emergencies"].items()
    )
    return _table(("fault", "number", "error code", "error register"), rows)


def objects() -> str:
    """Return the words of the objects 2001 and 2002 of four channels and eight layers."""

    def rows() -> Iterator[Sequence[object]]:
        for index, name in (("2001", "GetCaps"), ("2002", "GetStatus")):
            names = word_names(MESSAGES[name].reply, {"channels": 4, "layers": 8})
            shown = [f"{number} {each}" for number, each in enumerate(names, start=1)]
            yield index, " · ".join(shown)

    return _table(("object", "subindex and word, of four channels and eight layers"), rows())


def _blocks(*written: str) -> str:
    return "\n\n".join(written)


def _lists(named: Mapping[str, Mapping[str, int]]) -> str:
    return "\n".join(_list(title, each) for title, each in named.items())


_LISTS = {"Features, by bit": FEATURES, "Flags of Status, by bit": STATUS_FLAGS}
TABLES: Mapping[str, Mapping[str, Callable[[], str]]] = {
    "protocol": {
        "numbers": lambda: _blocks(quantities(), heads()),
        "messages": lambda: _blocks(
            messages(), records(), _lists({**_LISTS, "Codes of a Nak": REFUSALS})
        ),
        "states": lambda: _blocks(transitions(), _lists({"States": STATES, "Faults": FAULTS})),
    },
    "metrics": {"readings": readings},
    "modbus": {"mailboxes": mailboxes},
    "can": {"emergencies": emergencies, "objects": objects},
}
"""What writes each table, by page and part."""
