"""Redaction of texts for a report: of keys that this program does not know only the names remain.

Free text, as in causes and names, is not searched: whoever sends a report looks at it before.
"""

import re
from dataclasses import fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any, get_args

from pydantic import BaseModel

from controller.api.methods import StatusResult
from controller.daemon.config_sections import DaemonSection
from controller.effects.layout_file import LayoutSection
from drivers.protocol.records import Record, Rows
from drivers.protocol.table import EVENT_RECORD, IDENTITY, MESSAGES, NAK_RECORD
from model.rig.sections import RigSection

_COMMENT = re.compile(r"(?m)(?:^|(?<=\s))#.*$")
_HOST = re.compile(r"(?<=://)[^/?#\s\"']+")
_PARAMETER = re.compile(r"""([\w-]+)(=)([^\s,&#}"']+)""")  # of a URL
_ENTRY = re.compile(
    r"""([\w-]+)(["']?[ \t]*:[ \t]*)(?!//)("[^"\n]*"|'[^'\n]*'|[^\s,{}\[\]"'][^\n,{}\[\]"']*)"""
)  # of YAML or JSON


_HIDDEN = "hidden"


def shown(text: str, *, home: Path, is_dump: bool = False) -> str:
    """Hide in a text the values of unknown keys, hosts and comments.

    home: the folder that is replaced by ~; is_dump: of messages on a link.
    """
    keys = (_keys_of_dumps() if is_dump else _keys(*_OF_FILES)) - _PRIVATE

    def entry(found: re.Match[str]) -> str:
        key, separator, value = found.groups()
        return f"{key}{separator}{value if key in keys else _HIDDEN}"

    if home != home.parent:  # the home "/" of system users is part of every path
        text = text.replace(str(home), "~")
    text = _HOST.sub(_HIDDEN, _COMMENT.sub("", text))
    return _ENTRY.sub(entry, _PARAMETER.sub(entry, text))


_OF_FILES = (RigSection, DaemonSection, LayoutSection, StatusResult)
_PRIVATE = frozenset({"serial_number"})
_OTHERS = ("baud", "bitrate", "timeout", "cause", "unix_time_s", "link", "way", "message")


@cache
def _keys_of_dumps() -> frozenset[str]:
    """Every field of the messages of amplifiers, and the keys of a line."""
    records = [EVENT_RECORD, IDENTITY, NAK_RECORD]
    for message in MESSAGES.values():
        records += (message.request, message.reply)
    return frozenset({*_OTHERS, "time_s"}.union(*map(_fields_of, records)))


def _fields_of(record: Record) -> set[str]:
    names = set(record.names)
    for field in record.fields:
        if isinstance(field, Rows):
            names |= _fields_of(field.record)
    return names


@cache
def _keys(*models: Any) -> frozenset[str]:
    """Every key of these models at any depth, and of URLs."""
    found, pending, seen = {*_OTHERS}, [*models], set[int]()
    while pending:
        each = pending.pop()
        if id(each) in seen:
            continue
        seen.add(id(each))
        pending += get_args(each)
        if is_dataclass(each):
            found.update(field.name for field in fields(each))
        elif isinstance(each, type) and issubclass(each, BaseModel):
            for name, field in each.model_fields.items():
                found.add(field.alias or name)
                pending.append(field.annotation)
    return frozenset(found)
