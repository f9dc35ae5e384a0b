"""The clocks of a group's amplifiers, which are compared with each other.

If heartbeats do not measure the clocks well enough, for instance on full-speed USB or a busy
network, statuses are read between the heartbeats, less often for well-known clocks; any other
request preempts these. On a line shared by several amplifiers, a Mark makes all of them record the
clock at the same byte.
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
from drivers.host.joint_sets import JointSets
from drivers.host.line import Line
from drivers.host.members import Members
from drivers.host.requests import GRACE, Priority
from drivers.protocol.definition import HEARTBEAT, has_feature

# Errors of a clock [s]: a good clock does not lower a promise, a fair one by a tenth of a dB.
_GOOD, _FAIR = 5e-6, 8e-6
_MAX_LOAD = 0.2  # share of the line's time for readings between heartbeats
_MIN_INTERVAL = 0.01  # s; between readings of one clock
_SETTLING = 0.2  # s; at most, for readings before clocks are needed
_FRAME = 1e-3  # s; a USB frame; readings should cover all of its phases
_GOLDEN = (math.sqrt(5) - 1) / 2  # its multiples cover a circle evenly


class Clocks:
    """The clocks of the amplifiers of a group, on open lines."""

    def __init__(self, members: Members, sets: JointSets) -> None:
        self._members = members
        self._sets = sets
        self._amplifiers = members.amplifiers
        self._are_alike = True
        """Whether all amplifiers and lines are alike."""
        self._dither = 0.0
        """The last varying part of a frame, see `later`."""
        self._readings: dict[Amplifier, asyncio.Future[Any]] = {}
        """The last reading of each clock."""
        self._turns: dict[Line, Iterator[Amplifier]] = {}
        """The amplifiers of each line in endless turns."""
        self._marked: set[Line] = set()
        """Lines of several amplifiers that all support Mark."""
        self._firsts: dict[Line, HeldClock | None] = {}
        """The clock of each line that the others follow."""

    def follow(self) -> None:
        """Adopt the amplifiers and lines as just identified."""
        amplifiers = self._amplifiers.values()
        self._are_alike = len({_kind(amplifier) for amplifier in amplifiers}) == 1
        for line in self._members.lines:
            line_amplifiers = [amplifier for amplifier in amplifiers if amplifier.line is line]
            self._turns[line] = cycle(line_amplifiers)
            mark_support = []
            for amplifier in line_amplifiers:
                mark_support.append(has_feature(amplifier.ledger.capabilities, "mark"))
            if len(line_amplifiers) > 1 and all(mark_support):
                self._marked.add(line)
        for amplifier in amplifiers:
            amplifier.clock.is_alone = len(amplifiers) == 1

    @property
    def errors(self) -> Mapping[str, float]:
        """Relative errors of the clocks [s rms] by amplifier; infinite if not synchronized.

        Each error combines the amplifier's specified error, the measured error of its clock and, if
        lines or amplifiers differ, half of the shortest exchange without its bits, because no
        exchange shows how that time is split between the two directions. A single amplifier has 0.
        """
        amplifiers = self._amplifiers
        if len(amplifiers) < 2:
            return dict.fromkeys(amplifiers, 0.0)
        now = next(iter(amplifiers.values())).line.time()
        leads = {}
        synchronised_leads = []
        uncompared_count = 0
        for name, amplifier in amplifiers.items():
            leads[name] = amplifier.clock.lead(now)
            if amplifier.clock.is_synchronized(now):
                synchronised_leads.append(leads[name])
                uncompared_count += not amplifier.clock.is_compared
        is_common = len(self._members.lines) == 1 and uncompared_count == 1
        common_lead = median(synchronised_leads or [0.0])
        # With this factor the RMS of the errors is at least the RMS of their differences.
        count = len(synchronised_leads)
        factor = math.sqrt(count / max(count - 1, 1))
        errors = {}
        for name, amplifier in amplifiers.items():
            off = factor * (leads[name] - common_lead)
            clock_error = amplifier.clock.error(now, off=off, is_common=is_common)
            split_error = 0.0 if self._are_alike else amplifier.clock.shortest / 2
            errors[name] = math.hypot(clock_error, split_error)
        return errors

    async def settle(self) -> None:
        """Read poorly known clocks repeatedly while nothing plays, so that nothing is delayed.

        It ends early once an amplifier does not reply, or a stop or disarm has come.
        """
        lines = self._members.lines if len(self._amplifiers) > 1 else ()
        now = asyncio.get_running_loop().time()
        try:
            async with asyncio.TaskGroup() as settling:
                for line in lines:
                    settling.create_task(self._settle(line, now + _SETTLING))
        except* DriverError:  # arming finds the same error, and reports it
            pass

    async def _settle(self, line: Line, until: float) -> None:
        line_amplifiers = [
            amplifier
            for amplifier in self._amplifiers.values()
            if amplifier.line is line and amplifier.clock.can_be_steered
        ]
        epoch = self._members.epoch
        now = line.time()
        while now < until:
            errors = [amplifier.clock.scatter(now) for amplifier in line_amplifiers]
            if max(errors, default=0.0) <= _GOOD:
                break
            if line in self._marked:
                self._compare(line_amplifiers, now)
                await line.submit(None, Priority.READING, "Mark", {})
            for amplifier in line_amplifiers:
                if line.time() >= until or self._members.epoch != epoch:
                    return
                await amplifier.read_status(Priority.READING)
                await asyncio.sleep(self.later())
            now = line.time()

    def _compare(self, line_amplifiers: Sequence[Amplifier], now: float) -> None:
        """Make the clocks of a line follow the same clock as before, or else the best one."""
        line = line_amplifiers[0].line
        last_first = self._firsts.get(line)

        def rank(clock: HeldClock) -> tuple[bool, bool, bool, float]:
            # No other clock follows a clock that has jumped.
            error = clock.error(now)
            has_problem = clock.problem(now) is not None
            return error == math.inf, has_problem, clock is not last_first, error

        best = min([amplifier.clock for amplifier in line_amplifiers], key=rank)
        first = best if best.error(now) < math.inf else None
        self._firsts[line] = first
        for amplifier in line_amplifiers:
            amplifier.clock.compare(None if amplifier.clock is first else first)

    def look(self, by_line: Mapping[Line, Sequence[Amplifier]]) -> None:
        """Schedule readings of clocks between the heartbeats, which go out next.

        All lines are read equally often, because the lowest of several readings is the closer to
        the lead the more there are.
        """
        if len(self._amplifiers) == 1:
            return
        loop = asyncio.get_running_loop()
        now = loop.time()
        worst = 0.0
        unmarked: dict[Line, Sequence[Amplifier]] = {}
        for line, line_amplifiers in by_line.items():
            if line in self._marked:
                self._compare(line_amplifiers, now)
                # A Mark that waits for a reply would be sent in step with USB frames.
                delay = self.later(_MIN_INTERVAL + _busy_time(line_amplifiers))
                loop.call_later(delay, line.submit, None, Priority.HEARTBEAT, "Mark", {})
            else:
                unmarked[line] = line_amplifiers
                worst = max(worst, _worst_scatter(line_amplifiers, now))
        if worst <= _GOOD:
            return
        for line, line_amplifiers in unmarked.items():
            if line.late <= GRACE:
                self._schedule_readings(line, line_amplifiers, _reading_interval(worst))

    def _schedule_readings(
        self, line: Line, line_amplifiers: Sequence[Amplifier], min_interval: float
    ) -> None:
        """Schedule readings of a line's clocks until the next heartbeat.

        min_interval: between readings of one clock [s], longer on a busy line. A reading that waits
        for the reply to another one would be sent in step with USB frames.
        """
        loop = asyncio.get_running_loop()
        line_interval = max(min_interval, _busy_time(line_amplifiers) / _MAX_LOAD)
        interval = line_interval / len(line_amplifiers)
        for number in range(1, int(HEARTBEAT / interval)):
            amplifier = next(self._turns[line])
            loop.call_later(self.later(number * interval), self.read_clock, amplifier)

    def later(self, duration: float = 0.0) -> float:
        """Return a duration [s] plus a varying part of a frame."""
        self._dither = (self._dither + _GOLDEN) % 1.0
        return duration + self._dither * _FRAME

    def read_clock(self, amplifier: Amplifier) -> None:
        """Read the status of an amplifier, if it replies, can be steered and is not being read."""
        reading = self._readings.get(amplifier)
        is_free = amplifier.clock.can_be_steered and (reading is None or reading.done())
        is_heard = amplifier.no_reply_cause is None and amplifier.line.loss is None
        if is_free and is_heard and not self._sets.is_on_several_lines:
            self._readings[amplifier] = amplifier.read_status(Priority.READING)


def _busy_time(line_amplifiers: Sequence[Amplifier]) -> float:
    """Return how long heartbeats to all amplifiers of a line take [s]."""
    busy = 0.0
    for amplifier in line_amplifiers:
        last_round_trip = amplifier.counts.last_round_trip or 0.0
        busy += max(amplifier.exchange_time("GetStatus"), last_round_trip)
    return busy


def _worst_scatter(line_amplifiers: Sequence[Amplifier], now: float) -> float:
    """Return the largest scatter [s] of the clocks that can be steered; 0 if there are none."""
    worst = 0.0
    for amplifier in line_amplifiers:
        if amplifier.clock.can_be_steered:
            worst = max(worst, amplifier.clock.scatter(now))
    return worst


def _reading_interval(scatter: float) -> float:
    """Return the interval between readings of a clock with a scatter above _GOOD [s]."""
    return _MIN_INTERVAL * max((_FAIR - _GOOD) / (scatter - _GOOD), 1.0)


def _kind(amplifier: Amplifier) -> tuple[Any, ...]:
    """Return what must be equal for two amplifiers to receive their requests equally late."""
    line = amplifier.line
    identity = amplifier.identity
    device = re.match(r"/.*/(\D*)", line.name)  # without its number; None for a network
    model = identity.get("vendor"), identity.get("product"), identity.get("firmware")
    return type(line.wire), device and device[1], model
