"""Checks of layouts: effects of regions, and promises to fingers in several regions.

What a check reports is compared with the plate in time behind a wire.
"""

import asyncio
import json
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from cases import in_turn
from controller.cli.config_cli import config_kinds
from controller.content.pattern import Pattern
from controller.effects.effect import Effect, Region
from controller.effects.file_effect import File
from controller.effects.kinds import Buzz, Click, Detents, Dial, Ramp
from controller.effects.layout import SurfaceLayout
from controller.effects.player import EffectPlayer
from controller.play.chooser import Chooser
from controller.play.selected_contents import FingerSensation
from controller.play.selection import Selector
from controller.sources.touch import Contact, ContactKey
from era_haptics.command import run_era
from era_haptics.lab.checks import joint_touches, layout_check
from era_haptics.lab.checks.checked_effect import CheckedEffect
from era_haptics.lab.checks.joint_touches import check_together
from era_haptics.lab.checks.layout_check import check_layout
from era_haptics.lab.cli import app
from kit.fingers import playable
from kit.fingers import table as paper_table
from kit.plates import smooth_rig
from model.arrays import Point
from model.config.shapes import Circle, Rectangle
from model.table.table import LocalizationTable
from model.table.table_file import build_table, save_table
from tests.era_haptics.lab.checks.pressed_layout import WIRES, press

pytestmark = pytest.mark.usefixtures("plain_pictures")

BUTTON = Rectangle(0.05, 0.04, 0.012, 0.012)
SLIDER = Rectangle(0.02, 0.14, 0.26, 0.04)


@pytest.fixture(autouse=True)
def _few_touches(monkeypatch: pytest.MonkeyPatch) -> None:
    """A third of the touches of each region that the command tries."""
    monkeypatch.setattr(layout_check, "MAX_REGION_TOUCHES", 10)


@cache
def table() -> LocalizationTable:
    """Return a table of eight frequencies, which is quick to solve."""
    return build_table(smooth_rig(), frequencies=np.linspace(60.0, 340.0, 8))


def layout_of(region: Region, effect: Effect) -> SurfaceLayout:
    """Return a layout of a region with an effect, called `it`."""
    return SurfaceLayout((region,), {"it": effect}, elsewhere=None)


def checked(region: Region, effect: Effect) -> CheckedEffect:
    """Return the check of a region with an effect."""
    (effect_check,) = check_layout(layout_of(region, effect), table())
    return effect_check


def button(frequency: float | None = None) -> Region:
    """Return the region of a button, with a frequency [Hz] or any."""
    band = {} if frequency is None else {"band": (frequency, frequency)}
    return Region("button", BUTTON, on_press="it", **band)


# Effects of a region


def test_check_touches_the_part_of_a_region_that_is_on_the_plate() -> None:
    """A region of 40 mm by 12 mm, half of it beyond the east edge."""
    length = table().plate.length
    rectangle = Rectangle(length - 0.02, 0.04, 0.04, 0.012)

    touches = checked(Region("half", rectangle, on_press="it"), Buzz()).touches

    assert {touch.reason for touch in touches} == {None}
    columns = [touch.at[0] for touch in touches]
    assert length - 0.02 < min(columns) < max(columns) < length


def test_check_reports_a_region_beyond_the_plate() -> None:
    """It has no touches."""
    rectangle = Rectangle(table().plate.length + 0.02, 0.04, 0.04, 0.012)

    effect_check = checked(Region("beyond", rectangle, on_press="it"), Buzz())

    assert effect_check.touches == ()
    assert len(effect_check.problems) == 1


