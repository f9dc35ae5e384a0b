"""The limits of a rig file as guards apply them: the least of file, amplifier and ceiling."""

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest

from controller.group.guards import make_guards
from controller.loop.routing import route
from drivers.command import CommandSet, DriveCommand
from drivers.errors import CommandRefused
from drivers.guard import GuardLimits
from drivers.protocol.messages import Capabilities, Feature
from model.rig.file import example_rig_path, load_rig
from model.rig.rig import Rig
from model.vibration.excitation import Tone

CAPABILITIES = Capabilities(
    *(4, 20.0, 600.0, 0.01, 0.9, 0.0001, 0.01, 1.0, 0.1, 2.0, 32, 16, 0.001, 0.1),
    features=Feature.WHOLE,
)


@dataclass
class Reports:
    """An open amplifier that reports these capabilities."""

    capabilities: Capabilities = CAPABILITIES


def in_force(rig: Rig, reports: Reports) -> GuardLimits:
    """The limits of the guard for the rig's one amplifier."""
    return make_guards(rig, {"main": reports})["main"].limits  # type: ignore[dict-item]


def test_make_guards_applies_every_limit_of_the_file(tmp_path: Path) -> None:
    """Where amplifier and ceiling allow more."""
    text = example_rig_path().read_text(encoding="utf-8").replace("mesh: auto", "mesh: 12x9")
    for key in ("slew", "power", "on_time", "duty", "rate"):
        assert f"  # {key}:" in text
        text = text.replace(f"  # {key}:", f"  {key}:")
    path = tmp_path / "rig.yaml"
    path.write_text(text.replace("  level: 1.0", "  level: 0.7"), encoding="utf-8")
    limits = in_force(load_rig(path), Reports())
    assert limits == GuardLimits(
        40.0, 500.0, 0.7, slew=20.0, power=2.0, on_time=5.0, duty=0.5, rate=100.0
    )


@pytest.mark.parametrize(
    ("file", "reported", "least"),
    [
        ({"level": 0.5}, {"level_max": 0.9}, {"level": 0.5}),
        ({"level": 1.0}, {"level_max": 0.9}, {"level": 0.9}),
        ({"level": 5.0}, {"level_max": 4.0}, {"level": 1.0}),
        ({"frequency_min": 40.0}, {"frequency_min": 60.0}, {"frequency_min": 60.0}),
        ({"frequency_min": 1.0}, {"frequency_min": 2.0}, {"frequency_min": 10.0}),
        ({"frequency_max": 900.0}, {"frequency_max": 300.0}, {"frequency_max": 300.0}),
        ({"frequency_max": 5000.0}, {"frequency_max": 4000.0}, {"frequency_max": 3276.75}),
        ({"rate": 100.0}, {}, {"rate": 100.0}),
        ({"rate": math.inf}, {}, {"rate": 2000.0}),
        ({"slew": 20.0, "duty": 0.3}, {}, {"slew": 20.0, "duty": 0.3}),
        ({"on_time": 5.0, "power": 1.5}, {}, {"on_time": 5.0, "power": 1.5}),
    ],
)
def test_make_guards_applies_the_lowest_limit(
    coarse_rig: Rig,
    file: dict[str, float],
    reported: dict[str, float],
    least: dict[str, float],
) -> None:
    """Of file, amplifier and built-in ceiling."""
    rig = replace(coarse_rig, limits=replace(GuardLimits(40.0, 500.0, 1.0), **file))
    limits = in_force(rig, Reports(replace(CAPABILITIES, **reported)))  # type: ignore[arg-type]
    for name, value in least.items():
        assert getattr(limits, name) == pytest.approx(value)


def test_route_lengthens_ramps_to_the_slew_limit(coarse_rig: Rig) -> None:
    """Half of the stroke at 10 /s takes 50 ms; a ramp that is long enough stays."""
    rig = replace(coarse_rig, limits=replace(coarse_rig.limits, slew=10.0))
    guard = make_guards(rig, {"main": Reports()})["main"]  # type: ignore[dict-item]
    half = {"SW": Tone(110.0, rig.era("SW").stroke / 2)}
    for asked, expected in ((0.02, 0.05), (0.2, 0.2)):
        wanted = route(half, rig, token=1, ramp=asked)["main"]
        assert wanted.ramp == pytest.approx(expected)
        assert guard.check(wanted).ramp == wanted.ramp
    short = CommandSet(2, (DriveCommand(1, 110.0, 0.5),), ramp=0.02, valid_for=0.0)
    with pytest.raises(CommandRefused, match="use a longer ramp"):
        guard.check(short)


def test_make_guards_keeps_what_earlier_guards_count(coarse_rig: Rig) -> None:
    """Reopening an amplifier does not give it its on-time anew; other limits need another guard."""
    amplifiers: dict[str, Any] = {"main": Reports()}
    earlier = make_guards(coarse_rig, amplifiers)
    assert make_guards(coarse_rig, amplifiers, earlier) == earlier
    other = replace(coarse_rig, limits=replace(coarse_rig.limits, duty=0.5))
    assert make_guards(other, amplifiers, earlier)["main"] is not earlier["main"]
