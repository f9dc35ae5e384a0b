"""YAML files read strictly, with the line of every key, and the text of data.

A file must be UTF-8, with at most 1 MiB and 50 000 values in 20 levels: a single document with a
mapping at the top and unique keys. Anchors, aliases and tags are rejected, so that nothing expands
or constructs objects. All rules are checked before any value is built. Words are text unless they
are decimal numbers, true, false or null (core schema of YAML 1.2).
"""

import errno
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path, PurePath
from typing import Any, TypeAlias, TypeGuard

import yaml

from model.errors import InputError
from registry.files import read_regular

_MAX_SIZE = 1 << 20  # bytes
MAX_PROBLEMS = 50
"""Maximum number of reported problems per file; with more, it is the wrong kind of file."""

IF_EMPTY = "`era config init` writes one to begin with"
"""Remedy for an empty configuration file."""

_MAX_DEPTH = 20
MAX_DOCUMENT_VALUES = 50_000
_ZIP = b"PK\x03\x04"

Scalar: TypeAlias = bool | int | float | str | None
Value: TypeAlias = "Scalar | list[Value] | dict[str, Value]"
KeyPath: TypeAlias = tuple[str | int, ...]


@dataclass(frozen=True)
class ConfigProblem:
    """One problem in a file: line (None for the whole file), key, and message with remedy."""

    line: int | None
    key: str
    message: str


class ConfigError(InputError):
    """A configuration file that cannot be used, with all of its problems."""

    def __init__(self, source: str, problems: Sequence[ConfigProblem]) -> None:
        """Format the problems, one per line: `FILE:LINE: key: problem; remedy`.

        Only the first MAX_PROBLEMS are included.
        """
        self.source = source
        in_order = sorted(problems, key=lambda problem: problem.line or 0)
        self.problems = tuple(in_order[:MAX_PROBLEMS])
        lines = [self._sentence(problem) for problem in self.problems]
        if len(lines) > 1:
            count = f"more than {MAX_PROBLEMS}" if len(in_order) > MAX_PROBLEMS else len(lines)
            lines = [f"{source} has {count} errors:", *(f"  {line}" for line in lines)]
        super().__init__("\n".join(lines))

    def _sentence(self, problem: ConfigProblem) -> str:
        place = self.source if problem.line is None else f"{self.source}:{problem.line}"
        return ": ".join(part for part in (place, problem.key, problem.message) if part)


@dataclass(frozen=True)
class Document:
    """The data of a file and its text; data from a program has no text."""

    source: str
    text: str
    data: dict[str, Value]
    find_lines: Callable[[], Mapping[KeyPath, int]] = field(default=dict, compare=False)
    """Finds the line of every key and list entry by path, for errors; empty without text."""
    over: "Document | None" = None
    """The file alone, if `data` are its keys merged over its `base`."""

    @cached_property
    def lines(self) -> Mapping[KeyPath, int]:
        """Line of every key and list entry by path."""
        return self.find_lines()

    @property
    def whole_text(self) -> str:
        """Text with all keys, including those inherited from a base."""
        return self.text or data_text(self.data)

    def value(self, path: KeyPath) -> Value:
        """Return the value at a path of keys; raises KeyError for a missing key."""
        value: Value = self.data
        for key in path:
            if not (isinstance(value, dict) and isinstance(key, str)):
                raise KeyError(key)
            value = value[key]
        return value

    def line_of(self, path: KeyPath) -> int | None:
        """Return the line of a key or list entry; for a missing one, of the nearest parent."""
        while path and path not in self.lines:
            path = path[:-1]
        return self.lines.get(path, 1) if self.lines else None

    def beside(self, name: str) -> Path:
        """Return the path of a named file, relative to this document's folder; `~` is the home."""
        # Path.expanduser raises without a home; this leaves the name unchanged.
        return Path(self.source).parent / os.path.expanduser(name)  # noqa: PTH111

    def problem(self, path: KeyPath, message: str) -> ConfigProblem:
        """Return a problem at a key."""
        return ConfigProblem(self.line_of(path), key_name(path), message)


MAX_FILE_NAME = 1000
"""Maximum length of the name of a file in a configuration."""

