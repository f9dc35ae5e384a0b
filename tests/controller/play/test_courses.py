"""Courses in virtual time: what channels play of them, piece after piece, over the wire."""

import asyncio
import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import pytest

from chain import FINGER, OTHER, Chain, set_running
from controller.content.pattern import Pattern, Transient
from controller.effects.kinds import File
from controller.effects.layout import SurfaceLayout
from controller.play.intent import CLICK, HapticIntent, Pulse, Target
from controller.sources.touch import Contact
from model.answer.stimulus import Course
from model.vibration import Tone
from several_fingers import LEFT, fingers_on, table
from virtual_lines import in_virtual_time

FULL = 0.2  # the level that the table's pattern has
ROUNDING = 1.5e-4  # of a knot and of a status, in full levels
WAY = 0.002  # s; by which sets come sooner or later, and looks are a millisecond apart


@dataclass
class FeelsCourse:
    """The first finger feels a course from when it comes on, once or until it lifts."""

    course: Course
    loops: bool = False
    tap: Pulse | None = None
    pulses: dict[float, Pulse] = field(default_factory=dict)

    def intent(self, contacts: Sequence[Contact], now: float) -> HapticIntent:
        """Return it until its pulse ends."""
        if not contacts:
            return HapticIntent((), "no contact on the plate")
        first = contacts[0]
        lasts = math.inf if self.loops else self.course.duration
        pulse = self.pulses.setdefault(first.since, Pulse(lasts, first.since, is_raised=False))
        if now >= pulse.end:
            return HapticIntent((), "the course has ended")
        target = Target(first.key, 20.0, pulse=pulse, course=self.course)
        if self.tap is None or now >= self.tap.end:
            return HapticIntent((target,), until=pulse.end)
        return HapticIntent((target, Target(first.key, 14.0, pulse=self.tap)), until=self.tap.end)

    @property
    def started_at(self) -> float:
        """When [s] the only course has started on the amplifiers."""
        (pulse,) = self.pulses.values()
        assert pulse.started_at is not None
        return pulse.started_at


# Up in 0.1 s, down to a quarter in 0.4, up again in 0.3, and to silence in 0.4 s.
WAVE = Course((0.0, 0.1, 0.5, 0.8, 1.2), (0.0, 1.0, 0.25, 1.0, 0.0))


async def looked_at(chain: Chain, seconds: float, *down: tuple[int, float, float]) -> np.ndarray:
    """Times [s] and levels of the first channel, a millisecond apart, while fingers are down."""
    looks = []
    for number in range(round(seconds * 1000)):
        if number % 10 == 0:
            chain.put(*down)
        looks.append((asyncio.get_running_loop().time(), chain.far_end.levels[0]))
        await asyncio.sleep(0.001)
    return np.array(looks).T


def expected(times: np.ndarray, course: Course = WAVE, full: float = FULL) -> np.ndarray:
    """Levels by the points of a course alone, at times [s] from its start."""
    return full * np.interp(times, course.times, course.shares, left=0.0, right=0.0)


def furthest(
    times: np.ndarray,
    levels: np.ndarray,
    early: float = WAY,
    late: float = WAY,
    course: Course = WAVE,
) -> float:
    """How far levels are from all that is due from so early [s] on until so late."""
    shifts = np.arange(-early, late + 1e-9, 0.0005)
    due = np.array([expected(times - each, course) for each in shifts])
    return float(np.maximum(due.min(axis=0) - levels, levels - due.max(axis=0)).max())


@in_virtual_time
async def test_a_course_is_played_as_it_is() -> None:
    """Within the 2 ms of the wire and a step of it: the points lie on knots, which are 10 ms apart.

    It ends by itself, and nothing is left of it.
    """
    felt = FeelsCourse(WAVE)
    async with set_running(knots=32, intent_source=felt) as chain:
        times, levels = await looked_at(chain, 1.4, FINGER)
        assert furthest(times - felt.started_at, levels) < ROUNDING
        pieces = [one.layer for one in chain.far_end.sent()[1:] if not one.is_silent]
        assert [each.after for each in pieces] == [False, True, True, True, True]
        assert not chain.refused


