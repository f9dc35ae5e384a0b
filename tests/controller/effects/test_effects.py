"""Effects at a finger, regions, and priorities among several fingers."""

import math
from collections.abc import Mapping
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.daemon.messages import effects_result
from controller.effects.effect import Effect, EffectRun, EffectStimulus, NoStimulus, Region
from controller.effects.kinds import Buzz, Click, Detents, Ramp, Texture
from controller.effects.layout import SurfaceLayout
from controller.effects.player import EffectPlayer
from controller.play.intent import HapticIntent
from controller.sources.touch import Contact, ContactKey
from model.config.shapes import Circle, Polygon, Rectangle

LEFT = Rectangle(0.0, 0.0, 0.1, 0.2)
RIGHT = Rectangle(0.1001, 0.0, 0.1, 0.2)
CLICK = {"click": Click(duration=0.04)}


def finger(id: int, x: float = 0.05, y: float = 0.05, *, since: float = 0.0) -> Contact:
    """A contact of a panel."""
    return Contact(ContactKey("panel", id), x, y, since)


ON_LEFT = finger(1, 0.05)
ON_RIGHT = finger(2, 0.15)
ALSO_ON_RIGHT = finger(3, 0.16)


def left(**effects: str) -> Region:
    """The left half of the plate."""
    return Region("left", LEFT, **effects)  # type: ignore[arg-type]


def right(on_press: str, *, priority: int = 0) -> Region:
    """The right half of the plate."""
    return Region("right", RIGHT, on_press=on_press, priority=priority)


def layout_of(
    *regions: Region, effects: Mapping[str, Effect], elsewhere: str | None = None
) -> SurfaceLayout:
    """A layout of these regions and effects."""
    return SurfaceLayout(regions, dict(effects), elsewhere)


class Surface:
    """An effect player, and fingers on its layout."""

    def __init__(self, layout: SurfaceLayout) -> None:
        self.layout = layout
        self.player = EffectPlayer(layout)
        self.intent = HapticIntent(())
        """The last intent."""

    def feel(
        self, now: float, *fingers: Contact, starts_pulses: bool = True
    ) -> dict[int, float | None]:
        """The levels [dB SL] that fingers feel, by their ids; pulses start to play now."""
        self.intent = self.player.intent(fingers, now)
        for target in self.intent.targets:
            if starts_pulses and target.pulse is not None and target.pulse.started_at is None:
                target.pulse.started_at = now
        return {target.key.id: target.level_db_sl for target in self.intent.targets}

    def must_feel(self, now: float, expected: dict[int, float], *fingers: Contact) -> None:
        """Require the levels that fingers feel."""
        assert self.feel(now, *fingers) == expected

    def play(
        self, effect: str, contact: Contact, now: float, *, level: float | None = None
    ) -> None:
        """Request an effect at a finger."""
        self.player.play(effect, contact, now, level_db_sl=level)

    def replace(self, *, times: int) -> None:
        """Replace the layout by itself."""
        for _ in range(times):
            self.player.replace(self.layout)


def test_click_ends_after_its_duration() -> None:
    """It lasts 40 ms from its start, or 100 ms from its request without a start.

    Then the intent expires, and the reason names the click.
    """
    effects = {"click": Click(level=18.0)}
    surface = Surface(layout_of(effects=effects, elsewhere="click"))
    assert surface.feel(10.0, ON_LEFT, starts_pulses=False) == {1: 18.0}
    assert surface.intent.until == pytest.approx(10.1)
    surface.must_feel(10.05, {1: 18.0}, ON_LEFT)
    surface.must_feel(10.089, {1: 18.0}, ON_LEFT)
    assert surface.intent.until == pytest.approx(10.09)
    surface.must_feel(10.0901, {}, ON_LEFT)
    assert surface.intent.until == math.inf
    assert "click" in surface.intent.reason


