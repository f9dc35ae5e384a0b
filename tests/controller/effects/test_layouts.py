"""Surface layouts: their files and reference page, dials, and files of content as effects.

Detents of a dial are at angles about the center of its region; the clicks of a file are felt one
after the other.
"""

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from controller.content.formats import named_contents
from controller.content.pattern import Pattern, Transient
from controller.effects.effect import Effect, EffectStimulus, NoStimulus, Region, TunedSection
from controller.effects.file_effect import File
from controller.effects.kinds import Buzz, Click, Detents, Dial
from controller.effects.layout import LayoutSection, RegionSection, SurfaceLayout, load_layout
from controller.effects.player import EffectPlayer
from controller.play.intent import Target
from controller.sources.touch import Contact, ContactKey
from key_tables import key_rows
from model.config.document import ConfigError
from model.config.fields import Circle, CircleSection, Polygon, Rectangle, RectangleSection
from model.rig.rig_file import example_rig_path, load_rig

CENTRE = (0.2, 0.1)
KNOB = Region("knob", Circle(*CENTRE, 0.05), on_move="dial")


def at(degrees: float, *, radius: float = 0.03) -> Contact:
    """A finger at an angle about the center."""
    turn = math.radians(degrees)
    x, y = CENTRE[0] + radius * math.cos(turn), CENTRE[1] + radius * math.sin(turn)
    return Contact(ContactKey("panel", 1), x, y, since=0.0)


def clicks(way: Sequence[Contact], *, spacing: float) -> list[int]:
    """At which steps of a way, a second apart, a click starts."""
    run = Dial(spacing=spacing).start_in(KNOB, way[0], 0.0, level_db_sl=20.0)
    felt = [run.feel(contact, float(step)) for step, contact in enumerate(way)]
    assert all(isinstance(each, EffectStimulus | NoStimulus) for each in felt)
    return [step for step, each in enumerate(felt) if isinstance(each, EffectStimulus)]


@pytest.mark.parametrize("sense", [1, -1])
def test_dial_clicks_at_every_detent_of_two_turns(sense: int) -> None:
    """Detents lie at 10, 30, 50 ... degrees from where the finger came down, either way round."""
    way = [at(150.0 + sense * degrees) for degrees in range(0, 721, 4)]
    passed = [4 * step for step in clicks(way, spacing=math.radians(20))]
    expected = [4 * math.ceil((10 + 20 * number + 1.2) / 4) for number in range(36)]
    assert passed == expected


@pytest.mark.parametrize(
    ("way", "expected"),
    [
        ([at(0, radius=radius) for radius in (0.03, 0.04, 0.02, 0.01)], []),
        ([at(0), *(at(10 + degrees) for degrees in (2, -1, 1, -1, 1))], [1]),
        ([at(0), at(0, radius=0.003), at(180, radius=0.003), at(180), at(185), at(195)], [5]),
    ],
    ids=["out and in", "trembling at a detent", "across the centre"],
)
def test_dial_ignores_radius_noise_and_its_center(way: list[Contact], expected: list[int]) -> None:
    """Across the center the angle jumps by half a turn; then it goes on from there."""
    assert clicks(way, spacing=math.radians(20)) == expected


def test_player_gives_a_dial_the_center_of_its_region() -> None:
    """A quarter of a turn about that center is nine detents of 10 degrees; elsewhere nothing.

    Centers by hand: of a rectangle, and of an L of three unit squares at (5/6, 5/6).
    """
    assert Rectangle(1.0, 2.0, 4.0, 2.0).center == (3.0, 3.0)
    corners = ((0.0, 0.0), (2.0, 0.0), (2.0, 1.0), (1.0, 1.0), (1.0, 2.0), (0.0, 2.0))
    for points in (corners, corners[::-1]):
        assert Polygon(points).center == pytest.approx((5 / 6, 5 / 6))
    layout = SurfaceLayout((KNOB,), {"dial": Dial(spacing=math.radians(10))}, elsewhere=None)
    player = EffectPlayer(layout)
    player.intent([at(0)], 0.0)
    starts = {
        target.pulse.requested_at
        for step in range(1, 91)
        for target in player.intent([at(step)], 0.1 * step).targets
        if target.pulse is not None
    }
    assert len(starts) == 9


