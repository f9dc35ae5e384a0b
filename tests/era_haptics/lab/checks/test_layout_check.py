"""How a layout will feel: by its check and by reports, against the plate in time behind wires."""

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

from controller.cli.main import run as run_era
from controller.content.pattern import Pattern
from controller.effects.effect import Effect, Region
from controller.effects.kinds import BUILT_IN, Buzz, Click, Detents, Dial, File, Ramp, Texture
from controller.effects.layout import SurfaceLayout, load_layout
from era_haptics.lab.checks import layout_check, layout_picture
from era_haptics.lab.checks.layout_check import CheckedEffect, check_layout, strongest_target
from era_haptics.lab.cli import app
from long_form import in_turn, shortly
from model.config.fields import Circle, Rectangle
from model.config.file_kinds import KINDS
from model.rig.rig import Uncertainty
from model.table.table import LocalizationTable
from model.table.table_file import build_table, save_table
from plates import smooth_rig
from several_fingers import WIRES, Felt, Pressed

pytestmark = pytest.mark.usefixtures("plain_pictures")

EXAMPLE = Path(__file__).parents[4] / "examples" / "panel_layout.yaml"
BUTTON = Rectangle(0.05, 0.04, 0.012, 0.012)
SLIDER = Rectangle(0.02, 0.14, 0.26, 0.04)


@pytest.fixture(autouse=True)
def _few_touches(monkeypatch: pytest.MonkeyPatch) -> None:
    """A third of the touches of each region that the command tries."""
    monkeypatch.setattr(layout_check, "MAX_TOUCHES", 10)


@cache
def table() -> LocalizationTable:
    """Eight frequencies, which is quick to solve."""
    return build_table(smooth_rig(), frequencies=np.linspace(60.0, 340.0, 8))


@cache
def example_table() -> LocalizationTable:
    """The frequencies of the example's bands."""
    return build_table(smooth_rig(), frequencies=np.arange(100.0, 281.0, 10.0))


def checked(region: Region, effect: Effect) -> CheckedEffect:
    """The check of one region with one effect, called `it`."""
    layout = SurfaceLayout((region,), {"it": effect}, elsewhere=None)
    (found,) = check_layout(layout, table())
    return found


@pytest.mark.parametrize("resting", shortly([False, True], [True]))
@pytest.mark.parametrize("effect", [Click(duration=0.02), Click(), Buzz(level=15.0)])
def test_check_says_what_the_plate_behind_a_wire_makes_felt(effect: Effect, resting: bool) -> None:
    """The same touch through controller, wire and amplifier, within a decibel of its simulation."""
    found = checked(Region("button", BUTTON, on_press="it"), effect)
    (touch,) = [each for each in found.touches if (each.resting is not None) is resting]
    since, duration = (0.3, 0.1) if isinstance(effect, Buzz) else (0.0, effect.duration)
    layout = SurfaceLayout(
        (Region("button", BUTTON, on_press="it"),), {"it": effect}, elsewhere=None
    )
    chain = Pressed(
        smooth_rig(),
        table(),
        layout,
        "serial",
        resting=() if touch.resting is None else (touch.resting,),
        is_shaped=False,
    )
    ((felt,),) = chain.press(lambda since: touch.at, held=0.42)
    assert touch.frequencies == (felt.frequency,)
    assert touch.felt_db_sl is not None
    assert felt.level_db_sl(duration, since=since) == pytest.approx(touch.felt_db_sl, abs=1.0)
    expected = effect.level - touch.held_back_db
    assert expected - 0.5 <= touch.felt_db_sl <= expected + 2.0


def test_check_says_by_how_much_a_level_cannot_be_had() -> None:
    """Of 10 dB more than the full stroke gives, 10 dB are missing."""
    region = Region("button", BUTTON, on_press="it", band=(90.0, 110.0))
    most = max(checked(region, Click(level=60.0)).felt)
    assert most < 59
    short = checked(region, Click(level=math.floor(most) + 10.0))
    (problem,) = short.problems
    missing = float(problem.split("up to ")[1].split(" dB")[0])
    assert missing == pytest.approx(math.floor(most) + 10.0 - min(short.felt), abs=0.06)
    assert 9.0 <= missing <= 13.0
    assert short.frequencies == [100.0]
    assert "100 % of the region (1.4 cm²)" in problem


