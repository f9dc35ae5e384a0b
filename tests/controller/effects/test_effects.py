"""Effects at a finger, regions, and priorities among several fingers."""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from types import EllipsisType

import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.daemon.messages import effects_result
from controller.effects.effect import Effect, EffectRun, EffectStimulus, NoStimulus, Region
from controller.effects.kinds import Buzz, Click, Detents, Ramp, Texture
from controller.effects.layout import SurfaceLayout
from controller.effects.player import EffectPlayer
from controller.sources.touch import Contact, ContactKey
from model.config.fields import Circle, Polygon, Rectangle


def finger(id: int, x: float = 0.05, y: float = 0.05, *, since: float = 0.0) -> Contact:
    """A contact of a source."""
    return Contact(ContactKey("panel", id), x, y, since)


LEFT = Rectangle(0.0, 0.0, 0.1, 0.2)
RIGHT = Rectangle(0.1001, 0.0, 0.1, 0.2)


@dataclass(frozen=True)
class At:
    """What fingers feel at a time [s]: levels [dB SL] by their ids.

    played: an effect that is requested by name before, and its finger; level: the requested one.
    until: when the intent expires, infinite for never, if it is looked at. starts: whether what is
    short starts to play. layouts: how often the layout is replaced by itself before. says: what
    is found in the reason for what is not felt.
    """

    now: float
    felt: Mapping[int, float | None]
    fingers: Sequence[Contact]
    played: tuple[str, Contact] | None = None
    level: float | None = None
    until: float | EllipsisType = ...
    starts: bool = True
    layouts: int = 0
    says: str = ""


def left(**effects: str) -> Region:
    """The left half of the plate."""
    return Region("left", LEFT, **effects)  # type: ignore[arg-type]


def right(on_press: str, *, priority: int = 0) -> Region:
    """The right half of the plate."""
    return Region("right", RIGHT, on_press=on_press, priority=priority)


ONE, TWO, THREE = finger(1, 0.05), finger(2, 0.15), finger(3, 0.16)
AGAIN = finger(1, since=1.98)
CLICK = {"click": Click(duration=0.04)}
ALERT: dict[str, Effect] = {"buzz": Buzz(), "alert": Click(duration=0.1)}
PRESSED = SurfaceLayout(effects={"click": Click(), "hum": Buzz(level=9.0)}, elsewhere="click")
DOTS: dict[str, Effect] = {"buzz": Buzz(level=10.0), "click": Click(), "dots": Detents()}
CLICKS_AND_DOTS = SurfaceLayout((left(on_press="click", on_move="dots"),), DOTS)


def new_layout(times: int) -> list[At]:
    """Fingers that are down when the layout is replaced, and some that come later."""
    return [
        At(0.0, {1: 20.0, 2: 10.0}, [ONE, TWO]),
        At(0.01, {1: 20.0, 2: 10.0}, [ONE, TWO], layouts=times),
        At(0.9, {2: 24.0}, [ONE, TWO], ("buzz", TWO), 24.0),
        At(1.0, {2: 24.0}, [ONE, TWO], layouts=times),
        At(1.1, {1: 20.0, 2: 24.0}, [finger(1, 0.056), TWO]),
        At(2.0, {}, []),
        At(3.0, {1: 20.0}, [ONE]),
        At(4.0, {1: 20.0}, [finger(1, 0.05, since=3.5)], layouts=1),  # not asked between
    ]


