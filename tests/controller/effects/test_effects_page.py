"""The reference of surface layouts, key by key, against what layouts may say."""

from collections.abc import Iterator
from pathlib import Path
from typing import Literal, get_args, get_origin

import pytest
from pydantic.fields import FieldInfo

from controller.effects.band import TunedSection
from controller.effects.buzz import Buzz
from controller.effects.click import Click
from controller.effects.detents import Detents
from controller.effects.dial import Dial
from controller.effects.effect import MAX_DB_SL, MIN_DB_SL, Effect
from controller.effects.layout_file import (
    CircleSection,
    LayoutSection,
    RectangleSection,
    RegionSection,
)
from controller.effects.ramp import Ramp
from controller.effects.texture import Texture
from key_tables import bounds_in_words, key_rows, quantities
from model.config.sections import Section
from model.config.units import quantity

PAGE = Path(__file__).parents[3] / "docs" / "reference" / "effects.md"
KINDS: tuple[type[Effect], ...] = (Click, Buzz, Ramp, Texture, Detents, Dial)


def fields(heading: str) -> dict[str, FieldInfo]:
    """Every key of a section of the page, those of a part behind a dot, in the page's order."""
    match heading:
        case "The file":
            return dict(LayoutSection.model_fields)
        case "Regions":
            parts = {"rectangle": RectangleSection, "circle": CircleSection}
            return tuned_after_level(dict(with_parts(RegionSection, parts)))
        case _:
            own = {
                f"{kind.kind}.{key}": field
                for kind in KINDS
                for key, field in kind.model_fields.items()
                if key not in Effect.model_fields
            }
            return {**tuned_after_level(dict(Effect.model_fields)), **own}


def tuned_after_level(fields: dict[str, FieldInfo]) -> dict[str, FieldInfo]:
    """Put what every tuned section has behind its level."""
    tuned = {key: fields.pop(key) for key in TunedSection.model_fields}
    ordered = {}
    for key, field in fields.items():
        ordered[key] = field
        if key == "level":
            ordered.update(tuned)
    return ordered


def with_parts(
    section: type[Section], parts: dict[str, type[Section]]
) -> Iterator[tuple[str, FieldInfo]]:
    """The keys of a section, each part's own behind the key of the part."""
    for key, field in section.model_fields.items():
        yield key, field
        if key in parts:
            yield from ((f"{key}.{own}", its) for own, its in parts[key].model_fields.items())


def rows(heading: str) -> dict[str, list[str]]:
    """The page's table of a section."""
    return key_rows(PAGE.read_text("utf-8"), heading)


CASES = [
    pytest.param(heading, key, field, id=f"{heading}: {key}")
    for heading in ("The file", "Effects", "Regions")
    for key, field in fields(heading).items()
]


@pytest.mark.parametrize("heading", ["The file", "Effects", "Regions"])
def test_every_key_is_documented_and_no_other(heading: str) -> None:
    """The table of a section names its keys in their order."""
    named = list(rows(heading))
    if heading == "Effects":
        assert named.pop(0) == "kind"
    assert named == list(fields(heading))


@pytest.mark.parametrize(("heading", "key", "field"), CASES)
def test_page_has_units_limits_and_defaults_of_the_sections(
    heading: str, key: str, field: FieldInfo
) -> None:
    """A key's row has its unit, its default, and its limits in the words of the error."""
    unit, default, limits, _ = rows(heading)[key]
    found = quantities(field)
    assert unit == (found[0].dimension.unit if found else "")
    words = bounds(key, field)
    assert limits == words or not words
    if field.is_required():
        assert default == "required"
    elif isinstance(field.default, float) and found:
        assert quantity(default, found[0].dimension) == field.default
    elif isinstance(field.default, str):
        assert default == f"`{field.default}`"
    elif isinstance(field.default, bool):
        assert default == f"`{str(field.default).lower()}`"
    elif isinstance(field.default, int | float):
        assert default == f"{field.default:g}"
    else:
        assert default == "none"


def bounds(key: str, field: FieldInfo) -> str:
    """A field's bounds in words; none where they are not numbers or choices."""
    if key == "level":
        return f"at least {MIN_DB_SL:g}, at most {MAX_DB_SL:g}"
    if get_origin(field.annotation) is Literal:
        return ", ".join(f"`{choice}`" for choice in get_args(field.annotation))
    carried = [*field.metadata]
    for part in get_args(field.annotation):  # of `... | None`
        for each in getattr(part, "__metadata__", ()):
            carried += each.metadata if isinstance(each, FieldInfo) else [each]
    limits = {
        name: bound
        for each in carried
        for name in ("min_length", "max_length", "ge", "le")
        if (bound := getattr(each, name, None)) is not None
    }
    if "ge" in limits:
        return f"at least {limits['ge']}, at most {limits['le']}"
    most = limits.get("max_length")
    count = f"{limits['min_length']} to {most}" if "min_length" in limits else f"up to {most}"
    within = next((bounds_in_words(asked) for asked in quantities(field)), "")
    return ", each ".join(part for part in (count if most else "", within) if part)
