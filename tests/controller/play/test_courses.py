"""Courses in virtual time: what channels play of them, piece after piece, over the wire."""

import asyncio
import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import pytest

from chain import Chain
from controller.play.intent import HapticIntent, Pulse, Target
from controller.sources.contacts import Contact
from model.answer.course import Course
from set_chain import FINGER, OTHER, set_running
from virtual_loop import in_virtual_time

FULL = 0.2  # the level that the table's pattern has
STEP = 0.010  # s; between knots
WAY = 0.002  # s; of a set to the amplifier, and of looks a millisecond apart


@dataclass
class FeelsCourse:
    """The first finger feels a course from when it comes on, once or until it lifts."""

    course: Course
    loops: bool = False
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
        return HapticIntent((target,), until=pulse.end)

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


@in_virtual_time
async def test_a_course_is_played_as_it_is() -> None:
    """Within what 10 ms change of it: by hand, at most 2 % of full level, in its steepest part."""
    felt = FeelsCourse(WAVE)
    async with set_running(knots=32, intent_source=felt) as chain:
        times, levels = await looked_at(chain, 1.4, FINGER)
        times -= felt.started_at
        is_due = times > WAY
        expected = np.interp(times, [0.0, 0.1, 0.5, 0.8, 1.2], [0.0, 0.2, 0.05, 0.2, 0.0])
        assert np.abs(levels - expected)[is_due].max() < 0.0011
        assert not levels[times > 1.2 + STEP].any()
        pieces = [one.layer for one in chain.far_end.sent()[1:] if not one.is_silent]
        assert [each.after for each in pieces] == [False, True, True, True, True]
