"""Reopening of lost amplifiers, with growing pauses, until all are disarmed and silent."""

from collections.abc import Callable, Sequence
from typing import Literal, TypeAlias

from controller.operation.current_operation import CurrentOperation
from controller.operation.operation_states import DaemonState, not_reopened
from controller.operation.plate_controller import Controller
from drivers.errors import DriverError, LinkError, WrongAmplifier
from drivers.host.stops import StopOutcome
from model.errors import InputError
from registry import threads
from registry.retries import pauses

_RECHECK = 0.05  # s; between checks of the watchdog of a lost amplifier
_REOPENING = "the daemon reconnects on its own and stays disarmed"

LinkChange = Literal["degraded", "restored", "lost", "retry", "reopened"]
LinkObserver: TypeAlias = Callable[[LinkChange, Sequence[str], str], None]
"""Receives the kind of change, the affected amplifiers, if known, and a message."""


class Reopening:
    """Opens lost amplifiers again while the daemon is in COMM_LOST, and knows what they may play.

    report: receives each attempt.
    """

    def __init__(
        self, controller: Controller, current: CurrentOperation, report: LinkObserver
    ) -> None:
        self._controller = controller
        self._current = current
        self._report = report

    @property
    def is_due(self) -> bool:
        """Whether amplifiers are lost, and all lines are closed."""
        return self._current.state is DaemonState.COMM_LOST and self._controller.is_released

    def assume_energised(self, now: float) -> bool:
        """Whether a lost amplifier may still be playing at a time [s]."""
        if self._current.value.lost is None:
            return False
        ends = [self.what_may_play(name).may_play_until for name in self._controller.urls]
        return now < max(ends, default=now)

    def what_may_play(self, name: str) -> StopOutcome:
        """Return what an amplifier may be playing, and why no more is known."""
        operation = self._current.value
        lost = operation.lost
        is_named = lost is not None and name in (lost.names or self._controller.urls)
        return self._controller.what_may_play(name, operation.cause if is_named else "")

    async def reopen(self) -> bool:
        """Open the amplifiers, and wait until those that were lost are silent.

        Returns whether all are open; False if the daemon ends, or after a further loss.
        """
        for pause in pauses():
            if self._current.state is not DaemonState.COMM_LOST:
                return False
            if await self._open():
                break
            await self._current.pause(pause)
        while self._current.state is DaemonState.COMM_LOST and self.assume_energised(threads.now()):
            await self._current.pause(_RECHECK)
            await self._controller.group.statuses()  # a loud amplifier can have become silent
        return self._controller.group.is_open

    async def _open(self) -> bool:
        """Open and disarm all amplifiers, or release them; return whether that worked.

        Ports stay open between attempts: a board may restart whenever its own is opened.
        """
        try:
            await self._controller.open()
            await self._controller.disarm()  # a short loss may not have expired the watchdog
        except (DriverError, InputError) as error:
            names = self.report_failure(error)
            remedy = reopening_remedy(error)
            self._current.replace(not_reopened(self._current.value, error, remedy, names))
            if self._controller.group.is_open:
                await self._controller.release()
            return False
        self._report("reopened", (), "all amplifiers reply again and are disarmed")
        return True

    def report_failure(self, error: Exception) -> tuple[str, ...]:
        """Report that amplifiers could not be opened; return the names of the lost, if known."""
        lost = error.lost if isinstance(error, LinkError) else ()
        self._report("retry", lost, str(error))
        return lost


def reopening_remedy(error: Exception) -> str:
    """Return the remedy for amplifiers that cannot be opened."""
    if isinstance(error, WrongAmplifier):
        return _REOPENING
    return f"check cables and supply; {_REOPENING}"