@in_virtual_time
async def test_a_course_has_no_gap_while_the_host_is_late() -> None:
    """By 0.1 s, whenever it has turned: what was sent before goes on on the amplifier."""
    felt = FeelsCourse(WAVE)
    async with set_running(knots=32, intent_source=felt) as chain:
        chain.put(FINGER)
        await asyncio.sleep(0.02)
        looks = []
        for number in range(1300):
            if number % 105 == 0:
                chain.turning.clear()
            if number % 105 == 100:
                chain.put(FINGER)
                chain.turning.set()
            looks.append((asyncio.get_running_loop().time(), chain.far_end.levels[0]))
            await asyncio.sleep(0.001)
        chain.turning.set()
        times, levels = np.array(looks).T
        assert furthest(times - felt.started_at, levels) < ROUNDING


@in_virtual_time
async def test_a_course_goes_on_where_its_host_was_late_for_longer() -> None:
    """By 0.6 s, beyond its end by itself: where it would be, also after a tap beside it."""
    felt = FeelsCourse(Course((0.0, 0.1, 3.0), (0.0, 1.0, 0.5)))
    async with set_running(knots=32, intent_source=felt, watchdog=2.0) as chain:
        await looked_at(chain, 0.7, FINGER)
        chain.turning.clear()
        _, levels = await looked_at(chain, 0.6, FINGER)
        assert levels[-1] == 0
        chain.turning.set()
        await looked_at(chain, 0.1, FINGER)
        for _ in range(2):
            times, levels = await looked_at(chain, 0.4, FINGER)
            assert furthest(times - felt.started_at, levels, course=felt.course) < ROUNDING
            felt.tap = Pulse(0.04, times[-1])
            chain.controller.cycle.request_update()
            await looked_at(chain, 0.1, FINGER)


@in_virtual_time
async def test_a_course_ends_by_itself_if_its_host_is_gone() -> None:
    """0.1 s after the last piece that it has sent, along 20 ms: at 0.48 s, half way to the next."""
    felt = FeelsCourse(Course((0.0, 0.1, 9.0), (0.0, 1.0, 1.0)))
    async with set_running(knots=32, intent_source=felt, watchdog=2.0) as chain:
        await looked_at(chain, 0.3, FINGER)
        chain.turning.clear()
        times, levels = await looked_at(chain, 0.5, FINGER)
        times -= felt.started_at
        assert levels[times < 0.58 - WAY].min() > FULL - 2e-4
        assert not levels[times > 0.58 + 0.020 + WAY].any()
        chain.turning.set()


@in_virtual_time
async def test_a_stop_amid_a_course_is_silence() -> None:
    """What waits on the amplifier does not start."""
    felt = FeelsCourse(WAVE)
    async with set_running(knots=32, intent_source=felt) as chain:
        await looked_at(chain, 0.41, FINGER)  # the third piece waits for the second
        await chain.operate("stop")
        _, levels = await looked_at(chain, 0.6, FINGER)
        assert levels[0] < 1e-4
        assert not levels.any()


@in_virtual_time
async def test_a_restart_amid_a_course_is_silence_until_it_is_armed_again() -> None:
    """Then the resting finger feels what is left, where it would be; no old piece is waited for."""
    felt = FeelsCourse(Course((0.0, 0.1, 5.0), (0.0, 1.0, 0.5)))
    async with set_running(knots=32, intent_source=felt) as chain:
        await looked_at(chain, 0.5, FINGER)
        chain.far_end.fault("reboot", lasts=0.1)
        _, levels = await looked_at(chain, 0.6, FINGER)
        assert not levels.any()
        (refused,) = chain.refused
        assert "once the cause is gone, clear and arm again" in refused
        await chain.operate("clear")
        await chain.operate("arm")
        times, levels = await looked_at(chain, 0.8, FINGER)
        assert furthest(times[50:] - felt.started_at, levels[50:], course=felt.course) < ROUNDING


@in_virtual_time
async def test_a_course_begins_anew_without_a_gap() -> None:
    """Each of its turns is as the first, the seam included, until the finger lifts."""
    felt = FeelsCourse(Course((0.0, 0.2, 0.37), (0.5, 1.0, 0.5)), loops=True)
    async with set_running(knots=32, intent_source=felt) as chain:
        times, levels = await looked_at(chain, 2.0, FINGER)
        since = (times - felt.started_at)[20:]
        due = expected(np.mod(since - WAY / 2, 0.37), felt.course)
        # By hand: 10 ms change it by 0.6 % of full level, and cut that off at its corners.
        assert np.abs(levels[20:] - due).max() < 0.006
        await chain.leave(0.025)
        assert chain.far_end.levels[0] == 0


