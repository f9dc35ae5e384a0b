"""Vibrations that end by themselves unless their contacts are confirmed, in virtual time."""

import asyncio
import math
from itertools import pairwise

import pytest

from controller.loop.decision import ENDED
from controller.sources.contacts import Change, ContactTracker
from controller.sources.touch import Touch, TouchFrame
from controller_bench import FINGER, Bench, Sent, running
from virtual_loop import in_virtual_time

PROMISED = 0.001  # s; rounding of times


def vibrations(bench: Bench) -> list[tuple[float, Sent]]:
    """When each set that vibrates was sent [s], and the set."""
    return [(each.time, each) for each in bench.far_end.sets() if not each.is_silent]


def frame(*touches: Touch, timeout: float) -> TouchFrame:
    """A frame of a source that is silent while fingers rest."""
    return TouchFrame("panel", asyncio.get_running_loop().time(), touches, timeout)


@in_virtual_time
async def test_vibration_is_renewed_while_its_contact_is_confirmed() -> None:
    """It lasts two seconds, and before its end its time begins anew, without any command.

    No other pattern is reported.
    """
    async with running() as bench:
        await bench.hold(FINGER, seconds=10.0)
        sent = vibrations(bench)
        (first, *later) = [each for _, each in sent]
        assert 9 <= len(later) <= 10
        assert {each.valid_for for _, each in sent} == {2.0}
        assert not first.renew
        for each in later:
            assert each.renew
            assert each.token not in (first.token, 0)
            assert each.commands == ()
        assert max(b - a for (a, _), (b, _) in pairwise(sent)) < 1.1
        assert len(bench.reports.applied) == 1
        await asyncio.sleep(0.2)
        assert bench.silences()[-1]


@in_virtual_time
async def test_vibration_of_a_silent_sender_is_not_renewed() -> None:
    """It lasts as long as the contact does, and a little; any frame of the sender prolongs both."""
    async with running() as bench:
        begin = asyncio.get_running_loop().time()
        bench.controller.deliver(frame(Touch(*FINGER), timeout=3.0))
        await asyncio.sleep(2.5)
        ((sent, only),) = vibrations(bench)
        assert 3.0 <= sent - begin + only.valid_for <= 3.3
        bench.controller.deliver(frame(Touch(*FINGER), timeout=3.0))
        await asyncio.sleep(0.1)
        _, (again, renewed) = vibrations(bench)
        assert 5.5 <= again - begin + renewed.valid_for <= 5.8
        assert again < sent + only.valid_for
        await asyncio.sleep(5.0)
        assert len(vibrations(bench)) == 2
        assert bench.silences()[-1]


@in_virtual_time
async def test_vibration_ends_by_itself_if_a_contact_of_a_dead_panel_stays(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Were it never lifted, heartbeats alone would keep nothing playing."""
    async with running() as bench:
        monkeypatch.setattr(ContactTracker, "next_expiry", None)
        monkeypatch.setattr(ContactTracker, "expire", lambda tracker, now: Change())
        begin = asyncio.get_running_loop().time()
        bench.touch(FINGER)
        await asyncio.sleep(60.0)
        assert not bench.silences()[-1]
        ends = [time - begin + (each.valid_for or math.inf) for time, each in vibrations(bench)]
        assert max(ends) < 2.1


@in_virtual_time
async def test_renewal_keeps_to_a_rate_limit_of_one_set_a_second() -> None:
    """There is no gap although each second allows one set."""
    async with running(rate=1.0) as bench:
        await bench.hold(FINGER, seconds=10.0)
        sent = vibrations(bench)
        for (time, each), (following, _) in pairwise(sent):
            assert time + 1.0 - PROMISED <= following <= time + each.valid_for
        assert sent[-1][0] + sent[-1][1].valid_for >= asyncio.get_running_loop().time()
        assert bench.reports.refused == []


@pytest.mark.parametrize("on_time", [1.5, 2.5, 3.0, 5.5])
@in_virtual_time
async def test_renewal_keeps_to_the_on_time_limit(on_time: float) -> None:
    """The vibration ends by itself a little before, and does not begin again while fingers rest."""
    async with running(on_time=on_time) as bench:
        await bench.hold(FINGER, seconds=12.0)
        sent = vibrations(bench)
        begin, end = sent[0][0], max(time + each.valid_for for time, each in sent)
        assert 0.8 * on_time < end - begin <= on_time
        # Or it would be shown as if it played on.
        (silenced,) = [each for each in bench.reports.silenced if each.reason == ENDED]
        assert end <= silenced.time <= end + 0.06
