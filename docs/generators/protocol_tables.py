"""Tables of docs/reference/{protocol,modbus,can,metrics}.md, from `drivers.protocol.definition`."""

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
    **{"NOT_READY": "starting; replies if it can"},
    **{"SWITCH_ON_DISABLED": "**disarmed**, high voltage off"},
    **{"READY_TO_SWITCH_ON": "passed through immediately"},
    **{"SWITCHED_ON": "high voltage on, falling silent after a Disarm"},
    **{"OPERATION_ENABLED": "**armed**: plays, watchdog running"},
    **{"QUICK_STOP_ACTIVE": "**stopped**, latched; high voltage off once silent"},
    **{"FAULT_REACTION_ACTIVE": "falling silent because of a fault"},
    **{"FAULT": "silent, high voltage off, latched"},
    **{"NONE": "", "WATCHDOG": "not fed in time", "OVER_TEMPERATURE": "", "OVER_VOLTAGE": ""},
    **{"ARC": "", "CHANNEL": "one channel failed; all fall silent", "INTERNAL": ""},
    **{"INTERLOCK": "opened in 3, 4 or 5; ends once it is closed", "OVER_CURRENT": ""},
    **{"UNKNOWN_TYPE": "unknown message, or its feature is missing"},
    **{"BAD_LENGTH": "missing or extra words"},
    **{"BAD_VALUE": "number out of range, or a bit that must be 0"},
    **{"BAD_CHANNEL": "channel does not exist, or appears twice in a layer"},
    **{"WRONG_STATE": "not allowed in this state, or Arm with the interlock open"},
    **{"BAD_TOKEN": "0, not newer, or not staged"},
    **{"BUSY": "the host repeats the request after 5 ms, at most twice"},
    **{"UNSUPPORTED_VERSION": "version of the frame, on serial lines only"},
    **{"WRONG_SESSION": "session of another host, or an ended session"},
    **{"WRONG_LATCH": "Clear does not specify the last stop or fault"},
    **{"INCOMPLETE": "Commit of a set with missing parts"},
    **{"output": "full level is the output of a linear amplifier, not the amplitude of a motion"},
    **{"events": "sends Events on this wire"},
    **{"levels_measured": "levels in Status are measured, not computed"},
    **{"interlock": "has an interlock", "electrical": "GetMeasured"},
    **{"address": "SetAddress", "mark": "Mark"},
    "high_voltage": "on in states 3 and 4, and in 5 until silent; off in 6 once silent, or earlier",
    **{"interlock_open": "", "limited": "a sum was limited since the last Status"},
}
_PURPOSES = {
    "Hello": "returns the identity",
    "GetCaps": "returns the capabilities",
    "Arm": "begins a session, starts the watchdog, switches the high voltage on",
    "Disarm": "fades all voices, then switches the high voltage off",
    "Set": "transfers one part of a set",
    "Commit": "starts the staged set",
    "Silence": "fades all voices without disarming",
    "Stop": "fades all voices and latches",
    "GetStatus": "returns the current state",
    "GetFaults": "returns past faults",
    "Clear": "acknowledges a stop or a fault",
    "Ping": "feeds the watchdog, steers the clock",
    "GetAchieved": "returns the commands of a layer as they will be played",
    "GetMeasured": "returns voltages and currents",
    "SetAddress": "changes the address",
    "Mark": "stores the clock",
}
_CAPABILITY_MEANINGS = {
    "channels, layers": "numbers of channels and layers",
    "voices": "voices that each channel can play; at least the number of layers",
    "set_words": "longest stream of a set, in words",
    "knots": "maximum number of knots in an envelope",
    "features": "bits, listed above",
    "frequency_min, frequency_max, level_max": "limits of the whole amplifier, "
    "at least as wide as the limits of its channels",
    "frequency_step, level_step, phase_step": "resolution of playback",
    "ramp_max": "longest ramp",
    "slew": "fastest change of amplitude. A steeper change is played at this slope and arrives "
    "later; no host requests one. 0: no limit",
    "watchdog_min, watchdog_max": "limits of the watchdog time",
    "envelope_step_min, envelope_step_max": "limits of the step of an envelope",
    "clock_error": "largest error of a clock reading, or of the output relative to the clock, "
    "except for a constant error common to all amplifiers of a product; 65535: unknown, or the "
    "clock cannot be steered",
    "limits": "limits of each channel; sets are checked against these only",
}
_STATUS_MEANINGS = {
    "state, fault": "fault is NONE except in states 6 and 7",
    "flags": "bits, listed above",
    "latch": "number of the last stop or fault",
    "watchdog_left": "time until the watchdog expires; 0 unless armed",
    "temperature": "measured; 25 °C if it cannot be",
    "high_voltage": "measured, so it falls gradually; 0 if it cannot be",
    "clock": "see [the clock](#the-clock)",
    "token": "token of the last set committed since Arm; 0: none",
    "channels, layers": "see Capabilities",
    "levels": "level of each channel (below) at `clock`, or up to 0.2 ms earlier, but not from "
    "before the request or set that `state` and `tokens` show",
    "tokens": "token of the set that each layer plays; 0: the layer is over",
}


