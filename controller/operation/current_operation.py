"""The current operation of the plate: events replace it, and observers learn of each change."""

import asyncio
import contextlib
import secrets
from collections.abc import Callable
from functools import partial
from typing import TypeAlias

from controller.operation.deferred_calls import DeferredCalls
from controller.operation.operation_states import (
    Action,
    DaemonEvent,
    DaemonState,
    Operation,
    after_exception,
    step,
)
from registry import threads
from registry.plugins import failure_text

_EPOCHS = 2**31  # a daemon starts at a random one; all are exact as JSON numbers

StateObserver: TypeAlias = Callable[[Operation, Operation], None]
"""Receives the operation before and after a change."""


class CurrentOperation:
    """Holds the operation, notifies observers of every new epoch, and watches the lease.

    lease_over: called when the client that armed has not renewed its lease.
    """

    def __init__(self, *, lease_over: Callable[[], None]) -> None:
        # Differs from the epochs of an earlier daemon, whose clients may reconnect.
        self.value = Operation(epoch=secrets.randbelow(_EPOCHS))
        """The operation; only the methods of this class replace it."""
        self.reports = DeferredCalls()
        """Calls of observers."""
        self.observers: list[StateObserver] = []
        """Called a moment after each change of the state or its epoch."""
        self._lease_over = lease_over
        self._lease_timer: asyncio.TimerHandle | None = None
        self._changed = asyncio.Event()
        """Set by a change, until a waiting task has noticed it."""

    @property
    def state(self) -> DaemonState:
        """The state of the daemon."""
        return self.value.state

    def apply(self, event: DaemonEvent) -> tuple[Action, ...]:
        """Apply an event; return the actions of the transition."""
        try:
            operation, actions = step(self.value, event, threads.now())
        except Exception as error:
            operation = after_exception(self.value, failure_text(error))
            actions = (Action.STOP,)
        self.replace(operation)
        return actions

    def latch(self, error: Exception) -> None:
        """Latch an unexpected exception, which is a fault."""
        self.replace(after_exception(self.value, failure_text(error)))

    def replace(self, operation: Operation) -> None:
        """Adopt an operation; notify the observers of a new epoch, and watch a new lease."""
        last_operation = self.value
        self.value = operation
        if operation.epoch == last_operation.epoch:
            return
        self._changed.set()
        for observer in self.observers:
            self.reports.add(partial(observer, last_operation, operation))
        if self._lease_timer is not None:
            self._lease_timer.cancel()
        if operation.state is DaemonState.OPERATION_ENABLED:
            self.check_lease()

    def check_lease(self) -> None:
        """Report a lease that has expired, else check again when it will have."""
        now = threads.now()
        lease = self.value.lease
        if self.value.is_lease_over(now):
            self._lease_over()
        elif lease is not None:
            pause = lease.expires_at - now
            self._lease_timer = asyncio.get_running_loop().call_later(pause, self.check_lease)

    def note_change(self) -> None:
        """Wake the task that waits for a change."""
        self._changed.set()

    def note_seen(self) -> None:
        """Wait only for later changes from now on."""
        self._changed.clear()

    async def change(self) -> None:
        """Wait for a change that no task has noticed yet."""
        await self._changed.wait()
        self._changed.clear()

    async def wait_for(self, condition: Callable[[], bool], duration: float) -> bool:
        """Wait for a condition, checked after each change; False if a time [s] ends before."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(duration):
                while not condition():
                    await self.change()
                return True
        return False

    async def pause(self, duration: float) -> None:
        """Wait for a time [s], or until there is a change."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(duration):
                await self.change()
