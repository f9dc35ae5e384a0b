"""Keeps the amplifiers of a plate connected, and armed only as its operation allows.

It runs the control loop, notes faults and losses, and opens lost amplifiers again.
"""

import asyncio
import contextlib
import logging
from collections.abc import Callable, Mapping, Sequence
from functools import partial

from controller.operation.operation_states import (
    ENERGISED,
    Action,
    DaemonEvent,
    DaemonState,
    Trigger,
    are_silent,
    call_guarded,
    find_problem,
)
from controller.operation.operator import LinkChange, Operator, StateObserver, remedy_of
from controller.play.planner import Observers
from drivers.errors import CommandRefused, DriverError, FrameError, LinkError
from drivers.host.amplifier import Amplifier
from drivers.host.group import GroupState
from drivers.protocol.definition import FAULTS, NO_CHANNEL, name_of
from drivers.protocol.records import Values
from model.errors import InputError
from registry import threads
from registry.threads import pauses

STATUS_INTERVAL = 0.5  # s; between status requests to disarmed amplifiers
_RECHECK = 0.05  # s; of whether the watchdog of a lost amplifier has passed

_SILENT = (GroupState.DISARMED, GroupState.STOPPED)

_logger = logging.getLogger(__name__)


class Supervisor(Operator):
    """The operation of the plate by the amplifiers of a controller.

    Its controller must be created with its `connected`, and be observed by it first.
    link_changed receives the kind of change, the amplifiers concerned where they are known, and a
    message; alive is called after each cycle of the control loop, which runs in every state.
    """

    def __init__(
        self,
        *,
        state_changed: Sequence[StateObserver],
        link_changed: Callable[[LinkChange, Sequence[str], str], None],
        alive: Callable[[], None],
    ) -> None:
        super().__init__(state_changed=state_changed, link_changed=link_changed)
        self._alive = alive
        self.started = asyncio.Event()  # the amplifiers are open, or searched for
        self._closing = asyncio.Event()

    def observe(self, loop: Observers) -> None:
        """Observe refusals, losses and cycles of the control loop."""
        loop.refused.append(self._check_own_stop)
        loop.link_lost.append(self._link_lost)
        loop.cycle_completed.append(self._cycle_completed)

    def _link_lost(self, cause: str) -> None:
        if not self._is_loss_handled:
            self._spawn(self._in_background(self._handle_loss(LinkError(cause))))

    def _cycle_completed(self) -> None:
        self._check_own_stop(
            "the control loop has stopped the amplifiers, because an exchange failed"
        )
        self._check_degraded()
        call_guarded(self._alive)

    def connected(self, amplifiers: Mapping[str, Amplifier]) -> None:
        """Listen to the events of amplifiers, by name, whose lines have been opened."""
        for name, amplifier in amplifiers.items():
            amplifier.listeners = [partial(self._amplifier_event, name)]  # of each attempt

    async def run(self) -> None:
        """Open the amplifiers, run the control loop, and reconnect after every loss, until `close`.

        Amplifiers that do not reply at the start, or refuse, are searched for as after a loss; one
        in a fault leads to the state FAULT. Raises CommandError and InputError for
        amplifiers that do not fit the configuration, RuntimeError if the control loop ends early.
        """
        loop = asyncio.create_task(self._run_control_loop(), name="control loop")
        try:
            await self._open()
            self.started.set()
            while self.operation.state is not DaemonState.NOT_READY:
                if loop.done():
                    raise RuntimeError("control loop has ended before the daemon")
                self._changed.clear()
                if self._must_reopen:
                    await self._restore_link()
                else:
                    await self._poll()
        finally:
            await asyncio.gather(*self._tasks, return_exceptions=True)
            loop.cancel()
            await asyncio.gather(loop, return_exceptions=True)
            self._reports.flush()

    async def _run_control_loop(self) -> None:
        """Run the control loop; an unforeseen exception is a fault, which can be cleared."""
        while True:
            try:
                await self.controller.cycle.run()
            except Exception as error:
                _logger.exception("control loop failed, stopping all amplifiers")
                await self._stop_after(error)
            await asyncio.sleep(_RECHECK)

    async def _stop_after(self, error: Exception) -> None:
        """Stop after a failure of the control loop, until that works; no heartbeat goes before."""
        while True:
            try:
                return await self._fail(error)
            except Exception:
                _logger.exception("stop after a failure of the control loop failed")
                await asyncio.sleep(_RECHECK)

    async def close(self, cause: str) -> None:
        """Ramp down, read back, disarm and close the amplifiers; ends `run`."""
        self._closing.set()
        await self.handle(DaemonEvent(Trigger.CLOSE, cause))
        self._reports.flush()

    async def _open(self) -> None:
        """Open and verify the amplifiers; without a good reply they are searched for."""
        event = DaemonEvent(Trigger.OPENED, "every amplifier has replied")
        try:
            await self.controller.open()
        except (LinkError, CommandRefused, FrameError) as error:
            lost = self._not_opened(error)
            event = DaemonEvent(Trigger.NOT_FOUND, str(error), remedy_of(error), amplifiers=lost)
        if self._closing.is_set():
            await self.controller.close()
        else:
            await self._in_background(self.handle(event))

    @property
    def _must_reopen(self) -> bool:
        """Whether amplifiers are lost, and all lines are closed."""
        return self.operation.state is DaemonState.COMM_LOST and self.controller.is_released

    async def _fail(self, error: Exception) -> None:
        await super()._fail(error)
        if self.operation.state is DaemonState.COMM_LOST:  # what should have closed them has failed
            await self._carry_out([Action.RECONNECT], self.operation.epoch)

    async def _restore_link(self) -> None:
        """Reopen the amplifiers, with growing pauses; leave COMM_LOST once they are all silent."""
        try:
            try:
                await self._reconnect()
            finally:
                if self.operation.state is DaemonState.COMM_LOST:
                    await self.controller.release()
        except DriverError as error:
            _logger.info("failed: %s", error)
        except Exception:
            _logger.exception("reconnection failed")
            await self._pause(STATUS_INTERVAL)

    async def _reconnect(self) -> None:
        for pause in pauses():
            if self.operation.state is not DaemonState.COMM_LOST:
                return
            if await self._reopen():
                break
            await self._pause(pause)
        while self.assume_energised(threads.now()) and not self._closing.is_set():
            await self._pause(_RECHECK)
            await self.controller.group.statuses()  # what was loud may be silent by now
        if self.controller.group.is_open:  # none was lost again
            await self.handle(DaemonEvent(Trigger.RECONNECTED))

    async def _reopen(self) -> bool:
        """Open all amplifiers, disarmed; none that may be armed stays open.

        Ports stay open between attempts: a board may restart whenever its own is opened.
        """
        try:
            await self.controller.open()
            await self.controller.disarm()  # a short loss may not have expired the watchdog
        except (DriverError, InputError) as error:
            self.note_lost(self._not_opened(error), error)
            if self.controller.group.is_open:
                await self.controller.release()
            return False
        self._link_changed("reopened", (), "all amplifiers reply again and are disarmed")
        return True

    def _not_opened(self, error: Exception) -> tuple[str, ...]:
        """Say that amplifiers could not be opened; return the names of the lost, where known."""
        lost = error.lost if isinstance(error, LinkError) else ()
        self._link_changed("retry", lost, str(error))
        return lost

    async def _pause(self, duration: float) -> None:
        """Wait for a time [s], or until `close` or a stop, for which lines are opened at once."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(duration):
                await self._changed.wait()
                self._changed.clear()

    async def _poll(self) -> None:
        """Read the status of disarmed amplifiers; the control loop reads that of armed ones.

        Then pause, or until the state changes. A stop or fault reaction that has not silenced all
        of them is repeated.
        """
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(STATUS_INTERVAL):
                while self.operation.state is not DaemonState.NOT_READY and not self._must_reopen:
                    await self._changed.wait()
                    self._changed.clear()
                return
        if self.controller.group.state not in _SILENT:
            return
        try:
            await self._check_disarmed()
        except LinkError as error:
            if not self.controller.group.members.is_degraded_only(error):
                await self._in_background(self._handle_loss(error))
        except DriverError:
            pass  # preempted by another request, which reports for itself
        except Exception:
            _logger.exception("status read failed")

    async def _check_disarmed(self) -> None:
        epoch, group = self.operation.epoch, self.controller.group
        statuses = await group.statuses()
        if epoch != self.operation.epoch or group.members.silencing:
            return  # they may have been read before, or during a ramp
        problem, state = find_problem(statuses, group.amplifiers), self.operation.state
        if problem is not None and state is DaemonState.READY_TO_SWITCH_ON:
            await self._in_background(self.handle(DaemonEvent(Trigger.FAULT, problem)))
        elif (
            not are_silent(statuses, group.amplifiers)
            and state in (DaemonState.QUICK_STOP_ACTIVE, DaemonState.FAULT)
            and self.operation.epoch not in self._clears  # a clear reads back for itself
        ):
            _logger.error("stop repeated: %s", problem)
            await self._stop()

    def _check_own_stop(self, cause: str) -> None:
        """Post a fault where the loop itself has stopped the amplifiers of an armed plate."""
        is_armed = self.operation.state is DaemonState.OPERATION_ENABLED
        if is_armed and self.controller.group.state in _SILENT:
            self.post(DaemonEvent(Trigger.FAULT, cause))

    def _check_degraded(self) -> None:
        """Say that armed amplifiers have ceased to reply, or that all reply again."""
        group, operation = self.controller.group, self.operation
        degraded = group.members.degraded
        is_said = bool(degraded) is bool(operation.degraded)
        if operation.state is not DaemonState.OPERATION_ENABLED or is_said or group.members.lost_by:
            return  # of one that is lost the next heartbeat says so
        change: LinkChange = "restored"
        remedy: str | None
        level, remedy = logging.INFO, None
        cause = "all amplifiers reply again and play what they should"
        if degraded:
            change, level, remedy = "degraded", logging.WARNING, "check cables and supply"
            why = group.amplifiers[degraded[0]].silence_cause
            cause = f"amplifier {', '.join(degraded)} does not reply; nothing new is played: {why}"
        self.post(DaemonEvent(Trigger.LINK_CHANGED, cause, remedy, amplifiers=degraded))
        _logger.log(level, "link: %s: %s", change, cause, extra={"topic": "link"})
        self._link_changed(change, degraded, cause)

    def _amplifier_event(self, name: str, event: Values) -> None:
        """Post a fault that an amplifier reports unsolicited, ahead of the next heartbeat."""
        if not event["fault"] or self.operation.state not in ENERGISED:
            return
        channel = "" if event["channel"] == NO_CHANNEL else f", channel {event['channel']}"
        cause = f"amplifier {name} reports {name_of(FAULTS, event['fault'])}{channel}"
        self.post(DaemonEvent(Trigger.FAULT, cause))
