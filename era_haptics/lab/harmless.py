"""Reduce users' files and records to harmless values of known keys, so that they can be shared.

Of a configuration these are numbers, quantities, choices, and public words (materials, effects,
elements, URL schemes) that its schema declares. User-defined names become `name-1`, `name-2` ...,
the same in all files of a report. Everything else is hidden: free text, file names, host names, and
every unknown key with its value.

Of a record that this program wrote, such as a log line, these are numbers, and words that occur in
the program itself, under keys that occur there, too.
"""

import builtins
import json
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from difflib import get_close_matches
from functools import cache
from importlib.machinery import SourceFileLoader
from pathlib import Path
from types import CodeType
from typing import Any, TypeAlias
from urllib.parse import parse_qsl

from pydantic import BaseModel
from pydantic.json_schema import models_json_schema

from controller.content.formats import named_contents
from controller.daemon.config import DaemonSection, is_daemon_document
from controller.effects.kinds import BUILT_IN_EFFECTS as EFFECTS
from controller.effects.layout import LayoutSection, is_layout_document
from controller.sources.touch import open_source, source_schemes
from drivers.errors import CommandError
from drivers.urls import CLOCK_ERRORS, KIND_OF_PORT
from drivers.wires.wire import address_of, schemes
from model.config import units
from model.config.document import Document, Value, data_text, is_file_name, read_document
from model.drive_modes import DRIVE_MODES
from model.errors import InputError
from model.fem import ELEMENTS
from model.finger import THRESHOLDS
from model.rig.rig_file import example_rig_path
from model.rig.sections import RigSection
from model.spectral.plate_mesh import POLYNOMIALS
from model.structure.exciter import EXCITER_TYPES
from model.structure.material import KNOWN_MATERIALS

HIDDEN = "hidden"

Schema: TypeAlias = Mapping[str, Any]
"""JSON schema, or part of a schema."""

_ROOT = Path(__file__).parents[2]
_PACKAGES = ("registry", "drivers", "model", "controller", "sim", "era_haptics")
_FILE_ENDINGS = (".yaml", ".yml", ".npz", ".json", ".csv", ".uff", ".wav", ".ahap", ".haptic")

_SECRET = re.compile(r"(?i)key|\blease\b|pass|\bpin\b|secret|serial_number|token|user")
_NUMBER = r"[-+]?\d{1,6}(?:\.\d{1,12})?(?:[eE][-+]?\d{1,3})?"
_QUANTITY = re.compile(rf"({_NUMBER})\s*(.*)")
_SIZES = re.compile(r"\d{1,4}[x×]\d{1,4}")
_IDENTIFIER = re.compile(r"[A-Za-z][A-Za-z0-9_-]{0,31}")
_DEVICE = re.compile(rf"/dev/(?:{'|'.join(KIND_OF_PORT)}|input/event)\d{{1,3}}")
_SHORT = re.compile(r"\d{1,3}")  # address of an amplifier
_OPTION = re.compile(rf"{_NUMBER}|yes|[NEO]")
_TIME = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d(?:\.\d{1,6})?Z?")
_WORD = re.compile(r"[^\W\d_]+")
_FRAME = re.compile(r'\s*File "([^"]*)", line (\d{1,6})')


class Names:
    """Replacements of user-defined names, numbered in order of appearance."""

    def __init__(self) -> None:
        self._replacements: dict[str, str] = {}
        self.files: dict[str, str] = {}
        """Names of files in the report, by real path."""

    def declared(self, name: str) -> str:
        """Return the replacement of a name declared by a mapping; public names stay."""
        if name in public_words():
            return name
        if not _IDENTIFIER.fullmatch(name):
            return HIDDEN
        return self._replacements.setdefault(name, f"name-{len(self._replacements) + 1}")

    def replacement_of(self, name: str) -> str | None:
        """Return the replacement of a declared name; None for other text."""
        return self._replacements.get(name)


def harmless_configuration(document: Document, names: Names) -> str:
    """Return the harmless text of a rig, daemon or layout file; names: shared by all files.

    Names that the file declares below a reference to them are known only at a second call.
    """
    schema, definitions = _schema_of(document)
    configuration = _Configuration(document, definitions, names)
    return data_text(configuration.mapping((), document.data, schema))


