"""YAML files read strictly, with the line of every key.

A file is UTF-8, at most 1 MiB and 50 000 values in 20 levels, one document with a mapping at the
top, without anchors, aliases or tags, so that nothing expands or gets constructed; all this is
checked before a value is made. No key is given twice. Words are text unless they are decimal
numbers, true, false or null (core schema of YAML 1.2).
"""

import os
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeAlias

from ruamel.yaml import YAML
from ruamel.yaml.composer import Composer
from ruamel.yaml.error import MarkedYAMLError
from ruamel.yaml.events import Event, MappingStartEvent, ScalarEvent
from ruamel.yaml.nodes import MappingNode, Node, ScalarNode
from ruamel.yaml.reader import ReaderError
from ruamel.yaml.resolver import BaseResolver, VersionedResolver

from model.errors import InputError
from model.files.regular_file import regular_file

MAX_SIZE = 1 << 20  # bytes
MAX_PROBLEMS = 50
"""Number of problems of one file that are reported; with more it is the wrong kind of file."""

IF_EMPTY = "`era config init` writes one to begin with"
"""Remedy for an empty configuration file."""

_MAX_DEPTH = 20
_MAX_VALUES = 50_000
_ZIP = b"PK\x03\x04"

Scalar: TypeAlias = bool | int | float | str | None
Value: TypeAlias = "Scalar | list[Value] | dict[str, Value]"
KeyPath: TypeAlias = tuple[str | int, ...]


@dataclass(frozen=True)
class Problem:
    """One thing wrong in a file: its line (None: the file as a whole), the key, what to do."""

    line: int | None
    key: str
    message: str


class ConfigError(InputError):
    """A configuration file that cannot be used, with every problem that was found in it."""

    def __init__(self, source: str, problems: Sequence[Problem]) -> None:
        """Say the problems, `FILE:LINE: key: what is wrong; what to do`, one on a line.

        Of more than MAX_PROBLEMS the first ones.
        """
        self.source = source
        in_order = sorted(problems, key=lambda problem: problem.line or 0)
        self.problems = tuple(in_order[:MAX_PROBLEMS])
        lines = [self._sentence(problem) for problem in self.problems]
        if len(lines) > 1:
            count = f"more than {MAX_PROBLEMS}" if len(in_order) > MAX_PROBLEMS else len(lines)
            lines = [f"{source} has {count} errors:", *(f"  {line}" for line in lines)]
        super().__init__("\n".join(lines))

    def _sentence(self, problem: Problem) -> str:
        place = self.source if problem.line is None else f"{self.source}:{problem.line}"
        return ": ".join(part for part in (place, problem.key, problem.message) if part)


@dataclass(frozen=True)
class Document:
    """The content of a file, its text, and the line of every key and list entry by its path."""

    source: str
    text: str
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
        """The line of a key or list entry, or of the nearest one above it if it is missing."""
        while path and path not in self.lines:
            path = path[:-1]
        return self.lines.get(path, 1)

    def beside(self, name: str) -> Path:
        """The path of a file that this one names, relative to its folder; `~` is the home."""
        # Path.expanduser raises where there is no such home; this leaves the name as it is.
        return Path(self.source).parent / os.path.expanduser(name)  # noqa: PTH111

    def problem(self, path: KeyPath, message: str) -> Problem:
        """A problem at a key."""
        return Problem(self.line_of(path), key_name(path), message)


def key_name(path: KeyPath) -> str:
    """Format a path as `eras.SW.at[0]`; control characters are escaped."""
    name = ""
    for part in path:
        if isinstance(part, int):
            name += f"[{part}]"
        else:
            shown = part if re.fullmatch(r"[\w-]{1,40}", part) else repr(part[:40])
            name += f".{shown}" if name else shown
    return name


def read_document(path: Path, *, if_empty: str = IF_EMPTY) -> Document:
    """Read a YAML file; if_empty: the remedy for a file without content.

    Raises ConfigError if it cannot be read, or is more than plain data.
    """
    source = str(path)
    try:
        with open(path, "rb", opener=regular_file) as stream:
            content = stream.read(MAX_SIZE + 1)
    except FileNotFoundError as error:
        raise _whole(source, "no such file; check its name and folder") from error
    except IsADirectoryError as error:
        raise _whole(source, "is a folder; give the file in it") from error
    except OSError as error:
        raise _whole(source, f"cannot be read: {error.strerror}; give a YAML file") from error
    except ValueError as error:
        raise _whole(repr(source), f"is no file name: {error}") from error
    if content.startswith(_ZIP):
        raise _whole(
            source,
            "is a .npz file, as localization tables are, or another archive; give the YAML file "
            "that it is for, as `era config init` writes them",
        )
    if len(content) > MAX_SIZE:
        raise _whole(source, "is larger than 1 MiB; a configuration has a few lines")
    try:
        text = content.decode("utf-8")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        message = f"byte 0x{content[error.start]:02x} is no UTF-8; save the file as UTF-8"
        raise ConfigError(source, [Problem(line, "", message)]) from error
    return parse_document(source, text, if_empty=if_empty)


def parse_document(source: str, text: str, *, if_empty: str = IF_EMPTY) -> Document:
    """Read the text of a YAML file that came from a source; raises ConfigError."""
    yaml = plain_yaml("safe")
    with _errors_at(source, text):
        data = yaml.load(text)
    if yaml.composer.repeated:
        raise ConfigError(source, yaml.composer.repeated)
    if data is None:
        raise _whole(source, f"is empty; {if_empty}")
    return Document(source, text, data, yaml.composer.lines)


