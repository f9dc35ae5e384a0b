"""JSON files of content, read strictly; a line for every key, found when an error needs it."""

import json
import re
from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from typing import Annotated, Any, TypeAlias, TypeVar

import numpy as np
from pydantic import ConfigDict, GetCoreSchemaHandler

from controller.content.format import MAX_POINTS, refusal
from model.config.document import Document, KeyPath, decoded, key_name
from model.config.fields import Section
from model.quantities import counted

_MAX_SIZE = 2 << 20  # bytes
_MAX_LEVELS = 20
_MAX_VALUES = 5 * MAX_POINTS  # a keyframe of HJIF is four, an event of AHAP thirteen
_MAX_NAMED = 5  # unknown keys in remarks
_EMPTY: tuple[object, ...] = (None, "", [], {})

_SPACE = re.compile(r"[ \t\n\r]*")
_STRING = r'"[^"\\]*+(?:\\.?+[^"\\]*+)*+"?'  # one without an end, too: no text is read twice
_STRINGS = re.compile(_STRING, re.DOTALL)
_TRAILING_COMMA = re.compile(rf"({_STRING})|,(?=[ \t\n\r]*[\]}}])", re.DOTALL)
_DECODER = json.JSONDecoder(parse_int=float)  # of any number of digits


_T = TypeVar("_T")


class _FirstOfMany:
    """Annotation of a list: the first invalid entry is reported, and no more of them are looked at.

    pydantic's own, FailFast, cannot be in a union.
    """

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> Any:
        return {**handler(source), "fail_fast": True, "max_length": MAX_POINTS}


Entries: TypeAlias = Annotated[list[_T], _FirstOfMany()]
"""A list of which the first invalid entry is reported."""


class ContentSection(Section):
    """An object in a file of content: strict types, finite numbers; unknown keys are ignored."""

    model_config = ConfigDict(extra="allow", strict=True, frozen=True, allow_inf_nan=False)


@dataclass(frozen=True)
class JsonDocument(Document):
    """The content of a JSON file; lines are found when asked for."""

    def line_of(self, path: KeyPath) -> int:
        """The line of a key or list entry, or of the nearest one above it if it is missing."""
        start = value = _skipped(self.text, 0)
        for key in path:
            found = (where for name, *where in _entries(self.text, value) if name == key)
            start, value = next(found, (start, -1))
            if value < 0:
                break
        return _line(self.text, start)


def read_json(content: bytes, source: str, *, has_trailing_commas: bool = False) -> JsonDocument:
    """Read an object; raises ConfigError for what is not JSON, nested too deep or repeated."""
    if len(content) > _MAX_SIZE:
        raise refusal(source, f"is larger than {_MAX_SIZE >> 20} MiB; shorten the content")
    text = decoded(source, content).removeprefix("\ufeff")
    if has_trailing_commas:
        text = _TRAILING_COMMA.sub(lambda found: found[1] or " ", text)
    _check_size(source, text)
    try:
        # Whole numbers become floats: those of many digits are refused by their size, as 1e999 is.
        data = json.loads(text, object_pairs_hook=_unique, parse_int=float)
    except _RepeatedKey:
        line, path, first = next(_repeated(text, _skipped(text, 0), ()))
        message = f"is given twice, first on line {first}; remove one"
        raise refusal(source, message, line=line, key=key_name(path)) from None
    except json.JSONDecodeError as error:
        is_cut = not text.rstrip().endswith("}")
        remedy = "its end is missing: export it again" if is_cut else "correct it there"
        message = f"is not valid JSON: {error.msg} in column {error.colno}; {remedy}"
        raise refusal(source, message, line=error.lineno) from error
    if not isinstance(data, dict):
        raise refusal(source, "must be an object in braces, got another value", line=1)
    return JsonDocument(source, text, data, {})


def unknown_keys(section: ContentSection, but: Collection[str] = ()) -> tuple[str, ...]:
    """Return in words which keys of a file are ignored, the first ones by name.

    but: those that say nothing of what is felt, besides all that are empty.
    """
    found = Counter(name for name in _extra(section) if name not in but)
    if not found:
        return ()
    names = [key_name((name,)) for name in list(found)[:_MAX_NAMED]]
    more = " and others" * (len(found) > _MAX_NAMED)
    return (f"{counted(found.total(), 'unknown key')} ignored: {', '.join(names)}{more}",)


def _extra(value: Any) -> Iterator[str]:
    if isinstance(value, list):
        for entry in value:
            yield from _extra(entry)
    elif isinstance(value, ContentSection):
        yield from (k for k, each in (value.model_extra or {}).items() if each not in _EMPTY)
        for name in type(value).model_fields:
            yield from _extra(getattr(value, name))


class _RepeatedKey(Exception):
    """A key that is given twice."""


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    made = dict(pairs)
    if len(made) < len(pairs):
        raise _RepeatedKey
    return made


def _repeated(text: str, at: int, path: KeyPath) -> Iterator[tuple[int, KeyPath, int]]:
    """Yield the line, the path and the first line of every repeated key."""
    seen: dict[str | int, int] = {}
    for key, start, value in _entries(text, at):
        inner = (*path, key)
        if key in seen:
            yield _line(text, start), inner, _line(text, seen[key])
        seen[key] = start
        yield from _repeated(text, value, inner)


def _check_size(source: str, text: str) -> None:
    """Refuse what is nested too deep, or has too many values, before it is parsed."""
    bare = _STRINGS.sub("", text)
    codes = np.frombuffer(bare.encode("utf-32-le", "surrogatepass"), np.uint32)
    opened = (codes == ord("{")) | (codes == ord("["))
    levels = np.cumsum(opened.astype(int) - ((codes == ord("}")) | (codes == ord("]"))))
    if len(levels) and levels.max() > _MAX_LEVELS:
        line = _line(bare, int(np.argmax(levels > _MAX_LEVELS)))
        raise refusal(source, f"is nested more than {_MAX_LEVELS} levels deep", line=line)
    if np.count_nonzero(opened | (codes == ord(","))) > _MAX_VALUES:
        raise refusal(source, f"has more than {_MAX_VALUES} values; shorten it")


def _entries(text: str, at: int) -> Iterator[tuple[str | int, int, int]]:
    """Yield the key, where it begins and where its value begins, of an object or a list."""
    closing = {"{": "}", "[": "]"}.get(text[at])
    if closing is None:
        return
    at = _skipped(text, at + 1)
    index = 0
    while text[at] != closing:
        start, key = at, index
        name: str | int = key
        if closing == "}":
            name, at = json.decoder.scanstring(text, at + 1)  # type: ignore[attr-defined]
            at = _skipped(text, _skipped(text, at) + 1)
        yield name, start, at
        at = _skipped(text, _DECODER.raw_decode(text, at)[1])
        at = _skipped(text, at + 1) if text[at] == "," else at
        index += 1


def _skipped(text: str, at: int) -> int:
    """Return where something stands next that is no space."""
    found = _SPACE.match(text, at)
    return at if found is None else found.end()


def _line(text: str, at: int) -> int:
    return text.count("\n", 0, at) + 1