def test_region_fixes_the_frequency_of_its_effects() -> None:
    """Its band replaces that of an effect, which holds elsewhere; none leaves it free."""
    effects = {"low": Click(band=(60.0, 90.0)), "free": Click(), "tone": Click(frequency=130.0)}
    regions = (
        Region("tuned", Rectangle(0.0, 0.0, 0.05, 0.1), on_press="low", band=(200.0, 250.0)),
        Region("own", Rectangle(0.06, 0.0, 0.05, 0.1), on_press="low"),
        Region("free", Rectangle(0.12, 0.0, 0.05, 0.1), on_press="free"),
        Region("tone", Rectangle(0.18, 0.0, 0.05, 0.1), on_press="tone"),
    )
    layout = SurfaceLayout(regions, effects, elsewhere=None)
    bands = []
    for number, x in enumerate((0.03, 0.08, 0.14, 0.2)):
        contact = Contact(ContactKey("panel", number), x, 0.05, since=0.0)
        (target,) = EffectPlayer(layout).intent([contact], 0.0).targets
        bands.append(target.band)
    assert bands == [(200.0, 250.0), (60.0, 90.0), None, (130.0, 130.0)]


EXAMPLE = Path(__file__).parents[3] / "controller" / "effects" / "example.yaml"


def test_load_layout_reads_the_example() -> None:
    """Its numbers are in meters."""
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


ONE, TWO = (Contact(ContactKey("panel", id), 0.1 * id, 0.1, 0.0) for id in (1, 2))

# One second at intensity 1, and two taps of intensity 0.5, the second one sharp.
PATTERN = Pattern(
    1.0,
    ((0.0, 1.0), (1.0, 1.0)),
    ((0.0, 0.0), (1.0, 0.0)),
    (Transient(0.2, 0.5, 0.0), Transient(0.6, 0.5, 1.0)),
)


def player_of(**effects: File | Buzz) -> EffectPlayer:
    """A player whose layout has these effects alone."""
    return EffectPlayer(SurfaceLayout(effects=effects, elsewhere=None))


def file_of(pattern: Pattern = PATTERN, *, loop: bool = False) -> File:
    """A file of a pattern at 20 dB SL."""
    return File.of(pattern, name="it", level_db_sl=20.0, loop=loop)


def felt(player: EffectPlayer, now: float, *others: Contact) -> dict[bool, Target]:
    """What finger 1 feels at a time [s]: what lasts, and a short pulse (True)."""
    targets = player.intent([ONE, *others], now).targets
    return {each.is_short: each for each in targets if each.key == ONE.key}


def play(player: EffectPlayer, now: float, name: str = "it") -> None:
    """Play an effect at finger 1."""
    player.play(name, ONE, now, level_db_sl=None)


def test_taps_are_clicks_beside_what_lasts_at_their_times_levels_and_bands() -> None:
    """By hand: intensity 0.5 of 20 dB SL is 15, sharpness 0 and 1 are 65 and 300 Hz, 10 % about,
    or the nearest three of 10 Hz: 60 to 80.

    A click is not raised above what lasts, since its level is that of the file.
    """
    file = file_of(PATTERN)
    player = player_of(it=file)
    play(player, 3.0)
    clicks = []
    for now in np.arange(3.0, 4.0, 0.005):
        targets = felt(player, float(now))
        assert (targets[False].level_db_sl, targets[False].band) == (20.0, (58.5, 80.0))
        if True in targets and (not clicks or clicks[-1].pulse is not targets[True].pulse):
            clicks.append(targets[True])
    assert [each.level_db_sl for each in clicks] == [15.0, 15.0]
    assert [each.band for each in clicks] == [(58.5, 80.0), (270.0, 330.0)]
    assert [each.above_db for each in clicks] == [None, None]
    starts = [each.pulse.requested_at - 3.0 for each in clicks if each.pulse]
    assert starts == pytest.approx([0.2, 0.6], abs=0.005)
    assert felt(player, 4.0) == {}
    assert player.why_not(ONE.key) == "it ended; touch there again"


