"""The dial: detents in angle about the centre of a region."""

import math
from collections.abc import Sequence

import pytest

from controller.effects.effect import EffectStimulus, NoStimulus, Region
from controller.effects.kinds import Click, Dial
from controller.effects.layout import SurfaceLayout
from controller.effects.player import EffectPlayer
from controller.sources.touch import Contact, ContactKey
from model.config.fields import Circle, Polygon, Rectangle

CENTRE = (0.2, 0.1)
KNOB = Region("knob", Circle(*CENTRE, 0.05), on_move="dial")


def at(degrees: float, *, radius: float = 0.03) -> Contact:
    """A finger at an angle about the centre."""
    turn = math.radians(degrees)
    x, y = CENTRE[0] + radius * math.cos(turn), CENTRE[1] + radius * math.sin(turn)
    return Contact(ContactKey("panel", 1), x, y, since=0.0)


def clicks(way: Sequence[Contact], *, spacing: float) -> list[int]:
    """At which steps of a way, a second apart, a click starts."""
    run = Dial(spacing=spacing).start_in(KNOB, way[0], 0.0, level_db_sl=20.0)
    felt = [run.feel(contact, float(step)) for step, contact in enumerate(way)]
    assert all(isinstance(each, EffectStimulus | NoStimulus) for each in felt)
    return [step for step, each in enumerate(felt) if isinstance(each, EffectStimulus)]


@pytest.mark.parametrize("sense", [1, -1])
def test_dial_clicks_at_every_detent_of_two_turns(sense: int) -> None:
    """Detents lie at 10, 30, 50 ... degrees from where the finger came down, either way round."""
    way = [at(150.0 + sense * degrees) for degrees in range(0, 721, 4)]
    passed = [4 * step for step in clicks(way, spacing=math.radians(20))]
    expected = [4 * math.ceil((10 + 20 * number + 1.2) / 4) for number in range(36)]
    assert passed == expected


def test_dial_ignores_the_radius_and_noise_around_a_detent() -> None:
    """A finger that moves out and in feels nothing, nor one that trembles at a detent."""
    way = [at(0, radius=radius) for radius in (0.03, 0.04, 0.02, 0.01)]
    assert clicks(way, spacing=math.radians(20)) == []
    way = [at(0), *(at(10 + degrees) for degrees in (2, -1, 1, -1, 1))]
    assert clicks(way, spacing=math.radians(20)) == [1]


def test_dial_turns_nothing_near_its_centre() -> None:
    """Across the centre the angle jumps by half a turn; then it goes on from there."""
    way = [at(0), at(0, radius=0.003), at(180, radius=0.003), at(180), at(185), at(195)]
    assert clicks(way, spacing=math.radians(20)) == [5]


def test_player_gives_a_dial_the_centre_of_its_region() -> None:
    """A quarter of a turn about that centre is nine detents of 10 degrees; elsewhere nothing."""
    layout = SurfaceLayout((KNOB,), {"dial": Dial(spacing=math.radians(10))}, elsewhere=None)
    player = EffectPlayer(layout)
    player.intent([at(0)], 0.0)
    starts = {
        target.pulse.requested_at
        for step in range(1, 91)
        for target in player.intent([at(step)], 0.1 * step).targets
        if target.pulse is not None
    }
    assert len(starts) == 9


def test_centres_of_shapes() -> None:
    """By hand: of a rectangle, and of an L of three unit squares at (5/6, 5/6)."""
    assert Rectangle(1.0, 2.0, 4.0, 2.0).centre == (3.0, 3.0)
    corners = ((0.0, 0.0), (2.0, 0.0), (2.0, 1.0), (1.0, 1.0), (1.0, 2.0), (0.0, 2.0))
    for points in (corners, corners[::-1]):
        assert Polygon(points).centre == pytest.approx((5 / 6, 5 / 6))


def test_region_fixes_the_frequency_of_its_effects() -> None:
    """Its band replaces that of an effect, which holds elsewhere; none leaves it free."""
    effects = {"low": Click(band=(60.0, 90.0)), "free": Click(), "tone": Click(frequency=130.0)}
    regions = (
        Region("tuned", Rectangle(0.0, 0.0, 0.05, 0.1), on_press="low", band=(200.0, 250.0)),
        Region("own", Rectangle(0.06, 0.0, 0.05, 0.1), on_press="low"),
        Region("free", Rectangle(0.12, 0.0, 0.05, 0.1), on_press="free"),
        Region("tone", Rectangle(0.18, 0.0, 0.05, 0.1), on_press="tone"),
    )
    layout = SurfaceLayout(regions, effects, elsewhere=None)
    bands = []
    for number, x in enumerate((0.03, 0.08, 0.14, 0.2)):
        contact = Contact(ContactKey("panel", number), x, 0.05, since=0.0)
        (target,) = EffectPlayer(layout).intent([contact], 0.0).targets
        bands.append(target.band)
    assert bands == [(200.0, 250.0), (60.0, 90.0), None, (130.0, 130.0)]
