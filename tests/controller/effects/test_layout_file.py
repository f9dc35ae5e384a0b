"""Surface layouts in their files, and the page on their keys."""

from pathlib import Path

import pytest

from controller.effects.effect import Effect, TunedSection
from controller.effects.kinds import Click, Detents
from controller.effects.layout import LayoutSection, RegionSection, load_layout
from key_tables import key_rows
from model.config.document import ConfigError
from model.config.fields import CircleSection, Rectangle, RectangleSection
from model.rig.rig_file import example_rig_path, load_rig

EXAMPLE = Path(__file__).parents[3] / "controller" / "effects" / "example.yaml"


def test_load_layout_reads_the_example() -> None:
    """Its numbers are in metres."""
    layout = load_layout(EXAMPLE, load_rig(example_rig_path()).plate)
    assert [region.name for region in layout.regions] == [
        "keypad",
        "slider",
        "knob",
        "tuner",
        "patch",
    ]
    keypad, slider, _, tuner, patch = layout.regions
    shape = keypad.shape
    assert isinstance(shape, Rectangle)
    assert (shape.x, shape.y, shape.width, shape.height) == pytest.approx((0.23, 0.16, 0.04, 0.03))
    assert (keypad.on_press, keypad.on_release, keypad.has_level) == ("press", "soft", False)
    assert (patch.has_level, patch.level_db_sl) == (True, None)
    assert (slider.priority, slider.band) == (1, (100.0, 400.0))
    assert tuner.band == (60.0, 300.0)
    assert layout.effects["soft"] == Click(duration=0.03, level=14.0)
    assert layout.effects["notches"] == Detents(spacing=0.012, along="x", duration=0.03)
    assert layout.elsewhere is None
    found = layout.region_at(0.255, 0.045)
    assert found is not None
    assert found.name == "knob"
    assert layout.region_at(0.30, 0.01) is None


def test_a_region_says_how_its_fingers_are_to_be_served(tmp_path: Path) -> None:
    """Each key alone; what is a finger's own is not shared."""
    shape = "rectangle: {start: [0, 0], end: [0.1, 0.1]}, level: 14 dB, on_press: buzz"
    path = tmp_path / "layout.yaml"
    path.write_text(
        f"regions: {{a: {{{shape}, own: true, protected: true}}, b: {{{shape}, may_share: true}}}}",
        encoding="utf-8",
    )
    a, b = load_layout(path, None).regions
    assert b.level_db_sl == 14
    assert (a.is_own, a.may_share, a.is_protected) == (True, False, True)
    assert (b.is_own, b.may_share, b.is_protected) == (False, True, False)
    assert {key: a.as_json()[key] for key in ("own", "may_share", "protected")} == {
        "own": True,
        "may_share": False,
        "protected": True,
    }


def test_of_too_many_effects_the_number_is_said_and_no_more_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A thousand: a region that has one of the last has no problem of its own."""
    path, read = tmp_path / "layout.yaml", list[str]()
    effects = ", ".join(f"e{n}: {{kind: click}}" for n in range(1000))
    shape = "rectangle: {start: [0, 0], end: [0.1, 0.1]}"
    path.write_text(
        f"effects: {{{effects}}}\nregions: {{a: {{{shape}, on_press: e999}}}}\n", "utf-8"
    )
    monkeypatch.setattr(
        "controller.effects.layout.effect_kind", lambda kind: read.append(kind) or Click
    )
    with pytest.raises(ConfigError) as caught:
        load_layout(path, None)
    (problem,) = caught.value.problems
    assert (problem.line, problem.key) == (1, "effects")
    assert "64 entries, got 1000" in problem.message
    assert len(read) == 64


def test_region_at_returns_the_later_region_where_two_overlap(tmp_path: Path) -> None:
    """Regions lie on top of each other in the order of the file."""
    path = tmp_path / "layout.yaml"
    path.write_text(
        "regions:\n"
        "  under: {rectangle: {start: [0, 0], end: [0.2, 0.2]}}\n"
        "  over: {circle: {at: [0.1, 0.1], radius: 0.02}}\n",
        encoding="utf-8",
    )
    layout = load_layout(path, load_rig(example_rig_path()).plate)
    found = [layout.region_at(x, 0.1) for x in (0.1, 0.15)]
    assert [region.name for region in found if region] == ["over", "under"]


@pytest.mark.parametrize(
    ("highest", "problems"),
    [
        ("", ["effects.strong", "regions.a.level"]),
        ("max_level_db_sl: 45", ["regions.a.level"]),
        ("max_level_db_sl: 50", []),
        ("max_level_db_sl: 61", ["max_level_db_sl"]),
        ("max_level_db_sl: 39", ["max_level_db_sl"]),
    ],
)
def test_levels_end_where_the_layout_says(
    tmp_path: Path, highest: str, problems: list[str]
) -> None:
    """At 40 dB SL, or where the layout raises it, 60 at most; one problem a level."""
    path = tmp_path / "layout.yaml"
    path.write_text(
        f"{highest}\n"
        "effects: {strong: {kind: ramp, start_level: 45, level: 20}}\n"
        "regions:\n"
        "  a: {circle: {at: [0.1, 0.1], radius: 0.02}, on_press: strong, level: 50}\n",
        encoding="utf-8",
    )
    if not problems:
        assert load_layout(path, None).max_db_sl == 50
        return
    with pytest.raises(ConfigError) as caught:
        load_layout(path, None)
    found = str(caught.value)
    assert [each for each in problems if each not in found] == []


PAGE = Path(__file__).parents[3] / "docs" / "reference" / "effects.md"
PARTS = {"rectangle": RectangleSection, "circle": CircleSection}

KEYS = {
    "The file": set(LayoutSection.model_fields),
    "Effects": {"kind", *Effect.model_fields},
    "Regions": {
        *(*RegionSection.model_fields, *TunedSection.model_fields),
        *(f"{part}.{key}" for part, section in PARTS.items() for key in section.model_fields),
    },
}


@pytest.mark.parametrize("heading", KEYS)
def test_every_key_is_documented_and_no_other(heading: str) -> None:
    """The table of a section names its keys."""
    assert set(key_rows(PAGE.read_text("utf-8"), heading)) == KEYS[heading]


def test_tables_of_kinds_say_what_the_classes_do() -> None:
    """Unit, default, limits and meaning of a key; whose finger feels a kind."""
    page = PAGE.read_text("utf-8")
    assert "| `click.duration` | s | 40 ms | at least 0.02, at most 0.5 | the plate needs" in page
    assert "| `dial` | a moving finger in a region | yes | a click at each detent" in page