class _Configuration:
    """Walk through a document along its schema."""

    def __init__(self, document: Document, definitions: Schema, names: Names) -> None:
        self._document = document
        self._definitions = definitions
        self._names = names

    def mapping(
        self, path: tuple[str | int, ...], value: Mapping[str, Value], schema: Schema
    ) -> dict[str, Value]:
        """Return the harmless part of a mapping; its unknown keys are counted."""
        best = self._mapping_schema(value, schema)
        properties = best.get("properties", {})
        further = best.get("additionalProperties")
        reduced: dict[str, Value] = {}
        unknown: list[str] = []
        for key, entry in value.items():
            name = key
            entry_schema = properties.get(key)
            if entry_schema is None and isinstance(further, dict):
                name = self._names.declared(key)
                entry_schema = further
            if entry_schema is None or name == HIDDEN:
                unknown.append(key)
            else:
                reduced[name] = self._reduced((*path, key), entry, entry_schema)
        if unknown:
            reduced[HIDDEN] = self._described(path, unknown, [*properties])
        return reduced

    def _described(
        self, path: tuple[str | int, ...], unknown: Sequence[str], known_keys: Sequence[str]
    ) -> str:
        """Describe unknown keys without quoting them: their lines and similar known keys."""
        places = []
        similar_keys: set[str] = set()
        for key in unknown:
            line = self._document.line_of((*path, key))
            if line:
                places.append(f"line {line}")
            similar_keys.update(get_close_matches(key[:40], known_keys, 1))
        similar = f"; similar to {', '.join(sorted(similar_keys))}" if similar_keys else ""
        return f"unknown keys at {', '.join(places) or 'no line'}{similar}"

    def _reduced(self, path: tuple[str | int, ...], value: Value, schema: Schema) -> Value:
        if value is None or isinstance(value, bool):
            return value
        if isinstance(value, dict):
            return self.mapping(path, value, schema) if self._of_kind(schema, "object") else HIDDEN
        if isinstance(value, list):
            items = self._of_kind(schema, "array")
            return [
                self._reduced((*path, number), entry, _item_schema(items, number))
                for number, entry in enumerate(value)
            ]
        choices = [*self._alternatives(schema)]
        if isinstance(value, str):
            return self._text(value, choices)
        is_number = any({"number", "integer"} & _types_of(choice) for choice in choices)
        return value if is_number else HIDDEN

    def _text(self, text: str, choices: Sequence[Schema]) -> str:
        for choice in choices:
            if text == choice.get("const") or text in choice.get("enum", ()):
                return text
            if {"number", "string"} <= _types_of(choice) and is_quantity(text):
                return text
        if is_file_name(text):
            place = os.path.realpath(self._document.beside(text))
            if place in self._names.files:
                return self._names.files[place]
        return public_text(text, self._names) or self._names.replacement_of(text) or HIDDEN

    def _mapping_schema(self, value: Mapping[str, Value], schema: Schema) -> Schema:
        """Return the alternative that fits a mapping best: first by kind, then by known keys."""

        def fit(choice: Schema) -> tuple[bool, int]:
            properties = choice.get("properties", {})
            kind = properties.get("kind", {})
            kinds = {kind.get("const"), *kind.get("enum", ())}
            return value.get("kind") in kinds, len(properties.keys() & value.keys())

        return max(self._of_kind(schema, "object"), key=fit, default={})

    def _of_kind(self, schema: Schema, kind: str) -> list[Schema]:
        return [choice for choice in self._alternatives(schema) if kind in _types_of(choice)]

    def _alternatives(self, schema: Schema) -> Iterator[Schema]:
        if "$ref" in schema:
            name = schema["$ref"].rpartition("/")[2]
            yield from self._alternatives(self._definitions[name])
            return
        choices = [*schema.get("anyOf", ()), *schema.get("oneOf", ())]
        if "properties" in schema or not choices:
            yield schema
            return
        for choice in choices:
            yield from self._alternatives(choice)


def _types_of(schema: Schema) -> set[str]:
    kinds = schema.get("type", ())
    return {kinds} if isinstance(kinds, str) else set(kinds)


def _item_schema(arrays: Sequence[Schema], number: int) -> Schema:
    """Return the schema of a list item; {} if none is declared."""
    for array in arrays:
        entries: Sequence[Schema] = array.get("prefixItems", ())
        if number < len(entries):
            return entries[number]
        further: Schema = array.get("items", {})
        return further
    return {}


