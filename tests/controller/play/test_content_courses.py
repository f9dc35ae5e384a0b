"""Courses of one content in virtual time, over the wire.

The level of the first channel is looked at every millisecond. It must follow the course, times a
full level of 0.2, within a step of the wire and the 2 ms by which sets can come sooner or later.
"""

import math
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from controller.content.pattern import Pattern, Transient
from controller.effects.file_effect import File
from controller.effects.layout import SurfaceLayout
from controller.play.intent import CLICK, HapticIntent, Pulse, Target
from controller.sources.touch import Contact
from drivers.protocol.sets import LayerSet
from kit.chain import FINGER, OTHER, set_running
from kit.clock import in_virtual_time
from kit.fingers import table as paper_table
from model.answer.envelope import Course
from model.vibration import Tone
from registry import threads
from tests.controller.play.driven_loop import DrivenLoop
from tests.controller.play.fingers_on_layouts import LEFT, fingers_on

FULL_LEVEL = 0.2
"""Level of the table's pattern."""
ROUNDING = 1.5e-4
"""Rounding of a knot and of a status, in full levels."""
SHIFT = 0.002
"""By how much sets can come sooner or later than looks, which are a millisecond apart [s]."""
WAVE = Course((0.0, 0.1, 0.5, 0.8, 1.2), (0.0, 1.0, 0.25, 1.0, 0.0))
"""A course whose points lie on knots, which are 10 ms apart."""

Looks = Sequence[tuple[float, float]]
"""Times [s] and levels."""


@dataclass
class FeelsCourse:
    """The first finger feels a course after it comes, once or until it lifts."""

    course: Course
    loops: bool = False
    tap: Pulse | None = None
    """A click that it feels at the same time."""
    pulses: dict[float, Pulse] = field(default_factory=dict)
    """Each play of the course, by when the finger came [s]."""

    def intent(self, contacts: Sequence[Contact], now: float) -> HapticIntent:
        """Return the course until its pulse ends."""
        if not contacts:
            return HapticIntent((), "no contact on the plate")
        finger = contacts[0]
        duration = math.inf if self.loops else self.course.duration
        new_pulse = Pulse(duration, finger.since, is_raised=False)
        pulse = self.pulses.setdefault(finger.since, new_pulse)
        if now >= pulse.end:
            return HapticIntent((), "the course has ended")
        target = Target(finger.key, 20.0, pulse=pulse, course=self.course)
        if self.tap is None or now >= self.tap.end:
            return HapticIntent((target,), until=pulse.end)
        tapped = Target(finger.key, 14.0, pulse=self.tap)
        return HapticIntent((target, tapped), until=self.tap.end)

    def has_effect_at(self, contact: Contact) -> bool:
        """Return True: every contact has one."""
        return True

    @property
    def started_at(self) -> float:
        """When the only course has started on the amplifiers [s]."""
        (pulse,) = self.pulses.values()
        assert pulse.started_at is not None
        return pulse.started_at


@dataclass
class CourseLoop(DrivenLoop):
    """A control loop whose first finger feels a course."""

    feels: FeelsCourse = field(init=False)

    async def look_at(self, seconds: float, *fingers: tuple[int, float, float]) -> Looks:
        """Look every millisecond while fingers are reported."""
        return await self.look(seconds, lambda: self.put(*fingers))

    def must_follow(
        self,
        looks: Looks,
        *,
        within: float = ROUNDING,
        early: float = SHIFT,
        late: float = SHIFT,
        gain: float = 1.0,
    ) -> None:
        """Require that levels times a gain are within the course, shifted by so much [s]."""
        times, levels = np.array(looks).T
        course = self.feels.course
        since = times - self.feels.started_at
        if self.feels.loops:
            since = np.mod(since, course.duration)
        shifts = np.arange(-early, late + 1e-9, 0.0005)
        shifted = since[:, None] - shifts
        shares = np.interp(shifted, course.times, course.shares, left=0.0, right=0.0)
        expected = FULL_LEVEL * shares
        lowest = expected.min(axis=1) - within
        highest = expected.max(axis=1) + within
        nearest = np.clip(gain * levels, lowest, highest)
        np.testing.assert_allclose(gain * levels, nearest, atol=1e-9, err_msg=f"at {since} s")

    def levels_between(self, looks: Looks, start: float, end: float) -> list[float]:
        """Levels between two times [s] since the course has started."""
        began = self.feels.started_at
        return [level for time, level in looks if start <= time - began <= end]

    def play_tap(self) -> None:
        """Let the finger feel a tap of 40 ms in addition to the course."""
        self.feels.tap = Pulse(0.04, threads.now())
        self.controller.cycle.request_update()


