"""From an excitation to drive commands."""

import math

import pytest

from controller.loop.routing import commands_by_era, route
from drivers.command import CommandSet, DriveCommand
from drivers.protocol.messages import Achieved
from model.errors import InputError
from model.fem.mesh import Mesh
from model.rig.rig import Channel, Rig
from model.structure.actuator import Era
from model.structure.material import Material
from model.structure.plate import Plate
from model.vibration.excitation import Excitation, Tone
from registry.limits import GuardLimits

PLATE = Plate(0.3, 0.2, 0.0015, Material("aluminium", 70e9, 2700.0, 0.33))
RIG = Rig(
    plate=PLATE,
    mesh=Mesh(4, 4, 0.3, 0.2),
    eras=tuple(
        Era(name, x, y, 17_000.0, 1.0, 0.0, stroke)
        for name, x, y, stroke in (
            ("SW", 0.0, 0.0, 100e-6),
            ("SE", 0.3, 0.0, 50e-6),
            ("NE", 0.3, 0.2, 100e-6),
        )
    ),
    wiring={"SW": Channel("left", 1), "SE": Channel("right", 0), "NE": Channel("left", 0)},
    amplifiers={"left": "sim://", "right": "sim://"},
    limits=GuardLimits(40.0, 500.0, 1.0),
)


def test_route_by_hand() -> None:
    """20 of 100 µm is level 0.2, 20 of 50 is 0.4; pi/2 is 90°; other channels are silent."""
    sets = route(
        {"SW": Tone(110.0, 20e-6, math.pi / 2), "SE": Tone(250.0, 20e-6)}, RIG, token=7, ramp=0.02
    )
    assert sets == {
        "left": CommandSet(
            token=7,
            commands=(
                DriveCommand(channel=0, frequency=40.0, level=0.0, skip_ending=True),
                DriveCommand(
                    channel=1,
                    frequency=110.0,
                    level=pytest.approx(0.2),
                    phase=pytest.approx(90.0),
                ),
            ),
            ramp=0.02,
            valid_for=0.0,
        ),
        "right": CommandSet(
            token=7,
            commands=(DriveCommand(channel=0, frequency=250.0, level=pytest.approx(0.4)),),
            ramp=0.02,
            valid_for=0.0,
        ),
    }


@pytest.mark.parametrize(
    ("radians", "degrees"),
    [
        (0.0, 0.0),
        (math.pi, 180.0),
        (-math.pi, 180.0),
        (1.5 * math.pi, -90.0),
        (-1.5 * math.pi, 90.0),
        (5 * math.pi, 180.0),
        (20 * math.pi + 0.1, math.degrees(0.1)),
    ],
)
def test_route_wraps_phases(radians: float, degrees: float) -> None:
    """Phases lie above -180° and up to 180°."""
    command = route({"SE": Tone(100.0, 1e-6, radians)}, RIG, token=1, ramp=0)["right"].commands[0]
    assert command.phase == pytest.approx(degrees)
    assert -180 < command.phase <= 180


def test_route_applies_no_limits() -> None:
    """More than full stroke and NaN reach the guard unchanged."""
    over = route({"SE": Tone(1e9, 1e-4, math.nan)}, RIG, token=1, ramp=0)["right"].commands[0]
    assert over.frequency == 1e9
    assert over.level == pytest.approx(2.0)
    assert math.isnan(over.phase)


def test_route_refuses_an_unknown_era() -> None:
    """A pattern of another rig is refused as a whole."""
    with pytest.raises(InputError, match="got NW"):
        route({"SW": Tone(100.0, 1e-6), "NW": Tone(100.0, 1e-6)}, RIG, token=1, ramp=0)


@pytest.mark.parametrize(
    ("wanted", "kept"),
    [
        ({"SW": Tone(110.0, 5e-6), "SE": Tone(110.0, 9e-6)}, {"SW", "SE"}),
        ({"SW": Tone(110.0, 5e-6, 1.0), "SE": Tone(110.0, 9e-6)}, {"SW", "SE"}),
        ({"SE": Tone(110.0, 9e-6)}, {"SE"}),
        ({"SW": Tone(110.0, 5e-6), "SE": Tone(250.0, 9e-6)}, {"SW"}),
        ({"SW": Tone(110.0, 5e-6), "NE": Tone(110.0, 9e-6)}, set()),
        ({"SW": Tone(110.01, 5e-6), "SE": Tone(110.01, 9e-6)}, set()),
        ({"SW": Tone(250.0, 5e-6), "SE": Tone(250.0, 9e-6)}, set()),
    ],
)
def test_route_keeps_phase_only_if_all_eras_continue(wanted: Excitation, kept: set[str]) -> None:
    """A frequency restarts if an ERA joins it."""
    playing = {name: DriveCommand(0, 110.0, 0.5) for name in ("SW", "SE")}
    sets = route(wanted, RIG, token=1, ramp=0, playing=playing)
    drive = commands_by_era(sets, RIG)
    assert {name for name, command in drive.items() if command.keep_phase} == kept
    first = route(wanted, RIG, token=1, ramp=0)
    assert not any(command.keep_phase for each in first.values() for command in each.commands)


def test_drive_of_eras_by_hand() -> None:
    """What each ERA plays, without silent ones."""
    achieved = {
        "left": Achieved(7, (DriveCommand(0, 40.0, 0.0), DriveCommand(1, 110.01, 0.1999))),
        "right": Achieved(7, (DriveCommand(0, 250.0, 0.4),)),
    }
    assert commands_by_era(achieved, RIG) == {
        "SW": DriveCommand(1, 110.01, 0.1999),
        "SE": DriveCommand(0, 250.0, 0.4),
    }
