"""How layouts and content will feel: checks and reports, against the plate in time behind wires.

Content is compared with the plate in time that is solved piece by piece; of fingers in two and
three regions that are touched at once it is checked what they are promised.
"""

import asyncio
import json
import math
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from cases import in_turn, shortly
from controller.cli.config_cli import config_kinds
from controller.content.formats import named_content, read_content
from controller.content.pattern import Pattern, Transient
from controller.effects.effect import Effect, Region
from controller.effects.file_effect import File
from controller.effects.kinds import (
    Buzz,
    Click,
    Detents,
    Dial,
    Ramp,
)
from controller.effects.layout import SurfaceLayout
from controller.effects.player import EffectPlayer
from controller.play.chooser import Chooser
from controller.play.selection import Selector
from controller.sources.touch import Contact, ContactKey
from era_haptics.command import run_era
from era_haptics.lab.checks import joint_touches, layout_check
from era_haptics.lab.checks.checked_effect import CheckedEffect
from era_haptics.lab.checks.content_check import check_content
from era_haptics.lab.checks.content_figure import content_figure
from era_haptics.lab.checks.joint_touches import JointTouch, check_together, close_pairs
from era_haptics.lab.checks.layout_check import check_layout
from era_haptics.lab.checks.touch_simulator import loaded_plate
from era_haptics.lab.cli import app
from kit.fingers import WIRES, Pressed, playable
from kit.fingers import table as paper_table
from kit.plates import smooth_rig
from model.config.fields import Circle, Rectangle
from model.errors import InputError
from model.finger import (
    decibels,
    fingertip_points,
    fingertip_weights,
    over_threshold,
)
from model.table.table import LocalizationTable
from model.table.table_file import build_table, save_table
from model.transients.base_motion import along_lines, raised_cosine
from model.transients.shaping import SAMPLE_RATE, Transients

BUTTON = Rectangle(0.05, 0.04, 0.012, 0.012)
SLIDER = Rectangle(0.02, 0.14, 0.26, 0.04)


@pytest.fixture(autouse=True)
def _few_touches(monkeypatch: pytest.MonkeyPatch) -> None:
    """A third of the touches of each region that the command tries."""
    monkeypatch.setattr(layout_check, "MAX_REGION_TOUCHES", 10)


@cache
def table() -> LocalizationTable:
    """Eight frequencies, which is quick to solve."""
    return build_table(smooth_rig(), frequencies=np.linspace(60.0, 340.0, 8))


def checked(region: Region, effect: Effect) -> CheckedEffect:
    """The check of one region with one effect, called `it`."""
    (found,) = check_layout(SurfaceLayout((region,), {"it": effect}, elsewhere=None), table())
    return found


@pytest.mark.usefixtures("plain_pictures")
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
    assert felt.level_db_sl(duration, since=since) == pytest.approx(touch.felt_db_sl, abs=1.0)
    expected = effect.level - touch.held_back_db
    assert expected - 0.5 <= touch.felt_db_sl <= expected + 2.0


@pytest.mark.usefixtures("plain_pictures")
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


@pytest.mark.usefixtures("plain_pictures")
def test_check_touches_only_the_part_of_a_region_that_is_on_the_plate() -> None:
    """A region of 40 mm by 12 mm, half of it beyond the east edge, and one beyond it."""
    length = table().plate.length
    half = checked(
        Region("half", Rectangle(length - 0.02, 0.04, 0.04, 0.012), on_press="it"), Buzz()
    )
    assert {touch.reason for touch in half.touches} == {None}
    assert all(length - 0.02 < touch.at[0] < length for touch in half.touches)
    beyond = checked(
        Region("beyond", Rectangle(length + 0.02, 0.04, 0.04, 0.012), on_press="it"), Buzz()
    )
    assert (beyond.touches, len(beyond.problems)) == ((), 1)


@pytest.mark.usefixtures("plain_pictures")
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


@pytest.mark.usefixtures("plain_pictures")
def test_check_wants_a_frequency_for_notches_that_differ() -> None:
    """A slider without a band plays any frequency of the table; with one it stays in it."""
    free = checked(Region("slider", SLIDER, on_move="it"), Detents())
    assert len(free.frequencies) > 2
    assert len(free.problems) == 1
    tuned = checked(Region("slider", SLIDER, on_move="it", band=(170.0, 230.0)), Detents())
    assert set(tuned.frequencies) <= {180.0, 220.0}
    assert tuned.problems == ()
    assert max(abs(level - 20.0) for level in tuned.felt) <= 2.0


@pytest.mark.usefixtures("plain_pictures")
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