@pytest.mark.parametrize(
    ("level", "count"), [pytest.param(None, 0, marks=pytest.mark.long), (16.9, 1), (17.0, 0)]
)
def test_check_wants_notches_noticed_above_what_lasts(level: float | None, count: int) -> None:
    """3 dB above the 14 of the buzz there; without a level of their own they are."""
    region = Region("slider", SLIDER, on_press="low", on_move="it", band=(170.0, 230.0))
    notches = Detents() if level is None else Detents(level=level)
    layout = SurfaceLayout((region,), {"low": Buzz(level=14.0), "it": notches}, elsewhere=None)
    (found,) = [each for each in check_layout(layout, table()) if each.on == "on_move"]
    assert len(found.problems) == count


def test_check_wants_a_frequency_for_notches_that_differ() -> None:
    """A slider without a band plays any frequency of the table; with one it stays in it."""
    free = checked(Region("slider", SLIDER, on_move="it"), Detents())
    assert len(free.frequencies) > 2
    assert len(free.problems) == 1
    tuned = checked(Region("slider", SLIDER, on_move="it", band=(170.0, 230.0)), Detents())
    assert set(tuned.frequencies) <= {180.0, 220.0}
    assert tuned.problems == ()
    assert max(abs(level - 20.0) for level in tuned.felt) <= 2.0


def test_check_names_a_frequency_that_the_table_does_not_have() -> None:
    """700 Hz is not among 60 to 340 Hz; 200 Hz is as far from 180 as from 220 Hz."""
    for frequency in (700.0, 200.0):
        region = Region("button", BUTTON, on_press="it", band=(frequency, frequency))
        (problem,) = checked(region, Click()).problems
        assert f"{frequency:g} Hz" in problem
        # The daemon logs the same of all regions.
        layout = SurfaceLayout((region,), {"it": Click(frequency=60.0)}, elsewhere="it")
        assert layout.band_problems(table().frequencies) == [f"button: {problem}"]


# At the level of intensity 1 from its beginning to its end.
STEADY = File.of(
    Pattern(0.5, ((0.0, 1.0), (0.5, 1.0)), ((0.0, 0.5),)), name="steady", level_db_sl=20.0
)

STRONGEST: list[tuple[Effect, float, float | None]] = [
    (Click(), 20.0, 0.040),
    (Buzz(), 20.0, None),
    (Ramp(start_level=6.0), 20.0, 1.0),
    (Texture(fast=0.5), 20.0, None),
    (Detents(spacing=0.05), 20.0, 0.030),
    (Dial(), 20.0, 0.030),
    (STEADY, 20.0, 0.5),
]
"""An effect of each kind, its level and the duration of its pulses."""


@pytest.mark.parametrize(("effect", "level", "duration"), STRONGEST)
def test_strongest_target_of_every_kind(
    effect: Effect, level: float, duration: float | None
) -> None:
    """What its level is reached with, at rest or along some way."""
    region = Region("knob", Circle(0.15, 0.1, 0.05))
    layout = SurfaceLayout((region,), {"it": effect})
    felt = strongest_target(layout, "it", region, at=(0.15, 0.1))
    assert felt is not None
    assert felt.level_db_sl == level
    assert (felt.pulse and felt.pulse.duration) == duration


@pytest.mark.long
def test_a_better_known_rig_feels_no_worse(monkeypatch: pytest.MonkeyPatch) -> None:
    """No problem is new, and contrasts promised for the example do not fall by 0.3 dB or more."""
    monkeypatch.setattr(layout_check, "MAX_TOUCHES", 8)
    layout = load_layout(EXAMPLE, smooth_rig().plate)
    usual, known = (
        check_layout(layout, replace(example_table(), uncertainty=uncertainty))
        for uncertainty in (Uncertainty(), Uncertainty.none())
    )
    for before, each in zip(usual, known, strict=True):
        assert {*each.problems} <= {*before.problems}
        for measure in (min, np.median):
            assert measure(each.promised_contrasts) > measure(before.promised_contrasts) - 0.3


