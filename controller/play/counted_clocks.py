"""Errors of the amplifiers' clocks as answers count them, so that a promise holds while they vary.

They are counted anew where one is worse than counted, and where all have become far better: not at
each reading, of which every one differs.
"""

import logging
from collections.abc import Callable, Mapping

from model.ensemble.draws import EXACT_CLOCKS, MAX_HELD, ClockErrors
from model.rig.rig import Rig
from model.table.table import LocalizationTable
from registry import threads

MARGIN = 1.25
"""By how much more is counted than is known."""

SETTLED = 10.0
"""Time [s] for which a clock is held until that is said, with how often it was not."""

_FAR_BETTER = 2.0  # times what is counted

_logger = logging.getLogger(__name__)


class CountedClocks:
    """Errors by amplifier of a rig; now: gives what is known, rms [s], infinite if unknown."""

    def __init__(self, rig: Rig, now: Callable[[], Mapping[str, float]]) -> None:
        self._rig, self._now = rig, now
        self._names = sorted(rig.channel_counts)
        self._counted = EXACT_CLOCKS
        self._losses = dict.fromkeys(self._names, 0)  # since it was last said to be held
        self._held_since: dict[str, float] = {}  # not said yet
        self.errors: dict[str, float] = {}
        """By name, rms [s], as counted; empty where all ERAs are on one amplifier."""

    @property
    def known(self) -> Mapping[str, float]:
        """What is known by name now, rms [s]; empty where nothing is counted."""
        return self._now() if self.errors else {}

    def counted_by(
        self, table: LocalizationTable, known: Mapping[str, float] | None = None
    ) -> LocalizationTable:
        """The table with the clocks as they are counted now; takes no time.

        known: of now, if that was looked up.
        """
        if len(self._names) < 2:
            return table
        known = known or self._now()
        if self._is_other(known):
            before, errors = self.errors, {name: MARGIN * known[name] for name in self._names}
            eras = [era.name for era in table.eras]
            self._counted = ClockErrors.of(eras, self._rig.wiring, errors)
            self.errors = errors
            self._note(before)
        for name in [*self._held_since]:  # mostly none
            if threads.now() - self._held_since[name] >= SETTLED:
                self._say_held(name)
        return table.with_clocks(self._counted)

    def is_one_lost(self, known: Mapping[str, float]) -> bool:
        """Whether one is held no longer to those with which its amplifier shares contents.

        known: of now.
        """
        for name, counted in self.errors.items():  # with each plan: no further calls
            if known[name] > counted and MARGIN * known[name] > MAX_HELD >= counted:
                return True
        return False

    def _is_other(self, known: Mapping[str, float]) -> bool:
        """Whether a clock is worse than counted, or one far better."""
        for name, counted in self.errors.items():  # as often
            if known[name] > counted or known[name] * MARGIN * _FAR_BETTER < counted:
                return True
        return not self.errors

    def _note(self, before: Mapping[str, float]) -> None:
        """Count losses; log which amplifiers play contents of their own from now on, once.

        No clock is known when its line has just been opened, so that it is no warning then.
        """
        level = logging.WARNING if before else logging.INFO
        for name, error in self.errors.items():
            was_alone = before.get(name, 0.0) > MAX_HELD
            if error <= MAX_HELD:
                if was_alone:
                    self._held_since[name] = threads.now()
            elif not was_alone:
                self._held_since.pop(name, None)
                if not self._losses[name]:
                    _logger.log(
                        level,
                        "amplifier %s: its clock is not held to the others', so its ERAs play "
                        "contents of their own; if that lasts, see its clock_error in era amp "
                        "status",
                        name,
                    )
                self._losses[name] += 1

    def _say_held(self, name: str) -> None:
        """Log that an amplifier's clock has been held for long, and how often it was not."""
        _logger.info(
            "amplifier %s: clock held to %.0f us for %.0f s, its ERAs play with the others'; "
            "losses before: %d",
            name,
            1e6 * self.errors[name],
            SETTLED,
            self._losses[name],
        )
        self._losses[name] = 0
        del self._held_since[name]