_MAX_PART = 255  # bytes, on all usual file systems


_NULL_WORDS = frozenset(("none", "None", "NONE", "nil", "Nil", "NIL"))


def is_null_word(value: object) -> bool:
    """Return whether a value is a word for null in another language, which YAML reads as text."""
    return isinstance(value, str) and value in _NULL_WORDS


def is_file_name(value: object) -> TypeGuard[str]:
    """Return whether a value is text that every operating system accepts as the name of a file."""
    if not isinstance(value, str) or not 0 < len(value) <= MAX_FILE_NAME:
        return False
    if "\0" in value or is_null_word(value):
        return False
    parts = [part.encode("utf-8", "surrogatepass") for part in PurePath(value).parts]
    return all(len(part) <= _MAX_PART for part in parts)


def key_name(path: KeyPath) -> str:
    """Format a path as `eras.SW.at[0]`; control characters are escaped."""
    name = ""
    for part in path:
        if isinstance(part, int):
            name += f"[{part}]"
        else:
            word = part if re.fullmatch(r"[\w-]{1,40}", part) else repr(part[:40])
            name += f".{word}" if name else word
    return name


def read_document(path: Path, *, if_empty: str = IF_EMPTY) -> Document:
    """Read a YAML file; if_empty: the remedy for a file without content.

    Raises ConfigError if it cannot be read, or is more than plain data.
    """
    source = str(path)
    content = read_bytes(
        path, _MAX_SIZE, is_for="a configuration has a few lines", give="a YAML file"
    )
    if content.startswith(_ZIP):
        raise _whole(
            source,
            "is a .npz file, as localization tables are, or another archive; give the YAML file "
            "that it is for, as `era config init` writes them",
        )
    text = decoded(source, content)
    return parse_document(source, text, if_empty=if_empty)


def read_bytes(path: Path, max_size: int, *, is_for: str, give: str) -> bytes:
    """Read a regular file that a user names.

    is_for: remedy for a larger file; give: remedy for another one.

    Raises ConfigError if it cannot be read, or is larger than max_size [bytes].
    """
    source = str(path)
    try:
        return read_regular(path, max_size)
    except FileNotFoundError as error:
        raise _whole(source, "no such file; check its name and folder") from error
    except IsADirectoryError as error:
        raise _whole(source, "is a folder; give the file in it") from error
    except OSError as error:
        if error.errno == errno.EFBIG:
            raise _whole(source, f"{error.strerror}; {is_for}") from error
        raise _whole(source, f"cannot be read: {error.strerror}; give {give}") from error
    except ValueError as error:
        raise _whole(repr(source), f"is no file name: {error}") from error


def decoded(source: str, content: bytes) -> str:
    """Decode the text of a file; raises ConfigError with the line that is not UTF-8."""
    try:
        return content.decode("utf-8")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        message = f"byte 0x{content[error.start]:02x} is not valid UTF-8; save the file as UTF-8"
        raise ConfigError(source, [ConfigProblem(line, "", message)]) from error


def parse_document(
    source: str, text: str, *, if_empty: str = IF_EMPTY, max_values: int | None = None
) -> Document:
    """Read the text of a YAML file that came from a source; raises ConfigError."""
    forbidden = _NOT_ALLOWED.search(text)
    if forbidden is not None:
        line = text.count("\n", 0, forbidden.start()) + 1
        message = f"character U+{ord(forbidden[0]):04X} is not allowed in YAML; remove it"
        raise ConfigError(source, [ConfigProblem(line, "", message)])
    reader = _PlainReader(source, text, max_values or MAX_DOCUMENT_VALUES)
    try:
        data = reader.document()
    except yaml.MarkedYAMLError as error:
        raise _unparsed(source, text, error) from error
    if reader.repeated:
        raise ConfigError(source, reader.repeated)
    if data is None:
        raise _whole(source, f"is empty; {if_empty}")
    # A method of a dictionary can be pickled, as documents are for other processes.
    return Document(source, text, data, reader.lines.copy)


def _whole(source: str, message: str) -> ConfigError:
    return ConfigError(source, [ConfigProblem(None, "", message)])