SCENARIOS: Mapping[str, tuple[SurfaceLayout, Sequence[At]]] = {
    # 40 ms from its start; the intent expires then, or after 0.1 s without a start.
    "a click ends after its duration": (
        SurfaceLayout(effects={"click": Click(level=18.0)}, elsewhere="click"),
        [
            At(10.0, {1: 18.0}, [ONE], until=10.1, starts=False),
            At(10.05, {1: 18.0}, [ONE]),
            At(10.06, {1: 18.0}, [ONE], until=10.09),
            At(10.089, {1: 18.0}, [ONE]),
            At(10.0901, {}, [ONE]),
            At(10.1, {}, [ONE], until=math.inf, says="click"),
            At(10.2, {2: 18.0}, [finger(2)], says="^(?!.*click)"),
        ],
    ),
    # With the same id, and no intent between: it is known by when it came down.
    "a finger that came down again feels its press again": (
        PRESSED,
        [
            At(0.0, {1: 20.0}, [finger(1)]),
            At(1.0, {}, [finger(1)]),
            At(2.0, {1: 20.0}, [AGAIN]),
            At(3.0, {}, [AGAIN]),
        ],
    ),
    "a finger that came down again feels what is requested": (
        PRESSED,
        [
            At(0.0, {1: 20.0}, [finger(1)]),
            At(1.0, {}, [finger(1)]),
            At(2.0, {1: 9.0}, [AGAIN], ("hum", AGAIN)),
            At(3.0, {1: 9.0}, [AGAIN]),
        ],
    ),
    # Without a duration it goes on; a new finger starts it again.
    "a buzz lasts while the finger stays": (
        SurfaceLayout(),
        [
            At(0.0, {1: 20.0}, [ONE]),
            At(100.0, {1: 20.0}, [ONE], until=math.inf),
            At(101.0, {}, []),
            At(102.0, {1: 20.0}, [ONE]),
        ],
    ),
    # Half a millimeter across it is noise and no crossing; a millimeter of way is.
    "a finger on an edge keeps its region": (
        SurfaceLayout(
            (left(on_press="tick"), right("tock")),
            {"tick": Click(level=10.0), "tock": Click(level=15.0)},
            elsewhere=None,
        ),
        [
            At(0.0, {1: 10.0}, [finger(1, 0.0999)]),
            *(At(0.1 * n, {}, [finger(1, 0.0999 + 0.0005 * (n % 2))]) for n in range(1, 20)),
            At(2.0, {1: 15.0}, [finger(1, 0.1009)]),
            *(At(2 + 0.1 * n, {}, [finger(1, 0.1009 - 0.0009 * (n % 2))]) for n in range(1, 20)),
        ],
    ),
    # It presses where it comes in, is released where it goes out, and lifts without a feeling.
    "a finger slides through regions": (
        SurfaceLayout(
            (left(on_press="soft", on_release="hard"), right("buzz")),
            {"soft": Click(level=10.0), "hard": Click(level=24.0), "buzz": Buzz(level=16.0)},
            elsewhere=None,
        ),
        [
            At(0.0, {1: 10.0}, [finger(1, 0.05)]),
            At(0.1, {}, [finger(1, 0.06)]),
            At(0.2, {1: 24.0}, [finger(1, 0.15)]),  # left's release, on right
            At(0.3, {1: 16.0}, [finger(1, 0.15)]),  # then right's own goes on
            At(0.4, {}, [finger(1, 0.25)]),
            At(0.5, {}, []),
        ],
    ),
    # Then the one before, also beside a finger that feels the effect of a region.
    "outside of all regions only the newest finger feels": (
        SurfaceLayout((right("click", priority=1),), {"buzz": Buzz(), "click": Click(level=12.0)}),
        [
            At(0.0, {1: 20.0}, [finger(1, 0.02)]),
            At(0.1, {2: 20.0}, [finger(1, 0.02), finger(2, 0.08)]),
            At(0.2, {2: 20.0, 3: 12.0}, [finger(1, 0.02), finger(2, 0.08), THREE]),
            At(0.25, {2: 20.0}, [finger(1, 0.02), finger(2, 0.08), THREE]),
            At(0.3, {1: 20.0}, [finger(1, 0.02), THREE]),
        ],
    ),
    # Of a detent of 30 ms, then the turn and the end of a click of 40 ms at another finger.
    "an intent expires at the first end": (
        SurfaceLayout(
            (left(on_move="dots"),), {"dots": Detents(duration=0.03), **CLICK}, elsewhere="click"
        ),
        [
            At(0.0, {}, [ONE]),
            At(1.0, {1: 20.0}, [finger(1, 0.056), TWO]),
            At(1.001, {1: 20.0}, [finger(1, 0.056), TWO], until=1.03),
            At(1.03, {}, [finger(1, 0.056), TWO], until=1.06),
            At(1.0601, {2: 20.0}, [finger(1, 0.056), TWO]),
            At(1.07, {2: 20.0}, [finger(1, 0.056), TWO], until=1.1001),
            At(1.1002, {}, [finger(1, 0.056), TWO], until=math.inf),
        ],
    ),
    # The second and the third wait, and play for their whole duration.
    "clicks of two fingers are 60 ms apart": (
        SurfaceLayout((left(on_press="click"), right("click")), CLICK, elsewhere=None),
        [
            At(1.0, {1: 20.0}, [ONE, TWO, THREE]),
            At(1.01, {1: 20.0}, [ONE, TWO, THREE], until=1.04),
            At(1.059, {}, [ONE, TWO, THREE]),
            At(1.0601, {2: 20.0}, [ONE, TWO, THREE]),
            At(1.0999, {2: 20.0}, [ONE, TWO, THREE]),
            At(1.1201, {3: 20.0}, [ONE, TWO, THREE]),
            At(1.1602, {}, [ONE, TWO, THREE]),
        ],
    ),
    # The first at 0 ms, the second at 10 and again at 15: once, at 60; the first waits again, but
    # lifts: the third is next.
    "a waiting click is replaced in its place": (
        SurfaceLayout(effects=CLICK, elsewhere=None),
        [
            At(0.0, {1: 20.0}, [ONE, TWO, THREE], ("click", ONE)),
            At(0.010, {1: 20.0}, [ONE, TWO, THREE], ("click", TWO)),
            At(0.015, {1: 20.0}, [ONE, TWO, THREE], ("click", TWO)),
            At(0.0601, {2: 20.0}, [ONE, TWO, THREE]),
            At(0.070, {2: 20.0}, [ONE, TWO, THREE], ("click", ONE)),
            At(0.080, {2: 20.0}, [TWO, THREE], ("click", THREE)),
            At(0.1201, {3: 20.0}, [TWO, THREE]),
        ],
    ),
    # A finger between detents of a region feels nothing, and leaves the others what they feel.
    "plays without a stimulus count for nothing": (
        SurfaceLayout((left(on_move="dots"),), {"dots": Detents(), "buzz": Buzz()}),
        [
            At(0.0, {1: 20.0}, [finger(1, 0.15), finger(2, 0.05)]),
            At(0.1, {1: 20.0, 2: 20.0}, [finger(1, 0.15), finger(2, 0.056)]),
            At(0.2, {1: 20.0}, [finger(1, 0.15), finger(2, 0.056)]),
        ],
    ),
    # At its level, until it ends.
    "what is requested comes before all regions": (
        SurfaceLayout(effects=ALERT),
        [
            At(0.0, {2: 20.0}, [finger(1), finger(2)]),
            At(0.05, {1: 24.0, 2: 20.0}, [finger(1), finger(2)], ("alert", finger(1)), 24.0),
            At(0.16, {2: 20.0}, [finger(1), finger(2)]),
        ],
    ),
    # What its place has for it begins all the same, and goes on when the other is over.
    "what is requested plays for a finger that is new": (
        SurfaceLayout(effects=ALERT),
        [At(0.0, {1: 12.0}, [ONE], ("alert", ONE), 12.0), At(0.2, {1: 20.0}, [ONE])],
    ),
    # It goes on through other regions, unlike what a region has for it.
    "what is requested ends with its finger": (
        SurfaceLayout(
            (left(on_press="hum"), Region("right", RIGHT)),
            {"hum": Buzz(level=9.0), "alert": Buzz(level=18.0)},
            elsewhere=None,
        ),
        [
            At(0.0, {1: 9.0}, [finger(1, 0.05)]),
            At(0.2, {1: 18.0}, [finger(1, 0.15)], ("alert", finger(1, 0.05))),
            At(3.0, {}, []),
            At(4.0, {1: 9.0}, [finger(1, 0.05, since=4.0)]),
        ],
    ),
    # A finger that is down feels what lasts and what moves by it, but no second click. One that
    # comes later feels all, also under the name of one that has lifted, be it unnoticed.
    "a new layout repeats no press": (CLICKS_AND_DOTS, new_layout(1)),
    "a layout that is replaced twice repeats no press": (CLICKS_AND_DOTS, new_layout(2)),
}