def plain_yaml(kind: Literal["safe", "rt"]) -> YAML:
    """A YAML parser that accepts plain data only; "rt" keeps comments, and is far less robust."""
    yaml = YAML(typ=kind, pure=True)
    yaml.Composer = _PlainComposer
    yaml.Resolver = _PlainResolver
    yaml.allow_duplicate_keys = True  # the composer reports all of them
    return yaml


def _whole(source: str, message: str) -> ConfigError:
    return ConfigError(source, [Problem(None, "", message)])


@contextmanager
def _errors_at(source: str, text: str) -> Iterator[None]:
    """Raise what the parser raises as ConfigError, with the line."""
    try:
        yield
    except _Refused as error:
        raise ConfigError(source, error.problems) from None
    except MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = None if mark is None else mark.line + 1
        said = " ".join(part for part in (error.context, error.problem) if part)
        remedy = "; indent by spaces, not by tabs" if r"'\t'" in said else ""
        problem = Problem(line, "", f"is not valid YAML: {said}{remedy}")
        raise ConfigError(source, [problem]) from error
    except ReaderError as error:
        line = text.count("\n", 0, error.position) + 1
        message = f"character U+{error.character:04X} is not allowed in YAML; remove it"
        raise ConfigError(source, [Problem(line, "", message)]) from error


class _Refused(Exception):
    """A part of a file that is not plain data."""

    def __init__(self, *problems: Problem) -> None:
        self.problems = problems


class _PlainComposer(Composer):
    """Composes nodes of plain data; anything else is refused before it becomes a node.

    lines: of every key and list entry by its path; repeated: keys that are given twice.
    """

    def __init__(self, loader: Any = None) -> None:
        super().__init__(loader)
        self.lines: dict[KeyPath, int] = {}
        self.repeated: list[Problem] = []
        self._path: KeyPath = ()
        self._count = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        """Compose the next node: a list entry by its number, a value by the node of its key."""
        above = self._path
        is_key = parent is not None and index is None
        event = self.parser.peek_event()
        if isinstance(index, ScalarNode):
            self._path = (*above, index.value)
            self.lines.setdefault(self._path, _line(index))
        elif index is not None:
            self._path = (*above, index)
            self.lines[self._path] = _line(event)
        self._check(event, is_key=is_key, is_root=parent is None)
        node = super().compose_node(parent, index)
        if is_key:
            node.ctag = BaseResolver.DEFAULT_SCALAR_TAG  # NO is a word
        elif isinstance(node, MappingNode):
            self._note_repeated(node)
        self._path = above
        return node

    def _check(self, event: Event, *, is_key: bool, is_root: bool) -> None:
        if getattr(event, "anchor", None) is not None:  # an alias names its anchor too
            raise self._refused(event, "anchors and aliases are not used; write the value out")
        if getattr(event, "ctag", None) is not None:
            raise self._refused(event, "tags are not used; remove what begins with !")
        if len(self._path) > _MAX_DEPTH:
            self._path = self._path[:3]
            raise self._refused(event, f"is nested more than {_MAX_DEPTH} levels deep")
        self._count += 1
        if self._count > _MAX_VALUES:
            self._path = ()
            raise self._refused(event, f"has more than {_MAX_VALUES} values")
        if is_key and not isinstance(event, ScalarEvent):
            raise self._refused(event, "a key must be a word")
        if is_root and not isinstance(event, MappingStartEvent) and not _is_empty(event):
            raise self._refused(
                event, "expected `key: value` lines, as `era config init` writes them"
            )

    def _refused(self, event: Event, message: str) -> _Refused:
        return _Refused(Problem(_line(event), key_name(self._path), message))

    def _note_repeated(self, mapping: MappingNode) -> None:
        seen: set[str] = set()
        for key, _ in mapping.value:
            if key.value in seen:
                path = (*self._path, key.value)
                message = f"is given twice, first on line {self.lines[path]}; remove one"
                self.repeated.append(Problem(_line(key), key_name(path), message))
                if len(self.repeated) > MAX_PROBLEMS:
                    raise _Refused(*self.repeated)
            seen.add(key.value)


class _PlainResolver(VersionedResolver):
    """Resolves words to text unless they are decimal numbers, true, false or null."""

    processing_version = (1, 2)  # ignores %YAML directives

    def resolve(self, kind: Any, value: Any, implicit: Any) -> Any:
        """The tag of a node by its kind and text."""
        tag = super().resolve(kind, value, implicit)
        name = str(tag).rpartition(":")[2]
        is_number = name in ("int", "float") and _NUMBER.fullmatch(value)
        return tag if is_number or name in _PLAIN else BaseResolver.DEFAULT_SCALAR_TAG


_PLAIN = ("str", "map", "seq", "bool", "null")
# Longer numbers stay text, and are refused as such.
_NUMBER = re.compile(
    r"[-+]?(?:[0-9]{1,18}|(?:\.[0-9]{1,30}|[0-9]{1,30}(?:\.[0-9]{0,30})?)(?:[eE][-+]?[0-9]{1,3})?)"
    r"|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)"
)


def _is_empty(event: Event) -> bool:
    return isinstance(event, ScalarEvent) and event.value == "" and event.style is None


def _line(at: Event | Node) -> int:
    return at.start_mark.line + 1 if at.start_mark else 1
