"""A rig's amplifiers, drives and places from a script."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import era_haptics as era
from era_haptics.drive import as_points, layers_of
from model.answer.answer import Layer
from model.rig.rig import Channel
from plates import make_paper_rig

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
        name: sorted(
            (each.channel, each.frequency, round(each.level, 9), round(each.phase, 3))
            for layer in layers
            for each in layer.tones
        )
        for name, layers in sets.items()
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
        layer, *silent = amplifier.play(commands, duration=0.05).layers
        assert not any(each.commands for each in silent)
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


def test_layers_of_accepts_frequency_drive_and_tone() -> None:
    """A bare frequency is at full stroke, 100 µm; a Drive in shares and degrees; a Tone is kept.

    Several tones of an ERA are excitations beside the first.
    """
    tone = era.Tone(250.0, 3e-5, 0.1)
    drives = {"SW": 110, "SE": era.Drive(110, level=0.25, phase_deg=-90), "NE": tone}
    assert layers_of(drives, RIG)[0].excitation == {
        "SW": era.Tone(110, 1e-4, 0.0),
        "SE": era.Tone(110, 0.25e-4, -math.pi / 2),
        "NE": tone,
    }
    half = era.Drive(110, level=0.5)
    (layer,) = layers_of({"SW": [half, era.Drive(90, level=0.5)], "SE": [110]}, RIG)
    assert layer.excitations == (
        {"SW": era.Tone(110, 0.5e-4), "SE": era.Tone(110, 1e-4)},
        {"SW": era.Tone(90, 0.5e-4)},
    )


def test_layers_of_converts_numbers_of_numpy() -> None:
    """Of single precision too, which would go on into every command; 110.5 and 0.25 are exact."""
    drive = era.Drive(np.float32(110.5), level=np.float32(0.25), phase_deg=np.float32(0))  # type: ignore[arg-type]
    assert era.Drive(110, level=np.float64(1.0000000000000002)).level == 1  # of divided weights
    tone = layers_of({"SW": drive}, RIG)[0].excitation["SW"]
    assert tone == era.Tone(110.5, 0.25e-4, 0.0)
    assert {type(tone.frequency), type(tone.amplitude), type(tone.phase)} == {float}


@pytest.mark.parametrize(
    ("drives", "message"),
    [
        ({"XX": 110}, "XX'; choose from SW, SE, NE, NW"),
        ({"XX": era.Tone(110, 1e-4)}, "XX'; choose from SW, SE, NE, NW"),
        ({"SW": 0}, "frequency.* got 0 Hz"),
        ({"SW": math.inf}, "frequency.* got inf Hz"),
        ({"SW": "110 Hz"}, "frequency.* got '110 Hz'"),
        ({"SW": [110, -1]}, "frequency.* got -1 Hz"),
        ({"SW": 39.9}, r"frequency of SW must be from 40 to 500 Hz, got 39.9 Hz; .*limits\.freq"),
        ({"SW": (110, 0.5, 90)}, r"got \(110, 0.5, 90\); .*era\.Drive\(110, 0.5, 90\)"),
        ({"SW": era.Tone(110, 1.00001e-4)}, "level of SW.*0.0001 m, got 1.0000[01]"),
        ({"SW": era.Tone(110, math.nan)}, "level of SW.*got nan"),
        ({"SE": 90, "SW": [era.Drive(110, 0.7), era.Drive(250, 0.6)]}, "level of SW.*got 1.29999"),
        (Layer({"SW": era.Tone(110, 1e-4)}).scaled(1), "level of SW.*got 1.122"),
    ],
)
def test_layers_of_refuses_an_invalid_drive(drives: Any, message: str) -> None:
    """Unknown ERAs, frequencies beyond the limits, more than full stroke of one ERA, a tuple."""
    with pytest.raises(era.InputError, match=message):
        layers_of(drives, RIG)


@pytest.mark.parametrize(
    ("level", "phase", "message"),
    [
        (1.000000002, 0, "level.* got 1.000000002"),
        (math.nan, 0, "level.* got nan"),
        (1, math.inf, "phase.* got inf"),
    ],
)
def test_drive_refuses_an_invalid_level_or_phase(level: float, phase: float, message: str) -> None:
    """Beyond full stroke, and not finite."""
    with pytest.raises(era.InputError, match=message):
        era.Drive(110, level=level, phase_deg=phase)


@pytest.mark.parametrize(
    "places",
    [(0.1, 0.2), [0.1, 0.2], [(0.1, 0.2)], np.array([0.1, 0.2]), np.array([[0.1, 0.2]])],
)
def test_as_points_reads_one_place(places: object) -> None:
    """One alone or in a list, as an array or not."""
    assert as_points(places, what="target") == ((0.1, 0.2),)


def test_as_points_reads_several_places_or_none() -> None:
    """A list of places keeps their order, and any empty one, an array too, is no place."""
    assert as_points([(0.1, 0.2), (0.3, 0.1)], what="quiet") == ((0.1, 0.2), (0.3, 0.1))
    for nothing in ((), [], np.empty((0, 2))):
        assert as_points(nothing, what="quiet") == ()


@pytest.mark.parametrize("places", [(0.1,), (0.1, 0.2, 0.3), "SW", [(0.1, 0.2), (0.3,)], 0.1, None])
def test_as_points_refuses_other_values(places: object) -> None:
    """The error names the argument."""
    with pytest.raises(era.InputError, match="target"):
        as_points(places, what="target")