@asynccontextmanager
async def feeling(
    course: Course, *, loops: bool = False, knots: int = 32, **options: Any
) -> AsyncIterator[CourseLoop]:
    """A loop, armed, whose first finger feels a course."""
    feels = FeelsCourse(course, loops)
    chain = set_running(of=CourseLoop, knots=knots, intent_source=feels, **options)
    async with chain as loop:
        loop.feels = feels
        yield loop


@in_virtual_time
async def test_course_has_no_gap_while_the_host_is_late() -> None:
    """The host stalls for 0.1 s after each turn: pieces that were sent before continue."""
    async with feeling(WAVE) as loop:
        await loop.leave(0.02, FINGER)
        looks: list[tuple[float, float]] = []
        for _ in range(12):
            loop.turning.clear()
            looks += await loop.look(0.1)
            loop.put(FINGER)
            loop.turning.set()
            looks += await loop.look(0.005)
        loop.must_follow(looks)


@in_virtual_time
async def test_course_continues_where_it_would_be_after_its_host_was_late_for_longer() -> None:
    """The host stalls for 0.6 s, beyond the end of the last piece; later there is a tap, too."""
    course = Course((0.0, 0.1, 3.0), (0.0, 1.0, 0.5))
    async with feeling(course, watchdog=2.0) as loop:
        await loop.look_at(0.7, FINGER)
        loop.turning.clear()
        await loop.look_at(0.6, FINGER)
        assert not loop.is_loud
        loop.turning.set()
        await loop.look_at(0.1, FINGER)
        for _ in range(2):
            loop.must_follow(await loop.look_at(0.4, FINGER))
            loop.play_tap()
            await loop.look_at(0.1, FINGER)


@in_virtual_time
async def test_course_ends_by_itself_if_its_host_is_gone() -> None:
    """It ends 0.1 s after its last piece, along 20 ms: at 0.48 s, half way to the next."""
    async with feeling(Course((0.0, 0.1, 9.0), (0.0, 1.0, 1.0)), watchdog=2.0) as loop:
        await loop.look_at(0.3, FINGER)
        loop.turning.clear()
        looks = await loop.look_at(0.5, FINGER)
        assert min(loop.levels_between(looks, 0.0, 0.578)) > 0.1998
        assert max(loop.levels_between(looks, 0.602, 9.0)) == 0.0
        loop.turning.set()


@in_virtual_time
async def test_stop_amid_a_course_is_silence() -> None:
    """The third piece, which waits on the amplifier for the end of the second, does not start."""
    async with feeling(WAVE) as loop:
        await loop.look_at(0.41, FINGER)
        await loop.operate("stop")
        looks = await loop.look_at(0.6, FINGER)
        assert max(level for _, level in looks) == 0.0


@in_virtual_time
async def test_restart_amid_a_course_is_silence_until_it_is_armed_again() -> None:
    """Then the resting finger feels the remainder, where it would be, with no old piece."""
    async with feeling(Course((0.0, 0.1, 5.0), (0.0, 1.0, 0.5))) as loop:
        await loop.look_at(0.5, FINGER)
        loop.far_end.fault("reboot", lasts=0.1)
        looks = await loop.look_at(0.6, FINGER)
        assert max(level for _, level in looks) == 0.0
        (reason,) = loop.refused
        assert "clear and arm again" in reason

        await loop.operate("clear")
        await loop.operate("arm")
        looks = await loop.look_at(0.8, FINGER)
        loop.must_follow(looks[50:])


