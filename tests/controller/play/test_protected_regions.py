"""What reaches fingers that it is not for: regions where others are not noticed, and leaks."""

import math
from dataclasses import replace

import pytest

from controller.daemon.messages import PlateView
from controller.effects.effect import Region
from controller.effects.kinds import Buzz, Click
from controller.effects.layout import SurfaceLayout
from controller.sources.touch import Contact, ContactKey
from model.config.fields import Rectangle
from several_fingers import ABOVE, LEFT, RIGHT, Fingers, fingers_on, table
from virtual_lines import in_virtual_time

UPPER = Rectangle(0.0, 0.13, 0.3, 0.09)
LAYOUT = SurfaceLayout(
    (
        Region("left", Rectangle(0.0, 0.0, 0.15, 0.12), on_press="left"),
        Region("right", Rectangle(0.16, 0.0, 0.14, 0.12), on_press="right"),
        Region("above", UPPER, is_protected=True),
    ),
    {"left": Buzz(level=16.0), "right": Buzz(level=14.0), "above": Buzz(level=14.0)},
    elsewhere=None,
)

SHARED = SurfaceLayout(
    (
        Region("left", Rectangle(0.0, 0.0, 0.15, 0.12), on_press="left", may_share=True),
        Region("right", Rectangle(0.15, 0.0, 0.15, 0.12), "right", may_share=True, priority=1),
    ),
    {**LAYOUT.effects, "tick": Click(level=14.0)},
    elsewhere=None,
)
AT_ONE_CONTENT = {1: (0.138, 0.06), 2: (0.165, 0.06)}


@in_virtual_time
async def test_nothing_plays_that_a_protected_finger_would_notice() -> None:
    """Both contents are silent while it rests, each with its reason, and play once it has lifted.

    16 dB SL would need 26 dB of contrast there, of which four ERAs promise fewer than 20.
    """
    async with fingers_on(
        table(), LAYOUT, breaks="touch", at={1: LEFT, 2: RIGHT, 3: ABOVE}, held=0.6
    ) as fingers:
        assert fingers.levels_db_sl()[3] < -10
        silenced = fingers.silenced[-1]
        assert {each.contact.key.id for each in silenced.targets} == {1, 2}
        view = PlateView(lambda key: "effect", silenced.contacts, silenced)
        for status in view.contact_statuses():
            assert (status.verdict == "held back") is (status.id != 3)
            assert ("protected" in (status.held_back or "")) is (status.id != 3)
        del fingers.at[3]
        await fingers.hold(1.0)
        assert {each.contact.key.id for each in fingers.applied[-1].targets} == {1, 2}
        assert fingers.levels_db_sl()[1] > 14
        fingers.at[3] = ABOVE
        await fingers.hold(1.0)
        assert fingers.levels_db_sl()[3] < -10


@pytest.mark.parametrize(
    ("effect", "is_played"),
    [(Buzz(level=0.5), True), (Buzz(level=12.0), False), (Click(level=20.0), False)],
)
@in_virtual_time
async def test_one_content_beside_a_protected_finger(effect: Buzz | Click, is_played: bool) -> None:
    """Played if at most -10 dB SL reach that finger, of a click over its duration; else silent."""
    layout = replace(LAYOUT, effects={**LAYOUT.effects, "left": effect})
    async with fingers_on(table(), layout, breaks="touch", at={3: ABOVE}, held=0.2) as fingers:
        fingers.at[1] = LEFT
        await fingers.hold(1.0)
        assert bool(fingers.applied) is is_played
        assert fingers.levels_db_sl()[3] < -10
        if is_played:
            (applied,) = fingers.applied
            ((quiet,),) = applied.quiet_levels.values()
            assert fingers.levels_db_sl()[3] < quiet < -10


@in_virtual_time
async def test_a_protected_finger_feels_its_own_effect() -> None:
    """That of the others is held back for it, whatever their priorities."""
    above = Region("above", UPPER, on_press="above", is_protected=True, priority=0)
    left = replace(LAYOUT.regions[0], priority=5)
    async with fingers_on(
        table(), replace(LAYOUT, regions=(left, above)), at={1: LEFT, 3: ABOVE}, held=1.0
    ) as fingers:
        verdicts = {each.contact.key.id: each.verdict for each in fingers.applied[-1].targets}
        assert verdicts == {1: "held back", 3: "own"}
        assert fingers.levels_db_sl()[3] > 12


@in_virtual_time
async def test_a_region_with_its_own_is_never_mixed() -> None:
    """Of three fingers on four ERAs one is mixed; where it wants its own, another gives way."""
    third = Region("above", UPPER, on_press="above", priority=1)
    for is_own in (False, True):
        regions = (*LAYOUT.regions[:2], replace(third, is_own=is_own))
        async with fingers_on(
            table(), replace(LAYOUT, regions=regions), at={1: LEFT, 2: RIGHT, 3: ABOVE}, held=1.0
        ) as fingers:
            targets = fingers.applied[-1].targets
            verdicts = {each.contact.key.id: each.verdict for each in targets}
            assert ("held back" in verdicts.values()) is is_own
            if is_own:
                assert verdicts[3] == "own"
                assert all(level > 12 for level in fingers.contrasts().values())


