"""Files of content as effects: read beside a layout, then felt by a finger, click after click."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from controller.content.formats import named_contents
from controller.content.pattern import Pattern, Transient
from controller.effects.kinds import Buzz, File
from controller.effects.layout import SurfaceLayout, load_layout
from controller.effects.player import EffectPlayer
from controller.play.intent import Target
from controller.sources.touch import Contact, ContactKey
from model.config.document import ConfigError

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
    file = File(file="it.ahap")  # at 20 dB SL by default
    file._pattern = PATTERN
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
    assert pulse is not None
    pulse.started_at = 0.08
    assert True not in felt(player, 0.27)
    assert True in felt(player, 0.285)
    assert False in felt(player, 1.07)
    assert felt(player, 1.085) == {}


def test_a_loop_has_its_clicks_in_every_turn() -> None:
    """At 0.2 and 0.6 s of each second, for as long as the finger stays."""
    player = player_of(it=file_of(loop=True))
    play(player, 0.0)
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
        assert course is not None
        shares = course.at(np.arange(0.4, 0.6, 0.001))
        rises.append(int(((shares > 0.01) & (shares < 0.99)).sum()))
    assert rises[0] <= 5
    assert 25 <= rises[1] <= 40
    among, lone = (felt(player_with_tap, 0.2, *each)[True].band for each in ((TWO,), ()))
    assert among == pytest.approx((51.1, 91.6), abs=0.1)
    assert lone == (58.5, 80.0)
    alone = felt(player, 0.2)[False]
    assert alone.course is not None
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
    assert course is not None
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
        ("{kind: file, file: succes}", "unknown content 'succes'; did you mean success? known are"),
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