def _schema_of(document: Document) -> tuple[Schema, Schema]:
    """Return the schema of a document's kind and its definitions; empty for other files."""
    schemas, definitions = _schemas()
    if is_daemon_document(document):
        return schemas["daemon"], definitions
    if is_layout_document(document):
        return schemas["layout"], definitions
    return schemas["rig"], definitions


@cache
def _schemas() -> tuple[dict[str, Schema], Schema]:
    """Return the schemas of all kinds of files, and their common definitions."""
    sections: list[type[BaseModel]] = [RigSection, DaemonSection, LayoutSection, *EFFECTS]
    by_model, whole = models_json_schema([(section, "validation") for section in sections])
    definitions = whole["$defs"]
    schemas = []
    for section in sections:
        reference = by_model[section, "validation"]["$ref"]
        schemas.append(dict(definitions[reference.rpartition("/")[2]]))
    rig, daemon, layout, *effects = schemas
    # A fitted rig has its base and standard errors.
    fitted = {
        "base": {"type": "string"},
        "base_fingerprint": {"type": "string"},
        "standard_errors": {"type": "object", "additionalProperties": {"type": "number"}},
    }
    rig["properties"] = rig["properties"] | fitted
    # Effects are stored under user-defined names, with a kind.
    for section, effect in zip(EFFECTS, effects, strict=True):
        effect["properties"] = effect["properties"] | {"kind": {"const": section.kind}}
    named_effects = {"type": "object", "additionalProperties": {"anyOf": effects}}
    layout["properties"] = layout["properties"] | {"effects": named_effects}
    return {"rig": rig, "daemon": daemon, "layout": layout}, definitions


@cache
def public_words() -> frozenset[str]:
    """Return the public words of this program: choices, and names in its own example."""
    words = {POLYNOMIALS, "auto", *named_contents()}
    words.update(effect.kind for effect in EFFECTS)
    for choices in (KNOWN_MATERIALS, EXCITER_TYPES, THRESHOLDS, DRIVE_MODES, ELEMENTS):
        words.update(choices)
    example = read_document(example_rig_path()).data
    for key in ("eras", "amplifiers"):
        declared = example[key]
        if isinstance(declared, dict):
            words.update(declared)
    return frozenset(words)


@cache
def _public_units() -> frozenset[str]:
    """Return the units in this program's messages."""
    public_units = {""}
    for dimension in vars(units).values():
        if isinstance(dimension, units.Dimension):
            public_units.update(dimension.factors)
            public_units.add(dimension.example.partition(" ")[2])
    return frozenset(public_units)


def is_quantity(text: str) -> bool:
    """Return whether a text is a number with a common unit."""
    match = _QUANTITY.fullmatch(text.strip())
    return match is not None and match[2].strip() in _public_units()


def public_text(text: str, names: Names) -> str:
    """Return a text of public words and mesh sizes, or the public part of a URL; "" otherwise."""
    if text in public_words():
        return text
    parts = text.split()
    is_mesh = bool(parts) and (parts[0] == "auto" or _SIZES.fullmatch(parts[0]) is not None)
    if is_mesh and all(part in public_words() or is_quantity(part) for part in parts[1:]):
        return text
    scheme = text.partition(":")[0].lower()
    if scheme in (*schemes(), *source_schemes()):
        return _public_url(scheme, text.partition(":")[2], names)
    for ending in _FILE_ENDINGS:
        if text.lower().endswith(ending):
            return f"{HIDDEN}{ending}"
    return ""


def _public_url(scheme: str, rest: str, names: Names) -> str:
    """Return a URL's scheme and common device; if the URL is valid, also its options and number."""
    slashes = "//" if rest.startswith("//") else ""
    place, _, options = rest.removeprefix("//").partition("?")
    options, _, number = options.partition("#")
    if not options:
        place, _, number = place.partition("#")
    is_public = place in ("", "/") or _DEVICE.fullmatch(place) is not None
    url = f"{scheme}:{slashes}{place if is_public else HIDDEN}"
    read_url = address_of if scheme in schemes() else open_source
    try:
        read_url(f"{scheme}:{rest}")
    except (CommandError, InputError):
        return url
    separator = "?"
    for name, value in parse_qsl(options, keep_blank_values=True):
        url += f"{separator}{name}={_public_option(value, names)}"
        separator = "&"
    return f"{url}#{number}" if _SHORT.fullmatch(number) else url


