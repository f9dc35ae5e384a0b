"""Readings of an amplifier's clock, from which its lead over the host's clock is fitted.

An amplifier reads its clock for a Status between the last bit of the request and the first bit of
the reply. The *lead* of a reading is the clock's value minus the earliest arrival of the request.
USB frames, other traffic and operating systems delay a request and never speed it up, so a reading
shows at least the true lead, and the lowest readings are nearly right. The way back, with its
latency timers, has no influence. The time window is divided into parts of at most a quarter of a
second, the lowest reading of each part is kept, and a line is fitted to the lower half of the kept
readings (`lead_fit`). (The lowest readings alone are best if frames delay requests; their mean is
best if the operating system does.) Readings above the line show the possible delay. All leads here
are without the steered lead (`clock_steering`), so that steering does not feed back into the
measurement.
"""

import math
from collections import deque
from enum import Enum, auto
from typing import NamedTuple

from drivers.host.lead_fit import (
    MIN_ERROR,
    RECENT,
    LeadFit,
    Reading,
    aged_leads_of,
    current_leads,
    fit_lower_half,
)
from drivers.protocol.definition import CLOCK_TURN, SPAN

MAX_CRYSTAL = 0.01
"""Rate impossible for an oscillator: beyond it, a clock has stopped or runs backwards."""
FAR = 100e-6
_FAR_ERRORS = 10.0
"""A reading that is further off, in seconds plus standard errors, shows a clock that was moved."""
SIGNIFICANT = 4.0
"""Number of standard errors beyond which a difference is significant."""
CLOCK_STEP = CLOCK_TURN / SPAN
"""Step [s] of a clock on the wire."""
_WINDOW = 8.0
"""Time window of readings [s]: fewer are noisier; over a longer time a warming crystal drifts."""
_PARTS = 32
"""Parts of that window, with one reading kept per part."""
_MIN_PART = 2.0**-8
"""Shortest length of a part [s]."""
_BULK = 64
"""Number of latest readings that are compared with the lowest ones."""
_FAR_OUT = 2.0
"""Readings further below the latest ones than this multiple of their range, without the highest and
lowest eighth, are few and doubtful."""
_TOO_FAST = 1e-3
"""Tolerance [s] of a clock's gain beyond its crystal, due to reading errors."""


class ReadingVerdict(Enum):
    """What a reading shows, compared with the readings before it."""

    PLAUSIBLE = auto()
    BELOW_FIT = auto()
    """The fit is too high."""
    DOUBTFUL = auto()
    """Impossibly early. A single such reading may show a Mark that came twice."""
    JUMPED = auto()
    """The clock was moved, has stopped, or runs too fast."""


class _LeadBounds(NamedTuple):
    """The lowest and highest lead at a time that kept readings allow, as lines over time.

    No kept reading was later than its exchange took: this gives a lower bound. No reading shows
    less than the true lead, so a reading that is above a kept one by more than any crystal gains
    shows that the clock runs too fast.
    """

    low: float
    """Lowest lead [s] at time 0."""
    high: float
    """Highest lead [s] at time 0."""
    rate: float
    """Change of the lowest lead [s/s]; the highest one changes by MAX_CRYSTAL."""

    def at(self, time: float) -> tuple[float, float]:
        """Return the lowest and the highest lead [s] at a time [s]."""
        return self.low + self.rate * time, self.high + MAX_CRYSTAL * time


_UNBOUNDED = _LeadBounds(-math.inf, math.inf, 0.0)


