"""Reading: the base class of all content formats, and strict JSON.

The size of JSON files is checked before they are parsed; line numbers are determined only for
errors.
"""

import json
import re
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from contextlib import suppress
from functools import partial
from typing import Annotated, Any, ClassVar, TypeAlias, TypeVar

import numpy as np
from pydantic import ConfigDict, GetCoreSchemaHandler

from controller.content.pattern import MAX_CONTENT_DURATION, Pattern
from model.config.document import (
    ConfigError,
    ConfigProblem,
    Document,
    KeyPath,
    decoded,
    key_name,
    parse_document,
)
from model.config.fields import Section
from model.errors import shown
from model.quantities import counted
from registry.plugins import did_you_mean

MAX_SIZE = 4 << 20
"""Largest file [bytes]."""

_MAX_POINTS = 20_000
"""Maximum number of points in a file: breakpoints, keyframes, or events and their parts."""

_MAX_JSON_SIZE = 2 << 20  # bytes
_MAX_DEPTH = 20
_MAX_VALUES = 5 * _MAX_POINTS  # an HJIF keyframe has four, an AHAP event thirteen
_MAX_QUOTED = 50  # characters in errors
_MAX_NAMED = 5  # unknown names in a remark
_MAX_NAME = 40  # characters of a name to compare with valid names
_EMPTY: tuple[object, ...] = (None, "", [], {})
_BLANKS = str.maketrans("\t\x85\u2028\u2029", "    ")  # neither tab nor new line in YAML

_STRING = r'"[^"\\]*+(?:\\.?+[^"\\]*+)*+"?'  # or an unterminated one: no text is read twice
_STRINGS = re.compile(_STRING, re.DOTALL)
_TRAILING_COMMA = re.compile(rf"({_STRING})|,(?=[ \t\n\r]*[\]}}])", re.DOTALL)

_T = TypeVar("_T")


def refusal(source: str, message: str, *, line: int | None = None, key: str = "") -> ConfigError:
    """Return an error for a whole file, or for a key on a line."""
    return ConfigError(source, [ConfigProblem(line, key, message)])


def too_much(end: float, count: int) -> str:
    """Return the problem of content with too late an end [s] or too many points, or ""."""
    if end > MAX_CONTENT_DURATION:
        return f"must end within {MAX_CONTENT_DURATION:g} s, got {end:g} s; shorten it"
    if count > _MAX_POINTS:
        return f"has more than {_MAX_POINTS} points; leave some out"
    return ""


class ContentFormat(ABC):
    """A content format, named after the extension of its files."""

    ending: ClassVar[str]
    """File extension without the dot, in lower case."""

    has_channels: ClassVar[bool] = False
    """Whether a file can have several channels, from which the user selects one."""

    @abstractmethod
    def read(self, content: bytes, source: str, channel: int) -> Pattern:
        """Return the pattern of a file.

        content: all bytes of the file; source: its name, for errors; channel: counted from 1.
        Raises InputError for an invalid file, with line and key if available. Must not execute or
        read anything that the file refers to.
        """


class _FirstOfMany:
    """Annotation of a list: report only the first invalid entry.

    pydantic's FailFast does not work in a union.
    """

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> Any:
        return {**handler(source), "fail_fast": True, "max_length": _MAX_POINTS}


Entries: TypeAlias = Annotated[list[_T], _FirstOfMany()]
"""A list that reports only its first invalid entry."""


class ContentSection(Section):
    """An object in a content file: strict types, finite numbers; unknown keys are ignored."""

    model_config = ConfigDict(extra="allow", strict=True, frozen=True, allow_inf_nan=False)


def read_json(content: bytes, source: str, *, has_trailing_commas: bool = False) -> Document:
    """Read an object; raises ConfigError if it is invalid, nested too deep, or repeats a key."""
    if len(content) > _MAX_JSON_SIZE:
        raise refusal(source, f"is larger than {_MAX_JSON_SIZE >> 20} MiB; shorten the content")
    text = decoded(source, content).removeprefix("\ufeff")
    if has_trailing_commas:
        text = _TRAILING_COMMA.sub(lambda match: match[1] or " ", text)
    _check_size(source, text)
    has_repeats = False

    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        nonlocal has_repeats
        values = dict(pairs)
        if len(values) < len(pairs):
            has_repeats = True
        return values

    try:
        # Integers become floats: huge ones become infinite, like 1e999, and are rejected.
        data = json.loads(text, parse_int=float, object_pairs_hook=unique)
    except json.JSONDecodeError as error:
        raise refusal(source, _why_unparsed(text, error), line=error.lineno) from error
    if not isinstance(data, dict):
        raise refusal(source, "must be an object in braces, got another value", line=1)
    if has_repeats:
        _as_yaml(source, text)  # raises with the line
        raise refusal(source, "has a key that is given twice; remove one")
    return Document(source, text, data, partial(_lines_of, source, text))


