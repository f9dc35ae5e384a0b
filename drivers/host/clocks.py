"""The clocks of all amplifiers of a plate: how well they agree, and what more is read of them.

Where heartbeats alone do not show clocks well enough, on USB of full speed or in a busy network,
statuses are read between them, the seldomer the better these are known, and given up for whatever
is sent next. On a line that several share one Mark lets all keep the clock of the same byte, so
that what delays it is common to all of them.
"""

import asyncio
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from itertools import cycle
from statistics import median
from typing import Any

from drivers.errors import DriverError
from drivers.host.amplifier import Amplifier
from drivers.host.clock import HeldClock
from drivers.host.jobs import Priority
from drivers.host.line import GRACE, Line
from drivers.host.members import Members
from drivers.protocol.definition import HEARTBEAT, has_feature

# s; an error that costs nothing of a promise, one that costs a tenth of a dB, and more.
_GOOD, _FAIR, _POOR = 5e-6, 8e-6, 12e-6
_MAX_LOAD = 0.2  # of the line's time, for readings beside heartbeats
_INTERVAL = 0.01  # s, at least, between these; half where an error is poor, longer where near good
_SETTLING = 0.2  # s, at most, for readings before clocks are needed
_FRAME = 1e-3  # s, of USB: readings come at all its phases, however steady the heartbeats are
_GOLDEN = (math.sqrt(5) - 1) / 2  # its multiples fill a circle evenly


