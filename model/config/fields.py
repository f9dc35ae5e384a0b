"""User input and its validation: quantities with units, sections of files, options, shapes.

A quantity is a number with a unit, such as `12 in`, `1.5 mm` or `70 GPa`, or a bare SI number.
Sections of configuration files are pydantic models; all problems of a file are reported together.
The command line gives positions, counts and frequency ranges as text. Shapes are regions of the
plate.
"""

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property, partial
from types import UnionType
from typing import (
    Annotated,
    Any,
    Generic,
    TypeAlias,
    TypeVar,
    Union,
    get_args,
    get_origin,
)

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    GetJsonSchemaHandler,
    Strict,
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
from model.config.units import LENGTH, Dimension, as_written, quantity
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


_Point: TypeAlias = tuple[float, float]

_CIRCLE_CORNERS = 60  # a multiple of 4
_TOLERANCE = 1e-9  # m; a point this close to a side is on it


@dataclass(frozen=True)
class Rectangle:
    """A rectangle from its south-west corner (x, y), width along x and height along y."""

    x: float
    y: float
    width: float
    height: float

    def contains(self, x: float, y: float) -> bool:
        """Return whether a point is within the rectangle."""
        return self.x <= x <= self.x + self.width and self.y <= y <= self.y + self.height

    @property
    def center(self) -> _Point:
        """The center of area."""
        return (self.x + self.width / 2, self.y + self.height / 2)

    def corners(self) -> Sequence[_Point]:
        """Return the four corners."""
        east, north = self.x + self.width, self.y + self.height
        return ((self.x, self.y), (east, self.y), (east, north), (self.x, north))

    def as_json(self) -> dict[str, Any]:
        """Return it as the API describes it."""
        return {
            "shape": "rectangle",
            "x_m": self.x,
            "y_m": self.y,
            "width_m": self.width,
            "height_m": self.height,
        }


@dataclass(frozen=True)
class Circle:
    """A circle around (x, y)."""

    x: float
    y: float
    radius: float

    def contains(self, x: float, y: float) -> bool:
        """Return whether a point is within the circle."""
        return math.dist((x, y), (self.x, self.y)) <= self.radius

    @property
    def center(self) -> _Point:
        """The center of the circle."""
        return (self.x, self.y)

    def corners(self) -> Sequence[_Point]:
        """Return points around it, among them those farthest along x and y."""
        angles = [2 * math.pi * number / _CIRCLE_CORNERS for number in range(_CIRCLE_CORNERS)]
        return [
            (self.x + self.radius * math.cos(angle), self.y + self.radius * math.sin(angle))
            for angle in angles
        ]

    def as_json(self) -> dict[str, Any]:
        """Return it as the API describes it."""
        return {"shape": "circle", "x_m": self.x, "y_m": self.y, "radius_m": self.radius}


@dataclass(frozen=True)
class Polygon:
    """Polygon defined by corners; crossing sides follow the even-odd rule."""

    points: tuple[_Point, ...]

    def contains(self, x: float, y: float) -> bool:
        """Return whether a point is within the polygon: a ray to the east crosses its sides an odd
        number of times."""
        if not self._box.contains(x, y):
            return False
        is_within = False
        for (x0, y0), (x1, y1) in zip(self.points, (*self.points[1:], self.points[0]), strict=True):
            if _is_on_side(x, y, (x0, y0), (x1, y1)):
                return True
            if (y0 > y) != (y1 > y) and x < x0 + (y - y0) / (y1 - y0) * (x1 - x0):
                is_within = not is_within
        return is_within

    @cached_property
    def _box(self) -> Rectangle:
        """The bounding box: a fast test that most points fail."""
        xs, ys = zip(*self.points, strict=True)
        return Rectangle(
            min(xs) - _TOLERANCE,
            min(ys) - _TOLERANCE,
            max(xs) - min(xs) + 2 * _TOLERANCE,
            max(ys) - min(ys) + 2 * _TOLERANCE,
        )

    @property
    def center(self) -> _Point:
        """Centroid, or the mean of the corners if crossing sides leave no area."""
        following = (*self.points[1:], self.points[0])
        cross = [
            x0 * y1 - x1 * y0 for (x0, y0), (x1, y1) in zip(self.points, following, strict=True)
        ]
        area = sum(cross) / 2
        if abs(area) < _TOLERANCE:
            xs, ys = zip(*self.points, strict=True)
            return (sum(xs) / len(xs), sum(ys) / len(ys))
        x = y = 0.0
        for (x0, y0), (x1, y1), product in zip(self.points, following, cross, strict=True):
            x += (x0 + x1) * product
            y += (y0 + y1) * product
        return (x / (6 * area), y / (6 * area))

    def corners(self) -> Sequence[_Point]:
        """Return all corners."""
        return self.points

    def as_json(self) -> dict[str, Any]:
        """Return it as the API describes it."""
        return {"shape": "polygon", "points_m": [list(point) for point in self.points]}


