"""The control loop, in virtual time, with amplifiers that record their requests."""

import asyncio
from pathlib import Path

import pytest

from chain import FINGER, set_running
from controller.play.planner import Observers
from controller.sources.touch import Touch, TouchFrame
from courses import Acted, courses, follow
from virtual_lines import in_virtual_time

COURSES = courses(Path(__file__).with_name("courses.yaml"))


@pytest.mark.parametrize("name", COURSES)
def test_control_loop_keeps_to_its_course(name: str) -> None:
    """Every step is as it is in the file."""
    follow({"of": Acted, **COURSES[name]}, set_running)


def now() -> float:
    """The loop's time [s]."""
    return asyncio.get_running_loop().time()


@in_virtual_time
async def test_controller_decides_anew_for_a_load_that_doubles_not_for_one_that_wavers() -> None:
    """A panel at 100 Hz whose pressure wavers by a third in load, then doubles, then comes back."""

    def press(*loads: float) -> None:
        touches = (Touch(1, 0.5, 0.5), *(Touch(2, 0.9, 0.9, load=load) for load in loads))
        chain.deliver(TouchFrame("panel", now(), touches))

    async with set_running() as chain:
        for base, decisions in ((1.0, 1), (2.0, 2), (1.2, 3)):
            for number in range(50):
                press(base * (1.15 if number % 2 else 1 / 1.15))
                await asyncio.sleep(0.01)
            assert len(chain.table.asked) == decisions
        asked = [tuple(each.load for each in fingers) for fingers in chain.table.asked]
    assert asked == [(1.0, 1.0), (pytest.approx(2 / 1.15), 1.0), (pytest.approx(1.2 / 1.15), 1.0)]


@in_virtual_time
async def test_lift_as_a_set_is_confirmed_precedes_a_due_heartbeat() -> None:
    """It comes when the set is reported as playing, by replies as late as the heartbeat is due."""
    before: list[int] = []  # requests to each amplifier before the lift

    def lift(_: object) -> None:
        before.extend(len(end.asked) for end in chain.far_ends)
        chain.put()

    async with set_running(
        "a", "b", observe=lambda loop: loop.pattern_applied.append(lift)
    ) as chain:
        await asyncio.sleep(0.046)
        for end in chain.far_ends:
            end.delay(0.002)
        await chain.leave(0.05, FINGER)
        for end, count in zip(chain.far_ends, before, strict=True):
            assert end.names(count)[:2] == ["Silence", "Ping"]


@in_virtual_time
async def test_controller_survives_a_failing_observer(caplog: pytest.LogCaptureFixture) -> None:
    """Its exceptions are logged; pattern, silence and heartbeats are sent all the same."""

    def fail(*_: object) -> None:
        raise RuntimeError("no disk space for this row")

    def observe(loop: Observers) -> None:
        for callbacks in (loop.contacts_changed, loop.pattern_applied, loop.silenced):
            callbacks.append(fail)

    async with set_running(observe=observe) as chain:
        await chain.leave(0.01, FINGER)
        await chain.leave(0.2)
        assert [each.is_silent for each in chain.far_end.sent()] == [True, False, True]
        assert len(chain.far_end.requests("Ping")) > 3
    assert "no disk space for this row" in caplog.text


@in_virtual_time
async def test_latency_counts_from_the_touch_though_its_first_set_is_lost() -> None:
    """No reply for 80 ms from the moment that a finger comes down: a touch, not quicker than so."""
    async with set_running() as chain:
        chain.far_end.fault("drop", toward="host")
        begin = now()
        await chain.leave(0.08, FINGER)
        chain.far_end.recover()
        await chain.leave(0.2, FINGER)
        applied = chain.applied[0]
        assert applied.is_touch
        assert applied.latency == pytest.approx(applied.time - begin)
        assert applied.latency >= 0.08
