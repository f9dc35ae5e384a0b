"""User input and its validation: quantities with units, sections of files, options.

A quantity is a number with a unit, such as `12 in`, `1.5 mm` or `70 GPa`, or a bare SI number.
Sections of configuration files are pydantic models; all problems of a file are reported together.
The command line gives positions, counts and frequency ranges as text.
"""

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from types import UnionType
from typing import (
    Annotated,
    Any,
    Generic,
    TypeVar,
    Union,
    get_args,
    get_origin,
)

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    GetCoreSchemaHandler,
    GetJsonSchemaHandler,
    TypeAdapter,
    ValidationError,
)
from pydantic.fields import FieldInfo
from pydantic_core import CoreSchema, ErrorDetails, InitErrorDetails, core_schema

from model.config.document import (
    MAX_FILE_NAME,
    MAX_PROBLEMS,
    ConfigError,
    ConfigProblem,
    Document,
    KeyPath,
    Value,
    is_file_name,
    is_null_word,
)
from model.config.units import Dimension, as_written, quantity
from model.quantities import counted
from registry.plugins import did_you_mean
from registry.wording import reworded


class Section(BaseModel):
    """A mapping in a configuration file: strict types, no unknown keys."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


_MAX_NAME = 100  # characters; longer words are not spelling errors

SectionT = TypeVar("SectionT", bound=Section)
PartT = TypeVar("PartT", bound=Section)


@dataclass(frozen=True)
class Quantity:
    """Annotation of a float field written with a unit or in SI.

    Bounds are in SI: above and below exclude theirs, at_least and at_most include it.
    """

    dimension: Dimension
    above: float = -float("inf")
    at_least: float = -float("inf")
    at_most: float = float("inf")
    below: float = float("inf")
    word: str = ""
    """Word that is accepted instead of a number, and kept unchanged."""

    def read(self, value: object) -> float:
        """Convert to SI units; raises ValueError for another dimension or a value out of bounds."""
        result = quantity(value, self.dimension)
        if self.above < result < self.below and self.at_least <= result <= self.at_most:
            return result
        bounds = {
            "above": self.above,
            "at least": self.at_least,
            "at most": self.at_most,
            "below": self.below,
        }
        limits = []
        for words, bound in bounds.items():
            if math.isfinite(bound):
                limits.append(f"{words} {bound:g} {self.dimension.unit}".strip())
        bare = f"; a bare number is in {self.dimension.unit}" if self.dimension.unit else ""
        raise ValueError(f"must be {' and '.join(limits)}, got {value}{bare}")

    def __get_pydantic_core_schema__(
        self, source: object, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        return core_schema.no_info_plain_validator_function(self._read_or_word)

    def _read_or_word(self, value: object) -> float | str:
        if self.word and value == self.word:
            return self.word
        try:
            return self.read(value)
        except ValueError as error:
            raise ValueError(f"{error}; or {self.word}" if self.word else str(error)) from error

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: object) -> dict[str, Any]:
        unit = self.dimension.unit or "no unit"
        description = f"{self.dimension.name} [{unit}], for example {self.dimension.example}"
        return {"type": ["number", "string"], "description": description}


_WRITE_NULL = "; for none write null, or leave the key out"


def _file_name(text: str) -> str:
    if is_null_word(text):
        raise ValueError(f"must be the name of a file, got {text}{_WRITE_NULL}; or write ./{text}")
    if not is_file_name(text):
        raise ValueError(
            f"must be the name of a file, up to {MAX_FILE_NAME} characters, "
            f"got {as_written(text)[:40]}"
        )
    return text


FileName = Annotated[str, AfterValidator(_file_name)]
"""Type of a file name; relative names start at the folder of the file that contains them."""


def quantities(field: FieldInfo) -> list[Quantity]:
    """Return every Quantity in the type of a field, at any depth."""
    direct = [part for part in field.metadata if isinstance(part, Quantity)]
    return [*direct, *_nested_quantities(field.annotation)]


def _nested_quantities(annotation: Any) -> Iterator[Quantity]:
    for part in get_args(annotation):
        if isinstance(part, Quantity):
            yield part
        else:
            yield from _nested_quantities(part)


class ByKind:
    """Annotation of a union of sections; `kind` selects one, by default the first."""

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        sections = get_args(source)
        return core_schema.no_info_plain_validator_function(
            partial(_validated_by_kind, sections), metadata={"sections": sections}
        )

    def __get_pydantic_json_schema__(
        self, schema: Any, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        sections = schema["metadata"]["sections"]
        return {"anyOf": [handler(section.__pydantic_core_schema__) for section in sections]}


def _validated_by_kind(sections: Sequence[type[Section]], value: Any) -> Section:
    kinds = [kind for section in sections for kind in _kinds(section)]
    kind_name = value.get("kind", kinds[0]) if isinstance(value, dict) else kinds[0]
    if kind_name not in kinds:
        expected = " or ".join(repr(kind) for kind in kinds)
        error = InitErrorDetails(
            type="literal_error", loc=("kind",), input=kind_name, ctx={"expected": expected}
        )
        raise ValidationError.from_exception_data("kind", [error])
    return section_by_kind(sections, value).model_validate(value)


def _kinds(section: type[Section]) -> tuple[str, ...]:
    return get_args(section.model_fields["kind"].annotation)


def section_by_kind(sections: Sequence[type[PartT]], value: object) -> type[PartT]:
    """Return the section for the `kind` of a mapping; the first one for an unknown or missing
    kind."""
    kind = value.get("kind") if isinstance(value, dict) else None
    return next((section for section in sections if kind in _kinds(section)), sections[0])


class Validation(Generic[SectionT]):
    """Checks a document against its sections, and collects all problems."""

    def __init__(self, document: Document, root: type[SectionT]) -> None:
        """Find every unknown key, missing key and invalid value."""
        self._section: SectionT | None = None
        self.document = document
        self._problems: list[ConfigProblem] = []
        try:
            self._section = root.model_validate(document.data)
        except ValidationError as error:
            self._add_errors(error, root)

    def part(self, path: KeyPath, section: type[PartT]) -> PartT | None:
        """Return a section if it is valid on its own, for checks across sections; else None."""
        try:
            return section.model_validate(self.document.value(path))
        except (KeyError, ValidationError):
            return None

    def nested(
        self, path: KeyPath, section: type[PartT], *, without: str | None = None
    ) -> PartT | None:
        """Validate a section that its parent leaves open, without one of its keys."""
        value = self.mapping(path)
        try:
            return section.model_validate({k: v for k, v in value.items() if k != without})
        except ValidationError as error:
            self._add_errors(error, section, below=path)
            return None

    def field(self, path: KeyPath, section: type[Section]) -> Any:
        """Return one field of a section if it is valid on its own; else None."""
        try:
            return _field_reader(section, str(path[-1])).validate_python(self.document.value(path))
        except (KeyError, ValidationError):
            return None

    def mapping(self, path: KeyPath) -> Mapping[str, Value]:
        """Return a mapping of the file, unchecked; empty if missing."""
        try:
            value = self.document.value(path)
        except KeyError:
            return {}
        return value if isinstance(value, dict) else {}

    def add(self, path: KeyPath, message: str) -> None:
        """Add a problem at a key."""
        self._problems.append(self.document.problem(path, message))

    def _add_errors(
        self, error: ValidationError, section: type[Section], *, below: KeyPath = ()
    ) -> None:
        """Add the errors of a section below a path, up to one more than are reported."""
        for details in error.errors(include_url=False)[: MAX_PROBLEMS + 1]:
            self._problems.append(_problem(self.document, section, details, below=below))

    def finish(self) -> SectionT:
        """Return the root section; raises ConfigError with all problems."""
        if self._problems or self._section is None:
            raise ConfigError(self.document.source, self._problems)
        return self._section


@cache
def _field_reader(section: type[Section], name: str) -> TypeAdapter[Any]:
    return TypeAdapter(
        section.model_fields[name].rebuild_annotation(), config=ConfigDict(strict=True)
    )


def _problem(
    document: Document, root: type[Section], details: ErrorDetails, *, below: KeyPath = ()
) -> ConfigProblem:
    """Convert a pydantic error of a section below a path."""
    # pydantic marks an error in the key of a mapping by a last entry "[key]".
    path = tuple(part for part in details["loc"] if part != "[key]")
    value, context = details["input"], details.get("ctx", {})
    bound = context.get("min_length", context.get("max_length", 0))
    match details["type"]:
        case "extra_forbidden":
            keys = [*_section_at(root, path[:-1], document).model_fields]
            message = f"unknown key; {did_you_mean(str(path[-1]), keys)}known: {', '.join(keys)}"
        case "literal_error" | "enum":
            message = _no_choice(details, context["expected"])
        case kind if kind in _MESSAGES:
            message = _MESSAGES[kind].format(
                **context,
                got=_shown(details),
                quotes=_in_quotes(details),
                entries=counted(bound, "entry", plural="entries"),
                characters=counted(bound, "character"),
                # too many entries are not counted
                count=len(value) if isinstance(value, list | dict) else 0,
            )
        case _:
            message = f"{reworded(details['msg'])}, got {_shown(details)}"
    if is_null_word(value) and _WRITE_NULL not in message:
        message += _without_value(root, path, document)
    return document.problem((*below, *path), message)


def _without_value(root: type[Section], path: KeyPath, document: Document) -> str:
    """Return the text for "no value" at a key, "" if a value is required."""
    section = _section_at(root, path[:-1], document)  # or the type of a list or mapping
    field = getattr(section, "model_fields", {}).get(path[-1])
    if field is None or field.is_required():
        return ""
    is_nullable = type(None) in get_args(field.annotation)
    return _WRITE_NULL if is_nullable else "; for none leave the key out"


_WHOLE, _LIST = "must be a whole number, got {got}", "must be a list in brackets, got {got}"
_MAPPING = "must be a mapping of `key: value` lines, got {got}"
_MESSAGES = {
    "missing": "missing; add it",
    "value_error": "{error}",
    **dict.fromkeys(("model_type", "dict_type"), _MAPPING),
    **dict.fromkeys(("list_type", "tuple_type"), _LIST),
    **dict.fromkeys(("int_type", "int_from_float"), _WHOLE),
    "string_type": "must be text, got {got}{quotes}",
    "greater_than_equal": "must be at least {ge}, got {got}",
    "less_than_equal": "must be at most {le}, got {got}",
    "string_too_short": "must not be empty; write text, or remove the key",
    "string_too_long": "must have at most {characters}, got {got}",
    "too_short": "must have at least {entries}, got {count}",
    "too_long": "must have at most {entries}, got {count}",
}
"""Messages by pydantic's error kinds, with their placeholders."""


