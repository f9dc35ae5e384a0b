"""From an excitation to drive commands."""

import math

import pytest

from controller.loop.routing import route, tones_by_era
from drivers.contents import Layer
from drivers.contents import Tone as Played
from drivers.protocol.sets import Command, LayerSet
from model.errors import InputError
from model.fem.mesh import Mesh
from model.rig.rig import Channel, Rig
from model.structure.attachments import Era
from model.structure.plate import Material, Plate
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
    layers = route(
        {"SW": Tone(110.0, 20e-6, math.pi / 2), "SE": Tone(250.0, 20e-6)}, RIG, ramp=0.02
    )
    played = Played(1, 110.0, pytest.approx(0.2), pytest.approx(90.0))
    silent = Played(0, 40.0, 0.0, skip_ending=True)
    assert layers == {
        "left": Layer(0, (played, silent), ramp=0.02),
        "right": Layer(0, (Played(0, 250.0, pytest.approx(0.4)),), ramp=0.02),
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
    command = route({"SE": Tone(100.0, 1e-6, radians)}, RIG, ramp=0)["right"].tones[0]
    assert command.phase == pytest.approx(degrees)
    assert -180 < command.phase <= 180


def test_route_applies_no_limits() -> None:
    """More than full stroke and NaN reach the ledger unchanged."""
    over = route({"SE": Tone(1e9, 1e-4, math.nan)}, RIG, ramp=0)["right"].tones[0]
    assert over.frequency == 1e9
    assert over.level == pytest.approx(2.0)
    assert math.isnan(over.phase)


def test_route_refuses_an_unknown_era() -> None:
    """A pattern of another rig is refused as a whole."""
    with pytest.raises(InputError, match="got NW"):
        route({"SW": Tone(100.0, 1e-6), "NW": Tone(100.0, 1e-6)}, RIG, ramp=0)


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
    playing = {name: Played(0, 110.0, 0.5) for name in ("SW", "SE")}
    layers = route(wanted, RIG, ramp=0, playing=playing)
    assert {
        name
        for name, channel in RIG.wiring.items()
        for tone in layers[channel.amplifier].tones
        if tone.channel == channel.number and tone.keep_phase
    } == kept
    first = route(wanted, RIG, ramp=0)
    assert not any(tone.keep_phase for each in first.values() for tone in each.tones)


def test_drive_of_eras_by_hand() -> None:
    """What each ERA plays, without silent ones."""
    achieved = {
        "left": [LayerSet(0, 20, 0, (Command(0, 800, 0, 0), Command(1, 2201, 1999, -9000)))],
        "right": [LayerSet(0, 20, 0, (Command(0, 5000, 4000, 0),))],
    }
    assert tones_by_era(achieved, RIG) == {
        "SW": Played(1, 110.05, 0.1999, -90.0),
        "SE": Played(0, 250.0, 0.4),
    }