@pytest.mark.parametrize("name", SCENARIOS)
def test_fingers_feel_their_effects(name: str) -> None:
    """At every time of a scenario, in whose name it is said."""
    layout, steps = SCENARIOS[name]
    player = EffectPlayer(layout)
    for step in steps:
        for _ in range(step.layouts):
            player.replace(layout)
        if step.played is not None:
            player.play(*step.played, step.now, level_db_sl=step.level)
        intent = player.intent(step.fingers, step.now)
        assert {each.key.id: each.level_db_sl for each in intent.targets} == step.felt, step
        if step.until is not ...:
            assert intent.until == pytest.approx(step.until), step
        assert re.search(step.says, intent.reason), step
        for target in intent.targets if step.starts else ():
            if target.pulse is not None and target.pulse.started_at is None:
                target.pulse.started_at = step.now


def test_a_press_outlasts_its_layout_beside_an_older_finger() -> None:
    """The newest finger outside of all regions stays it, though the older one starts anew."""
    effects: dict[str, Effect] = {"press": Buzz(duration=1.0), "buzz": Buzz()}
    player = EffectPlayer(SurfaceLayout((), effects, "press"))
    fingers = [ONE, finger(2, since=0.5)]
    player.intent([ONE], 0.0)
    player.intent(fingers, 0.5)
    player.replace(SurfaceLayout((), effects, "buzz"))
    felt = [player.intent(fingers, at).targets for at in (1.2, 1.6)]
    assert [[(each.key.id, each.content) for each in one] for one in felt] == [
        [(2, "press")],
        [(2, "buzz")],
    ]


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
    """Over its duration; then it holds the last level, or as strong as the neighbors allow."""
    course = ramp.start(finger(1), 5.0, level_db_sl=level)
    felt = [course.feel(finger(1), 5.0 + step * number + 1e-9) for number in range(len(levels))]
    assert [getattr(one, "level_db_sl", None) for one in felt] == levels
    for one, number in zip(felt, range(1, len(levels)), strict=False):
        until = getattr(one, "until", None)
        assert until is None or until == pytest.approx(5.0 + step * number)
    last = EffectStimulus(level) if ramp.hold else None
    assert felt[-1] == last


