"""As many fingers as there may be, and answers that come too late: said, and never played."""

import asyncio
from collections.abc import Mapping
from itertools import pairwise

import pytest

from chain import Position
from controller.daemon.messages import PlateView
from controller.effects.effect import Region
from controller.effects.kinds import Buzz
from controller.effects.layout import SurfaceLayout
from controller.play.layer_contents import BEING_CHOSEN
from controller.play.selection import BLOCKED, GIVEN_UP
from drivers.protocol.definition import HEARTBEAT
from model.config.fields import Rectangle
from several_fingers import ABOVE, LAYOUT, LEFT, RIGHT, Fingers, answers_take, fingers_on, table
from virtual_lines import in_virtual_time


def said(fingers: Fingers) -> dict[int, str | None]:
    """What the status says of each finger that does not feel its own."""
    applied = fingers.applied[-1] if fingers.applied else None
    silenced = fingers.silenced[-1] if fingers.silenced else None
    if applied and silenced and silenced.time > applied.time:
        applied = None
    contacts = fingers.controller.cycle.tracker.contacts
    view = PlateView(lambda key: None, contacts, applied or silenced)
    return {each.id: each.held_back for each in view.contact_statuses()}


@in_virtual_time
async def test_an_answer_given_up_holds_up_nothing_and_is_never_played(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It takes 5 s: silent after one, at once asked anew for a finger that moves, and no sooner."""
    async with fingers_on(table(), LAYOUT, breaks="touch", at={1: LEFT}, held=0.3) as fingers:
        asked, began = answers_take(monkeypatch, 5.0, 0.02), asyncio.get_running_loop().time()
        fingers.at[2] = RIGHT
        await fingers.hold(0.9)
        assert said(fingers) == {1: None, 2: BEING_CHOSEN}
        await fingers.hold(0.6)
        assert said(fingers) == {1: GIVEN_UP, 2: GIVEN_UP}
        assert 1.0 <= fingers.silenced[-1].time - began <= 1.01
        assert fingers.levels() == {"main": (0.0,) * 4}
        assert len(asked) == 1
        fingers.at[2], count = (RIGHT[0] + 0.01, RIGHT[1]), len(fingers.applied)
        moved = asyncio.get_running_loop().time()
        await fingers.hold(0.4)
        assert fingers.applied[count].time - moved <= 0.035
        assert said(fingers) == {1: None, 2: None}
        before = len(asked), len(fingers.applied)
        await fingers.hold(5.0)
        assert (len(asked), len(fingers.applied)) == before


@in_virtual_time
async def test_answers_that_hang_are_bounded_and_that_is_said(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Two hang: with a third set of fingers none is begun until one of them has ended."""
    async with fingers_on(table(), LAYOUT, breaks="touch", at={1: LEFT}, held=0.3) as fingers:
        asked = answers_take(monkeypatch, 4.0, 4.0, 0.02)
        fingers.at[2] = RIGHT
        await fingers.hold(1.2)
        fingers.at[3] = ABOVE
        await fingers.hold(1.2)
        for number in range(1, 6):
            fingers.at[3] = (ABOVE[0] + 0.01 * number, ABOVE[1])
            await fingers.hold(0.1)
            assert said(fingers) == dict.fromkeys((1, 2, 3), BLOCKED)
        assert len(asked) == 2
        fingers.at = {1: LEFT}
        await fingers.hold(0.1)
        assert said(fingers) == {1: None}  # one finger needs no thread
        fingers.at[2] = RIGHT
        await fingers.hold(1.2)
        assert asked[2] - asked[0] == pytest.approx(4.0, abs=0.001)
        assert said(fingers) == {1: None, 2: None}


WHOLE = Region("all", Rectangle(0.0, 0.0, 0.31, 0.23), on_press="buzz")
ONE_REGION = SurfaceLayout((WHOLE,), {"buzz": Buzz(level=14.0)}, elsewhere=None)


def spread(count: int, *, above: int = 0) -> Mapping[int, Position]:
    """Fingers 4 cm apart or more, numbered from one on."""
    places = [(0.04 + 0.055 * (n % 5), 0.035 + 0.05 * (n // 5)) for n in range(count)]
    return {above + number: at for number, at in enumerate(places, start=1)}


@pytest.mark.parametrize("count", [10, 20])
@in_virtual_time
async def test_all_fingers_of_a_region_feel_its_effect(count: int) -> None:
    """In one layer of eight, within the time of an answer; a further one is refused and counted."""
    async with fingers_on(table(), ONE_REGION) as fingers:
        fingers.at = {**spread(count)}
        await fingers.hold(0.4)
        applied = fingers.applied[-1]
        assert {each.contact.key.id for each in applied.targets} == fingers.at.keys()
        assert {each.content for each in applied.targets} == {"buzz"}
        assert {each.verdict for each in applied.targets} <= {"own", "mixed", "shared"}
        assert len(applied.contents) == 1
        levels = fingers.levels_db_sl()
        assert levels.keys() == fingers.at.keys()
        assert min(levels.values()) > 5
        assert applied.targets[0].level_db_sl is not None
        if count == 20:
            fingers.must_be_felt = False
            fingers.at[21] = (0.15, 0.21)
            await fingers.hold(0.1)
            assert fingers.controller.cycle.rejects.counts["too_many"] >= 1
            assert len(fingers.applied[-1].contacts) == 20


@pytest.mark.parametrize("what", ["stop", "lift"])
@in_virtual_time
async def test_ten_moving_fingers_with_slow_answers_starve_nothing(
    what: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of 0.4 s each: heartbeats as ever, and silence as soon as at rest; nothing plays after it."""
    loop = asyncio.get_running_loop()
    async with fingers_on(table(), ONE_REGION, breaks="touch") as fingers:
        asked, rest = answers_take(monkeypatch, 0.4), spread(10)

        def move(since: float) -> None:
            fingers.at = {id: (x + 0.03 * since, y) for id, (x, y) in rest.items()}

        await fingers.hold(1.5, move)
        assert len(asked) >= 3
        assert fingers.applied
        feeding = fingers.far_end.times("Ping", "Set", "Commit")
        assert max(later - sooner for sooner, later in pairwise(feeding)) <= HEARTBEAT + 0.01
        begin, count = loop.time(), len(fingers.committed)
        if what == "stop":
            fingers.witness.operator_command(begin, "stop")
            stopped = await fingers.controller.stop()
            assert all(each.is_confirmed for each in stopped.values())
            assert loop.time() - begin < 0.02
        else:
            fingers.at = {}
            await fingers.hold(0.02)
            assert fingers.committed[count][2] == ()
            assert fingers.committed[count][0] - begin < 0.005
        await fingers.hold(1.0)
        assert fingers.levels() == {"main": (0.0,) * 4}
        assert len(fingers.committed) <= count + 1


@in_virtual_time
async def test_a_thread_that_cannot_start_is_asked_for_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Where the system has no thread left all is silent, and felt again once there is one."""
    async with fingers_on(table(), LAYOUT, breaks="touch", at={1: LEFT}, held=0.3) as fingers:

        def exhausted(*_: object) -> None:
            raise RuntimeError("can't start new thread")

        with monkeypatch.context() as patch:
            patch.setattr(type(asyncio.get_running_loop()), "run_in_executor", exhausted)
            fingers.at[2] = RIGHT
            await fingers.hold(0.3)
            assert fingers.levels() == {"main": (0.0,) * 4}
        await fingers.hold(0.4)
        assert said(fingers) == {1: None, 2: None}
