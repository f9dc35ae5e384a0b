"""Reading a YAML file strictly: plain data, and the line that every key stands on.

The rules it lives by: UTF-8, at most 1 MiB, one document, a mapping at the top. No anchors,
aliases or tags, so that nothing unfolds or gets constructed. No key twice. Words are text: only
true, false and null are more (YAML 1.1 takes NO for false and 1:30 for 90). All of it comes from
the parser's events; no object is ever built by the YAML library.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import yaml

from model.errors import InputError

SIZE_LIMIT = 1 << 20
_DEPTH_LIMIT = 20
_ZIP = b"PK\x03\x04"

Scalar: TypeAlias = bool | int | float | str | None
Value: TypeAlias = "Scalar | list[Value] | dict[str, Value]"
KeyPath: TypeAlias = tuple[str | int, ...]

# Longer numbers stay text, which says of itself that it is no number.
_INTEGER = re.compile(r"[-+]?[0-9]{1,18}")
_NUMBER = re.compile(r"[-+]?(\.[0-9]{1,30}|[0-9]{1,30}(\.[0-9]{0,30})?)([eE][-+]?[0-9]{1,3})?")
_WORDS: dict[str, Scalar] = {
    **dict.fromkeys(("", "~", "null", "Null", "NULL")),
    **dict.fromkeys(("true", "True", "TRUE"), True),
    **dict.fromkeys(("false", "False", "FALSE"), False),
    **dict.fromkeys((".nan", ".NaN", ".NAN"), float("nan")),
    **dict.fromkeys((".inf", ".Inf", ".INF", "+.inf", "+.Inf", "+.INF"), float("inf")),
    **dict.fromkeys(("-.inf", "-.Inf", "-.INF"), float("-inf")),
}


@dataclass(frozen=True)
class Problem:
    """One thing wrong in a file: its line (None: the file as a whole), the key, what to do."""

    line: int | None
    key: str
    message: str


class ConfigError(InputError):
    """A configuration file that cannot be used, with every problem that was found in it."""

    def __init__(self, source: str, problems: list[Problem]) -> None:
        """Say all problems, `FILE:LINE: key: what is wrong; what to do`, one on a line."""
        self.source = source
        self.problems = tuple(sorted(problems, key=lambda problem: problem.line or 0))
        lines = [self._sentence(problem) for problem in self.problems]
        if len(lines) > 1:
            lines = [f"{source} has {len(lines)} errors:", *(f"  {line}" for line in lines)]
        super().__init__("\n".join(lines))

    def _sentence(self, problem: Problem) -> str:
        place = self.source if problem.line is None else f"{self.source}:{problem.line}"
        return ": ".join(part for part in (place, problem.key, problem.message) if part)


@dataclass(frozen=True)
class Document:
    """What a file says. lines: the line of every key and list entry, by its path."""

    source: str
    data: dict[str, Value]
    lines: dict[KeyPath, int]

    def value(self, path: KeyPath) -> Value:
        """The value at a path of keys; KeyError if there is none."""
        value: Value = self.data
        for key in path:
            if not (isinstance(value, dict) and isinstance(key, str)):
                raise KeyError(key)
            value = value[key]
        return value

    def line_of(self, path: KeyPath) -> int:
        """The line of a key, or of the nearest one above it for a key that is missing."""
        while path not in self.lines:
            path = path[:-1]
        return self.lines[path]

    def problem(self, path: KeyPath, message: str) -> Problem:
        """A problem at a key."""
        return Problem(self.line_of(path), key_name(path), message)


def key_name(path: KeyPath) -> str:
    """A path as people write it: `eras.SW.at[0]`; what could garble a terminal is escaped."""
    name = ""
    for part in path:
        if isinstance(part, int):
            name += f"[{part}]"
        else:
            shown = part if re.fullmatch(r"[\w-]{1,40}", part) else repr(part[:40])
            name += f".{shown}" if name else shown
    return name


def read_document(path: Path) -> Document:
    """Read a YAML file; raises ConfigError if it cannot be read, or is more than plain data."""
    source = str(path)
    try:
        with path.open("rb") as stream:
            content = stream.read(SIZE_LIMIT + 1)
    except FileNotFoundError as error:
        raise _whole(source, "no such file; check its name and folder") from error
    except IsADirectoryError as error:
        raise _whole(source, "is a folder; give the file in it") from error
    except OSError as error:
        raise _whole(source, f"cannot be read: {error.strerror}") from error
    except ValueError as error:
        raise _whole(repr(source), f"is no file name: {error}") from error
    if content.startswith(_ZIP):
        raise _whole(
            source,
            "is a .npz file, as localization tables are, or another archive; give the YAML file "
            "that it is for, as `era config init` writes them",
        )
    if len(content) > SIZE_LIMIT:
        raise _whole(source, "is larger than 1 MiB; a configuration has a few lines")
    try:
        text = content.decode("utf-8")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        message = f"byte 0x{content[error.start]:02x} is no UTF-8; save the file as UTF-8"
        raise ConfigError(source, [Problem(line, "", message)]) from error
    return parse_document(source, text)


def parse_document(source: str, text: str) -> Document:
    """Read the text of a YAML file that came from a source; raises ConfigError."""
    return _Builder(source, text).document()


def _whole(source: str, message: str) -> ConfigError:
    return ConfigError(source, [Problem(None, "", message)])


class _Builder:
    """Builds a document from parser events, one pass, nothing kept that the file did not say."""

    def __init__(self, source: str, text: str) -> None:
        self._source = source
        self._events = self._parse(text)
        self._lines: dict[KeyPath, int] = {(): 1}
        self._repeated: list[Problem] = []

    def document(self) -> Document:
        """The one document of the text."""
        event = self._next()
        while isinstance(event, yaml.StreamStartEvent | yaml.DocumentStartEvent):
            event = self._next()
        if isinstance(event, yaml.StreamEndEvent):
            raise _whole(self._source, "is empty; `era config init` writes one to begin with")
        if not isinstance(event, yaml.MappingStartEvent):
            raise self._error(
                event, (), "expected `key: value` lines, as `era config init` writes them"
            )
        self._check(event, ())
        data = self._mapping(())
        self._next()  # the document's end
        event = self._next()
        if not isinstance(event, yaml.StreamEndEvent):
            raise self._error(event, (), "a second document starts here; keep one in the file")
        if self._repeated:
            raise ConfigError(self._source, self._repeated)
        return Document(self._source, data, self._lines)

    def _parse(self, text: str) -> Iterator[yaml.Event]:
        """The parser's events; its errors as ConfigError."""
        try:
            yield from yaml.parse(text, Loader=yaml.SafeLoader)
        except yaml.MarkedYAMLError as error:
            mark = error.problem_mark or error.context_mark
            line = None if mark is None else mark.line + 1
            said = " ".join(part for part in (error.context, error.problem) if part)
            message = f"is not valid YAML: {said}"
            raise ConfigError(self._source, [Problem(line, "", message)]) from error
        except yaml.reader.ReaderError as error:
            line = text.count("\n", 0, error.position) + 1
            message = f"character U+{error.character:04X} is not allowed in YAML; remove it"
            raise ConfigError(self._source, [Problem(line, "", message)]) from error

    def _next(self) -> yaml.Event:
        return next(self._events)

    def _error(self, event: yaml.Event, path: KeyPath, message: str) -> ConfigError:
        line = _line(event)
        return ConfigError(self._source, [Problem(line, key_name(path), message)])

    def _check(self, event: yaml.Event, path: KeyPath) -> None:
        """Refuse what makes YAML more than plain data."""
        if getattr(event, "anchor", None) is not None:  # an alias names its anchor too
            raise self._error(event, path, "anchors and aliases are not used; write the value out")
        tag = getattr(event, "tag", None)
        if tag is not None:
            raise self._error(event, path, "tags are not used; remove what begins with !")
        if len(path) > _DEPTH_LIMIT:
            raise self._error(event, path[:3], "is nested too deeply")

    def _value(self, event: yaml.Event, path: KeyPath) -> Value:
        self._check(event, path)
        if isinstance(event, yaml.MappingStartEvent):
            return self._mapping(path)
        if isinstance(event, yaml.SequenceStartEvent):
            return self._sequence(path)
        assert isinstance(event, yaml.ScalarEvent)  # noqa: S101 - no other event can stand here
        return _scalar(event.value) if event.style is None else event.value

    def _mapping(self, path: KeyPath) -> dict[str, Value]:
        mapping: dict[str, Value] = {}
        while not isinstance(event := self._next(), yaml.MappingEndEvent):
            self._check(event, path)
            if not isinstance(event, yaml.ScalarEvent):
                raise self._error(event, path, "a key must be a word")
            key = event.value
            here = (*path, key)
            line = _line(event)
            value = self._value(self._next(), here)
            if key in mapping:
                first = self._lines[here]
                message = f"stands twice, first on line {first}; remove one"
                self._repeated.append(Problem(line, key_name(here), message))
                continue
            mapping[key] = value
            self._lines[here] = line
        return mapping

    def _sequence(self, path: KeyPath) -> list[Value]:
        sequence: list[Value] = []
        while not isinstance(event := self._next(), yaml.SequenceEndEvent):
            here = (*path, len(sequence))
            self._lines[here] = _line(event)
            sequence.append(self._value(event, here))
        return sequence


def _line(event: yaml.Event) -> int:
    return event.start_mark.line + 1 if event.start_mark else 1


def _scalar(text: str) -> Scalar:
    """What a word without quotes means, by the core schema of YAML 1.2 in decimal."""
    if text in _WORDS:
        return _WORDS[text]
    if _INTEGER.fullmatch(text):
        return int(text)
    if _NUMBER.fullmatch(text):
        return float(text)
    return text