def test_finger_on_an_edge_keeps_its_region() -> None:
    """Half a millimeter of noise is no crossing; a millimeter is."""
    effects = {"tick": Click(level=10.0), "tock": Click(level=15.0)}
    surface = Surface(layout_of(left(on_press="tick"), right("tock"), effects=effects))
    surface.must_feel(0.0, {1: 10.0}, finger(1, 0.0999))
    for number in range(1, 20):
        noise = 0.0005 * (number % 2)
        surface.must_feel(0.1 * number, {}, finger(1, 0.0999 + noise))
    surface.must_feel(2.0, {1: 15.0}, finger(1, 0.1009))
    for number in range(1, 20):
        noise = 0.0009 * (number % 2)
        surface.must_feel(2.0 + 0.1 * number, {}, finger(1, 0.1009 - noise))


def test_finger_that_slides_feels_presses_and_releases_of_regions() -> None:
    """It is pressed where it comes in and released where it goes out; a lift is not felt."""
    effects = {"soft": Click(level=10.0), "hard": Click(level=24.0), "buzz": Buzz(level=16.0)}
    surface = Surface(
        layout_of(left(on_press="soft", on_release="hard"), right("buzz"), effects=effects)
    )
    surface.must_feel(0.0, {1: 10.0}, finger(1, 0.05))
    surface.must_feel(0.1, {}, finger(1, 0.06))
    surface.must_feel(0.2, {1: 24.0}, finger(1, 0.15))  # the left region's release, on the right
    surface.must_feel(0.3, {1: 16.0}, finger(1, 0.15))
    surface.must_feel(0.4, {}, finger(1, 0.25))
    surface.must_feel(0.5, {})


def test_newest_finger_outside_of_all_regions_feels_the_effect_there() -> None:
    """When it lifts, the one before does; fingers in a region feel theirs meanwhile."""
    effects = {"buzz": Buzz(), "click": Click(level=12.0)}
    surface = Surface(layout_of(right("click", priority=1), effects=effects, elsewhere="buzz"))
    first, second = finger(1, 0.02), finger(2, 0.08)
    surface.must_feel(0.0, {1: 20.0}, first)
    surface.must_feel(0.1, {2: 20.0}, first, second)
    surface.must_feel(0.2, {2: 20.0, 3: 12.0}, first, second, ALSO_ON_RIGHT)
    surface.must_feel(0.3, {1: 20.0}, first, ALSO_ON_RIGHT)


def test_waiting_click_is_replaced_in_its_place() -> None:
    """The second is requested at 10 and 15 ms and plays once, at 60; the first waits, but lifts."""
    surface = Surface(layout_of(effects=CLICK))
    fingers = ON_LEFT, ON_RIGHT, ALSO_ON_RIGHT
    surface.play("click", ON_LEFT, 0.0)
    surface.must_feel(0.0, {1: 20.0}, *fingers)
    for now in (0.010, 0.015):
        surface.play("click", ON_RIGHT, now)
        surface.must_feel(now, {1: 20.0}, *fingers)
    surface.must_feel(0.0601, {2: 20.0}, *fingers)
    surface.play("click", ON_LEFT, 0.070)
    surface.feel(0.070, *fingers)
    surface.play("click", ALSO_ON_RIGHT, 0.080)
    surface.must_feel(0.080, {2: 20.0}, ON_RIGHT, ALSO_ON_RIGHT)
    surface.must_feel(0.1201, {3: 20.0}, ON_RIGHT, ALSO_ON_RIGHT)


def test_requested_effect_precedes_all_regions_until_it_ends() -> None:
    """It has the requested level, also at a new finger, whose own effect continues afterwards."""
    effects = {"buzz": Buzz(), "alert": Click(duration=0.1)}
    surface = Surface(layout_of(effects=effects, elsewhere="buzz"))
    surface.must_feel(0.0, {2: 20.0}, ON_LEFT, ON_RIGHT)
    surface.play("alert", ON_LEFT, 0.05, level=24.0)
    surface.must_feel(0.05, {1: 24.0, 2: 20.0}, ON_LEFT, ON_RIGHT)
    surface.must_feel(0.16, {2: 20.0}, ON_LEFT, ON_RIGHT)

    surface.play("alert", ALSO_ON_RIGHT, 1.0, level=12.0)
    surface.must_feel(1.0, {3: 12.0}, ALSO_ON_RIGHT)
    surface.must_feel(1.2, {3: 20.0}, ALSO_ON_RIGHT)