def test_times_count_from_when_the_amplifiers_have_started() -> None:
    """80 ms after the press: so long later come the clicks, and the end."""
    player = player_of(it=file_of())
    play(player, 0.0)
    pulse = felt(player, 0.0)[False].pulse
    pulse.started_at = 0.08
    assert True not in felt(player, 0.27)
    assert True in felt(player, 0.285)
    assert False in felt(player, 1.07)
    assert felt(player, 1.085) == {}


def test_a_loop_has_its_clicks_in_every_turn() -> None:
    """At 0.2 and 0.6 s of each second, for as long as the finger stays; its course repeats, too."""
    player = player_of(it=file_of(loop=True))
    play(player, 0.0)
    course = felt(player, 0.0)[False].course
    assert course is not None
    assert course.repeats
    pulses = [
        targets[True].pulse
        for now in np.arange(0.0, 60.0, 0.01)
        if True in (targets := felt(player, float(now)))
    ]
    starts = dict.fromkeys(each.requested_at for each in pulses if each)
    assert [*starts] == pytest.approx(
        [turn + at for turn in range(60) for at in (0.2, 0.6)], abs=0.01
    )


def test_a_finger_that_is_alone_feels_the_file_as_it_is() -> None:
    """A step of intensity at 0.5 s lasts 5 ms alone, and 40 ms beside another finger.

    By hand: an average over 20 ms at half height is 40 ms wide. A tap has a wider band there: 58.5
    and 80 Hz, moved by a third of an octave less 10 %.
    """
    step = Pattern(1.0, ((0.0, 0.0), (0.5, 0.0), (0.5, 1.0), (0.9, 1.0)), ((0.0, 0.0),))
    player, player_with_tap = player_of(it=file_of(step)), player_of(it=file_of())
    play(player, 0.0)
    play(player_with_tap, 0.0)
    rises = []
    for others in ((), (TWO,)):
        course = felt(player, 0.1, *others)[False].course
        shares = course.at(np.arange(0.4, 0.6, 0.001))
        rises.append(int(((shares > 0.01) & (shares < 0.99)).sum()))
    assert rises[0] <= 5
    assert 25 <= rises[1] <= 40
    among, lone = (felt(player_with_tap, 0.2, *each)[True].band for each in ((TWO,), ()))
    assert among == pytest.approx((51.1, 91.6), abs=0.1)
    assert lone == (58.5, 80.0)
    alone = felt(player, 0.2)[False]
    assert alone.course.at(np.array([0.51]))[0] == 1.0


def test_of_two_files_at_one_finger_the_later_is_felt() -> None:
    """Its clicks alone, too; then what is left of the one before."""
    short = file_of(
        replace(PATTERN, duration=0.5, intensity=((0.0, 0.5), (0.5, 0.5)), transients=())
    )
    player = player_of(it=file_of(), other=short)
    play(player, 0.0)
    play(player, 0.1, "other")
    assert {key: each.content for key, each in felt(player, 0.21).items()} == {False: "other"}
    assert {key: each.content for key, each in felt(player, 0.61).items()} == {
        False: "it",
        True: "it",
    }


def test_a_file_that_plays_goes_on_to_its_end_under_another_layout() -> None:
    """Of a region or requested; one that begins anew ends with its layout."""
    player = player_of(it=file_of(), again=file_of(loop=True))
    play(player, 0.0)
    felt(player, 0.0)
    player.replace(SurfaceLayout(effects={}, elsewhere=None))
    assert felt(player, 0.9)[False].content == "it"
    assert felt(player, 1.0) == {}


AHAP = {
    "Version": 1.0,
    "Pattern": [{"Event": {"EventType": "HapticContinuous", "Time": 0.0, "EventDuration": 0.4}}],
}


