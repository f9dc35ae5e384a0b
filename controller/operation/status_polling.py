"""Polling of disarmed amplifiers; the control loop reads the statuses of armed ones."""

import asyncio
import contextlib
import logging
from collections.abc import Awaitable, Callable

from controller.operation.current_operation import CurrentOperation
from controller.operation.operation_states import DaemonState
from controller.operation.plate_controller import Controller
from controller.operation.read_back import are_silent, find_problem
from drivers.errors import DriverError, LinkError
from drivers.host.group_states import GroupState

STATUS_INTERVAL = 0.5  # s; between status requests to disarmed amplifiers
SILENT_GROUP = (GroupState.DISARMED, GroupState.STOPPED)
"""States of a group that plays nothing."""

_logger = logging.getLogger(__name__)


class StatusPolling:
    """Reads the statuses of disarmed amplifiers, and starts the reaction to a problem.

    is_over: whether the polling ends, since the daemon closes or lost amplifiers must be reopened.
    is_clearing: whether a clear of an epoch is in progress, which reads back for itself. lost,
    faulty: start the reaction to a loss and to a fault. stop: repeats the stop.
    """

    def __init__(
        self,
        controller: Controller,
        current: CurrentOperation,
        *,
        is_over: Callable[[], bool],
        is_clearing: Callable[[int], bool],
        lost: Callable[[LinkError], Awaitable[None]],
        faulty: Callable[[str], Awaitable[None]],
        stop: Callable[[], Awaitable[None]],
    ) -> None:
        self._controller = controller
        self._current = current
        self._is_over = is_over
        self._is_clearing = is_clearing
        self._lost = lost
        self._faulty = faulty
        self._stop = stop

    async def poll(self) -> None:
        """Wait for the next interval, then check the amplifiers; return early if it is over."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(STATUS_INTERVAL):
                while not self._is_over():
                    await self._current.change()
                return
        if self._controller.group.state not in SILENT_GROUP:
            return
        try:
            await self._check()
        except LinkError as error:
            if not self._controller.group.members.is_degraded_only(error):
                await self._lost(error)
        except DriverError:
            pass  # preempted by another request, which reports for itself
        except Exception:
            _logger.exception("status read failed")

    async def _check(self) -> None:
        """Read all statuses; report a fault, or repeat a stop that has not silenced all."""
        epoch = self._current.value.epoch
        group = self._controller.group
        statuses = await group.statuses()
        if epoch != self._current.value.epoch or group.members.disarming:
            return  # they may have been read before, or during a ramp
        problem = find_problem(statuses, group.amplifiers)
        match self._current.state:
            case DaemonState.READY_TO_SWITCH_ON if problem is not None:
                await self._faulty(problem)
            case DaemonState.QUICK_STOP_ACTIVE | DaemonState.FAULT:
                if not self._is_clearing(epoch) and not are_silent(statuses, group.amplifiers):
                    _logger.error("stop repeated: %s", problem)
                    await self._stop()
