"""The operation of the plate: the one owner of its state, and who may change it by which event.

Actions come before observers: these are called a moment later, each guarded (`DeferredCalls`).
"""

import asyncio
import logging
import secrets
from abc import ABC, abstractmethod
from collections.abc import Awaitable, Callable, Coroutine, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, TypeVar

from controller.daemon.deferred_calls import DeferredCalls, call_guarded
from controller.daemon.lease import Lease, check_lease
from controller.daemon.states import (
    ACKNOWLEDGE,
    Action,
    DaemonEvent,
    DaemonState,
    StateMachine,
    Trigger,
    failed,
    step,
)
from drivers import clock
from drivers.errors import DriverError
from registry.plugins import failure_text

_EPOCHS = 2**31  # of which a daemon begins at one by chance: exact as numbers of JSON
LEASE_OVER = DaemonEvent(Trigger.LEASE_LOST, "the arming lease was not renewed", "arm again")
StateObserver = Callable[[StateMachine, StateMachine], None]
"""Receives the old and the new state machine."""

_LOG_LEVELS = {
    DaemonState.COMM_LOST: logging.ERROR,
    DaemonState.FAULT_REACTION_ACTIVE: logging.ERROR,
}

_logger = logging.getLogger(__name__)
_rate_limited_logger = logging.getLogger(f"{__name__}.background")
_T = TypeVar("_T")


class Operation(ABC):
    """Applies events to the state machine and has their actions carried out.

    An unexpected exception in a transition or action ends in a stop of all amplifiers and in FAULT.
    state_changed are called a moment after every change of the state or its epoch.
    """

    def __init__(self, state_changed: Sequence[StateObserver]) -> None:
        # Not that of a daemon before, whose clients may be left.
        self.machine = StateMachine(epoch=secrets.randbelow(_EPOCHS))
        self._state_observers = (_log_transition, *state_changed)
        self._reports = DeferredCalls()
        self._tasks: set[asyncio.Task[Any]] = set()
        self._lease_timer: asyncio.TimerHandle | None = None
        self._changed = asyncio.Event()  # to another state, since `run` has looked at it

    @abstractmethod
    async def _do(self, action: Action, epoch: int) -> None:
        """Carry out an action of an event that came in an epoch."""

    @abstractmethod
    async def _stop(self) -> None:
        """Quick-stop all amplifiers."""

    @abstractmethod
    def _energised_until(self, now: float) -> float:
        """When [s] amplifiers that are lost now must be silent."""

    async def handle(self, event: DaemonEvent) -> None:
        """Apply an event and carry out its actions; raises the error of an action.

        The actions are completed even if the caller is cancelled.
        """
        try:
            await asyncio.shield(self._spawn(self._applied(event)))
        except (DriverError, asyncio.CancelledError):
            raise
        except Exception as error:
            await self._fail(error)
            raise

    def post(self, event: DaemonEvent) -> None:
        """Apply an event at once and carry out its actions in a task."""
        self._spawn(self._in_background(self._applied(event)))

    def latch_stop(self, cause: str) -> None:
        """Latch a stop that was requested of the amplifiers already; raises nothing."""
        call_guarded(partial(self._step, DaemonEvent(Trigger.STOP, cause, ACKNOWLEDGE)))

    def renew(self, token: str) -> Lease:
        """Renew the lease of a token; raises RpcError if it has expired or is another's."""
        now = clock.now()
        lease = check_lease(self.machine.lease, token, now).renewed(now)
        self.machine = replace(self.machine, lease=lease)
        return lease

    def withdraw(self, token: str, cause: str) -> None:
        """Disarm, unless the lease of a token has ended."""
        lease = self.machine.lease
        if lease is not None and lease.token == token:
            self.post(DaemonEvent(Trigger.LEASE_LOST, cause, "arm again"))

    def tick(self) -> None:
        """End the lease if it has expired, else look again when it will have."""
        machine, now = self.machine, clock.now()
        if machine.is_lease_over(now):
            self.post(LEASE_OVER)
        elif machine.lease is not None:
            pause = machine.lease.expires_at - now
            self._lease_timer = asyncio.get_running_loop().call_later(pause, self.tick)

    def _spawn(self, work: Coroutine[Any, Any, _T]) -> "asyncio.Task[_T]":
        """Run work in a task that `run` waits for."""
        task = asyncio.ensure_future(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return task

    def _step(self, event: DaemonEvent) -> tuple[Action, ...]:
        """Apply one transition; return its actions."""
        before, now = self.machine, clock.now()
        try:
            if event.trigger in (Trigger.LINK_LOST, Trigger.NOT_FOUND):
                event = replace(event, energised_until=self._energised_until(now))
            self.machine, actions = step(before, event, now)
        except Exception as error:
            self.machine, actions = failed(before, failure_text(error)), (Action.STOP,)
        self._report_transition(before)
        return actions

    def _report_transition(self, before: StateMachine) -> None:
        """Notify the observers of a new epoch, deferred; look after a lease that has begun."""
        if self.machine.epoch == before.epoch:
            return
        self._changed.set()
        for observer in self._state_observers:
            call_guarded(partial(self._reports.add, partial(observer, before, self.machine)))
        if self._lease_timer is not None:
            self._lease_timer.cancel()
        if self.machine.state is DaemonState.OPERATION_ENABLED:
            self.tick()

    def _applied(self, event: DaemonEvent) -> Coroutine[Any, Any, None]:
        """Apply an event; await its actions."""
        actions = self._step(event)
        return self._carry_out(actions, self.machine.epoch)

    async def _carry_out(self, actions: Sequence[Action], epoch: int) -> None:
        for action in actions:
            await self._do(action, epoch)

    async def _fail(self, error: Exception) -> None:
        """Stop all amplifiers after an unexpected exception, which is a fault."""
        before, self.machine = self.machine, failed(self.machine, failure_text(error))
        self._report_transition(before)
        await asyncio.shield(self._spawn(self._stop()))

    async def _in_background(self, work: Awaitable[object]) -> None:
        """Await work without a caller: its errors are already part of the state."""
        try:
            await work
        except DriverError as error:
            _rate_limited_logger.info("failed: %s", error)
        except Exception as error:
            _rate_limited_logger.exception("failed, stopping all amplifiers")
            await self._fail(error)


def _log_transition(before: StateMachine, after: StateMachine) -> None:
    if after.state is before.state:
        return
    _logger.log(
        _LOG_LEVELS.get(after.state, logging.INFO),
        "%s -> %s",
        before.state,
        after.state,
        extra={"topic": "state", "cause": after.cause, "remedy": after.remedy},
    )