def write(folder: Path, effect: str, **files: object) -> Path:
    """A layout with one effect, and files beside it."""
    for name, content in files.items():
        (folder / f"{name}.ahap").write_text(json.dumps(content))
    path = folder / "layout.yaml"
    path.write_text(f"effects:\n  it: {effect}\nelsewhere: it\n")
    return path


def test_a_layout_names_files_beside_it_and_contents_that_come_along(tmp_path: Path) -> None:
    """Each is read once, with the layout: what changes on disk is felt after a reload alone."""
    path = write(tmp_path, "{kind: file, file: door.ahap}", door=AHAP)
    layout = load_layout(path, None)
    (tmp_path / "door.ahap").write_text("{}")
    player = EffectPlayer(layout)
    course = felt(player, 0.0)[False].course
    assert course.duration == pytest.approx(0.4)
    assert load_layout(write(tmp_path, "{kind: file, file: door.ahap}", door=AHAP), None) == layout
    longer = json.loads(json.dumps(AHAP).replace("0.4", "0.5"))
    other = load_layout(write(tmp_path, "{kind: file, file: door.ahap}", door=longer), None)
    assert other != layout
    assert layout.effects.keys() >= {*named_contents()}
    assert layout.effects["click"].kind == "click"
    named = load_layout(write(tmp_path, "{kind: file, file: success}"), None)
    player = EffectPlayer(named)
    assert any(felt(player, now) for now in np.arange(0.0, 0.3, 0.01))


@pytest.mark.parametrize(
    ("effect", "words"),
    [
        ("{kind: file, file: none.ahap}", "none.ahap"),
        ("{kind: file, file: ../layout.ahap}", "must be in the folder of the layout"),
        ("{kind: file, file: /etc/hostname}", "must be in the folder of the layout"),
        ("{kind: file, file: link.ahap}", "must be in the folder of the layout"),
        ("{kind: file, file: circle.ahap}", "must name a file"),
        ('{kind: file, file: "a\\0b.ahap"}', "must name a file"),
        ("{kind: file, file: broken.ahap}", "broken.ahap:1"),
        ("{kind: file, file: door.ahap, channel: 2}", "channel must be left out"),
        ("{kind: file, file: door.txt}", "txt"),
        ("{kind: file, file: succes}", "unknown content 'succes'; did you mean success? known:"),
    ],
    ids=[
        "missing",
        "above",
        "absolute",
        "link",
        "circle",
        "no name",
        "broken",
        "channel",
        "format",
        "mistyped",
    ],
)
def test_a_file_that_cannot_be_played_is_a_problem_of_its_layout(
    tmp_path: Path, effect: str, words: str
) -> None:
    """With the layout's line and key, then what is wrong with the file."""
    folder = tmp_path / "layouts"
    folder.mkdir()
    (tmp_path / "layout.ahap").write_text(json.dumps(AHAP))
    (folder / "link.ahap").symlink_to(tmp_path / "layout.ahap")
    (folder / "circle.ahap").symlink_to(folder / "circle.ahap")
    with pytest.raises(ConfigError) as caught:
        load_layout(write(folder, effect, door=AHAP, broken=[]), None)
    (problem,) = caught.value.problems
    assert (problem.line, problem.key) == (2, "effects.it.file")
    assert words in problem.message


@pytest.mark.parametrize("word", ["null", "~", "none", "None", "nil"])
def test_layout_takes_words_for_no_effect(tmp_path: Path, word: str) -> None:
    """Nothing is felt elsewhere, nor in a region; YAML takes all but the first two as text."""
    path = tmp_path / "layout.yaml"
    region = f"{{circle: {{at: [0.1, 0.1], radius: 0.02}}, on_press: {word}, on_move: {word}}}"
    path.write_text(f"elsewhere: {word}\nregions: {{button: {region}}}\n", "utf-8")
    layout = load_layout(path, None)
    assert layout.elsewhere is None
    assert list(layout.uses()) == []