@pytest.mark.parametrize("times", [1, 2])
def test_new_layout_repeats_no_press(times: int) -> None:
    """A finger that is down feels continuous effects and detents, but no second click.

    A finger that comes later feels everything, also with the id of one that has lifted.
    """
    effects = {"buzz": Buzz(level=10.0), "click": Click(), "dots": Detents()}
    layout = layout_of(left(on_press="click", on_move="dots"), effects=effects, elsewhere="buzz")
    surface = Surface(layout)
    surface.must_feel(0.0, {1: 20.0, 2: 10.0}, ON_LEFT, ON_RIGHT)
    surface.replace(times=times)
    surface.must_feel(0.01, {1: 20.0, 2: 10.0}, ON_LEFT, ON_RIGHT)
    surface.play("buzz", ON_RIGHT, 0.9, level=24.0)
    surface.must_feel(0.9, {2: 24.0}, ON_LEFT, ON_RIGHT)
    surface.replace(times=times)
    surface.must_feel(1.0, {2: 24.0}, ON_LEFT, ON_RIGHT)
    surface.must_feel(1.1, {1: 20.0, 2: 24.0}, finger(1, 0.056), ON_RIGHT)
    surface.must_feel(2.0, {})
    surface.must_feel(3.0, {1: 20.0}, ON_LEFT)
    surface.replace(times=1)
    surface.must_feel(4.0, {1: 20.0}, finger(1, since=3.5))


@pytest.mark.parametrize(
    ("ramp", "level", "step", "levels"),
    [
        # From 6 to 20 dB in 2 dB steps are eight levels, each for an eighth of 0.8 s; then none.
        (Ramp(start_level=6.0, duration=0.8), 20.0, 0.1, [*range(6, 21, 2), None]),
        # 40 dB in 0.1 s would be twenty steps: five levels of 20 ms, the least that is felt.
        (Ramp(start_level=6.0, duration=0.1), 46.0, 0.02, [6.0, 16.0, 26.0, 36.0, 46.0, None]),
        (Ramp(start_level=8.0, duration=0.3, hold=True), 12.0, 0.1, [8.0, 10.0, 12.0, 12.0, 12.0]),
        (Ramp(start_level=6.0, duration=0.8, hold=True), None, 0.1, [*range(6, 19, 2), None]),
    ],
)
def test_ramp_rises_in_steps(
    ramp: Ramp, level: float | None, step: float, levels: list[float | None]
) -> None:
    """Afterwards it can hold the last level, or be as strong as its neighbors permit."""
    run = ramp.start(ON_LEFT, 5.0, level_db_sl=level)
    for number, expected in enumerate(levels):
        stimulus = run.feel(ON_LEFT, 5.0 + step * number + 1e-9)
        is_last = number == len(levels) - 1
        if is_last:
            assert stimulus == (EffectStimulus(level) if ramp.hold else None)
            continue
        assert isinstance(stimulus, EffectStimulus)
        assert stimulus.level_db_sl == expected, f"step {number}"
        if stimulus.until is not None:
            assert stimulus.until == pytest.approx(5.0 + step * (number + 1))


def slide(run: EffectRun, speed: float) -> tuple[object, float]:
    """What a finger feels at last that slides for 0.19 s at a speed [m/s], and where it is [m]."""
    stimulus = None
    for step in range(1, 20):
        way = 0.01 * speed * step
        stimulus = run.feel(finger(1, way), 0.01 * step)
    return stimulus, way