@in_virtual_time
async def test_what_is_left_of_a_course_goes_on_where_another_finger_joins() -> None:
    """At the new weights, half of those before, 20 ms later."""
    felt = FeelsCourse(WAVE)
    async with set_running(knots=32, intent_source=felt) as chain:
        chain.table.shared = {"SW": Tone(110.0, 10e-6, math.pi / 2)}
        times, levels = await looked_at(chain, 0.43, FINGER)
        joined = times[-1] - felt.started_at
        times, levels = await looked_at(chain, 1.0, FINGER, OTHER)
        times -= felt.started_at
        is_late = times > joined + 0.03
        # By hand: straight lines of 20 ms, for a while, cut off 0.0044 of its corner at 0.5 s.
        assert furthest(times[is_late], 2 * levels[is_late]) < 0.0044 + ROUNDING
        # In between it is led there without falling silent.
        assert levels[~is_late].min() > 0.9 * expected(np.array([0.5]))[0] / 2


@in_virtual_time
async def test_an_amplifier_without_knots_follows_along_ramps() -> None:
    """50 ms each: it is never further off than what the course has within one of them.

    That it is coarse is said once.
    """
    felt = FeelsCourse(WAVE)
    async with set_running(intent_source=felt) as chain:
        times, levels = await looked_at(chain, 1.4, FINGER)
        assert furthest(times - felt.started_at, levels, 0.05, 0.06) < ROUNDING
        assert max(levels) > 0.8 * FULL
        ramps = [each for each in chain.far_end.sent()[1:] if not each.is_silent]
        assert len(ramps) == pytest.approx(1.2 / 0.05, abs=2)


@in_virtual_time
async def test_all_actuators_have_one_course_times_their_weights() -> None:
    """On two amplifiers: the one has half the level of the other at every moment."""
    felt = FeelsCourse(WAVE)
    async with set_running("main", "side", knots=32, intent_source=felt) as chain:
        chain.table.excitation = {"SW": Tone(110.0, 20e-6), "NE": Tone(110.0, 10e-6, 1.0)}
        chain.put(FINGER)
        for number in range(1300):
            if number % 10 == 0:
                chain.put(FINGER)
            levels = chain.levels()
            assert levels["side"][1] == pytest.approx(levels["main"][0] / 2, abs=ROUNDING)
            await asyncio.sleep(0.001)


@in_virtual_time
async def test_a_click_of_a_file_is_felt_beside_what_lasts_of_it() -> None:
    """In a layer of its own, 0.3 s after the start of the other, within 10 ms.

    What lasts is silent then: by hand, 30 ms before and after the 40 of the click.
    """
    pattern = Pattern(0.8, ((0.0, 1.0), (0.8, 1.0)), ((0.0, 0.5),), (Transient(0.3, 1.0, 0.5),))
    file = File.of(pattern, name="it", level_db_sl=14.0).for_table(table().frequencies)
    layout = SurfaceLayout(effects={"it": file}, elsewhere="it")
    async with fingers_on(table(), layout, at={1: LEFT}, held=1.2) as fingers:
        began = fingers.applied[0].time
        (short,) = {
            one.content.targets[0][1].pulse
            for report in fingers.applied
            for one in report.contents.values()
            if one.content.key[1] == CLICK
        }
        assert short is not None
        assert short.started_at - began == pytest.approx(0.3, abs=0.01)
        (lasting,) = {
            layer.layer for _, _, layers in fingers.committed for layer in layers if layer.after
        }
        times, levels = list[float](), list[int]()
        for time, _, layers in fingers.committed:
            for layer in layers:
                onset = layer.commands[0].onset if layer.commands else None
                if layer.layer == lasting and onset is not None:
                    since = times[-1] if layer.after else time
                    steps = 1e-4 * onset.step * np.arange(1, len(onset.knots) + 2)
                    times += (since + steps).tolist()
                    levels += [each for each, _ in onset.knots] + [layer.commands[0].level]
        due = {0.20: 1.0, 0.26: 1.0, 0.29: 1 / 3, 0.31: 0.0, 0.33: 0.0, 0.35: 1 / 3, 0.4: 1.0}
        played = np.interp([*due], np.array(times) - times[0] + 0.01, levels) / max(levels)
        assert played == pytest.approx([*due.values()], abs=0.01)