def _check_size(source: str, text: str) -> None:
    """Reject text with too deep nesting or too many values before parsing it."""
    bare = _STRINGS.sub("", text)
    codes = np.frombuffer(bare.encode("ascii", "replace"), np.uint8)  # one for each character
    is_opening = (codes == ord("{")) | (codes == ord("["))
    is_closing = (codes == ord("}")) | (codes == ord("]"))
    depths = np.cumsum(is_opening.astype(int) - is_closing)
    too_deep = np.flatnonzero(depths > _MAX_DEPTH)
    if len(too_deep):
        line = bare.count("\n", 0, too_deep[0]) + 1
        raise refusal(source, f"is nested more than {_MAX_DEPTH} levels deep", line=line)
    if np.count_nonzero(is_opening | (codes == ord(","))) > _MAX_VALUES:
        raise refusal(source, f"has more than {_MAX_VALUES} values; shorten it")


def _why_unparsed(text: str, error: json.JSONDecodeError) -> str:
    """Return why text is not JSON, and the remedy."""
    if error.msg == "Extra data":
        surplus = shown(text[error.pos : error.pos + _MAX_QUOTED])
        return (
            f"nothing must follow the end of the content, got {surplus} in column "
            f"{error.colno}; remove it"
        )
    is_complete = text.rstrip().endswith("}")
    remedy = "correct it there" if is_complete else "its end is missing: export it again"
    return f"is not valid JSON: {error.msg} in column {error.colno}; {remedy}"


def _lines_of(source: str, text: str) -> Mapping[KeyPath, int]:
    """Return the line of every key and list entry of JSON; empty if YAML does not include it."""
    with suppress(ConfigError):
        return _as_yaml(source, text).lines
    return {}


def _as_yaml(source: str, text: str) -> Document:
    """Read JSON as YAML; raises ConfigError for a repeated key."""
    return parse_document(source, text.translate(_BLANKS), max_values=3 * _MAX_VALUES)


def unknown_keys(section: ContentSection, but: Collection[str] = ()) -> tuple[str, ...]:
    """Return a remark listing the first unknown keys of a file, if any.

    but: keys that do not affect the vibration; empty keys are ignored too.
    """
    names = Counter(name for name in _unknown_names(section) if name not in but)
    return names_remark("unknown key", names, verb="ignored")


def _unknown_names(value: Any) -> Iterator[str]:
    """Yield the unknown keys of a section or list and of its parts, except empty ones."""
    if isinstance(value, list):
        for entry in value:
            yield from _unknown_names(entry)
    elif isinstance(value, ContentSection):
        for name, unknown in (value.model_extra or {}).items():
            if unknown not in _EMPTY:
                yield name
        for name in type(value).model_fields:
            yield from _unknown_names(getattr(value, name))


def names_remark(
    thing: str, names: Counter[str], *, verb: str = "left out", valid_names: Collection[str] = ()
) -> tuple[str, ...]:
    """Return a remark listing the first names in a file without an effect, if any.

    valid_names: for suggestions.
    """
    if not names:
        return ()
    listed = [_suggested(name, valid_names) for name in list(names)[:_MAX_NAMED]]
    if len(names) > _MAX_NAMED:
        listed.append(f"and {len(names) - _MAX_NAMED} others")
    return (f"{counted(names.total(), thing)} {verb}: {', '.join(listed)}",)


def _suggested(name: str, valid_names: Collection[str]) -> str:
    """Format a name from a file, suggesting a similar valid name."""
    name_text = key_name((name,))
    suggestion = did_you_mean(name[:_MAX_NAME], valid_names).strip()
    return f"{name_text} ({suggestion})" if suggestion else name_text
