"""Clock errors as answers count them: updated if a clock is worse than counted, or far better."""

import logging
from collections.abc import Callable, Mapping

from model.ensemble.draws import EXACT_CLOCKS, MAX_HELD, ClockErrors
from model.rig.rig import Rig
from model.table.table import LocalizationTable
from registry import threads

MARGIN = 1.25
"""Safety factor of the assumed clock errors."""

SETTLED = 10.0
"""Time [s] that a clock is synchronized before this is logged, with the number of losses."""

_FAR_BETTER = 2.0  # ratio to the assumed error

_logger = logging.getLogger(__name__)


class CountedClocks:
    """Clock errors of a rig's amplifiers as answers count them, so that promises hold.

    now: returns the error of each amplifier by name, rms [s], infinite if it is unknown.
    """

    def __init__(self, rig: Rig, now: Callable[[], Mapping[str, float]]) -> None:
        self._rig = rig
        self._now = now
        self._names = sorted(rig.channel_counts)
        self._counted = EXACT_CLOCKS
        self._losses = dict.fromkeys(self._names, 0)  # since last logged as synchronized
        self._held_since: dict[str, float] = {}  # not logged yet
        self.errors: dict[str, float] = {}
        """Assumed RMS errors [s] by name; empty if all ERAs are on one amplifier."""

    @property
    def present_errors(self) -> Mapping[str, float]:
        """Current RMS errors [s] by name; empty if none are assumed."""
        return self._now() if self.errors else {}

    def counted_by(
        self, table: LocalizationTable, present_errors: Mapping[str, float] | None = None
    ) -> LocalizationTable:
        """Return the table with the currently assumed clock errors; takes no time.

        present_errors: if already read.
        """
        if len(self._names) < 2:
            return table
        present_errors = present_errors or self._now()
        if self._is_other(present_errors):
            former_errors = self.errors
            self.errors = {name: MARGIN * present_errors[name] for name in self._names}
            era_names = [era.name for era in table.eras]
            self._counted = ClockErrors.of(era_names, self._rig.wiring, self.errors)
            self._note(former_errors)
        if self._held_since:
            self._log_settled()
        return table.with_clocks(self._counted)

    def _log_settled(self) -> None:
        """Log which clocks have been synchronized for long enough, with their losses before."""
        now = threads.now()
        for name, held_since in [*self._held_since.items()]:
            if now - held_since < SETTLED:
                continue
            _logger.info(
                "amplifier %s: clock held to %.0f us for %.0f s, its ERAs play with the "
                "others'; losses before: %d",
                name,
                1e6 * self.errors[name],
                SETTLED,
                self._losses[name],
            )
            self._losses[name] = 0
            del self._held_since[name]

    def is_one_lost(self, present_errors: Mapping[str, float]) -> bool:
        """Whether a clock is no longer held to those with which its amplifier shares contents.

        present_errors: of the amplifiers by name [s].
        """
        for name, counted in self.errors.items():  # with each plan: no further calls
            error = present_errors[name]
            if error > counted and MARGIN * error > MAX_HELD >= counted:
                return True
        return False

    def _is_other(self, present_errors: Mapping[str, float]) -> bool:
        """Whether a clock is worse than counted, or far better."""
        for name, counted in self.errors.items():  # as often
            error = present_errors[name]
            if error > counted or error * MARGIN * _FAR_BETTER < counted:
                return True
        return not self.errors

    def _note(self, former_errors: Mapping[str, float]) -> None:
        """Count losses; log once which amplifiers play contents of their own from now on.

        That is no warning when a line has just been opened, since no clock is known then.
        """
        level = logging.WARNING if former_errors else logging.INFO
        for name, error in self.errors.items():
            was_alone = former_errors.get(name, 0.0) > MAX_HELD
            if error <= MAX_HELD:
                if was_alone:
                    self._held_since[name] = threads.now()
            elif not was_alone:
                self._held_since.pop(name, None)
                if not self._losses[name]:
                    _logger.log(
                        level,
                        "amplifier %s: its clock is not held to the others', so its ERAs play "
                        "vibrations of their own; if that lasts, see its clock_error in era amp "
                        "status",
                        name,
                    )
                self._losses[name] += 1