@in_virtual_time
async def test_looping_course_has_no_gap() -> None:
    """Each turn equals the first, including the seam, until the finger lifts.

    By hand: steps of 10 ms, in which it changes by 0.6 % of full level, cut off its corners.
    """
    course = Course((0.0, 0.2, 0.37), (0.5, 1.0, 0.5))
    async with feeling(course, loops=True) as loop:
        looks = await loop.look_at(2.0, FINGER)
        loop.must_follow(looks[20:], within=0.006)
        await loop.leave(0.025)
        assert not loop.is_loud


@in_virtual_time
async def test_remaining_course_continues_when_another_finger_joins() -> None:
    """It has the new weights, half of the old ones, after 20 ms, without silence on the way.

    By hand: lines of 20 ms cut off 0.0044 of its corner at 0.5 s.
    """
    async with feeling(WAVE) as loop:
        loop.table.shared = {"SW": Tone(110.0, 10e-6)}
        await loop.look_at(0.43, FINGER)
        looks = await loop.look_at(1.0, FINGER, OTHER)
        loop.must_follow(looks[31:], within=0.0045, gain=2.0)
        assert min(loop.levels_between(looks, 0.0, 0.45)) > 0.0225


@in_virtual_time
async def test_amplifier_without_knots_follows_a_course_along_ramps() -> None:
    """Each takes 50 ms: the level is always one that the course has within one of them."""
    async with feeling(WAVE, knots=0) as loop:
        looks = await loop.look_at(1.4, FINGER)
        loop.must_follow(looks, early=0.05, late=0.06)
        assert max(level for _, level in looks) > 0.16
        assert len(loop.vibrations) == pytest.approx(24, abs=2)


def envelope_of(
    commits: Sequence[tuple[float, int, Sequence[LayerSet]]], number: int
) -> tuple[np.ndarray, np.ndarray]:
    """Times [s] and levels of the knots that the first command of a layer was sent."""
    times: list[float] = []
    levels: list[int] = []
    for time, _, layers in commits:
        for layer in layers:
            command = layer.commands[0] if layer.commands else None
            if layer.layer != number or command is None or command.onset is None:
                continue
            start = times[-1] if layer.after else time
            steps = np.arange(1, len(command.onset.knots) + 2)
            times += (start + 1e-4 * command.onset.step * steps).tolist()
            levels += [level for level, _ in command.onset.knots]
            levels.append(command.level)
    return np.array(times), np.array(levels)


@in_virtual_time
async def test_click_of_a_file_is_felt_in_a_gap_of_its_continuous_event() -> None:
    """It has a layer of its own, 0.3 s after the start of the other, within 10 ms.

    By hand: the continuous event is silent from 30 ms before to 30 ms after the click of 40 ms.
    """
    pattern = Pattern(0.8, ((0.0, 1.0), (0.8, 1.0)), ((0.0, 0.5),), (Transient(0.3, 1.0, 0.5),))
    file = File.of(pattern, name="it", level_db_sl=14.0).for_table(paper_table().frequencies)
    layout = SurfaceLayout(effects={"it": file}, elsewhere="it")
    async with fingers_on(paper_table(), layout, at={1: LEFT}, held=1.2) as fingers:
        began = fingers.applied[0].time
        contents = [slot.content for report in fingers.applied for slot in report.contents.values()]
        click_starts = {
            content.target.pulse.started_at
            for content in contents
            if content.key.voice == CLICK and content.target.pulse
        }
        assert [*click_starts] == [pytest.approx(began + 0.3, abs=0.01)]

        lasting = {
            layer.layer for _, _, layers in fingers.committed for layer in layers if layer.after
        }
        times, levels = envelope_of(fingers.committed, *lasting)
        expected = {0.20: 1.0, 0.26: 1.0, 0.29: 1 / 3, 0.31: 0.0, 0.33: 0.0, 0.35: 1 / 3, 0.4: 1.0}
        played = np.interp([*expected], times - times[0] + 0.01, levels / levels.max())
        np.testing.assert_allclose(played, [*expected.values()], atol=0.01)