@in_virtual_time
async def test_fingers_that_may_share_say_whose_content_they_feel() -> None:
    """Two near fingers of different effects: one vibration, of the name of the higher priority."""
    regions = (
        Region("left", Rectangle(0.0, 0.0, 0.15, 0.12), on_press="left", may_share=True),
        Region("right", Rectangle(0.15, 0.0, 0.15, 0.12), "right", may_share=True, priority=1),
    )
    async with fingers_on(
        table(), replace(LAYOUT, regions=regions), at={1: (0.138, 0.06), 2: (0.165, 0.06)}, held=1.0
    ) as fingers:
        applied = fingers.applied[-1]
        view = PlateView(lambda key: ("", "left", "right")[key.id], applied.contacts, applied)
        first, second = view.contact_statuses()
        assert (first.verdict, first.effect, first.feels) == ("shared", "left", "right")
        assert (second.effect, second.feels) == ("right", "right")
        assert first.frequency_hz == second.frequency_hz


@in_virtual_time
async def test_who_shares_the_content_of_a_finger_feels_it_through_a_click_of_that() -> None:
    """The click has a layer of its own, and each finger is told once what it feels."""
    async with fingers_on(table(), SHARED, at=AT_ONE_CONTENT, held=1.0) as fingers:
        ((shared, one),) = fingers.applied[-1].contents.items()
        owner, other = (contact for contact, _ in one.content.targets)
        count, sent = len(fingers.applied), len(fingers.committed)
        fingers.play("tick", owner.key.id)
        await fingers.hold(0.3)
        sets = [one for _, _, layers in fingers.committed[sent:] for one in layers]
        assert {one.layer for one in sets if not one.renew} == {1 - shared}
        clicked, ended = fingers.applied[count:]
        assert clicked.contents[shared].content == ended.contents[shared].content == one.content
        for applied in (clicked, ended):
            assert sorted(each.contact.key for each in applied.targets) == sorted(
                [owner.key, other.key]
            )
        assert {each.contact.key: each.verdict for each in clicked.targets}[owner.key] == "mixed"


@in_virtual_time
async def test_a_click_that_is_refused_leaves_what_others_share() -> None:
    """Of the finger whose content it is: only the click is left out."""
    async with fingers_on(table(), SHARED, at=AT_ONE_CONTENT, held=1.0) as fingers:
        ((shared, one),) = fingers.applied[-1].contents.items()
        sent = len(fingers.committed)
        fingers.refuse(
            "too much power",
            lambda layers: any(t.level for each in layers if not each.renew for t in each.tones),
        )
        fingers.play("tick", one.content.targets[0][0].key.id)
        await fingers.hold(0.1)
        assert {n: each.content for n, each in fingers.applied[-1].contents.items()} == {
            shared: one.content
        }
        assert not fingers.silenced
        sets = [each for _, _, layers in fingers.committed[sent:] for each in layers]
        assert shared not in {each.layer for each in sets if not each.renew}


LEAKING = SurfaceLayout(
    (
        Region("left", Rectangle(0.0, 0.0, 0.15, 0.12), on_press="left"),
        Region("right", Rectangle(0.16, 0.0, 0.14, 0.12), on_press="right"),
    ),
    {"left": Buzz(level=14.0), "right": Buzz(level=14.0)},
    elsewhere=None,
)


def statuses(fingers: Fingers) -> dict[int, float]:
    """What the status says that leaks to each finger [dB SL]."""
    contacts = tuple(
        Contact(ContactKey("panel", id), *at, since=0.0) for id, at in fingers.at.items()
    )
    view = PlateView(lambda key: None, contacts, fingers.applied[-1])
    found = {each.id: each.leak_db_sl for each in view.statuses_now(table())}
    return {id: -math.inf if level is None else level for id, level in found.items()}


@in_virtual_time
async def test_status_says_what_leaks_to_a_finger_that_has_moved() -> None:
    """Slowly, by less than 8 mm, no weights change: within a decibel of what is measured there."""
    async with fingers_on(table(), LEAKING, at={1: LEFT, 2: RIGHT, 3: ABOVE}, held=1.2) as fingers:
        rested = statuses(fingers)
        assert rested == pytest.approx(fingers.levels_db_sl(foreign=True), abs=1.0)
        count = len(fingers.applied)

        def move(since: float) -> None:
            way = min(0.02 * since, 0.0055)
            fingers.at[3] = (ABOVE[0] + way, ABOVE[1] - way)

        await fingers.hold(1.5, move)
        assert len(fingers.applied) == count
        moved = statuses(fingers)
        assert moved == pytest.approx(fingers.levels_db_sl(foreign=True), abs=1.0)
        assert moved[3] > rested[3]


@in_virtual_time
async def test_weights_follow_a_finger_at_half_a_metre_a_second() -> None:
    """10 cm in 0.2 s: several answers on the way, after which as little leaks as before."""
    async with fingers_on(table(), LEAKING, at={1: LEFT, 2: RIGHT, 3: ABOVE}, held=1.0) as fingers:
        rested, count = statuses(fingers)[3], len(fingers.applied)
        on_the_way = []

        def way(since: float) -> None:
            on_the_way.append(statuses(fingers)[3])
            fingers.at[3] = (ABOVE[0] + 0.5 * since, ABOVE[1])

        await fingers.hold(0.2, way)
        changes = [each.time for each in fingers.applied[count:]]
        assert 4 <= len(changes) <= 0.2 / 0.017 + 1
        await fingers.hold(1.0)
        assert statuses(fingers)[3] == pytest.approx(fingers.levels_db_sl(foreign=True)[3], abs=1.0)
        assert max(on_the_way) > rested
        assert statuses(fingers)[3] < max(on_the_way)


@in_virtual_time
async def test_nothing_leaks_without_fingers() -> None:
    """The status is read when the last has lifted and its silence is not confirmed yet."""
    async with fingers_on(table(), LEAKING, at={1: LEFT}, held=0.3) as fingers:
        view = PlateView(lambda key: None, (), fingers.applied[-1])
        assert view.statuses_now(table()) == []