def texture_run(slow: float, fast: float, span: float) -> EffectRun:
    """A texture of 20 dB SL at the speed `fast`, from the edge of the plate on."""
    texture = Texture(slow=slow, fast=fast, range=span)
    return texture.start(finger(1, 0.0), 0.0, level_db_sl=20.0)


@pytest.mark.parametrize(
    ("speed", "level"), [(0.16, 20.0), (0.5, 20.0), (0.04, 12.0), (0.0101, 4.0)]
)
def test_texture_level_follows_speed(speed: float, level: float) -> None:
    """At the geometric mean of slow and fast, it is lower by half of the range.

    At rest there is nothing, 80 ms after the last report from another position.
    """
    run = texture_run(0.01, 0.16, 16.0)
    stimulus, way = slide(run, speed)
    assert isinstance(stimulus, EffectStimulus)
    assert stimulus.level_db_sl == level
    assert stimulus.until is not None
    assert 0.08 <= stimulus.until - 0.18 <= 0.0901
    assert run.feel(finger(1, way), stimulus.until) == NoStimulus()


def test_texture_starts_with_the_movement() -> None:
    """After a rest of seconds, the first report elsewhere counts over the last 60 ms.

    3 mm within them are 5 cm/s, which is halfway between slow and fast along the logarithm.
    """
    run = texture_run(0.01, 0.25, 16.0)
    run.feel(finger(1, 0.001), 0.01)
    assert run.feel(finger(1, 0.001), 0.2) == NoStimulus()
    stimulus = run.feel(finger(1, 0.004), 5.0)
    assert isinstance(stimulus, EffectStimulus)
    assert stimulus.level_db_sl == 12.0


def test_texture_level_has_hysteresis() -> None:
    """Speeds 0.8 and 1.2 dB below `fast`, on both sides of a border at 1 dB, keep one level."""
    run = texture_run(0.01, 0.1, 20.0)
    levels = set()
    way = 0.0
    for step in range(1, 60):
        attenuation = 0.8 if step // 10 % 2 else 1.2
        way += 0.01 * 0.1 * 10 ** (-attenuation / 20)
        stimulus = run.feel(finger(1, way), 0.01 * step)
        assert isinstance(stimulus, EffectStimulus)
        levels.add(stimulus.level_db_sl)
    assert len(levels) == 1


def test_detents_click_once_per_detent() -> None:
    """Detents lie at 5, 15, 25 mm from where the finger came down.

    Noise around one is no second click, and the way back clicks again.
    """
    run = Detents(spacing=0.010, along="y").start(finger(1, y=0.05), 0.0, level_db_sl=14.0)
    clicks = []
    for number, way in enumerate((1, 4, 5.3, 5.6, 5.2, 5.6, 14, 15.6, 30.6, 26, 24, 20)):
        now = 0.1 * number
        moved = finger(1, x=0.9, y=0.05 + 1e-3 * way)
        stimulus = run.feel(moved, now)
        if isinstance(stimulus, EffectStimulus):
            clicks.append(way)
            assert stimulus.pulse is not None
            stimulus.pulse.started_at = now
            assert run.feel(moved, now + 0.031) == NoStimulus()
    assert clicks == [5.6, 15.6, 30.6, 24]


