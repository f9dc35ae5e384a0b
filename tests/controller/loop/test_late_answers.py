"""Answers that come too late: given up, said at every finger, and never played."""

import asyncio

import pytest

from controller.daemon.api_views import PlateView
from controller.loop.content import BEING_CHOSEN
from controller.loop.selection import BLOCKED, GIVEN_UP
from several_fingers import ABOVE, LAYOUT, LEFT, RIGHT, Fingers, answers_take, fingers_on, table
from virtual_loop import in_virtual_time


def said(fingers: Fingers) -> dict[int, str | None]:
    """What the status says of each finger that does not feel its own."""
    applied = fingers.applied[-1] if fingers.applied else None
    silenced = fingers.silenced[-1] if fingers.silenced else None
    if applied and silenced and silenced.time > applied.time:
        applied = None
    contacts = fingers.controller._tracker.contacts
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
async def test_fingers_that_rest_are_asked_for_again_once_a_late_answer_has_ended(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A machine that stalled for 1.5 s: felt after it, for the fingers as they are by then."""
    async with fingers_on(table(), LAYOUT, breaks="touch", at={1: LEFT}, held=0.3) as fingers:
        asked = answers_take(monkeypatch, 1.5, 0.02)
        fingers.at[2] = RIGHT
        await fingers.hold(1.7)
        assert asked[1] - asked[0] == pytest.approx(1.5, abs=0.001)
        assert said(fingers) == {1: None, 2: None}
        assert fingers.applied[-1].time - asked[1] <= 0.035


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
