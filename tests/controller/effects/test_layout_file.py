"""Surface layouts in their files."""

from pathlib import Path

import pytest

from controller.effects.layout_file import load_layout
from controller.effects.moving import Detents
from controller.effects.shapes import Rectangle
from controller.effects.timed import Click
from model.config.document import ConfigError
from model.errors import InputError
from model.rig.file import example_rig_path, load_rig

EXAMPLE = Path(__file__).parents[3] / "controller" / "effects" / "example.yaml"


def refused(path: Path, text: str) -> str:
    """The error that a layout of the paper's plate gives."""
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        load_layout(path, load_rig(example_rig_path()).plate)
    return str(caught.value)


def test_example() -> None:
    """The layout in the examples, by its own numbers in metres."""
    layout = load_layout(EXAMPLE, load_rig(example_rig_path()).plate)
    assert [region.name for region in layout.regions] == ["keypad", "slider", "knob", "patch"]
    keypad, slider, _, patch = layout.regions
    shape = keypad.shape
    assert isinstance(shape, Rectangle)
    assert (shape.x, shape.y, shape.width, shape.height) == pytest.approx((0.02, 0.02, 0.1, 0.08))
    assert (keypad.on_press, keypad.on_release, keypad.has_level) == ("click", "soft", False)
    assert (patch.has_level, patch.level_db_sl) == (True, None)
    assert slider.priority == 1
    assert layout.effects["soft"] == Click(duration=0.03, level=14.0)
    assert layout.effects["notches"] == Detents(spacing=0.012, along="x", duration=0.03)
    assert (layout.elsewhere, layout.most_at_once) == (None, 1)
    found = layout.region_at(0.22, 0.06)
    assert found is not None
    assert found.name == "knob"
    assert layout.region_at(0.30, 0.01) is None


def test_later_regions_lie_on_top(tmp_path: Path) -> None:
    """Where two overlap, the one that stands later in the file is touched."""
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
    ("text", "words"),
    [
        (
            "regions: {a: {on_press: buzz}}",
            ["layout.yaml:1:", "regions.a", "needs one of rectangle"],
        ),
        (
            "regions:\n  a:\n    circle: {at: [1 m, 0], radius: 1 cm}\n",
            ["layout.yaml:3:", "regions.a.circle", "reaches beyond the plate"],
        ),
        (
            "regions:\n  a:\n    circle: {at: [0.1, 0.1], radius: 1 cm}\n    on_press: tick\n",
            ["layout.yaml:4:", "no effect 'tick'; did you mean click? known are buzz, click"],
        ),
        (
            "effects:\n  cloth: {kind: texture, slow: 1 cm}\n",
            ["layout.yaml:2:", "effects.cloth.slow", "is not a speed"],
        ),
        ("effects:\n  cloth: {kind: silk}\n", ["effects.cloth.kind", "known are buzz, click"]),
        ("effects:\n  cloth: {level: 3}\n", ["effects.cloth", "needs a kind"]),
        (
            "effects:\n  c: {kind: click, durration: 1 s}\n",
            ["effects.c.durration", "did you mean duration?"],
        ),
        ("effects:\n  c: {kind: click, level: loud}\n", ["effects.c.level", "or neighbours"]),
        ("effects:\n  c: {kind: click, level: 90}\n", ["effects.c.level", "at most 60"]),
        (
            "regions:\n  a: {circle: {at: [0.1, 0.1], radius: 1 cm}, on_move: buzz}\n",
            ["regions.a.on_move", "goes by itself"],
        ),
        (
            "regions:\n  a: {circle: {at: [0.1, 0.1], radius: 1 cm}, on_release: buzz}\n",
            ["regions.a.on_release", "would never end"],
        ),
        (
            "effects:\n  cloth: {kind: texture, slow: 20 cm/s}\n",
            ["layout.yaml:2:", "effects.cloth", "fast is 0.2 m/s and must be above slow"],
        ),
        ("elsewhere: nowhere\n", ["elsewhere", "there is no effect 'nowhere'"]),
        ("most_at_once: 0\n", ["most_at_once"]),
        ("region: {}\n", ["region", "did you mean regions?"]),
    ],
)
def test_layouts_that_could_not_work(tmp_path: Path, text: str, words: list[str]) -> None:
    """Each is refused with line, key and what to do."""
    told = refused(tmp_path / "layout.yaml", text)
    for part in words:
        assert part in told


def test_all_problems_at_once(tmp_path: Path) -> None:
    """Everything that is wrong is told in one go."""
    told = refused(
        tmp_path / "layout.yaml",
        "effects: {a: {kind: silk}, b: {kind: click, level: 90}}\n"
        "regions: {c: {on_press: d}}\nelsewhere: e\n",
    )
    keys = ("effects.a.kind", "effects.b.level", "regions.c", "regions.c.on_press", "elsewhere")
    assert [key for key in keys if f"{key}:" not in told] == []


@pytest.mark.parametrize(
    ("text", "kind"), [("plate: {}\n", "is a rig"), ("rig: rig.yaml\n", "is a daemon's file")]
)
def test_another_kind_of_file_is_named_as_such(tmp_path: Path, text: str, kind: str) -> None:
    """In one sentence, not by every key that a layout has not."""
    path = tmp_path / "other.yaml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=kind) as caught:
        load_layout(path, None)
    assert "unknown key" not in str(caught.value)