def _unparsed(source: str, text: str, error: yaml.MarkedYAMLError) -> ConfigError:
    """Return the error for text that is not YAML, with the line and a remedy."""
    mark = error.problem_mark or error.context_mark
    line = None if mark is None else mark.line + 1
    problem = " ".join(part for part in (error.context, error.problem) if part)
    remedy = "" if line is None else _remedy(text, line)
    if not remedy and "expected ','" in problem:
        line, remedy = _missing_comma(text, mark)
    return ConfigError(source, [ConfigProblem(line, "", f"is not valid YAML: {problem}{remedy}")])


_BLANKS = re.compile(r"(?<!^)\ufeff|[\t\u00a0\u1680\u2000-\u200b\u202f\u205f\u3000]")
_NO_KEY = re.compile(r"\s*[\w.-]+(:(?![\s/]|$)|\N{FULLWIDTH COLON})")  # `key:value`, but no URL


def _remedy(text: str, line: int) -> str:
    """Suggest a remedy for a line that looks right: a directive, a non-breaking space, `key:value`.

    The parser reports some errors at the next line that is not empty.
    """
    lines = text.splitlines()[:line]
    if len(lines) == line and lines[-1].startswith("%"):
        return "; remove this line"
    for number in range(len(lines), 0, -1):
        content = lines[number - 1].partition("#")[0]
        place = "" if number == line else f" of line {number}"
        blank = _BLANKS.search(content)
        if blank is not None:
            name = "tab" if blank[0] == "\t" else f"character U+{ord(blank[0]):04X}"
            return f"; write a space in place of the {name} in column {blank.start() + 1}{place}"
        key = _NO_KEY.match(content)
        if key is not None:
            return f"; write a colon and a space in column {key.end()}{place}"
        if content.strip() and number < line:
            break
    return ""


_COMMENT = re.compile(r"(^|\s)#.*")


def _missing_comma(text: str, mark: Any) -> tuple[int, str]:
    """Return the line of a missing comma in braces or brackets, and the remedy.

    mark: position at which the parser stopped, after the comma. If it stopped at a colon, it read
    the key before the colon as a part of the value.
    """
    lines = [*text.splitlines()[: mark.line + 1], ""]
    start, rest_of_line = lines[mark.line][: mark.column], lines[mark.line][mark.column :]
    if rest_of_line.startswith(":"):
        start = re.sub(r"\S+\s*$", "", start)
    number, value = 0, ""
    for line_number, line in enumerate([*lines[: mark.line], start]):
        content = _COMMENT.sub("", line).rstrip()
        if content or line_number == 0:
            number, value = line_number, content
    words = value.split() or [""]
    return number + 1, (
        f"; write a comma, or the bracket that closes, after {words[-1]} in column {len(value)}"
    )


YAML_LOADER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # libyaml if available
_NOT_ALLOWED = (
    yaml.reader.Reader.NON_PRINTABLE
)  # libyaml counts bytes, and accepts other characters


