"""The clock of an amplifier as statuses and Marks show it, and the moments that commits name."""

from drivers.judge.outputs import DRIFT, Report
from drivers.playing.uncertain import Interval
from drivers.protocol.definition import HIGH_STEPS, MAX_AHEAD, QUANTITIES, ahead, high_word

_DRIFT = DRIFT + QUANTITIES["rate"].high
"""Of the clock, at any rate."""


class ExpectedClock:
    """The clock of one amplifier, unknown at first; report: takes what is wrong; slack [s]."""

    def __init__(self, report: Report, slack: float) -> None:
        self._report, self._slack = report, slack
        self._read: tuple[int, Interval] | None = None  # the last one, and when
        self._marked: Interval | None = None
        self._is_unclear = False

    @property
    def present(self) -> int:
        """The high word that was read last, which names no moment ahead."""
        return 0 if self._read is None else high_word(self._read[0])

    @property
    def is_marked(self) -> bool:
        """Whether the next status shows the clock of a Mark."""
        return self._marked is not None

    def mark(self, when: Interval) -> None:
        """Note a Mark that comes between two times."""
        self._marked = when

    def shifted(self) -> None:
        """Note that it may go on from elsewhere."""
        self._read = None

    def unheard(self) -> None:
        """Note that the next status may show another clock than what was heard says.

        The present one, if a status before showed the Mark, or that of a Mark that came twice.
        """
        self._is_unclear = True

    def check(self, shown: int, when: Interval) -> None:
        """Note what a status shows, or compare it where it is the clock of a Mark."""
        marked, self._marked = self._marked, None
        is_unclear, self._is_unclear = self._is_unclear, False
        if is_unclear:
            return
        if marked is None:
            self._read = shown, when
        elif self._read is not None:
            clock, read = self._read
            slack = self._slack + _DRIFT * (marked[1] - read[0])
            low, high = marked[0] - read[1] - slack, marked[1] - read[0] + slack
            passed = ahead(shown, clock)
            if not low <= passed <= high:
                what, must = "time from the clock read last to that of a Mark", f"{low} to {high} s"
                self._report("clock", when[1], what, must=must, seen=passed)

    def moment(self, at: int, when: Interval) -> Interval | None:
        """Return when a set starts whose commit names a high word and comes between two times.

        None where that is surely at once.
        """
        if self._read is None:
            return when[0], when[1] + MAX_AHEAD
        clock, read = self._read
        left = ahead(at * HIGH_STEPS, clock)
        drift = _DRIFT * max(when[1] - read[0], left)
        early, late = read[0] + left - drift, read[1] + left + drift
        if early > when[1] and late <= when[0] + MAX_AHEAD:
            return early, late
        if late <= when[0] or early > when[1] + MAX_AHEAD:
            return None
        return when[0], max(when[1], late)