def test_texture_level_follows_speed() -> None:
    """At `fast` the level, at the geometric mean of slow and fast half of the range less.

    At rest nothing, 80 ms after the last report from another place.
    """
    texture = Texture(slow=0.01, fast=0.16, range=16.0)
    for speed, level in ((0.16, 20.0), (0.5, 20.0), (0.04, 12.0), (0.0101, 4.0)):
        course = texture.start(finger(1, 0.0), 0.0, level_db_sl=20.0)
        for step in range(1, 20):
            felt = course.feel(finger(1, speed * 0.01 * step), 0.01 * step)
        assert isinstance(felt, EffectStimulus)
        assert felt.level_db_sl == level
        assert 0.08 <= felt.until - 0.18 <= 0.0901
        assert course.feel(finger(1, speed * 0.19), felt.until) == NoStimulus()
    course = texture.start(finger(1, 0.0), 0.0, level_db_sl=20.0)
    for step in range(1, 20):
        felt = course.feel(finger(1, 0.009 * 0.01 * step), 0.01 * step)
    assert isinstance(felt, NoStimulus)


def test_texture_starts_with_the_movement() -> None:
    """After a rest of seconds the first report elsewhere counts against the last 60 ms.

    3 mm within them are 5 cm/s, which is halfway between slow and fast along the logarithm.
    """
    course = Texture(slow=0.01, fast=0.25, range=16.0).start(finger(1, 0.0), 0, level_db_sl=20)
    course.feel(finger(1, 0.001), 0.01)
    assert course.feel(finger(1, 0.001), 0.2) == NoStimulus()
    felt = course.feel(finger(1, 0.004), 5.0)
    assert isinstance(felt, EffectStimulus)
    assert felt.level_db_sl == 12.0