@pytest.mark.usefixtures("plain_pictures")
def test_command_prints_one_object_and_writes_a_picture(tmp_path: Path) -> None:
    """One region falls short: exit status 1; its keys as documented.

    With a band for the slider, too, it is 0, and a table of what is felt is printed.
    """
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
    # Nine of ten plates have less than the one that is modeled.
    assert key["promised_contrast_db"]["median"] < key["felt_contrast_db"]["median"]
    assert 18 <= key["felt_db_sl"]["min"] <= key["felt_db_sl"]["max"] <= 22
    assert len(strip["problems"]) == 1  # its frequency
    assert 0.0 <= strip["held_back_db"] < 2.0
    (both,) = found["promised_together"]
    assert both["regions"] == ["key", "strip"]
    assert both["promised_worst_db"] <= min(both["promised_contrast_db"])
    assert {*both["promised_verdicts"]} <= {"own", "mixed", "shared", "held back"}
    assert len(both["at_m"]) == 2
    status, output = run(tmp_path, LAYOUT.replace("notches}\n", "notches, band: [130, 190]}\n"))
    assert status == 0
    assert "strip, on_move: notches, 20 dB SL" in output
    (row,) = (line.split() for line in output.splitlines() if line.startswith(" 2 strip"))
    assert float(row[2]) > 0
    assert row[3] == "-"


