"""A rig's amplifiers from a script."""

from dataclasses import replace

import pytest

import era_haptics as era
from model.rig.rig import Channel
from paper_plate import make_paper_rig

RIG = make_paper_rig(12, 9)
URL = f"sim://{era.example_rig_path()}"


def test_commands_for_follows_the_wiring() -> None:
    """Levels, degrees, and every wired channel by its amplifier; others are silent."""
    wiring = {
        "SW": Channel("a", 1), "SE": Channel("a", 0), "NE": Channel("b", 5), "NW": Channel("b", 2),
    }  # fmt: skip
    rig = replace(RIG, wiring=wiring, amplifiers={"a": "sim://", "b": "sim://"})
    sets = era.commands_for(rig, {"SW": era.Drive(110, level=0.25), "NE": era.Tone(90, 5e-5, -1)})
    found = {
        name: sorted((c.channel, c.frequency, round(c.level, 9), round(c.phase, 3)) for c in tones)
        for name, tones in sets.items()
    }
    assert found == {
        "a": [(0, 40.0, 0.0, 0.0), (1, 110, 0.25, 0.0)],
        "b": [(2, 40.0, 0.0, 0.0), (5, 90, 0.5, -57.296)],
    }


def test_open_amplifier_applies_the_limits_of_the_rig() -> None:
    """It plays within the limits and refuses commands beyond them."""
    rig = replace(RIG, limits=replace(RIG.limits, level=0.2))
    with era.open_amplifier(rig, url=URL) as amplifier:
        amplifier.arm()
        (commands,) = era.commands_for(rig, {"SW": era.Drive(110, level=0.2)}).values()
        (layer,) = amplifier.play(commands, duration=0.02).layers
        levels = {command.channel: command.level for command in layer.commands}  # in 1/10000
        assert levels == {0: 2000, 1: 0, 2: 0, 3: 0}
        (commands,) = era.commands_for(rig, {"SW": era.Drive(110, level=0.21)}).values()
        with pytest.raises(era.CommandRefused, match="level"):
            amplifier.apply(commands)


def test_open_amplifier_needs_a_name_when_there_are_several() -> None:
    """No name or an unknown one: the error lists the known names."""
    rig = replace(RIG, amplifiers={"a": "sim://", "b": "sim://"})
    for name in (None, "c"):
        with pytest.raises(era.InputError, match="a, b"):
            era.open_amplifier(rig, name)