def test_texture_level_has_hysteresis() -> None:
    """Speeds around the border of two levels, 1 dB from each, keep the one that was first."""
    course = Texture(slow=0.01, fast=0.1, range=20.0).start(finger(1, 0), 0, level_db_sl=20)
    levels, way = set(), 0.0
    for step in range(1, 60):
        # By turns 0.8 dB and 1.2 dB below `fast`: on both sides of the border at 1 dB.
        way += 0.01 * 0.1 * 10 ** -((0.8 if step // 10 % 2 else 1.2) / 20)
        felt = course.feel(finger(1, way), 0.01 * step)
        assert isinstance(felt, EffectStimulus)
        levels.add(felt.level_db_sl)
    assert len(levels) == 1


def test_detents_click_once_per_detent() -> None:
    """Detents lie at 5, 15, 25 mm from where the finger came down, 10 mm apart.

    Noise around one is no second click, and the way back clicks again.
    """
    course = Detents(spacing=0.010, along="y").start(finger(1, y=0.05), 0.0, level_db_sl=14.0)
    clicks = []
    for index, way in enumerate((1, 4, 5.3, 5.6, 5.2, 5.6, 14, 15.6, 30.6, 26, 24, 20)):
        now = 0.1 * index
        felt = course.feel(finger(1, x=0.9, y=0.05 + 1e-3 * way), now)
        if isinstance(felt, EffectStimulus):
            clicks.append(way)
            felt.pulse.started_at = now
            assert course.feel(finger(1, y=0.05 + 1e-3 * way), now + 0.031) == NoStimulus()
    assert clicks == [5.6, 15.6, 30.6, 24]


def test_every_finger_in_a_region_feels_its_own() -> None:
    """And outside of all regions the newest alone; each with its level, priority and content."""
    region = Region("left", LEFT, on_press="soft", on_move=None, priority=3)
    player = EffectPlayer(SurfaceLayout((region,), {"soft": Buzz(level=9.0), "buzz": Buzz()}))
    fingers = [finger(1, 0.15), finger(2, 0.05), finger(3, 0.16), finger(4, 0.06)]
    targets = player.intent(fingers, 0.0).targets
    assert [(each.key.id, each.level_db_sl, each.priority, each.content) for each in targets] == [
        (2, 9.0, 3, "soft"),
        (3, 20.0, 0, "buzz"),
        (4, 9.0, 3, "soft"),
    ]


def test_clicks_requested_faster_than_they_play_wait_for_two_turns_at_most() -> None:
    """Two fingers by turns, 50 a second each for 2 s: one click every 60 ms, each soon felt."""
    player = EffectPlayer(SurfaceLayout(effects={"click": Click(duration=0.04)}, elsewhere=None))
    fingers = [finger(1, 0.05), finger(2, 0.15)]
    starts: list[tuple[float, int]] = []
    for step in range(400):
        now = 0.005 * step
        if step % 2 == 0:
            player.play("click", fingers[step // 2 % 2], now, level_db_sl=None)
        for target in player.intent(fingers, now).targets:
            if target.pulse.started_at is None:
                target.pulse.started_at = now
                starts.append((now, target.key.id))
                assert now - target.pulse.requested_at <= 0.125
    assert [id for _, id in starts] == [1 + number % 2 for number in range(len(starts))]
    pauses = [after - before for (before, _), (after, _) in pairwise(starts)]
    assert all(0.06 - 1e-9 <= pause <= 0.07 for pause in pauses)
    assert len(starts) >= 28  # 2 s by 70 ms


def test_requested_effect_restarts_when_requested_again() -> None:
    """An effect without an end, requested a thousand times, runs once."""
    felt: list[float] = []

    class Endless(Buzz, EffectRun):
        """Never ends, and notes when it is felt."""

        def start(self, contact: Contact, now: float, *, level_db_sl: float | None) -> EffectRun:
            return self

        def feel(self, contact: Contact, now: float) -> EffectStimulus | NoStimulus | None:
            felt.append(now)
            return EffectStimulus(20.0)

    player = EffectPlayer(SurfaceLayout(effects={"hum": Endless()}, elsewhere=None))
    for number in range(1000):
        player.play("hum", finger(1), 0.001 * number, level_db_sl=None)
    player.intent([finger(1)], 2.0)
    assert felt == [2.0]


def test_a_click_is_felt_beside_what_lasts_at_its_finger() -> None:
    """6 dB above it where neither the layout nor who plays it gives a level; then alone again."""
    effects: dict[str, Effect] = {"buzz": Buzz(level=14), "click": Click(), "soft": Click(level=15)}
    player = EffectPlayer(SurfaceLayout((left(on_press="buzz"),), effects, elsewhere=None))
    for now, name, asked, level, above in (
        (0.0, "click", None, 20.0, 6.0),
        (1.0, "click", 18.0, 18.0, None),
        (2.0, "soft", None, 15.0, None),
    ):
        player.intent([ONE], now)
        player.play(name, ONE, now, level_db_sl=asked)
        lasting, short = player.intent([ONE], now).targets
        assert (lasting.content, lasting.level_db_sl) == ("buzz", 14.0)
        assert (short.content, short.level_db_sl, short.above_db) == (name, level, above)
        assert player.intent([ONE], now + 0.2).targets == (lasting,)


@given(
    steps=st.lists(
        st.tuples(
            st.floats(0, 0.2),
            st.dictionaries(
                st.integers(0, 3),
                st.tuples(st.floats(0, 0.2), st.floats(0, 0.2)),
                max_size=4,
            ),
        ),
        max_size=25,
    )
)
def test_player_invariants_for_any_movement(
    steps: list[tuple[float, dict[int, tuple[float, float]]]],
) -> None:
    """Only fingers that are there are targets, each once, and no intent ran out before.

    The same sequence gives the same intents.
    """
    regions = (
        Region("left", LEFT, on_press="click", on_move="texture", on_release="click"),
        Region("round", Circle(0.1, 0.1, 0.05), on_press="ramp", on_move="detents", priority=2),
    )
    effects: dict[str, Effect] = {
        "buzz": Buzz(),
        "click": Click(),
        "ramp": Ramp(),
        "texture": Texture(),
        "detents": Detents(),
    }
    players = [EffectPlayer(SurfaceLayout(regions, effects)) for _ in range(2)]
    now = 0.0
    for pause, places in steps:
        now += pause
        contacts = [finger(id, x, y) for id, (x, y) in places.items()]
        first, again = (player.intent(contacts, now) for player in players)
        assert first == again
        assert {target.key for target in first.targets} <= {each.key for each in contacts}
        felt = {(target.key, target.is_short) for target in first.targets}
        assert len(felt) == len(first.targets)
        assert first.until > now


@pytest.mark.parametrize(
    ("shape", "inside", "outside"),
    [
        (Rectangle(0.1, 0.2, 0.3, 0.1), [(0.1, 0.2), (0.4, 0.3), (0.2, 0.25)], [(0.41, 0.25)]),
        (Circle(0.1, 0.1, 0.05), [(0.15, 0.1), (0.13, 0.13)], [(0.14, 0.14)]),
        (
            # An L: its inner corner at (0.1, 0.1).
            Polygon(((0, 0), (0.2, 0), (0.2, 0.1), (0.1, 0.1), (0.1, 0.2), (0, 0.2))),
            [(0.05, 0.15), (0.15, 0.05), (0.1, 0.15), (0, 0), (0.1, 0.1)],
            [(0.15, 0.15), (0.101, 0.101), (-0.001, 0.1), (0.05, 0.2001)],
        ),
        (
            # A U: between its arms is outside, also on the line through their ends.
            Polygon(
                (
                    *((0, 0), (0.3, 0), (0.3, 0.2), (0.2, 0.2)),
                    *((0.2, 0.1), (0.1, 0.1), (0.1, 0.2), (0, 0.2)),
                )
            ),
            [(0.25, 0.2), (0.05, 0.05)],
            [(0.15, 0.2), (0.15, 0.15)],
        ),
    ],
)
def test_shapes(
    shape: Rectangle | Circle | Polygon,
    inside: list[tuple[float, float]],
    outside: list[tuple[float, float]],
) -> None:
    """Edges and corners belong to a shape."""
    assert [shape.contains(*point) for point in inside] == [True] * len(inside)
    assert [shape.contains(*point) for point in outside] == [False] * len(outside)


def test_effect_kinds_include_plug_ins() -> None:
    """Their parameters are described as JSON."""

    class Rhythm(Buzz):
        """Beats of one's own."""

        beats: tuple[float, ...] = (0.1, 0.2)
        count: int = 3

    listed = effects_result(SurfaceLayout(effects={"buzz": Buzz(), "rhythm": Rhythm()})).effects
    (_, rhythm) = (each.model_dump(mode="json") for each in listed)
    assert rhythm["description"] == "Beats of one's own."
    assert (rhythm["parameters"]["beats"], rhythm["parameters"]["count"]) == ([0.1, 0.2], 3)
