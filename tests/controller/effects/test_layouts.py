"""Surface layouts: their files, their reference page, and dials about the centers of regions."""

import math
from collections.abc import Sequence
from pathlib import Path

import pytest

from controller.effects.effect import Effect, EffectStimulus, Region, TunedSection
from controller.effects.kinds import Click, Detents, Dial
from controller.effects.layout import LayoutSection, RegionSection, SurfaceLayout, load_layout
from controller.effects.player import EffectPlayer
from controller.sources.touch import Contact, ContactKey
from key_tables import key_rows
from model.config.document import ConfigError
from model.config.shapes import Circle, CircleSection, Polygon, Rectangle, RectangleSection
from model.rig.rig_file import example_rig_path, load_rig

ROOT = Path(__file__).parents[3]
CENTER = (0.2, 0.1)
KNOB = Region("knob", Circle(*CENTER, 0.05), on_move="dial")
SQUARE = "rectangle: {start: [0, 0], end: [0.1, 0.1]}"


def contact_at(x: float, y: float) -> Contact:
    """A finger on the plate."""
    return Contact(ContactKey("panel", 1), x, y, since=0.0)


def at_angle(degrees: float, *, radius: float = 0.03) -> Contact:
    """A finger at an angle about the center of the knob."""
    angle = math.radians(degrees)
    x = CENTER[0] + radius * math.cos(angle)
    y = CENTER[1] + radius * math.sin(angle)
    return contact_at(x, y)


def clicks_of_a_dial(way: Sequence[Contact]) -> list[int]:
    """The steps of a way, a second apart, at which a dial of 20 degrees clicks."""
    dial = Dial(spacing=math.radians(20))
    run = dial.start_in(KNOB, way[0], 0.0, level_db_sl=20.0)
    stimuli = [run.feel(contact, float(step)) for step, contact in enumerate(way)]
    return [step for step, felt in enumerate(stimuli) if isinstance(felt, EffectStimulus)]


@pytest.mark.parametrize("direction", [1, -1])
def test_dial_clicks_at_every_detent_of_two_turns(direction: int) -> None:
    """Detents lie at 10, 30, 50 ... degrees from where the finger came down, either way round.

    A finger that moves in steps of 4 degrees must pass them by 1.2 degrees.
    """
    way = [at_angle(150.0 + direction * degrees) for degrees in range(0, 721, 4)]
    detents = range(10, 721, 20)
    assert clicks_of_a_dial(way) == [math.ceil((detent + 1.2) / 4) for detent in detents]


@pytest.mark.parametrize(
    ("way", "clicks"),
    [
        ([at_angle(0, radius=radius) for radius in (0.03, 0.04, 0.02, 0.01)], []),
        ([at_angle(0), *(at_angle(10 + degrees) for degrees in (2, -1, 1, -1, 1))], [1]),
        (
            [
                at_angle(0),
                at_angle(0, radius=0.003),
                at_angle(180, radius=0.003),
                at_angle(180),
                at_angle(185),
                at_angle(195),
            ],
            [5],
        ),
    ],
    ids=["out and in", "trembling at a detent", "across the center"],
)
def test_dial_ignores_radius_noise_and_its_center(way: list[Contact], clicks: list[int]) -> None:
    """Across the center the angle jumps by half a turn; then it continues from there."""
    assert clicks_of_a_dial(way) == clicks


def test_center_of_a_shape_is_that_of_its_area() -> None:
    """By hand: of a rectangle, and of an L of three unit squares, in either order of corners."""
    assert Rectangle(1.0, 2.0, 4.0, 2.0).center == (3.0, 3.0)
    corners = ((0.0, 0.0), (2.0, 0.0), (2.0, 1.0), (1.0, 1.0), (1.0, 2.0), (0.0, 2.0))
    assert Polygon(corners).center == pytest.approx((5 / 6, 5 / 6))
    assert Polygon(corners[::-1]).center == pytest.approx((5 / 6, 5 / 6))


@pytest.mark.parametrize(
    ("effect", "region_band", "band"),
    [
        (Click(band=(60.0, 90.0)), (200.0, 250.0), (200.0, 250.0)),
        (Click(band=(60.0, 90.0)), None, (60.0, 90.0)),
        (Click(), None, None),
        (Click(frequency=130.0), None, (130.0, 130.0)),
    ],
)
def test_region_replaces_the_band_of_its_effects(
    effect: Effect, region_band: tuple[float, float] | None, band: tuple[float, float] | None
) -> None:
    """Without a band of the region, that of the effect counts."""
    region = Region("region", Rectangle(0.0, 0.0, 0.1, 0.1), on_press="it", band=region_band)
    player = EffectPlayer(SurfaceLayout((region,), {"it": effect}, elsewhere=None))
    contact = contact_at(0.03, 0.05)
    (target,) = player.intent([contact], 0.0).targets
    assert target.band == band


