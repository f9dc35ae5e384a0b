"""Reopening of lost amplifiers, with growing pauses, until all are disarmed and silent."""

import logging
from collections.abc import Awaitable, Callable, Sequence
from typing import Literal, TypeAlias

from controller.operation.current_operation import CurrentOperation
from controller.operation.operation_states import DaemonState, not_reopened
from controller.operation.plate_controller import Controller
from drivers.errors import DriverError, LinkError, WrongAmplifier
from model.errors import InputError
from registry import threads
from registry.threads import pauses

_RECHECK = 0.05  # s; between checks of the watchdog of a lost amplifier
_RETRY_INTERVAL = 0.5  # s; after an unexpected exception
_REOPENING = "the daemon reconnects on its own and stays disarmed"

LinkChange = Literal["degraded", "restored", "lost", "retry", "reopened"]
LinkObserver: TypeAlias = Callable[[LinkChange, Sequence[str], str], None]
"""Receives the kind of change, the affected amplifiers, if known, and a message."""

_logger = logging.getLogger(__name__)


class Reopening:
    """Opens lost amplifiers again, while the daemon is in COMM_LOST.

    report: receives each attempt. may_play: whether a lost amplifier may still be playing at a time
    [s]. is_closing: whether the daemon ends. reconnected: called once all amplifiers are silent.
    """

    def __init__(
        self,
        controller: Controller,
        current: CurrentOperation,
        report: LinkObserver,
        *,
        may_play: Callable[[float], bool],
        is_closing: Callable[[], bool],
        reconnected: Callable[[], Awaitable[None]],
    ) -> None:
        self._controller = controller
        self._current = current
        self._report = report
        self._may_play = may_play
        self._is_closing = is_closing
        self._reconnected = reconnected

    @property
    def is_due(self) -> bool:
        """Whether amplifiers are lost, and all lines are closed."""
        return self._current.state is DaemonState.COMM_LOST and self._controller.is_released

    async def run(self) -> None:
        """Open the amplifiers, and leave COMM_LOST once all are silent; ends early after an error.

        If the amplifiers are still lost then, all lines are closed.
        """
        try:
            try:
                await self._reconnect()
            finally:
                if self._current.state is DaemonState.COMM_LOST:
                    await self._controller.release()
        except DriverError as error:
            _logger.info("failed: %s", error)
        except Exception:
            _logger.exception("reconnection failed")
            await self._current.pause(_RETRY_INTERVAL)

    async def _reconnect(self) -> None:
        """Open the amplifiers, and wait until those that were lost are silent."""
        for pause in pauses():
            if self._current.state is not DaemonState.COMM_LOST:
                return
            if await self._open():
                break
            await self._current.pause(pause)
        while self._may_play(threads.now()) and not self._is_closing():
            await self._current.pause(_RECHECK)
            await self._controller.group.statuses()  # a loud amplifier can have become silent
        if self._controller.group.is_open:  # no further loss
            await self._reconnected()

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