def _in_quotes(details: ErrorDetails) -> str:
    """Return the remedy for text that YAML reads as a number or a boolean."""
    value = details["input"]
    return "" if value is None or isinstance(value, dict | list) else "; write it in quotes"


def _no_choice(details: ErrorDetails, expected: str) -> str:
    """Return the message for a value that is not one of the choices, `'x', 'y' or 'z'`."""
    choices = expected.replace("'", "")
    meant = did_you_mean(str(details["input"])[:_MAX_NAME], re.findall(r"'([^']+)'", expected))
    return f"must be {choices}, got {_shown(details)}" + (f"; {meant.strip()}" if meant else "")


def _shown(details: ErrorDetails) -> str:
    text = as_written(details["input"])
    return text if len(text) <= 40 else f"{text[:40]}..."


def _section_at(root: type[Section], path: KeyPath, document: Document) -> type[Section]:
    """Return the section at a path; if it has several kinds, the one in the document."""
    kind: Any = root
    for number, part in enumerate(path, start=1):
        if get_origin(kind) in (dict, list):
            kind = get_args(kind)[-1]
        else:
            kind = kind.model_fields[part].annotation
        while get_origin(kind) in (Annotated, Union, UnionType):
            annotations = getattr(kind, "__metadata__", ())
            kind = get_args(kind)[0]  # of a field that may be left out
            if any(isinstance(annotation, ByKind) for annotation in annotations):
                kind = section_by_kind(get_args(kind), document.value(path[:number]))
    section: type[Section] = kind
    return section
