"""The clocks of all amplifiers of a plate: how well they agree, and what more is read of them.

Where heartbeats alone do not show a clock well enough, on USB of full speed or in a busy network,
statuses are read between them, as seldom as the line allows, and given up for whatever is sent
next. On a line that several share one Mark lets all keep the clock of the same byte, so that what
delays it is common to all of them.
"""

import asyncio
import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

from drivers.host.amplifier import Amplifier
from drivers.host.clock_fit import WINDOW
from drivers.host.jobs import Priority
from drivers.host.line import GRACE, Line
from drivers.protocol.table import has_feature
from drivers.protocol.timing import HEARTBEAT

_GOOD = 5e-6  # s; an error that costs nothing of a promise
_MAX_LOAD = 0.2  # of the line's time, for readings beside heartbeats
_INTERVAL = 0.01  # s, at least, between these
_FRAME = 1e-3  # s, of USB: readings come at all its phases, however steady the heartbeats are
_GOLDEN = (math.sqrt(5) - 1) / 2  # its multiples fill a circle evenly


class Clocks:
    """The clocks of amplifiers by name, whose lines are open."""

    def __init__(self, amplifiers: Mapping[str, Amplifier]) -> None:
        self._amplifiers = amplifiers
        for each in amplifiers.values():
            each.clock.is_alone = len(amplifiers) == 1
        self._dither = 0.0
        self._readings: dict[Amplifier, asyncio.Future[Any]] = {}
        self._marked_from: dict[Line, float] = {}  # s; since when only marks are read

    @property
    def errors(self) -> Mapping[str, float]:
        """Errors of the clocks against each other [s rms] by amplifier; infinite: not held.

        That which an amplifier states, that of what is seen of its clock, and where lines or
        amplifiers differ half of the shortest exchange less its bits, of which no exchange shows
        how it is shared by its two ways. 0 for one alone.
        """
        amplifiers = self._amplifiers
        if len(amplifiers) == 1:
            return dict.fromkeys(amplifiers, 0.0)
        is_alike = len({_kind(each) for each in amplifiers.values()}) == 1
        errors: dict[str, float] = {}
        for name, each in amplifiers.items():
            now = each.line.time()
            shown = each.clock.error(now, common=self._common(each.line, now))
            errors[name] = shown if is_alike else math.hypot(shown, each.clock.shortest / 2)
        return errors

    def look(self, line: Line, of_line: Sequence[Amplifier]) -> None:
        """Read clocks of a line beside its heartbeat, which goes out next: more where needed."""
        steered = [each for each in of_line if each.clock.can_be_steered]
        if len(self._amplifiers) == 1 or not steered:
            return
        now, call_later = line.time(), asyncio.get_running_loop().call_later
        is_good = all(each.clock.scatter(now) <= _GOOD for each in steered)
        if line in self._marked_from or (not is_good and _has_marks(of_line)):
            self._marked_from.setdefault(line, now)
            for each in of_line:
                each.clock.takes_marks = True
            call_later(self._later(_INTERVAL), _mark, line)
        elif line.late <= GRACE:
            takes = sum([each.exchange_time("GetStatus") for each in steered])
            interval = max(_INTERVAL, takes / _MAX_LOAD)
            count = int(HEARTBEAT / interval) - 1
            for number in range(1, 1 + (min(count, 1) if is_good else count)):
                call_later(self._later(number * interval), self._read, steered)

    def dither(self, line: Line) -> float:
        """Return by how much later [s] an amplifier is fed whose heartbeats alone are readings.

        On a line whose replies come late, where nothing else is to wait for one.
        """
        return self._later(0.0) if len(self._amplifiers) > 1 and line.late > GRACE else 0.0

    def _later(self, duration: float) -> float:
        """Return a duration [s] and some of a frame."""
        self._dither = (self._dither + _GOLDEN) % 1.0
        return duration + self._dither * _FRAME

    def _read(self, amplifiers: Sequence[Amplifier]) -> None:
        """Read the statuses of amplifiers that reply and are not being read."""
        for each in amplifiers:
            reading = self._readings.get(each)
            is_free = reading is None or reading.done()
            is_free = is_free and not each.line.has_set
            if is_free and each.silence_cause is None and each.line.loss is None:
                self._readings[each] = each.read_status(Priority.READING)

    def _common(self, line: Line, now: float) -> float | None:
        """Return the mean lead [s] where the readings of all have the same delays; else None."""
        clocks = [each.clock for each in self._amplifiers.values() if each.line is line]
        is_only = len(clocks) == len(self._amplifiers)
        if not is_only or now - self._marked_from.get(line, math.inf) <= WINDOW:
            return None
        return sum([each.lead(now) for each in clocks]) / len(clocks)


def _has_marks(of_line: Sequence[Amplifier]) -> bool:
    """Whether several amplifiers share a line, and all keep the clock of a Mark."""
    return len(of_line) > 1 and all(has_feature(each.capabilities, "mark") for each in of_line)


def _mark(line: Line) -> None:
    """Have all amplifiers of a line keep their clocks, for their next statuses."""
    line.submit(None, Priority.HEARTBEAT, "Mark", {})


def _kind(amplifier: Amplifier) -> tuple[Any, ...]:
    """Return what an amplifier and its line have in common with those of equal delays."""
    line, identity = amplifier.line, amplifier.identity
    device = re.match(r"/.*/(\D*)", line.name)
    return (
        type(line.wire),
        amplifier.status_time,
        device and device[1],
        *(identity.get(each) for each in ("vendor", "product", "firmware")),
    )