@pytest.mark.usefixtures("plain_pictures")
@pytest.mark.parametrize("kind", shortly([*config_kinds()], {*config_kinds()} - {"layout"}))
def test_files_that_config_init_writes_fit_each_other(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Each beside the rig; fingers in any two regions of the layout are promised 4 dB at once."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(layout_check, "MAX_REGION_TOUCHES", 20)
    monkeypatch.setattr(joint_touches, "MAX_TRIPLES", 0)
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
    """An effect, the part of its first vibration [s] that is measured, and the finger's path.

    vibrations: number of separate vibrations that a press causes.
    """

    effect: Effect
    duration: float
    since: float = 0.0
    way: Way = rest
    held: float = 0.15
    vibrations: int = 1


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


@pytest.mark.usefixtures("plain_pictures")
@pytest.mark.parametrize(("name", "wire"), in_turn(CASES, [*WIRES]))
def test_effect_is_felt_as_promised_and_alike_at_every_press(name: str, wire: str) -> None:
    """Within 3 dB of what layout and report promise, all presses within 2 dB, on the plate."""
    case = CASES[name]
    where = "on_move" if case.effect.is_for_motion else "on_press"
    region = Region("all", Circle(*CENTRE, 0.06), **{where: "it"})
    layout = SurfaceLayout((region,), {"it": case.effect}, elsewhere=None)
    chain = Pressed(smooth_rig(), table(), layout, wire)
    ways = [case.way] * PRESSES.get(wire, FEW)
    vibrations = chain.press(*ways, held=case.held)
    assert [len(of_press) for of_press in vibrations] == [case.vibrations] * len(ways)
    presses = [of_press[0] for of_press in vibrations]
    levels = [felt.level_db_sl(case.duration, since=case.since) for felt in presses]
    assert levels == pytest.approx([case.effect.level] * len(ways), abs=3.0)
    if name != "ramp":  # which reports each of its steps
        assert levels == pytest.approx([felt.promised_db_sl for felt in presses], abs=3.0)
    assert max(levels) - min(levels) <= 2.0


@pytest.mark.usefixtures("plain_pictures")
def test_check_states_the_exposure_of_raised_levels() -> None:
    """A buzz of 100 Hz: 45 dB SL are 0.249 m/s² times 178, 0.160 of its rms by ISO 5349-1 or more.

    The fingertip's mean is at that level, so that its loudest point has no less.
    """
    region = Region("button", BUTTON, on_press="it", band=(100.0, 100.0))
    least = 0.249 * 10 ** (45 / 20) * 0.160 / math.sqrt(2)
    found = checked(region, Buzz(level=45.0))
    assert least * 10 ** (-2 / 20) <= found.exposure_m_s2 <= 3 * least


SIZE = 0.03
WEST, EAST, NEXT, NORTH = (0.03, 0.06), (0.2448, 0.06), (0.075, 0.06), (0.1374, 0.18)
"""South-west corners [m] of regions on a plate of 0.3048 m by 0.2286 m; west and east mirrored."""


def region(name: str, corner: tuple[float, float]) -> Region:
    """A square region with a buzz of its name."""
    return Region(name, Rectangle(*corner, SIZE, SIZE), on_press=name)


def layout(*regions: Region) -> SurfaceLayout:
    """A layout of regions."""
    effects = {each.name: Buzz(level=14.0) for each in regions}
    return SurfaceLayout(regions, effects, elsewhere=None)


def test_pairs_that_are_felt_as_one_are_named() -> None:
    """Those below 6 dB, the rule's bound of what is mixed, the worst first; none of three."""
    at, worst = (0.0, 0.0), {"ab": 3.2, "ac": 6.0, "bc": -1.0, "abc": -5.0}
    found = [JointTouch((*names,), (at, at), (db, db), db, ()) for names, db in worst.items()]
    said = close_pairs(found)
    assert "2 of 3 pairs" in said
    assert said.index("b with c -1.0 dB") < said.index("a with b 3.2 dB")
    assert close_pairs(found[1:2]) == ""


def test_verdicts_follow_the_rule_and_what_regions_say() -> None:
    """Below 12 dB mixed; where a region requires its own or is protected another is held back."""
    near = region("near", (0.12, 0.06))
    (mixed,) = check_together(layout(region("west", WEST), near), paper_table())
    assert 6 < mixed.worst_db < 12
    assert "mixed" in mixed.verdicts
    for said in (replace(near, is_own=True), replace(near, is_protected=True)):
        (found,) = check_together(
            layout(region("west", WEST), replace(said, priority=1)), paper_table()
        )
        assert found.verdicts[0] == "held back"
        assert (found.at, found.worst_db) == (mixed.at, mixed.worst_db)


@pytest.mark.parametrize(
    "effect", [Buzz(level=14.0, modulation=20.0), Click(level=14.0)], ids=["rough", "click"]
)
async def test_what_comes_and_goes_is_promised_as_the_daemon_promises_it(effect: Effect) -> None:
    """Side bands and short effects leak more than a steady tone, by what a selection says.

    A selection of the control loop, of amplifiers with eight layers, for fingers down at once.
    """
    steady = layout(region("west", WEST), region("north", NORTH))
    changed = replace(steady, effects={**steady.effects, "west": effect})
    (before,), (found,) = (check_together(each, paper_table()) for each in (steady, changed))
    assert found.at == before.at
    assert found.worst_db < before.worst_db - 0.2
    contacts = [Contact(ContactKey("test", n), *at, since=0.0) for n, at in enumerate(found.at)]
    arrived, intent = asyncio.Event(), EffectPlayer(changed).intent(contacts, 0.0)
    selector = Selector(Chooser(paper_table()), arrived=arrived.set)
    selector.select(contacts, intent, playable())
    if selector.pending is not None:
        await arrived.wait()
    predicted = selector.select(contacts, intent, playable()).finger_sensations
    west, north = sorted(predicted, key=lambda each: each.contact.key.id)
    assert found.contrasts[0] == pytest.approx(west.sensation.promised_contrast_db, abs=0.3)
    assert (
        north.sensation.promised_contrast_db <= found.contrasts[1] + 0.3
    )  # less while a click plays


AT, QUIET = (0.11, 0.13), (0.21, 0.06)
SWELL = Pattern(
    0.4, ((0.0, 0.4), (0.3, 1.0), (0.4, 0.0)), ((0.0, 0.5),), (Transient(0.15, 1.0, 0.2),)
)


@cache
def content_check_table() -> LocalizationTable:
    """Frequencies 20 Hz apart, which is quick to solve."""
    return build_table(smooth_rig(), frequencies=np.arange(60.0, 321.0, 20.0), drive_mode="phased")


@pytest.mark.usefixtures("plain_pictures")
def test_felt_level_is_that_of_the_plate_in_time() -> None:
    """A swell and a tap in it, also as terms of the bases, each between two knots by itself."""
    found = check_content(SWELL, content_check_table(), 20.0, at=AT)
    lasting, tap = found.parts
    bases = []
    for era in content_check_table().eras:
        swell, click = (each.answer.layers[0].excitation[era.name] for each in found.parts)
        ramp, omega = tap.answer.layers[0].ramp, 2 * math.pi * click.frequency
        course = lasting.stimulus.course
        end = click.phasor * np.exp(0.04j * omega)
        bases.append(
            (
                *along_lines(
                    0.0,
                    course.times[1],
                    2 * math.pi * swell.frequency,
                    [share * swell.phasor for share in course.shares],
                ),
                *raised_cosine(0.15, ramp, omega, 0, click.phasor),
                *raised_cosine(0.19, ramp, omega, 0, -end),
            )
        )
    transients = Transients(loaded_plate(content_check_table(), [AT]))
    points = fingertip_points(*AT, content_check_table().plate)
    moved = transients.acceleration(tuple(bases), points, duration=0.4)
    felt = over_threshold(moved, SAMPLE_RATE, content_check_table().threshold)
    for time in (0.06, 0.11, 0.17, 0.3):
        around = np.arange(-159, 160)
        window = np.cos(np.pi / 2 * around / 160) ** 2  # 20 ms wide at half its height
        some = felt[round(time * SAMPLE_RATE) + around]
        power = 2 * (window[:, None] * some**2).sum(axis=0) / window.sum()
        expected = decibels(np.sqrt(power) @ fingertip_weights(*AT, content_check_table().plate))
        assert found.given[round(time / found.step)] == pytest.approx(float(expected), abs=0.3)


@pytest.mark.usefixtures("plain_pictures")
def test_what_lasts_has_its_level_and_taps_theirs() -> None:
    """20 dB SL for a second, the plate's rise apart; then a tap of 15 dB SL alone."""
    pattern = Pattern(
        1.5, ((0.0, 1.0), (1.0, 1.0), (1.0, 0.0)), ((0.0, 0.5),), (Transient(1.3, 0.5, 0.5),)
    )
    found = check_content(pattern, content_check_table(), 20.0, at=AT)
    middle = found.given[round(0.2 / found.step) : round(0.9 / found.step)]
    assert np.median(middle) == pytest.approx(20.0, abs=1.0)
    assert found.given[round(1.3 / found.step) :].max() == pytest.approx(15.0, abs=2.0)
    assert found.kept_share > 0.9
    assert found.delay <= 0.01


@pytest.mark.usefixtures("plain_pictures")
def test_beside_a_quiet_finger_content_is_smoothed_and_promised() -> None:
    """The course starts and ends at rest; each part has a promise, the least counts."""
    found = check_content(SWELL, content_check_table(), 20.0, at=AT, quiet=[QUIET])
    course = found.parts[0].stimulus.course
    assert course.shares[0] == course.shares[-1] == 0
    promises = [each.answer.fingers[0].promised_contrast_db for each in found.parts]
    assert found.as_json()["promised_contrast_db"] == min(each for each in promises if each)


@pytest.mark.usefixtures("plain_pictures")
def test_command_says_what_is_kept_and_fails_below_the_least(tmp_path: Path) -> None:
    """Exit status 0 and 1 of the same content, its levels over time, and a picture."""
    save_table(content_check_table(), tmp_path / "table.npz")
    picture, place = tmp_path / "picture.png", "0.11,0.13"
    arguments = [
        "content",
        "check",
        "success",
        "--table",
        str(tmp_path / "table.npz"),
        "--at",
        place,
    ]
    result = CliRunner().invoke(app, [*arguments, "-o", str(picture), "--json"])
    assert result.exit_code == 0
    found = json.loads(result.stdout)
    assert found["kept_share"] >= 0.8
    assert found["level_db_sl"]["step_s"] == pytest.approx(0.005, abs=0.001)
    assert max(each for each in found["level_db_sl"]["given"] if each) > 15
    assert [each["time_s"] for each in found["parts"]] == sorted(
        each["time_s"] for each in found["parts"]
    )
    assert found["files"] == [str(picture)]
    assert picture.stat().st_size > 0
    result = CliRunner().invoke(app, [*arguments, "--least", "1", "--quiet", "0.21,0.06"])
    assert result.exit_code == 1
    assert "lost too much; at least 100 % of the level must be kept" in result.stdout
    assert "dB above quiet fingers" in result.stdout


@pytest.mark.usefixtures("plain_pictures")
def test_command_tries_several_places_and_says_what_a_tap_loses(tmp_path: Path) -> None:
    """The median of five is shown, never the worst; of all its time all that is off its level."""
    save_table(content_check_table(), tmp_path / "table.npz")
    arguments = ["content", "check", "tick", "--table", str(tmp_path / "table.npz")]
    shares, sides = [], (content_check_table().plate.length, content_check_table().plate.width)
    for at in (None, (0.5, 0.5), (0.2, 0.3), (0.35, 0.75), (0.65, 0.2), (0.8, 0.6)):
        x, y = (each * side for each, side in zip(at or (0, 0), sides, strict=True))
        more = ["--at", f"{x},{y}"] if at else []
        found = json.loads(CliRunner().invoke(app, [*arguments, *more, "--json"]).stdout)
        off = sum(int(each.partition(" %")[0]) for each in found["lost"] if "wanted" in each)
        assert off / 100 == pytest.approx(1 - found["kept_share"], abs=0.06)
        shares.append(found["kept_share"])
    assert shares[0] == np.median(shares[1:])
    (told,) = re.findall(
        r"(\d) of 5 positions keep at least 80 %: (\d+) % at \S+, (\d+) % at ",
        CliRunner().invoke(app, arguments).stdout,
    )
    worst, *_, best = (math.floor(100 * each) for each in sorted(shares[1:]))
    assert [*map(int, told)] == [sum(each >= 0.8 for each in shares[1:]), worst, best]


@pytest.mark.usefixtures("plain_pictures")
def test_level_beyond_all_is_refused_as_it_was_given() -> None:
    """Not as what becomes of it in the file."""
    with pytest.raises(InputError, match="level must be between -100 and 60 dB SL, got 70;"):
        check_content(Pattern(0.3, ((0.0, 0.5), (0.3, 0.5))), content_check_table(), 70.0, at=AT)


def write_haptic(path: Path, **envelopes: list[dict[str, float]]) -> None:
    """Write a .haptic file with these envelopes."""
    content = {"version": {"major": 1, "minor": 0, "patch": 0}, "metadata": {}}
    signals = {"signals": {"continuous": {"envelopes": envelopes}}}
    path.write_text(json.dumps(content | signals))


@pytest.mark.usefixtures("plain_pictures")
def test_sweep_keeps_its_level_but_not_its_sharpness(tmp_path: Path) -> None:
    """A sweep of 65 to 300 Hz in a second becomes one tone, on the built-in plate, without a table.

    Its best band, 245 to 300 Hz, is 23 % of the sweep: the frequency is linear over time.
    """
    even = [{"time": 0, "amplitude": 1}, {"time": 1, "amplitude": 1}]
    rise = [{"time": share, "frequency": share**2} for share in np.linspace(0, 1, 101).tolist()]
    write_haptic(tmp_path / "sweep.haptic", amplitude=even, frequency=rise)
    arguments = ["content", "check", str(tmp_path / "sweep.haptic"), "--at", "0.11,0.13"]
    found = json.loads(CliRunner().invoke(app, [*arguments, "--json"]).stdout)
    assert found["table"] is None
    assert found["kept_share"] > 0.9
    assert found["sharpness_kept_share"] == pytest.approx(0.23, abs=0.02)
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0
    assert result.stdout.startswith("plate: the founding paper's, 305 x 229 mm with 4 ERAs; ")
    share = math.floor(100 * found["sharpness_kept_share"])
    headline = f"sharpness {share} % kept: level good, but its sharpness is lost;"
    assert headline in result.stdout
    pattern = read_content(tmp_path / "sweep.haptic")
    checked = check_content(pattern, content_check_table(), 20.0, at=AT)
    title = content_figure(pattern, checked).axes[0].get_title()
    assert title.startswith(checked.headline)
    assert "sharpness 2" in title


@pytest.mark.usefixtures("plain_pictures")
def test_folder_is_listed_with_a_line_for_each_file(tmp_path: Path) -> None:
    """Files of its subfolders, too; not other kinds. An unreadable or silent file fails it."""
    save_table(content_check_table(), tmp_path / "table.npz")
    folder = tmp_path / "contents"
    (folder / "taps").mkdir(parents=True)
    tick = folder / "taps" / "tick.ahap"
    tick.write_bytes(named_content("tick").read_bytes())
    (folder / "notes.txt").write_text("not a content")
    arguments = ["content", "check", str(folder), "--table", str(tmp_path / "table.npz")]
    arguments += ["--at", "0.11,0.13", "--least", "0.1"]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0
    _, row, last = result.stdout.splitlines()
    assert re.fullmatch(rf" *\d+ % +100 % +0.110,0.130 +{re.escape(str(tick))}: good", row)
    assert last == "1 of 1 files keep at least 10 % of their level"
    (folder / "broken.haptic").write_text("{}")
    silent_tap = {
        "EventType": "HapticTransient",
        "Time": 0,
        "EventParameters": [{"ParameterID": "HapticIntensity", "ParameterValue": 0}],
    }
    (folder / "silent.ahap").write_text(json.dumps({"Pattern": [{"Event": silent_tap}]}))
    result = CliRunner().invoke(app, [*arguments, "--json"])
    assert result.exit_code == 1
    broken, silent, kept = json.loads(result.stdout)["contents"]
    assert broken["error"].startswith(str(folder / "broken.haptic"))
    assert silent["error"] == f"{folder / 'silent.ahap'}: must not be silent"
    assert kept["file"] == str(tick)
    assert kept["kept_share"] >= 0.1