def _public_option(value: str, names: Names) -> str:
    is_public = value in CLOCK_ERRORS or _OPTION.fullmatch(value) is not None
    return value if is_public else names.replacement_of(value) or HIDDEN


def harmless_records(text: str, names: Names) -> str:
    """Return the harmless part of JSON lines that this program wrote."""
    return "".join(f"{_harmless_line(line, names)}\n" for line in text.splitlines())


def harmless_json(text: str, names: Names) -> str:
    """Return the harmless part of a JSON value that this program wrote."""
    return json.dumps(_recorded(json.loads(text), names), indent=2)


def _harmless_line(line: str, names: Names) -> str:
    try:
        record = json.loads(line)
    except (ValueError, RecursionError):
        return f'"{HIDDEN}: a line that is not a record"'
    return json.dumps(_recorded(record, names))


def _recorded(value: Any, names: Names) -> Any:
    if isinstance(value, list):
        return [_recorded(entry, names) for entry in value]
    if isinstance(value, str):
        return harmless_words(value, names)
    if not isinstance(value, dict):
        return value
    reduced: dict[str, Any] = {}
    for key, entry in value.items():
        name = names.replacement_of(key) or f"{HIDDEN}-{len(reduced) + 1}"
        if key in own_words() or key in public_words():
            name = key
        is_secret = _SECRET.search(key) is not None
        is_nested = isinstance(entry, dict | list | bool | None)
        if name.startswith(HIDDEN) or (is_secret and not is_nested):
            reduced[name] = HIDDEN
        elif key == "traceback" and isinstance(entry, str):
            reduced[name] = _harmless_traceback(entry, names)
        else:
            reduced[name] = _recorded(entry, names)
    return reduced


def harmless_words(text: str, names: Names) -> str:
    """Replace everything by an ellipsis except numbers, the program's own words and known names."""

    def replaced(match: re.Match[str]) -> str:
        token = match[0]
        core = token.strip(".,;:()[]'\"")
        name = names.replacement_of(core)
        if name is not None:
            return token.replace(core, name)
        if not any(sign.isalnum() for sign in core) or _is_own(core):
            return token
        scheme, colon, rest = core.partition(":")
        if colon and scheme in (*schemes(), *source_schemes()):
            return token.replace(core, _public_url(scheme, rest, names))
        return "…"

    return re.sub(r"\S+", replaced, text)


def _is_own(core: str) -> bool:
    if core in public_words() or is_quantity(core) or _TIME.fullmatch(core):
        return True
    name, equals, value = core.partition("=")
    if equals:
        return name in own_words() and not _SECRET.search(name) and is_quantity(value)
    if core in _own_modules():
        return True
    parts = re.split(r"[-_/]", core)
    return all(_WORD.fullmatch(part) and part in own_words() for part in parts)


def _harmless_traceback(text: str, names: Names) -> str:
    """Return a traceback with this program's files and the known words of its other lines."""
    lines = ["Traceback"]
    for line in text.splitlines()[1:]:
        frame = _FRAME.match(line)
        if frame is None:
            lines.append(harmless_words(line, names))
            continue
        path, line_number = frame.groups()
        file = next((file for file in _own_files() if path.endswith(f"/{file}")), HIDDEN)
        lines.append(f"  File {file}, line {line_number}")
    return "\n".join(lines)


@cache
def _own_files() -> tuple[str, ...]:
    files = (path for package in _PACKAGES for path in (_ROOT / package).rglob("*.py"))
    return tuple(str(path.relative_to(_ROOT)) for path in files)


@cache
def _own_modules() -> frozenset[str]:
    return frozenset(file.removesuffix(".py").replace("/", ".") for file in _own_files())


@cache
def own_words() -> frozenset[str]:
    """Return all words and identifiers of the program: in its texts, keys and names."""
    words = set(dir(builtins))  # error classes, for tracebacks
    pending: list[object] = [
        SourceFileLoader("own", str(_ROOT / file)).get_code("own") for file in _own_files()
    ]
    while pending:
        constant = pending.pop()
        if isinstance(constant, CodeType):
            pending += constant.co_consts
            words.update(constant.co_names)
        elif isinstance(constant, tuple | frozenset):
            pending += constant
        elif isinstance(constant, str):
            words.update(re.findall(r"[^\W\d]\w*", constant))
            words.update(_WORD.findall(constant))
    return frozenset(words)