class ClockReadings:
    """The readings of a clock, and the lead fitted to them; times [s] are of the host's clock."""

    fit: LeadFit
    """The lead over the host's clock."""
    is_doubted: bool
    """Whether only the last reading was impossibly early."""
    reply_bits: float = 0.0
    """Time that the bits of a Status take [s]."""
    min_exchange: float = math.inf
    """The shortest exchange, less its bits [s]."""
    _kept: list[Reading]
    """The lowest reading of each part of the time window."""
    _part: float
    """Length of the parts [s]."""
    _latest: deque[Reading]
    """The latest readings, without their possible delays."""
    _bounds: _LeadBounds
    """Bounds of the lead by the kept readings."""

    def __init__(self) -> None:
        self.forget(0.0)

    def forget(self, time: float) -> None:
        """Drop all readings, as if the clock had never been read before this time [s]."""
        self._kept = []
        self._part = _MIN_PART
        self._latest = deque(maxlen=_BULK)
        self.fit = LeadFit(time)
        self.is_doubted = False
        self._bounds = _UNBOUNDED

    def forget_kept(self) -> None:
        """Drop the kept readings; the fit stays until the next reading."""
        self._kept.clear()
        self._bounds = _UNBOUNDED

    @property
    def is_empty(self) -> bool:
        """Whether no reading is kept."""
        return not self._kept

    @property
    def are_many(self) -> bool:
        """Whether most parts of the time window have a reading, so that the rate is known."""
        return len(self._kept) > _PARTS // 2

    @property
    def shortest(self) -> float:
        """The shortest exchange less the bits [s]; its division between both ways is unknown."""
        return max(self.min_exchange, 0.0)

    def judge(
        self,
        off: float,
        time: float,
        *,
        max_early: float,
        max_delay: float,
        error: float,
        clock_error: float,
    ) -> ReadingVerdict:
        """Compare a reading at a time [s] with the earlier ones, and note if it is doubtful.

        off: its distance from the fit [s]. max_early, max_delay: by how much the request may have
        arrived before or after that time [s]. error: standard error of the lead [s].
        clock_error: maximum reading error of the clock [s].
        """
        expected = self.fit.on_line(time)
        far = FAR + _FAR_ERRORS * error + clock_error
        lowest, highest = self._bounds.at(time)
        is_early = off < lowest - expected - far - max_early
        is_late = off > max_delay + far or off > max_delay + highest - expected + _TOO_FAST
        self.is_doubted = is_early and not self.is_doubted
        if self.is_doubted:
            return ReadingVerdict.DOUBTFUL
        if is_early or is_late:
            return ReadingVerdict.JUMPED
        is_below = off < -FAR - SIGNIFICANT * error
        return ReadingVerdict.BELOW_FIT if is_below else ReadingVerdict.PLAUSIBLE

    def _note_bounds(self) -> None:
        """Note which leads the kept readings allow."""
        rate = self.fit.rate
        low = -math.inf
        high = math.inf
        for time, lead, max_delay in self._kept:
            lowest = lead - max_delay - rate * time
            if lowest > low:
                low = lowest
            highest = lead - MAX_CRYSTAL * time
            if highest < high:
                high = highest
        self._bounds = _LeadBounds(low, high, rate)

    def lower(self, off: float) -> None:
        """Lower the kept readings because a reading is far below the fit, by -off [s]."""
        for number, reading in enumerate(self._kept):
            below_fit = max(self.fit.on_line(reading.time) - reading.lead, 0.0)
            lead = reading.lead + min(off + below_fit, 0.0)
            self._kept[number] = reading._replace(lead=lead)
        self._note_bounds()

    def add(self, reading: Reading) -> None:
        """Add a reading, and fit the lead again if it is kept."""
        delay = max(self._excess_delay(reading), 0.0)
        self._latest.append(Reading(reading.time, reading.lead - delay, 0.0))
        self._keep(reading)
        if self._kept[-1].time == reading.time:
            self._update_fit(reading.time)

    def _excess_delay(self, reading: Reading) -> float:
        """Return by how much the exchange of a reading took longer than the shortest one [s]."""
        return reading.max_delay - self.min_exchange - self.reply_bits

    def _keep(self, newest: Reading) -> None:
        """Keep the lowest reading of each part of the window, which ends with the newest one."""
        while self._kept and newest.time - self._kept[0].time > _WINDOW:
            del self._kept[0]
        part = _MIN_PART
        while self._kept and newest.time - self._kept[0].time > _PARTS * part:
            part *= 2
        former_part = self._part
        self._part = part
        if part > former_part:
            kept = self._kept
            self._kept = []
            for reading in kept:
                self._keep_in_part(reading)
        self._keep_in_part(newest)

    def _keep_in_part(self, reading: Reading) -> None:
        """Keep a reading unless its part of the window has a lower one already."""
        if self._kept:
            last = self._kept[-1]
            if reading.time // self._part == last.time // self._part:
                expected = last.lead + self.fit.rate * (reading.time - last.time)
                if reading.lead > expected + CLOCK_STEP / 2:
                    return
                self._kept.pop()
        self._kept.append(reading)

    def _update_fit(self, time: float) -> None:
        """Fit the lead at a time [s], and check the fit against the latest readings."""
        kept = self._kept
        # A single reading may be as late as its whole exchange, and few readings nearly so, even if
        # they lie on a line.
        delay = self.shortest if len(kept) > 3 else kept[0].max_delay - self.reply_bits
        min_variance = (delay / len(kept) ** 2) ** 2 / 12 + MIN_ERROR**2
        fit, lowest_lead = fit_lower_half(kept, self.fit, time, min_variance)
        shortest_exchange = self.min_exchange + self.reply_bits
        recent = kept[-RECENT:]
        leads = []
        sure_leads = []  # after subtraction of the possible delays
        for (lead, _), reading in zip(
            current_leads(aged_leads_of(recent, time), fit.rate, fit.bend), recent, strict=True
        ):
            leads.append(lead)
            sure_leads.append(lead - (reading.max_delay - shortest_exchange))
        # If even the recent readings that cannot be late are far above the fit, the clock was
        # moved, and the older readings are dropped.
        if min(sure_leads) - fit.offset > FAR / 2:
            del self._kept[:-RECENT]
        error = max(fit.error, min(leads) - fit.offset)
        self.fit = self._centered(fit._replace(error=error), lowest_lead)
        self._note_bounds()

    def _centered(self, fit: LeadFit, lowest_lead: float) -> LeadFit:
        """Return a fit, in the middle of the gap if a few readings are far below most others.

        Either most readings are late, or the few are wrong; the error includes half the gap.
        """
        if len(self._latest) < _BULK:
            return fit
        latest = sorted(current_leads(aged_leads_of(self._latest, fit.time), fit.rate, fit.bend))
        low_end, _ = latest[_BULK // 8]
        high_end, _ = latest[-1 - _BULK // 8]
        gap = low_end - lowest_lead
        if gap <= _FAR_OUT * (high_end - low_end):
            return fit
        return fit._replace(offset=(lowest_lead + low_end) / 2, error=fit.error + gap / 2)