@pytest.mark.parametrize(
    ("level", "count"), [pytest.param(None, 0, marks=pytest.mark.long), (16.9, 1), (17.0, 0)]
)
def test_notches_must_be_felt_above_a_continuous_effect(level: float | None, count: int) -> None:
    """3 dB above the 14 of the buzz there, which they are by default."""
    region = Region("slider", SLIDER, on_press="low", on_move="it", band=(170.0, 230.0))
    notches = Detents() if level is None else Detents(level=level)
    layout = SurfaceLayout((region,), {"low": Buzz(level=14.0), "it": notches}, elsewhere=None)

    checks = {effect_check.on: effect_check for effect_check in check_layout(layout, table())}

    assert len(checks["on_move"].problems) == count


def test_notches_need_a_frequency() -> None:
    """A slider without a band plays any frequency of the table; with one it stays in it."""
    free = Region("slider", SLIDER, on_move="it")

    free_check = checked(free, Detents())
    tuned_check = checked(replace(free, band=(170.0, 230.0)), Detents())

    assert len(free_check.frequencies) > 2
    assert len(free_check.problems) == 1
    assert set(tuned_check.frequencies) <= {180.0, 220.0}
    assert tuned_check.problems == ()
    assert tuned_check.felt == pytest.approx([20.0] * len(tuned_check.felt), abs=2.0)


@pytest.mark.parametrize("frequency", [700.0, 200.0])
def test_check_names_a_frequency_that_the_table_lacks(frequency: float) -> None:
    """700 Hz is beyond 60 to 340 Hz; 200 Hz is as far from 180 as from 220 Hz."""
    region = button(frequency)

    (problem,) = checked(region, Click()).problems

    assert f"{frequency:g} Hz" in problem
    # The daemon logs the same of all regions.
    layout = SurfaceLayout((region,), {"it": Click(frequency=60.0)}, elsewhere="it")
    assert layout.band_problems(table().frequencies) == [f"button: {problem}"]


def test_check_states_the_exposure_of_raised_levels() -> None:
    """A buzz of 100 Hz: 45 dB SL are 0.249 m/s² times 178, of whose RMS ISO 5349-1 counts 0.160.

    The fingertip's mean is at that level, so its loudest point has no less.
    """
    weighted = 0.249 * 10 ** (45 / 20) * 0.160 / math.sqrt(2)

    exposure = checked(button(100.0), Buzz(level=45.0)).exposure_m_s2

    assert weighted * 10 ** (-2 / 20) <= exposure <= 3 * weighted


# The command

LAYOUT = """\
effects: {notches: {kind: detents}}
regions:
  key: {rectangle: {start: [3 cm, 3 cm], end: [5 cm, 5 cm]}, on_press: click, frequency: 100 Hz}
  strip: {rectangle: {start: [3 cm, 9 cm], end: [25 cm, 11 cm]}, on_move: notches}
elsewhere: null
"""


def run_check(folder: Path, text: str, *options: str) -> tuple[int, str]:
    """Return the exit status and the output of the command for a layout."""
    (folder / "layout.yaml").write_text(text, encoding="utf-8")
    save_table(table(), folder / "table.npz")
    files = [str(folder / name) for name in ("layout.yaml", "table.npz")]
    result = CliRunner().invoke(app, ["layout", "check", *files, *options])
    return result.exit_code, result.stdout


def test_command_reports_an_effect_that_falls_short(tmp_path: Path) -> None:
    """The strip has no band: exit status 1, a JSON object with the documented keys, a picture."""
    picture = tmp_path / "preview.png"

    status, output = run_check(tmp_path, LAYOUT, "--json", "-o", str(picture))

    assert status == 1
    assert picture.read_bytes().startswith(b"\x89PNG")
    report: dict[str, Any] = json.loads(output)
    assert report["files"] == [str(picture)]
    key, strip = report["regions"]
    assert key["region"] == "key"
    assert key["effect"] == "click"
    assert key["promised_db_sl"] == 20.0
    assert key["frequency_hz"] == [100.0]
    assert key["problems"] == []
    felt = key["felt_db_sl"]
    assert 18 <= felt["min"] <= felt["median"] <= felt["max"] <= 22
    # 90 % of plates have less than the nominal one.
    assert key["promised_contrast_db"]["median"] < key["felt_contrast_db"]["median"]
    assert len(strip["problems"]) == 1
    assert 0.0 <= strip["held_back_db"] < 2.0
    (pair,) = report["promised_together"]
    assert pair["regions"] == ["key", "strip"]
    assert pair["promised_worst_db"] <= min(pair["promised_contrast_db"])
    assert set(pair["promised_verdicts"]) <= {"own", "mixed", "shared", "held back"}
    assert len(pair["at_m"]) == 2