RegionShape: TypeAlias = Rectangle | Circle | Polygon
"""A part of the plate; lengths in meters, from the plate's south-west corner."""


def _is_on_side(x: float, y: float, start: _Point, end: _Point) -> bool:
    """Return whether a point is on a side, within a nanometer."""
    length = math.dist(start, end)
    if length == 0:
        return (x, y) == start
    along = ((x - start[0]) * (end[0] - start[0]) + (y - start[1]) * (end[1] - start[1])) / length
    across = ((x - start[0]) * (end[1] - start[1]) - (y - start[1]) * (end[0] - start[0])) / length
    return abs(across) <= _TOLERANCE and -_TOLERANCE <= along <= length + _TOLERANCE


_Length = Annotated[float, Quantity(LENGTH, at_least=-10, at_most=10)]
PointSection = Annotated[tuple[_Length, _Length], Strict(strict=False)]  # a list in the file
PolygonSection = Annotated[list[PointSection], Field(min_length=3, max_length=64)]


class RectangleSection(Section):
    """Two opposite corners."""

    start: PointSection
    end: PointSection


class CircleSection(Section):
    """A center and a radius."""

    at: PointSection
    radius: Annotated[float, Quantity(LENGTH, above=0, at_most=10)]


class ShapedSection(Section):
    """Section with exactly one shape."""

    rectangle: RectangleSection | None = None
    circle: CircleSection | None = None
    polygon: PolygonSection | None = None

    @property
    def shape(self) -> RegionShape:
        """The shape of the section."""
        if self.rectangle is not None:
            (x0, y0), (x1, y1) = self.rectangle.start, self.rectangle.end
            return Rectangle(min(x0, x1), min(y0, y1), abs(x1 - x0), abs(y1 - y0))
        if self.circle is not None:
            return Circle(*self.circle.at, self.circle.radius)
        return Polygon(tuple(self.polygon or ()))

    def shape_problem(self, sides: _Point | None) -> tuple[tuple[str, ...], str] | None:
        """Return the key and the problem of a section without a single shape on the plate, else
        None.

        sides [m]: length and width of the plate, None for any plate.
        """
        keys = [name for name in ShapedSection.model_fields if getattr(self, name) is not None]
        if len(keys) != 1:
            known_keys = ", ".join(ShapedSection.model_fields)
            return (), f"must have one of {known_keys}, got {' and '.join(keys) or 'none'}"
        (x0, y0), (x1, y1) = box_of(self.shape)
        length, width = sides or (x1, y1)
        d = _TOLERANCE
        if sides is None or (min(x0, y0) >= -d and x1 <= length + d and y1 <= width + d):
            return None
        return (keys[0],), (
            f"must lie on the plate of {length:g} m by {width:g} m, got ({x0:g}, {y0:g}) to "
            f"({x1:g}, {y1:g}) m; coordinates start at its south-west corner"
        )


def box_of(shape: RegionShape) -> tuple[_Point, _Point]:
    """South-west and north-east corner of the box around a shape."""
    xs, ys = zip(*shape.corners(), strict=True)
    return (min(xs), min(ys)), (max(xs), max(ys))