def test_clicks_requested_faster_than_they_play_wait_for_two_turns_at_most() -> None:
    """Two fingers take turns, 50 requests per second each: one click every 60 to 70 ms."""
    surface = Surface(layout_of(effects=CLICK))
    fingers = [ON_LEFT, ON_RIGHT]
    starts: list[tuple[float, int]] = []
    for step in range(400):
        now = 0.005 * step
        if step % 2 == 0:
            surface.play("click", fingers[step // 2 % 2], now)
        surface.feel(now, *fingers)
        for target in surface.intent.targets:
            assert target.pulse is not None
            if target.pulse.started_at == now:
                starts.append((now, target.key.id))
                assert now - target.pulse.requested_at <= 0.125

    ids = [id for _, id in starts]
    assert ids == [1 + number % 2 for number in range(len(ids))]
    pauses = [later - sooner for (sooner, _), (later, _) in pairwise(starts)]
    assert min(pauses) >= 0.06 - 1e-9
    assert max(pauses) <= 0.07


POSITIONS = st.tuples(st.floats(0, 0.2), st.floats(0, 0.2))
FINGERS = st.dictionaries(st.integers(0, 3), POSITIONS, max_size=4)
MOVEMENTS = st.lists(st.tuples(st.floats(0, 0.2), FINGERS), max_size=25)


@given(MOVEMENTS)
def test_player_invariants_for_any_movement(
    movement: list[tuple[float, dict[int, tuple[float, float]]]],
) -> None:
    """Only present fingers are targets, each once, and no intent has already expired.

    The same sequence gives the same intents.
    """
    layout = layout_of(
        Region("left", LEFT, on_press="click", on_move="texture", on_release="click"),
        Region("round", Circle(0.1, 0.1, 0.05), on_press="ramp", on_move="detents", priority=2),
        effects={
            "buzz": Buzz(),
            "click": Click(),
            "ramp": Ramp(),
            "texture": Texture(),
            "detents": Detents(),
        },
        elsewhere="buzz",
    )
    player, second_player = EffectPlayer(layout), EffectPlayer(layout)
    now = 0.0
    for pause, positions in movement:
        now += pause
        contacts = [finger(id, x, y) for id, (x, y) in positions.items()]
        intent = player.intent(contacts, now)
        assert second_player.intent(contacts, now) == intent
        targets = [(target.key.id, target.is_short) for target in intent.targets]
        assert {id for id, _ in targets} <= positions.keys()
        assert len({*targets}) == len(targets)
        assert intent.until > now


L_SHAPE = Polygon(((0, 0), (0.2, 0), (0.2, 0.1), (0.1, 0.1), (0.1, 0.2), (0, 0.2)))
"""Its inner corner is at (0.1, 0.1)."""
OUTER_CORNERS = ((0, 0), (0.3, 0), (0.3, 0.2), (0.2, 0.2))
INNER_CORNERS = ((0.2, 0.1), (0.1, 0.1), (0.1, 0.2), (0, 0.2))
U_SHAPE = Polygon((*OUTER_CORNERS, *INNER_CORNERS))
"""Between its arms is outside, also on the line through their ends."""


@pytest.mark.parametrize(
    ("shape", "inside", "outside"),
    [
        (Rectangle(0.1, 0.2, 0.3, 0.1), [(0.1, 0.2), (0.4, 0.3), (0.2, 0.25)], [(0.41, 0.25)]),
        (Circle(0.1, 0.1, 0.05), [(0.15, 0.1), (0.13, 0.13)], [(0.14, 0.14)]),
        (L_SHAPE, [(0.05, 0.15), (0.1, 0.15), (0.1, 0.1)], [(0.15, 0.15), (-0.001, 0.1)]),
        (U_SHAPE, [(0.25, 0.2), (0.05, 0.05)], [(0.15, 0.2), (0.15, 0.15)]),
    ],
)
def test_edges_and_corners_belong_to_a_shape(
    shape: Rectangle | Circle | Polygon,
    inside: list[tuple[float, float]],
    outside: list[tuple[float, float]],
) -> None:
    """Points within and outside of each kind of shape."""
    for point in inside:
        assert shape.contains(*point), point
    for point in outside:
        assert not shape.contains(*point), point


class Rhythm(Buzz):
    """Beats of one's own."""

    beats: tuple[float, ...] = (0.1, 0.2)
    count: int = 3


def test_listed_effects_describe_the_parameters_of_plug_ins() -> None:
    """As JSON."""
    effects = effects_result(layout_of(effects={"rhythm": Rhythm()})).effects
    (rhythm,) = [effect.model_dump(mode="json") for effect in effects]
    assert rhythm["description"] == "Beats of one's own."
    assert rhythm["parameters"]["beats"] == [0.1, 0.2]
    assert rhythm["parameters"]["count"] == 3