@pytest.mark.parametrize("kind", sorted(set(config_kinds()) - {"layout", "rig"}))
def test_files_of_config_init_fit_the_rig(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each is valid next to the rig."""
    monkeypatch.chdir(tmp_path)

    assert run_era(["config", "init", "rig.yaml"]) == 0
    assert run_era(["config", "init", f"{kind}.yaml", "--kind", kind]) == 0

    assert run_era(["config", "check", f"{kind}.yaml"]) == 0


@pytest.mark.long
def test_layout_of_config_init_keeps_regions_apart(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Fingers in any two of its regions are promised 4 dB."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(layout_check, "MAX_REGION_TOUCHES", 20)
    monkeypatch.setattr(joint_touches, "MAX_TRIPLES", 0)
    assert run_era(["config", "init", "rig.yaml"]) == 0
    assert run_era(["config", "init", "layout.yaml", "--kind", "layout"]) == 0
    assert run_era(["table", "build", "rig.yaml", "-o", "table.npz"]) == 0
    capsys.readouterr()

    assert run_era(["layout", "check", "layout.yaml", "table.npz", "--json"]) == 0

    pairs = json.loads(capsys.readouterr().out)["promised_together"]
    assert len(pairs) == 10
    assert min(pair["promised_worst_db"] for pair in pairs) >= 4


# Presses on all wires

PRESS_COUNTS = {"modbus-rtu": 6}
"""Equal presses, each at another phase of the heartbeats; 3 on the other wires."""
PLACE = (0.09, 0.07)


def rest(since: float) -> Point:
    """Return the position of a finger that does not move."""
    return PLACE


def step(since: float) -> Point:
    """Return the position of a finger that moves by 8 mm after a tenth of a second."""
    x, y = PLACE
    return (x + 0.008, y) if since > 0.1 else PLACE


@dataclass(frozen=True)
class Case:
    """An effect, the part of its vibration [s] that is measured, and the finger's path."""

    effect: Effect
    duration: float
    since: float = 0.0
    path: Callable[[float], Point] = rest
    held: float = 0.15


STEADY = Pattern(0.5, ((0.0, 1.0), (0.5, 1.0)), ((0.0, 0.5),))
CASES = {
    "short click": Case(Click(duration=0.020), 0.020),
    "click": Case(Click(), 0.040),
    "long click": Case(Click(duration=0.120, level=14.0), 0.120, held=0.2),
    "short buzz": Case(Buzz(duration=0.300, level=16.0), 0.300, held=0.4),
    "buzz": Case(Buzz(), 0.1, since=0.3, held=0.42),
    "ramp": Case(Ramp(start_level=14.0, duration=0.4), 0.08, since=0.32, held=0.42),
    "detents": Case(Detents(), 0.030, path=step, held=0.2),
    "dial": Case(Dial(), 0.030, path=step, held=0.2),
    "file": Case(File.of(STEADY, name="steady", level_db_sl=20.0), 0.1, since=0.3, held=0.42),
}


@pytest.mark.parametrize(("name", "wire"), in_turn(CASES, [*WIRES]))
def test_effect_is_felt_as_promised_at_every_press(name: str, wire: str) -> None:
    """Within 3 dB of the promises of layout and report, all presses within 2 dB, on the plate."""
    case = CASES[name]
    trigger = "on_move" if case.effect.is_for_motion else "on_press"
    region = Region("all", Circle(0.09, 0.10, 0.06), **{trigger: "it"})
    layout = layout_of(region, case.effect)
    count = PRESS_COUNTS.get(wire, 3)

    presses = press(smooth_rig(), table(), layout, wire, case.path, count=count, held=case.held)

    assert [len(vibrations) for vibrations in presses] == [1] * count
    levels = []
    promises = []
    for (felt,) in presses:
        levels.append(felt.level_db_sl(case.duration, since=case.since))
        promises.append(felt.promised_db_sl)
    assert levels == pytest.approx([case.effect.level] * count, abs=3.0)
    if name != "ramp":  # which reports each of its steps
        assert levels == pytest.approx(promises, abs=3.0)
    assert np.ptp(levels) <= 2.0


# Fingers in several regions

SIZE = 0.03  # m


def square(name: str, x: float, y: float, **keys: Any) -> Region:
    """Return a square region with its south-west corner [m] and an effect of its name."""
    return Region(name, Rectangle(x, y, SIZE, SIZE), on_press=name, **keys)


WEST = square("west", 0.03, 0.06)
NORTH = square("north", 0.1374, 0.18)


def buzzes(*regions: Region) -> SurfaceLayout:
    """Return a layout of regions with a buzz each."""
    effects = {region.name: Buzz(level=14.0) for region in regions}
    return SurfaceLayout(regions, effects, elsewhere=None)


@pytest.mark.parametrize("requirement", ["is_own", "is_protected"])
def test_verdicts_follow_the_requirements_of_regions(requirement: str) -> None:
    """Below 12 dB mixed; if a region requires its own or is protected, another is held back."""
    near = square("near", 0.12, 0.06)
    demanding = replace(near, priority=1, **{requirement: True})

    (mixed,) = check_together(buzzes(WEST, near), paper_table())
    (held_back,) = check_together(buzzes(WEST, demanding), paper_table())

    assert 6 < mixed.worst_db < 12
    assert "mixed" in mixed.verdicts
    assert held_back.verdicts[0] == "held back"
    assert held_back.at == mixed.at
    assert held_back.worst_db == mixed.worst_db


async def selected_sensations(
    layout: SurfaceLayout, contacts: list[Contact]
) -> list[FingerSensation]:
    """Return what the control loop selects for fingers, with amplifiers of eight layers."""
    arrived = asyncio.Event()
    intent = EffectPlayer(layout).intent(contacts, 0.0)
    selector = Selector(Chooser(paper_table()), arrived=arrived.set)
    selector.select(contacts, intent, playable())
    if selector.pending is not None:
        await arrived.wait()
    sensations = selector.select(contacts, intent, playable()).finger_sensations
    return sorted(sensations, key=lambda sensation: sensation.contact.key.id)


@pytest.mark.parametrize(
    "effect", [Buzz(level=14.0, modulation=20.0), Click(level=14.0)], ids=["rough", "click"]
)
async def test_check_promises_what_the_daemon_promises(effect: Effect) -> None:
    """Side bands and short effects leak more than a steady tone."""
    steady_layout = buzzes(WEST, NORTH)
    layout = replace(steady_layout, effects={**steady_layout.effects, "west": effect})

    (steady,) = check_together(steady_layout, paper_table())
    (touch,) = check_together(layout, paper_table())
    contacts = []
    for number, place in enumerate(touch.at):
        contacts.append(Contact(ContactKey("test", number), *place, since=0.0))
    west, north = await selected_sensations(layout, contacts)

    assert touch.at == steady.at
    assert touch.worst_db < steady.worst_db - 0.2
    west_contrast, north_contrast = touch.contrasts
    assert west_contrast == pytest.approx(west.sensation.promised_contrast_db, abs=0.3)
    # less while a click plays
    assert north.sensation.promised_contrast_db <= north_contrast + 0.3