LAYOUT = """\
effects: {notches: {kind: detents}}
regions:
  key: {rectangle: {start: [3 cm, 3 cm], end: [5 cm, 5 cm]}, on_press: click, frequency: 100 Hz}
  strip: {rectangle: {start: [3 cm, 9 cm], end: [25 cm, 11 cm]}, on_move: notches}
elsewhere: null
"""


def run(folder: Path, text: str, *options: str) -> tuple[int, str]:
    """Exit status and output of the command."""
    (folder / "layout.yaml").write_text(text, encoding="utf-8")
    save_table(table(), folder / "table.npz")
    files = [str(folder / name) for name in ("layout.yaml", "table.npz")]
    result = CliRunner().invoke(app, ["layout", "check", *files, *options])
    return result.exit_code, result.stdout


def test_command_prints_one_object_and_writes_a_picture(tmp_path: Path) -> None:
    """One region falls short: exit status 1; its keys as documented."""
    picture = tmp_path / "preview.png"
    status, output = run(tmp_path, LAYOUT, "--json", "-o", str(picture))
    found: dict[str, Any] = json.loads(output)
    assert status == 1
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert found["files"] == [str(picture)]
    key, strip = found["regions"]
    assert (key["region"], key["effect"], key["promised_db_sl"]) == ("key", "click", 20.0)
    assert key["frequency_hz"] == [100.0]
    assert key["problems"] == []
    assert set(key["felt_db_sl"]) == {"min", "median", "max"}
    # Nine of ten plates have less than the one that is modelled.
    assert key["promised_contrast_db"]["median"] < key["felt_contrast_db"]["median"]
    assert 18 <= key["felt_db_sl"]["min"] <= key["felt_db_sl"]["max"] <= 22
    assert len(strip["problems"]) == 1  # its frequency
    assert 0.0 <= strip["held_back_db"] < 2.0
    (both,) = found["promised_together"]
    assert both["regions"] == ["key", "strip"]
    assert both["promised_worst_db"] <= min(both["promised_contrast_db"])
    assert {*both["promised_verdicts"]} <= {"own", "mixed", "shared", "held back"}
    assert len(both["at_m"]) == 2