_WIDTH = 160


def _table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    lines = [head, ["---"] * len(head), *([str(cell) for cell in row] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _side_by_side(head: Sequence[str], rows: Sequence[Sequence[object]], parts: int) -> str:
    """Return a table split into parts that are placed side by side."""
    height = -(-len(rows) // parts)
    filled = [*rows, *[("",) * len(head)] * (height * parts - len(rows))]
    columns = (filled[height * part : height * (part + 1)] for part in range(parts))
    return _table((*head,) * parts, [[*chain(*row)] for row in zip(*columns, strict=True)])


def quantities() -> str:
    """Return the steps and ranges; quantities with equal values share a row."""
    groups: dict[tuple[object, ...], list[str]] = {}
    for each in QUANTITIES.values():
        row = f"{each.minimum} to {each.maximum}", each.scale
        groups.setdefault(row, []).append(each.name)
    rows = [(", ".join(names), *row) for row, names in groups.items()]
    return _side_by_side(("quantity", "integers", "one step is"), rows, 3)


def heads() -> str:
    """Return a picture of the shared words with a letter for each bit."""
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
    """Return the table of messages with the words of their requests."""

    def rows() -> Iterator[Sequence[object]]:
        yield "Hello", HELLO, _PURPOSES["Hello"], "–", "Identity", "", ""
        for each in MESSAGES.values():
            reply = next(name for name, record in _REPLIES.items() if record is each.reply)
            marks = ["yes" if mark else "" for mark in (each.feeds, each.is_broadcast)]
            words = layout(each.request) or "–"
            yield each.name, each.number, _PURPOSES[each.name], words, reply, *marks

    head = ("message", "number", "purpose", "words of the request", "reply", "feeds", "broadcast")
    return _table(head, rows())


def records() -> str:
    """Return the words of replies, and of the parts of a set."""
    rows = ((name, layout(record)) for name, record in {**_OTHERS, **_REPLIES}.items())
    return _table(("record", "words"), rows)


def fields(record: Record, meanings: Mapping[str, str]) -> str:
    """Return the fields of a record with their meanings; raises ValueError if one is missing."""
    explained = [name for names in meanings for name in names.split(", ")]
    names = list[str]()
    for field in record.fields:
        names += dict(field.parts) if isinstance(field, Bits) else [field.name]
    if sorted(explained) != sorted(names):
        raise ValueError(f"fields must be {', '.join(names)}, got {', '.join(explained)}")
    rows = []
    for names_of_row, text in meanings.items():
        marked = [f"`{name}`" for name in names_of_row.split(", ")]
        rows.append((", ".join(marked), text))
    return _table(("field", "meaning"), rows)


def _status_meanings() -> Mapping[str, str]:
    """Return the meanings of the fields of Status, including readings that were added later."""
    meanings = dict(_STATUS_MEANINGS)
    for reading in READINGS:
        meanings.setdefault(reading.name, f"{reading.meaning}; 0: not stated")
    return meanings


def readings() -> str:
    """Return the readings of Status, and the places that show them."""
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
    """Return the words of a record in order, with the quantity or bits of each field."""
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
    """Return names and numbers as a sentence, with meanings unless the name is enough."""
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
    """Return the words of objects 2001 and 2002, for four channels and eight layers."""

    def rows() -> Iterator[Sequence[object]]:
        for index, name in (("2001", "GetCaps"), ("2002", "GetStatus")):
            names = word_names(MESSAGES[name].reply, {"channels": 4, "layers": 8})
            shown = [f"{number} {each}" for number, each in enumerate(names, start=1)]
            yield index, " · ".join(shown)

    return _table(("object", "subindex and word, with four channels and eight layers"), rows())


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
        "capabilities": lambda: fields(MESSAGES["GetCaps"].reply, _CAPABILITY_MEANINGS),
        "status": lambda: fields(STATUS, _status_meanings()),
        "states": lambda: _blocks(transitions(), _lists({"States": STATES, "Faults": FAULTS})),
    },
    "metrics": {"readings": readings},
    "modbus": {"mailboxes": mailboxes},
    "can": {"emergencies": emergencies, "objects": objects},
}
"""Writers of the tables, by page and part."""
