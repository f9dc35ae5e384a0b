"""Redaction of texts for a report: known keys with their values, numbers and own words remain.

Anything else is hidden, since secrets cannot be recognised. A hidden word has the
same number throughout a report, so that it can still be followed.
"""

import re
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any, get_args

from pydantic import BaseModel

import drivers.protocol.messages
from controller.api.methods import StatusResult
from controller.daemon.config_sections import DaemonSection
from controller.effects.layout_file import LayoutSection
from model.rig.sections import RigSection

_PACKAGES = ("controller", "drivers", "model", "registry", "sim")
_COMMENT = re.compile(r"(?m)(?:^|(?<=\s))#.*$")
_HOST = re.compile(r"(?<=://)[^/?#\s\"']+")
_PARAMETER = re.compile(r"""([\w-]+)(=)([^\s,&#}"']+)""")  # of a URL
_ENTRY = re.compile(
    r"""([\w-]+)(["']?[ \t]*:[ \t]*)(?!//)("[^"\n]*"|'[^'\n]*'|[^\s,{}\[\]"'][^\n,{}\[\]"']*)"""
)  # of YAML or JSON
_WORD = re.compile(r"\w[\w-]*")
_NUMBER = re.compile(r"[\d_]+(?:e[+-]?\d+)?|\d+[^\W\d_]{1,4}|0x[\da-f]+", re.IGNORECASE)


class Shown:
    """Shows texts of one report; home: the folder that is replaced by ~."""

    def __init__(self, *, home: Path) -> None:
        self._home = home
        self._hidden: dict[str, str] = {}

    def text(self, text: str, *, is_dump: bool = False) -> str:
        """The text with everything hidden that is not known; is_dump: of messages on a link."""
        keys = _keys(*(_OF_DUMPS if is_dump else _OF_FILES))
        if self._home != self._home.parent:  # the home "/" of system users is part of every path
            text = text.replace(str(self._home), "~")
        text = _COMMENT.sub("", text)
        text = _HOST.sub(lambda found: self._hide(found[0]), text)
        for pattern in (_PARAMETER, _ENTRY):
            text = pattern.sub(lambda found: self._value(keys, *found.groups()), text)
        return _WORD.sub(lambda found: self._word(found[0]), text)

    def _value(self, keys: frozenset[str], key: str, separator: str, value: str) -> str:
        return f"{key}{separator}{value if key in keys else self._hide(value)}"

    def _word(self, word: str) -> str:
        if word in _words() or _NUMBER.fullmatch(word) or re.fullmatch(r"hidden-\d+", word):
            return word
        return self._hide(word)

    def _hide(self, what: str) -> str:
        return self._hidden.setdefault(what, f"hidden-{len(self._hidden) + 1}")


@cache
def _words() -> frozenset[str]:
    """Every word of this program's own files: none of them is the user's."""
    found: set[str] = set()
    for package in _PACKAGES:
        spec = find_spec(package)
        for folder in (spec and spec.submodule_search_locations) or ():
            for file in Path(folder).rglob("*"):
                if file.suffix in (".py", ".yaml"):
                    found.update(_WORD.findall(file.read_text("utf-8")))
    return frozenset(found)


_OF_FILES = (RigSection, DaemonSection, LayoutSection, StatusResult)
_OF_DUMPS = tuple(each for each in vars(drivers.protocol.messages).values() if is_dataclass(each))
_OTHERS = ("baud", "bitrate", "timeout", "cause", "unix_time_s", "link", "way", "message")


@cache
def _keys(*models: Any) -> frozenset[str]:
    """Every key of these models at any depth, and of URLs and dumps."""
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


def installed_from(direct_url: Mapping[str, Any] | None) -> str:
    """Where a package was installed from, without its address."""
    if direct_url is None:
        return "an index"
    if "vcs_info" in direct_url:
        return "a repository"
    return "a checkout" if direct_url.get("dir_info", {}).get("editable") else "a file or folder"
