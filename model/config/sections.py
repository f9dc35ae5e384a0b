"""The shape of a configuration file: sections as pydantic models, every error found at once."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from types import UnionType
from typing import Annotated, Any, Generic, TypeVar, Union, get_args, get_origin

from pydantic import BaseModel, ConfigDict, GetCoreSchemaHandler, TypeAdapter, ValidationError
from pydantic_core import CoreSchema, ErrorDetails, core_schema

from model.config.document import ConfigError, Document, KeyPath, Problem, Value
from model.config.units import Dimension, quantity, shown
from model.counting import counted
from model.errors import in_our_words
from registry.suggestions import did_you_mean


class Section(BaseModel):
    """A mapping in a configuration file: no unknown keys, nothing converted behind one's back."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


SectionT = TypeVar("SectionT", bound=Section)
PartT = TypeVar("PartT", bound=Section)


@dataclass(frozen=True)
class Quantity:
    """Annotates a float field that is written with a unit or in SI; bounds in SI.

    above and below exclude the bound itself, least and most include it.
    """

    dimension: Dimension
    above: float = -float("inf")
    least: float = -float("inf")
    most: float = float("inf")
    below: float = float("inf")

    def read(self, value: object) -> float:
        """The value in SI units; raises InputError if it is none, or out of bounds."""
        result = quantity(value, self.dimension)
        if self.above < result < self.below and self.least <= result <= self.most:
            return result
        limits = [
            f"{words} {limit:g} {self.dimension.unit}".strip()
            for words, limit in (
                ("above", self.above),
                ("at least", self.least),
                ("at most", self.most),
                ("below", self.below),
            )
            if abs(limit) != float("inf")
        ]
        bare = f"; a bare number is in {self.dimension.unit}" if self.dimension.unit else ""
        raise ValueError(f"{value} is out of range, must be {' and '.join(limits)}{bare}")

    def __get_pydantic_core_schema__(
        self, source: object, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        return core_schema.no_info_plain_validator_function(self.read)

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: object) -> dict[str, Any]:
        unit = self.dimension.unit or "no unit"
        description = f"{self.dimension.name} [{unit}], for example {self.dimension.example}"
        return {"type": ["number", "string"], "description": description}


class Validation(Generic[SectionT]):
    """Checks a document against its sections, and collects all problems."""

    def __init__(self, document: Document, root: type[SectionT]) -> None:
        """Find every key that is unknown, missing, or has a value that its section refuses."""
        self._section: SectionT | None = None
        self._document = document
        self._problems: list[Problem] = []
        try:
            self._section = root.model_validate(document.data)
        except ValidationError as error:
            for details in error.errors(include_url=False):
                self._problems.append(_problem(document, root, details))

    def part(self, path: KeyPath, section: type[PartT]) -> PartT | None:
        """A section if it is in order by itself, so that checks across sections need not wait."""
        try:
            return section.model_validate(self._document.value(path))
        except (KeyError, ValidationError):
            return None

    def nested(
        self, path: KeyPath, section: type[PartT], *, without: str | None = None
    ) -> PartT | None:
        """A section that its parent leaves open, but for one of its keys; problems are noted."""
        value = self.mapping(path)
        try:
            return section.model_validate({k: v for k, v in value.items() if k != without})
        except ValidationError as error:
            for details in error.errors(include_url=False):
                self._problems.append(_problem(self._document, section, details, below=path))
            return None

    def field(self, path: tuple[str, ...], section: type[Section]) -> Any:
        """One field of a section if that is in order, whatever its neighbours are; else None."""
        try:
            return _field_reader(section, path[-1]).validate_python(self._document.value(path))
        except (KeyError, ValidationError):
            return None

    def mapping(self, path: KeyPath) -> Mapping[str, Value]:
        """A mapping as it stands in the file, unchecked; empty if there is none."""
        try:
            value = self._document.value(path)
        except KeyError:
            return {}
        return value if isinstance(value, dict) else {}

    def add(self, path: KeyPath, message: str) -> None:
        """Note a problem at a key."""
        self._problems.append(self._document.problem(path, message))

    def finish(self) -> SectionT:
        """Return the root section; raises ConfigError with all problems."""
        if self._problems or self._section is None:
            raise ConfigError(self._document.source, self._problems)
        return self._section


