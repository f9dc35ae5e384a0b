"""Files of content as effects: their transients and continuous events at fingers."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from controller.content.formats import named_contents
from controller.content.pattern import Pattern, Transient
from controller.effects.file_effect import File
from controller.effects.layout import SurfaceLayout, load_layout
from controller.effects.player import EffectPlayer
from controller.play.intent import Target
from controller.sources.touch import Contact, ContactKey
from model.config.document import ConfigError

FINGER = Contact(ContactKey("panel", 1), 0.1, 0.1, 0.0)
ANOTHER_FINGER = Contact(ContactKey("panel", 2), 0.2, 0.1, 0.0)
PATTERN = Pattern(
    1.0,
    ((0.0, 1.0), (1.0, 1.0)),
    ((0.0, 0.0), (1.0, 0.0)),
    (Transient(0.2, 0.5, 0.0), Transient(0.6, 0.5, 1.0)),
)
"""One second at intensity 1, and two transients of intensity 0.5, the second one sharp."""


def file_of(pattern: Pattern = PATTERN, *, loop: bool = False) -> File:
    """A file of a pattern at 20 dB SL."""
    return File.of(pattern, name="it", level_db_sl=20.0, loop=loop)


class FilePlayer:
    """A player of files, and what the finger feels of them."""

    def __init__(self, layout: SurfaceLayout) -> None:
        self.player = EffectPlayer(layout)

    @classmethod
    def of(cls, **files: File) -> "FilePlayer":
        """A player whose layout has these effects alone."""
        return cls(SurfaceLayout(effects=files, elsewhere=None))

    def play(self, now: float, name: str = "it") -> None:
        """Play an effect at the finger."""
        self.player.play(name, FINGER, now, level_db_sl=None)

    def targets(self, now: float, *neighbors: Contact) -> dict[bool, Target]:
        """The targets of the finger; True for a click, False for a continuous event."""
        targets = self.player.intent([FINGER, *neighbors], now).targets
        return {target.is_short: target for target in targets if target.key == FINGER.key}

    def click(self, now: float, *neighbors: Contact) -> Target | None:
        """The click that the finger feels."""
        return self.targets(now, *neighbors).get(True)

    def lasting(self, now: float, *neighbors: Contact) -> Target | None:
        """The continuous event that the finger feels."""
        return self.targets(now, *neighbors).get(False)

    def course(self, now: float, *neighbors: Contact) -> Any:
        """The course of this event."""
        target = self.lasting(now, *neighbors)
        assert target is not None
        return target.course

    def clicks(self, start: float, end: float) -> dict[float, Target]:
        """Clicks between two times [s], by when they were requested."""
        clicks = {}
        for now in np.arange(start, end, 0.005):
            click = self.click(float(now))
            if click is not None and click.pulse is not None:
                clicks[click.pulse.requested_at] = click
        return clicks


def test_transients_are_clicks_at_their_times_levels_and_bands() -> None:
    """By hand: intensity 0.5 of 20 dB SL is 15 dB SL, sharpness 0 and 1 are 65 and 300 Hz.

    Bands are 10 % about these, or the nearest three of 10 Hz: 60 to 80. A click is not raised above
    the continuous event, because its level is that of the file.
    """
    files = FilePlayer.of(it=file_of())
    files.play(3.0)
    lasting = files.lasting(3.1)
    assert lasting is not None
    assert (lasting.level_db_sl, lasting.band) == (20.0, (58.5, 80.0))

    clicks = files.clicks(3.1, 4.0)
    assert [*clicks] == pytest.approx([3.2, 3.6], abs=0.005)
    described = [(click.level_db_sl, click.band, click.above_db) for click in clicks.values()]
    assert described == [(15.0, (58.5, 80.0), None), (15.0, (270.0, 330.0), None)]
    assert files.targets(4.0) == {}
    assert files.player.why_not(FINGER.key) == "it ended; touch there again"


def test_times_count_from_the_start_on_the_amplifiers() -> None:
    """It is 80 ms after the press, and so are the clicks and the end later."""
    files = FilePlayer.of(it=file_of())
    files.play(0.0)
    lasting = files.lasting(0.0)
    assert lasting is not None
    assert lasting.pulse is not None
    lasting.pulse.started_at = 0.08
    assert files.click(0.27) is None
    assert files.click(0.285) is not None
    assert files.lasting(1.07) is not None
    assert files.targets(1.085) == {}


def test_loop_has_its_clicks_in_every_turn() -> None:
    """At 0.2 and 0.6 s of each second, for as long as the finger stays; its course repeats, too."""
    files = FilePlayer.of(it=file_of(loop=True))
    files.play(0.0)
    assert files.course(0.0).repeats
    times = [turn + time for turn in range(20) for time in (0.2, 0.6)]
    assert [*files.clicks(0.0, 20.0)] == pytest.approx(times, abs=0.01)


def test_click_near_another_finger_has_a_wider_band() -> None:
    """58.5 and 80 Hz, moved by a third of an octave less 10 %."""
    files = FilePlayer.of(it=file_of())
    files.play(0.0)
    alone, together = files.click(0.2), files.click(0.2, ANOTHER_FINGER)
    assert alone is not None
    assert together is not None
    assert alone.band == (58.5, 80.0)
    assert together.band == pytest.approx((51.1, 91.6), abs=0.1)


def test_later_file_of_a_finger_is_felt_then_the_remainder_of_the_earlier() -> None:
    """While it lasts, the clicks of the earlier file are not felt."""
    short = replace(PATTERN, duration=0.5, intensity=((0.0, 0.5), (0.5, 0.5)), transients=())
    files = FilePlayer.of(it=file_of(), short=file_of(short))
    files.play(0.0)
    files.play(0.1, "short")
    names = {is_click: target.content for is_click, target in files.targets(0.21).items()}
    assert names == {False: "short"}
    names = {is_click: target.content for is_click, target in files.targets(0.61).items()}
    assert names == {False: "it", True: "it"}


def test_active_file_continues_to_its_end_under_another_layout() -> None:
    """Its name is unknown there."""
    files = FilePlayer.of(it=file_of())
    files.play(0.0)
    files.targets(0.0)
    files.player.replace(SurfaceLayout(effects={}, elsewhere=None))
    lasting = files.lasting(0.9)
    assert lasting is not None
    assert lasting.content == "it"
    assert files.targets(1.0) == {}


def ahap(duration: float) -> dict[str, object]:
    """A continuous event of a duration [s]."""
    event = {"EventType": "HapticContinuous", "Time": 0.0, "EventDuration": duration}
    return {"Version": 1.0, "Pattern": [{"Event": event}]}


def write_layout(folder: Path, effect: str, **files: object) -> Path:
    """A layout with one effect, in a folder with files."""
    for name, content in files.items():
        (folder / f"{name}.ahap").write_text(json.dumps(content))
    path = folder / "layout.yaml"
    path.write_text(f"effects:\n  it: {effect}\nelsewhere: it\n")
    return path


def test_file_is_read_once_with_its_layout(tmp_path: Path) -> None:
    """A change on disk is felt after the next reload."""
    path = write_layout(tmp_path, "{kind: file, file: door.ahap}", door=ahap(0.4))
    layout = load_layout(path, None)
    assert load_layout(path, None) == layout
    (tmp_path / "door.ahap").write_text(json.dumps(ahap(0.5)))
    assert FilePlayer(layout).course(0.0).duration == pytest.approx(0.4)
    reloaded = load_layout(path, None)
    assert reloaded != layout
    assert FilePlayer(reloaded).course(0.0).duration == pytest.approx(0.5)


def test_layout_knows_the_included_contents(tmp_path: Path) -> None:
    """An effect can name one of them, and its finger feels it."""
    layout = load_layout(write_layout(tmp_path, "{kind: file, file: success}"), None)
    assert layout.effects.keys() >= {*named_contents()}
    assert layout.effects["click"].kind == "click"
    files = FilePlayer(layout)
    felt = [files.targets(float(now)) for now in np.arange(0.0, 0.3, 0.01)]
    assert max(len(targets) for targets in felt) >= 1


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
        ("{kind: file, file: succes}", "did you mean success?"),
    ],
)
def test_file_that_cannot_be_played_is_a_problem_of_its_layout(
    tmp_path: Path, effect: str, words: str
) -> None:
    """It has the layout's line and key, and states what is wrong with the file."""
    folder = tmp_path / "layouts"
    folder.mkdir()
    (tmp_path / "layout.ahap").write_text(json.dumps(ahap(0.4)))
    (folder / "link.ahap").symlink_to(tmp_path / "layout.ahap")
    (folder / "circle.ahap").symlink_to(folder / "circle.ahap")
    path = write_layout(folder, effect, door=ahap(0.4), broken=[])
    with pytest.raises(ConfigError) as caught:
        load_layout(path, None)
    (problem,) = caught.value.problems
    assert (problem.line, problem.key) == (2, "effects.it.file")
    assert words in problem.message
