"""The reference of surface layouts, key by key, against what layouts may say."""

from collections.abc import Iterator
from pathlib import Path
from typing import Literal, get_args, get_origin

import pytest
from pydantic.fields import FieldInfo

from controller.effects.buzz import Buzz
from controller.effects.click import Click
from controller.effects.detents import Detents
from controller.effects.effect import MAX_DB_SL, MIN_DB_SL, Effect
from controller.effects.layout_file import (
    CircleSection,
    LayoutSection,
    RectangleSection,
    RegionSection,
    load_layout,
)
from controller.effects.ramp import Ramp
from controller.effects.texture import Texture
from key_tables import bounds_in_words, key_rows, quantities
from model.config.document import ConfigError
from model.config.sections import Section
from model.config.units import quantity
from model.rig.file import example_rig_path, load_rig

PAGE = Path(__file__).parents[3] / "docs" / "reference" / "effects.md"
KINDS: tuple[type[Effect], ...] = (Click, Buzz, Ramp, Texture, Detents)

CIRCLE = "circle: {at: [0.1, 0.1], radius: 1 cm}"
# Lines of a layout with an invalid value of each key.
WRONG = {
    "The file": {
        "effects": "effects: 5",
        "regions": "regions: [a]",
        "elsewhere": "elsewhere: nowhere",
        "most_at_once": "most_at_once: 5",
    },
    "Effects": {
        "kind": "effects: {mine: {kind: silk}}",
        "level": "effects: {mine: {kind: click, level: 61}}",
        "click.duration": "effects: {click: {duration: 19 ms}}",
        "buzz.duration": "effects: {buzz: {duration: 11 s}}",
        "ramp.start_level": "effects: {ramp: {start_level: -21}}",
        "ramp.duration": "effects: {ramp: {duration: 1 m}}",
        "ramp.hold": "effects: {ramp: {hold: 2}}",
        "texture.slow": "effects: {texture: {slow: 0}}",
        "texture.fast": "effects: {texture: {fast: 6 m/s}}",
        "texture.range": "effects: {texture: {range: 41}}",
        "detents.spacing": "effects: {detents: {spacing: 1 mm}}",
        "detents.along": "effects: {detents: {along: z}}",
        "detents.duration": "effects: {detents: {duration: 0.3}}",
    },
    "Regions": {
        "rectangle": "regions: {a: {rectangle: [0, 0]}}",
        "rectangle.start": "regions: {a: {rectangle: {start: [0, 0, 0], end: [0.1, 0.1]}}}",
        "rectangle.end": "regions: {a: {rectangle: {start: [0, 0], end: [0, 1 s]}}}",
        "circle": "regions: {a: {circle: 5 mm}}",
        "circle.at": "regions: {a: {circle: {at: 0.1, radius: 1 cm}}}",
        "circle.radius": "regions: {a: {circle: {at: [0.1, 0.1], radius: 0}}}",
        "polygon": "regions: {a: {polygon: [[0, 0], [0, 0.1]]}}",
        "on_press": f"regions: {{a: {{{CIRCLE}, on_press: nothing}}}}",
        "on_move": f"regions: {{a: {{{CIRCLE}, on_move: buzz}}}}",
        "on_release": f"regions: {{a: {{{CIRCLE}, on_release: buzz}}}}",
        "level": f"regions: {{a: {{{CIRCLE}, on_press: buzz, level: loud}}}}",
        "priority": f"regions: {{a: {{{CIRCLE}, priority: 101}}}}",
    },
}


def fields(heading: str) -> dict[str, FieldInfo]:
    """Every key of a section of the page, those of a part behind a dot, in the page's order."""
    match heading:
        case "The file":
            return dict(LayoutSection.model_fields)
        case "Regions":
            parts = {"rectangle": RectangleSection, "circle": CircleSection}
            return dict(with_parts(RegionSection, parts))
        case _:
            own = {
                f"{kind.kind}.{key}": field
                for kind in KINDS
                for key, field in kind.model_fields.items()
                if key != "level"
            }
            return {"level": Effect.model_fields["level"], **own}


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
    """In their order; each has an invalid value in the table of this file."""
    named = list(rows(heading))
    assert list(WRONG[heading]) == named
    if heading == "Effects":
        assert named.pop(0) == "kind"
    assert named == list(fields(heading))


@pytest.mark.parametrize(("heading", "key", "field"), CASES)
def test_page_has_units_limits_and_defaults_of_the_sections(
    heading: str, key: str, field: FieldInfo
) -> None:
    """Limits in the words of the error."""
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


@pytest.mark.parametrize(
    ("heading", "key"), [(heading, key) for heading, lines in WRONG.items() for key in lines]
)
def test_load_layout_refuses_an_invalid_value_at_its_key(
    tmp_path: Path, heading: str, key: str
) -> None:
    """With its line, and no other problem."""
    expected = {
        "The file": key,
        "Effects": f"effects.{key}" if "." in key else f"effects.mine.{key}",
        "Regions": f"regions.a.{key}",
    }[heading]
    path = tmp_path / "layout.yaml"
    path.write_text(f"# a layout\n{WRONG[heading][key]}\n", encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        load_layout(path, load_rig(example_rig_path()).plate)
    found = [(problem.line, problem.key.partition("[")[0]) for problem in caught.value.problems]
    assert found == [(2, expected)]