@cache
def _field_reader(section: type[Section], name: str) -> TypeAdapter[Any]:
    return TypeAdapter(
        section.model_fields[name].rebuild_annotation(), config=ConfigDict(strict=True)
    )


def _problem(
    document: Document, root: type[Section], details: ErrorDetails, *, below: KeyPath = ()
) -> Problem:
    """A pydantic error in our words, of a section that lies below a path."""
    # pydantic marks an error in a mapping's key, not its value, by a last entry "[key]".
    path = tuple(part for part in details["loc"] if part != "[key]")
    context = details.get("ctx", {})
    match details["type"]:
        case "missing":
            message = "is missing; add it"
        case "extra_forbidden":
            message = _unknown_key(str(path[-1]), _section_at(root, path[:-1]))
        case "value_error":
            message = str(context["error"])
        case "model_type" | "dict_type":
            message = f"must be a mapping, `key: value` each on a line, not {_shown(details)}"
        case "list_type" | "tuple_type":
            message = f"must be a list in brackets, not {_shown(details)}"
        case "int_type" | "int_from_float":
            message = f"must be a whole number, not {_shown(details)}"
        case "string_type":
            message = f"must be a text, not {_shown(details)}{_in_quotes(details)}"
        case "greater_than_equal":
            message = f"must be {context['ge']} or more, not {_shown(details)}"
        case "less_than_equal":
            message = f"must be {context['le']} or less, not {_shown(details)}"
        case "literal_error" | "enum":
            message = _no_choice(details, context["expected"])
        case "string_too_short":
            message = "is empty; write something, or leave the key out"
        case "string_too_long":
            bound = counted(context["max_length"], "character")
            message = f"{_shown(details)} is too long; write {bound} at most"
        case "too_short" | "too_long":
            bound = f"at least {context['min_length']}" if "min_length" in context else ""
            bound = bound or f"at most {context['max_length']}"
            count = context["actual_length"]
            message = f"has {count} {'entry' if count == 1 else 'entries'}, must have {bound}"
        case _:
            message = f"{in_our_words(details['msg'])}, not {_shown(details)}"
    return document.problem((*below, *path), message)


def _in_quotes(details: ErrorDetails) -> str:
    """What to do about a name that YAML takes for a number, a truth value or a date."""
    given = details["input"]
    return "" if given is None or isinstance(given, dict | list) else "; write it in quotes"


def _no_choice(details: ErrorDetails, expected: str) -> str:
    """pydantic lists what is expected as `'x', 'y' or 'z'`."""
    choices = expected.replace("'", "")
    meant = did_you_mean(str(details["input"]), re.findall(r"'([^']+)'", expected))
    return f"must be {choices}, not {_shown(details)}" + (f"; {meant.strip()}" if meant else "")


def _shown(details: ErrorDetails) -> str:
    text = shown(details["input"])
    return text if len(text) <= 40 else f"{text[:40]}..."


def _unknown_key(key: str, section: type[Section]) -> str:
    known = list(section.model_fields)
    return f"unknown key; {did_you_mean(key, known)}known here are: {', '.join(known)}"


def _section_at(root: type[Section], path: KeyPath) -> type[Section]:
    """The section whose keys stand below a path."""
    kind: Any = root
    for part in path:
        if get_origin(kind) in (dict, list):
            kind = get_args(kind)[-1]
        else:
            kind = kind.model_fields[part].annotation
        if get_origin(kind) in (Union, UnionType):  # of a field that may be left out
            kind = get_args(kind)[0]
        if get_origin(kind) is Annotated:
            kind = get_args(kind)[0]
    section: type[Section] = kind
    return section