class _PlainReader:
    """Builds values from events, after checking them: nothing is expanded or constructed.

    lines: of every key and list entry by path; repeated: duplicate keys.
    """

    def __init__(self, source: str, text: str, max_values: int) -> None:
        self._source, self._text = source, text
        self._max_values = max_values
        self._events: Iterator[Any] = yaml.parse(text, Loader=YAML_LOADER)
        self.lines: dict[KeyPath, int] = {}
        self.repeated: list[ConfigProblem] = []
        self._count = 0

    def document(self) -> Any:
        """The content of the only document; None for an empty one."""
        next(self._events)
        if isinstance(next(self._events), yaml.StreamEndEvent):
            return None
        event = next(self._events)
        is_empty = isinstance(event, yaml.ScalarEvent) and event.value == "" and not event.style
        if not (is_empty or isinstance(event, yaml.MappingStartEvent | yaml.AliasEvent)):
            message = "expected `key: value` lines, as `era config init` writes them"
            raise self._refused((), event, message + _remedy(self._text, _line(event)))
        data = self._value((), event)
        next(self._events)
        following = next(self._events)
        if isinstance(following, yaml.DocumentStartEvent):
            raise self._refused((), following, "must be one document, got another; remove it")
        return data

    def _value(self, path: KeyPath, event: Any) -> Any:
        self._check(path, event)
        if isinstance(event, yaml.ScalarEvent):
            return str(event.value) if event.style else plain_value(event.value)
        if isinstance(event, yaml.SequenceStartEvent):
            entries: list[Any] = []
            while not isinstance(event := next(self._events), yaml.SequenceEndEvent):
                inner = (*path, len(entries))
                self.lines[inner] = _line(event)
                entries.append(self._value(inner, event))
            return entries
        mapping: dict[str, Any] = {}
        while not isinstance(key := next(self._events), yaml.MappingEndEvent):
            self._check(path, key)
            if not isinstance(key, yaml.ScalarEvent):
                raise self._refused(path, key, "a key must be a word")
            inner, is_repeated = (*path, key.value), key.value in mapping
            self.lines.setdefault(inner, _line(key))
            value = self._value(inner, next(self._events))
            if is_repeated:
                message = f"is given twice, first on line {self.lines[inner]}; remove one"
                self.repeated.append(ConfigProblem(_line(key), key_name(inner), message))
                if len(self.repeated) > MAX_PROBLEMS:
                    raise ConfigError(self._source, self.repeated)
            else:
                mapping[key.value] = value
        return mapping

    def _check(self, path: KeyPath, event: Any) -> None:
        if getattr(event, "anchor", None) is not None:  # an alias names its anchor too
            raise self._refused(
                path, event, "anchors and aliases are not used; write the value out"
            )
        if getattr(event, "tag", None) is not None:
            raise self._refused(path, event, "tags are not used; remove what begins with !")
        if len(path) > _MAX_DEPTH:
            raise self._refused(path[:3], event, f"is nested more than {_MAX_DEPTH} levels deep")
        self._count += 1
        if self._count > self._max_values:
            raise self._refused((), event, f"has more than {self._max_values} values")

    def _refused(self, path: KeyPath, event: Any, message: str) -> ConfigError:
        return ConfigError(self._source, [ConfigProblem(_line(event), key_name(path), message)])


_WORDS: dict[str, Scalar] = {
    **dict.fromkeys(("", "~", "null", "Null", "NULL")),
    **dict.fromkeys(("true", "True", "TRUE"), True),
    **dict.fromkeys(("false", "False", "FALSE"), False),
}


def plain_value(text: str) -> Scalar:
    """Return the value of unquoted text in the core schema of YAML 1.2; only decimal numbers."""
    text = text.strip()  # removes non-breaking spaces, too
    if text in _WORDS:
        return _WORDS[text]
    if not _NUMBER.fullmatch(text):
        return text
    is_whole = re.fullmatch("[-+]?[0-9]+", text)
    return int(text) if is_whole else float(re.sub(r"\.(?=[inIN])", "", text))


# Longer numbers stay text, and are rejected as text.
_NUMBER = re.compile(
    r"[-+]?(?:[0-9]{1,18}|(?:\.[0-9]{1,30}|[0-9]{1,30}(?:\.[0-9]{0,30})?)(?:[eE][-+]?[0-9]{1,3})?)"
    r"|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)"
)


def _line(at: Any) -> int:
    return at.start_mark.line + 1 if at.start_mark else 1


class _PlainDumper(yaml.SafeDumper):
    """Quotes text that would be read as a number, a boolean or null."""

    def text(self, value: str) -> yaml.ScalarNode:
        """Make the node of a text."""
        style = None if isinstance(plain_value(value), str) else "'"
        return self.represent_scalar("tag:yaml.org,2002:str", value, style=style)

    def ignore_aliases(self, data: Any) -> bool:
        """Write repeated values in full."""
        return True


_PlainDumper.add_representer(str, _PlainDumper.text)


def data_text(data: Mapping[str, Value]) -> str:
    """Return the text of a new file with this data; inner lists and mappings are on one line."""
    return str(
        yaml.dump(
            {**data},
            Dumper=_PlainDumper,
            default_flow_style=None,
            sort_keys=False,
            allow_unicode=True,
            width=100,
        )
    )