@pytest.mark.parametrize("kind", shortly(KINDS, {*KINDS} - {"layout"}))
def test_files_that_config_init_writes_fit_each_other(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Each beside the rig; fingers in any two regions of the layout are promised 4 dB at once."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(layout_check, "MAX_TOUCHES", 20)
    monkeypatch.setattr(layout_picture, "MAX_TRIPLES", 0)
    assert run_era(["config", "init", "rig.yaml"]) == 0
    if kind != "rig":
        assert run_era(["config", "init", f"{kind}.yaml", "--kind", kind]) == 0
    assert run_era(["config", "check", f"{kind}.yaml"]) == 0
    if kind == "layout":
        assert run_era(["table", "build", "rig.yaml", "-o", "table.npz"]) == 0
        capsys.readouterr()
        assert run_era(["layout", "check", "layout.yaml", "table.npz", "--json"]) == 0
        together = json.loads(capsys.readouterr().out)["promised_together"]
        assert len(together) == 10
        assert min(each["promised_worst_db"] for each in together) >= 4


def test_command_ends_with_zero_for_a_good_layout(tmp_path: Path) -> None:
    """With a band for the slider, too."""
    status, output = run(tmp_path, LAYOUT.replace("notches}\n", "notches, band: [130, 190]}\n"))
    assert status == 0
    assert "strip, on_move: notches, 20 dB SL" in output
    (row,) = (line.split() for line in output.splitlines() if line.startswith(" 2 strip"))
    assert float(row[2]) > 0
    assert row[3] == "-"


PRESSES = {"modbus-rtu": 6}
"""Equal presses, each at another phase of the heartbeats; on the other wires `FEW`."""
FEW = 3
PLACE, CENTRE = (0.09, 0.07), (0.09, 0.10)
Way = Callable[[float], tuple[float, float]]


def rest(since: float) -> tuple[float, float]:
    """A finger that stays where it came down."""
    return PLACE


def step(since: float) -> tuple[float, float]:
    """A finger that moves by 8 mm after a tenth of a second."""
    return (PLACE[0] + (0.008 if since > 0.1 else 0.0), PLACE[1])


@dataclass(frozen=True)
class Case:
    """An effect and over which part of it [s] its level is felt, and the way of the finger."""

    effect: Effect
    duration: float
    since: float = 0.0
    way: Way = rest
    held: float = 0.15


CASES = {
    "short click": Case(Click(duration=0.020), 0.020),
    "click": Case(Click(), 0.040),
    "long click": Case(Click(duration=0.120, level=14.0), 0.120, held=0.2),
    "short buzz": Case(Buzz(duration=0.300, level=16.0), 0.300, held=0.4),
    "buzz": Case(Buzz(), 0.1, since=0.3, held=0.42),
    "ramp": Case(Ramp(start_level=14.0, duration=0.4), 0.08, since=0.32, held=0.42),
    "detents": Case(Detents(), 0.030, way=step, held=0.2),
    "dial": Case(Dial(), 0.030, way=step, held=0.2),
    "file": Case(STEADY, 0.1, since=0.3, held=0.42),
}


def test_every_kind_has_its_rows() -> None:
    """In both lists of this file; a texture is felt where a finger moves, not where it stops."""
    assert {type(effect) for effect, *_ in STRONGEST} == {*BUILT_IN}, "a row in STRONGEST each"
    assert {type(case.effect) for case in CASES.values()} | {Texture} == {*BUILT_IN}, (
        "a row in CASES each, but for kinds that only a moving finger feels"
    )


@cache
def pressed(case: Case, wire: str) -> list[Felt]:
    """What equal presses feel."""
    where = "on_move" if case.effect.is_for_motion else "on_press"
    region = Region("all", Circle(*CENTRE, 0.06), **{where: "it"})
    layout = SurfaceLayout((region,), {"it": case.effect}, elsewhere=None)
    chain = Pressed(smooth_rig(), table(), layout, wire)
    presses = chain.press(*[case.way] * PRESSES.get(wire, FEW), held=case.held)
    assert all(len(each) == 1 for each in presses)
    return [felt for (felt,) in presses]


@pytest.mark.parametrize(("name", "wire"), in_turn(CASES, [*WIRES]))
def test_effect_is_felt_as_promised_and_alike_at_every_press(name: str, wire: str) -> None:
    """Within 3 dB of what layout and report promise, all presses within 2 dB, on the plate."""
    case = CASES[name]
    presses = pressed(case, wire)
    levels = [felt.level_db_sl(case.duration, since=case.since) for felt in presses]
    assert levels == pytest.approx([case.effect.level] * len(presses), abs=3.0)
    if name != "ramp":  # which reports each of its steps
        assert levels == pytest.approx([felt.promised_db_sl for felt in presses], abs=3.0)
    assert max(levels) - min(levels) <= 2.0


def test_check_states_the_exposure_of_raised_levels() -> None:
    """A buzz of 100 Hz: 45 dB SL are 0.249 m/s² times 178, 0.160 of its rms by ISO 5349-1 or more.

    The fingertip's mean is at that level, so that its loudest point has no less.
    """
    region = Region("button", BUTTON, on_press="it", band=(100.0, 100.0))
    least = 0.249 * 10 ** (45 / 20) * 0.160 / math.sqrt(2)
    found = checked(region, Buzz(level=45.0))
    assert least * 10 ** (-2 / 20) <= found.exposure_m_s2 <= 3 * least