def test_example_layout_is_read_in_meters() -> None:
    """Every key of the example arrives in its region or effect."""
    path = ROOT / "controller" / "effects" / "example.yaml"
    layout = load_layout(path, load_rig(example_rig_path()).plate)
    regions = {region.name: region for region in layout.regions}
    assert [*regions] == ["keypad", "slider", "knob", "tuner", "patch"]
    keypad = regions["keypad"]
    shape = keypad.shape
    assert isinstance(shape, Rectangle)
    assert (shape.x, shape.y, shape.width, shape.height) == pytest.approx((0.23, 0.16, 0.04, 0.03))
    assert (keypad.on_press, keypad.on_release, keypad.has_level) == ("press", "soft", False)
    patch, slider = regions["patch"], regions["slider"]
    assert (patch.has_level, patch.level_db_sl) == (True, None)
    assert (slider.priority, slider.band) == (1, (100.0, 400.0))
    assert layout.effects["soft"] == Click(duration=0.03, level=14.0)
    assert layout.effects["notches"] == Detents(spacing=0.012, along="x", duration=0.03)
    assert layout.elsewhere is None
    knob = layout.region_at(0.255, 0.045)
    assert knob is not None
    assert knob.name == "knob"
    assert layout.region_at(0.30, 0.01) is None


def load_text(folder: Path, text: str) -> SurfaceLayout:
    """The layout of a file with this text."""
    path = folder / "layout.yaml"
    path.write_text(text, encoding="utf-8")
    return load_layout(path, None)


def test_region_states_how_its_fingers_are_to_be_served(tmp_path: Path) -> None:
    """Each key counts alone; a content of the finger's own is not shared."""
    own = f"a: {{{SQUARE}, on_press: buzz, own: true, protected: true}}"
    shared = f"b: {{{SQUARE}, on_press: buzz, level: 14 dB, may_share: true}}"
    a, b = load_text(tmp_path, f"regions: {{{own}, {shared}}}").regions
    assert (a.is_own, a.may_share, a.is_protected) == (True, False, True)
    assert (b.is_own, b.may_share, b.is_protected) == (False, True, False)
    assert b.level_db_sl == 14


def test_too_many_effects_are_counted_but_not_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A region with one of the last of a thousand has no problem of its own."""
    kinds: list[str] = []

    def record(kind: str) -> type[Effect]:
        kinds.append(kind)
        return Click

    monkeypatch.setattr("controller.effects.layout.effect_kind", record)
    effects = ", ".join(f"e{number}: {{kind: click}}" for number in range(1000))
    regions = f"{{a: {{{SQUARE}, on_press: e999}}}}"
    with pytest.raises(ConfigError) as caught:
        load_text(tmp_path, f"effects: {{{effects}}}\nregions: {regions}\n")
    (problem,) = caught.value.problems
    assert (problem.line, problem.key) == (1, "effects")
    assert "64 entries, got 1000" in problem.message
    assert len(kinds) == 64


def test_later_region_lies_on_top(tmp_path: Path) -> None:
    """Regions overlap in the order of the file."""
    layout = load_text(
        tmp_path,
        "regions:\n"
        "  under: {rectangle: {start: [0, 0], end: [0.2, 0.2]}}\n"
        "  over: {circle: {at: [0.1, 0.1], radius: 0.02}}\n",
    )
    for x, name in ((0.1, "over"), (0.15, "under")):
        region = layout.region_at(x, 0.1)
        assert region is not None
        assert region.name == name


LOUD_EFFECTS = (
    "effects: {strong: {kind: ramp, start_level: 45, level: 20}}\n"
    "regions:\n"
    "  a: {circle: {at: [0.1, 0.1], radius: 0.02}, on_press: strong, level: 50}\n"
)


@pytest.mark.parametrize(
    ("maximum", "problems"),
    [
        ("", ["effects.strong", "regions.a.level"]),
        ("max_level_db_sl: 45\n", ["regions.a.level"]),
        ("max_level_db_sl: 61\n", ["max_level_db_sl"]),
        ("max_level_db_sl: 39\n", ["max_level_db_sl"]),
    ],
)
def test_level_above_the_maximum_is_a_problem(
    tmp_path: Path, maximum: str, problems: list[str]
) -> None:
    """It is 40 dB SL, or that of the layout, which is 60 at most."""
    with pytest.raises(ConfigError) as caught:
        load_text(tmp_path, maximum + LOUD_EFFECTS)
    for key in problems:
        assert key in str(caught.value)


REGION_KEYS = {
    *RegionSection.model_fields,
    *TunedSection.model_fields,
    *(f"rectangle.{key}" for key in RectangleSection.model_fields),
    *(f"circle.{key}" for key in CircleSection.model_fields),
}


@pytest.mark.parametrize(
    ("heading", "keys"),
    [
        ("The file", {*LayoutSection.model_fields}),
        ("Effects", {"kind", *Effect.model_fields}),
        ("Regions", REGION_KEYS),
    ],
)
def test_every_key_is_documented_and_no_other(heading: str, keys: set[str]) -> None:
    """The table of a section names its keys."""
    page = ROOT / "docs" / "reference" / "effects.md"
    assert set(key_rows(page.read_text("utf-8"), heading)) == keys


@pytest.mark.parametrize("word", ["null", "~", "none", "None", "nil"])
def test_layout_takes_words_for_no_effect(tmp_path: Path, word: str) -> None:
    """YAML takes all but the first two as text."""
    region = f"{{circle: {{at: [0.1, 0.1], radius: 0.02}}, on_press: {word}, on_move: {word}}}"
    layout = load_text(tmp_path, f"elsewhere: {word}\nregions: {{button: {region}}}\n")
    assert layout.elsewhere is None
    assert list(layout.uses()) == []