class Clocks:
    """The clocks of the amplifiers of a group, whose lines are open."""

    def __init__(self, members: Members) -> None:
        self._members, self._amplifiers = members, members.amplifiers
        self._are_alike = True  # and so are their lines
        self._dither = 0.0
        self._readings: dict[Amplifier, asyncio.Future[Any]] = {}
        self._turns: dict[Line, Iterator[Amplifier]] = {}
        self._marked: set[Line] = set()  # all on which know Mark, and are several
        self._firsts: dict[Line, HeldClock | None] = {}  # to which the others of a line are held

    def follow(self) -> None:
        """Know all from now on: one alone, or by which lines and amplifiers they differ."""
        every = self._amplifiers.values()
        self._are_alike = len({_kind(each) for each in every}) == 1
        for line in self._members.lines:
            of_line = [each for each in every if each.line is line]
            self._turns[line] = cycle(of_line)
            know_mark = [has_feature(each.ledger.capabilities, "mark") for each in of_line]
            if len(of_line) > 1 and all(know_mark):
                self._marked.add(line)
        for each in every:
            each.clock.is_alone = len(every) == 1

    @property
    def errors(self) -> Mapping[str, float]:
        """Errors of the clocks against each other [s rms] by amplifier; infinite: not held.

        That which an amplifier states, that of what is seen of its clock, and where lines or
        amplifiers differ half of the shortest exchange less its bits, of which no exchange shows
        how it is shared by its two ways. 0 for one alone.
        """
        every = self._amplifiers
        if len(every) < 2:
            return dict.fromkeys(every, 0.0)
        now = next(iter(every.values())).line.time()
        held = [each for each in every.values() if each.clock.error(now) < math.inf]
        is_common = len(self._members.lines) == 1
        is_common &= sum(not each.clock.is_compared for each in held) == 1
        leads = {each: each.clock.lead(now) for each in every.values()}
        common = median([leads[each] for each in held] or [0.0])
        # So that the rms of what is known is no less than that of their differences.
        wider = math.sqrt(len(held) / max(len(held) - 1, 1))
        return {
            name: math.hypot(
                each.clock.error(now, off=wider * (leads[each] - common), is_common=is_common),
                0.0 if self._are_alike else each.clock.shortest / 2,
            )
            for name, each in every.items()
        }

    async def settle(self) -> None:
        """Read clocks that are known poorly time and again, before anything plays: it costs none.

        No more once one does not reply, or a stop or disarm has come.
        """
        lines = self._members.lines if len(self._amplifiers) > 1 else ()
        now = asyncio.get_running_loop().time()
        try:
            async with asyncio.TaskGroup() as settling:
                for line in lines:
                    settling.create_task(self._settle(line, now + _SETTLING))
        except* DriverError:  # as arming says, too
            pass

    async def _settle(self, line: Line, until: float) -> None:
        of_line = [
            each
            for each in self._amplifiers.values()
            if each.line is line and each.clock.can_be_steered
        ]
        before = self._members.epoch
        while (now := line.time()) < until:
            if max([each.clock.scatter(now) for each in of_line], default=0.0) <= _GOOD:
                break
            if line in self._marked:
                self._compare(of_line, now)
                await line.submit(None, Priority.READING, "Mark", {})
            for each in of_line:
                if line.time() >= until or self._members.epoch != before:
                    return
                await each.read_status(Priority.READING)
                await asyncio.sleep(self.later())

    def _compare(self, of_line: Sequence[Amplifier], now: float) -> None:
        """Hold clocks of a line to one as long as nothing ails it, else to the best known."""
        line = of_line[0].line
        before = self._firsts.get(line)

        def rank(one: HeldClock) -> tuple[bool, bool, bool, float]:
            # One that has jumped is led back by itself: no other follows it.
            error = one.error(now)
            return error == math.inf, one.problem(now) is not None, one is not before, error

        best = min([each.clock for each in of_line], key=rank)
        first = self._firsts[line] = best if best.error(now) < math.inf else None
        for each in of_line:
            each.clock.compare(None if each.clock is first else first)

    def look(self, by_line: Mapping[Line, Sequence[Amplifier]]) -> None:
        """Read clocks of lines beside their heartbeats, which go out next: more where needed.

        Of all lines as often: how far the lowest of some readings is above a lead depends on it.
        """
        if len(self._amplifiers) == 1:
            return
        loop, worst, busy = asyncio.get_running_loop(), 0.0, dict[Line, float]()
        now, unmarked = loop.time(), list[tuple[Line, Sequence[Amplifier]]]()
        for line, of_line in by_line.items():
            takes = [each.exchange_time("GetStatus") for each in of_line]
            shown = [each.counts.last_round_trip or 0.0 for each in of_line]
            busy[line] = sum(map(max, takes, shown))
            if line in self._marked:
                self._compare(of_line, now)
                # Behind the heartbeats: what waits for a reply is sent in step with frames.
                later = self.later(_INTERVAL + busy[line])
                loop.call_later(later, line.submit, None, Priority.HEARTBEAT, "Mark", {})
                continue
            unmarked.append((line, of_line))
            for each in of_line:
                if each.clock.can_be_steered:
                    worst = max(worst, each.clock.scatter(now))
        if worst <= _GOOD:
            return
        longer = max((_FAIR - _GOOD) / (worst - _GOOD), 1.0)
        least = _INTERVAL * (longer if worst <= _POOR else 0.5)
        for line, of_line in unmarked:
            if line.late <= GRACE:
                # Each by itself: one behind the reply to another is sent in step with frames.
                interval = max(least, busy[line] / _MAX_LOAD) / len(of_line)
                for number in range(1, int(HEARTBEAT / interval)):
                    loop.call_later(
                        self.later(number * interval), self._read, next(self._turns[line])
                    )

    def later(self, duration: float = 0.0) -> float:
        """Return a duration [s] and some of a frame."""
        self._dither = (self._dither + _GOLDEN) % 1.0
        return duration + self._dither * _FRAME

    def _read(self, amplifier: Amplifier) -> None:
        """Read the status of an amplifier that replies, can be steered and is not being read."""
        reading = self._readings.get(amplifier)
        is_free = amplifier.clock.can_be_steered and (reading is None or reading.done())
        is_heard = amplifier.silence_cause is None and amplifier.line.loss is None
        if is_free and is_heard and not self._members.has_joint_set:
            self._readings[amplifier] = amplifier.read_status(Priority.READING)


def _kind(amplifier: Amplifier) -> tuple[Any, ...]:
    """Return what amplifiers and lines have in common whose requests are as late at the least."""
    line, of = amplifier.line, amplifier.identity
    device = re.match(r"/.*/(\D*)", line.name)  # without its number; none for a network
    made = of.get("vendor"), of.get("product"), of.get("firmware")
    return type(line.wire), device and device[1], made
