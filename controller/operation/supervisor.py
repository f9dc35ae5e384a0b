"""Supervisor of a plate: its operation, its links, and the handling of faults and losses.

An event replaces the operation (`CurrentOperation`), the controller carries out the resulting
actions, and the outcome of each action at the amplifiers is the next event. Actions come before
observers, which are called a moment later, each guarded (`DeferredCalls`).

Actions run in tasks of their own (`_spawn`). A caller that is cancelled, such as the request of a
client that has left, stops waiting, but the task continues to its end. `run` waits for all tasks
before it returns; only a cancellation of `run` ends them early. A stop does not wait for these
tasks: its requests to the amplifiers are queued before the operation changes. An exception that no
action expects stops all amplifiers in one place (`_guarded`).

The supervisor also runs the control loop, polls the statuses of disarmed amplifiers, and opens lost
ones again (`Reopening`).
"""

import asyncio
import logging
from collections.abc import Awaitable, Callable, Coroutine, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, TypeVar

from controller.operation.current_operation import CurrentOperation
from controller.operation.deferred_calls import call_guarded
from controller.operation.operation_states import (
    ENERGISED,
    Action,
    DaemonEvent,
    DaemonState,
    Lease,
    Operation,
    Trigger,
    fault_remedy,
)
from controller.operation.plate_controller import Controller
from controller.operation.read_back import (
    SILENT_GROUP,
    STATUS_INTERVAL,
    are_silent,
    find_problem,
    is_any_armed,
)
from controller.operation.reopening import (
    LinkChange,
    LinkObserver,
    Reopening,
    reopening_remedy,
)
from drivers.errors import (
    CommandRefused,
    DriverError,
    FrameError,
    LinkDegraded,
    LinkError,
    Preempted,
)
from drivers.host.amplifier import Amplifier
from drivers.host.stops import StopOutcome
from drivers.protocol.definition import FAULTS, NO_CHANNEL, name_of
from drivers.protocol.records import Values
from registry import threads

_LOOP_PAUSE = 0.05  # s; before the control loop runs again after a failure
_READ_BACK_INTERVAL = 0.02  # s
_RETRY_INTERVAL = 0.5  # s; after an unexpected exception while amplifiers are reopened
_MAX_READ_BACKS = 15

LEASE_OVER = DaemonEvent(Trigger.DISARM, "the arming lease was not renewed", "arm again")

_LOG_LEVELS = {
    DaemonState.COMM_LOST: logging.ERROR,
    DaemonState.FAULT_REACTION_ACTIVE: logging.ERROR,
}

_logger = logging.getLogger(__name__)
_T = TypeVar("_T")


class Supervisor:
    """Operates the amplifiers of a controller: applies events, and keeps the links open.

    It observes the control loop before all other observers. An unexpected exception in a transition
    or action stops all amplifiers and ends in FAULT.

    controller: opens, arms and stops the amplifiers.
    alive: called after each cycle of the control loop, which runs in every state.
    """

    def __init__(self, controller: Controller, *, alive: Callable[[], None]) -> None:
        self.controller = controller
        self.current = CurrentOperation(lease_over=partial(self.post, LEASE_OVER))
        """The current operation, with the observers of its state."""
        self.current.observers.append(_log_transition)
        self.link_observers: list[LinkObserver] = []
        """Observers of the links to the amplifiers."""
        self.started = asyncio.Event()
        """Set once the amplifiers are open, or searched for."""
        self.closing = asyncio.Event()
        """Set once the daemon ends."""
        self.tasks: set[asyncio.Task[Any]] = set()
        """Actions in progress."""
        self.reopening = Reopening(controller, self.current, self._report_link)
        """Opens lost amplifiers again."""
        self._alive = alive
        self._loss_lock = asyncio.Lock()
        """Held until the lost amplifiers are closed."""
        self._clears: list[int] = []
        """Epochs of clears in progress."""
        controller.connected.insert(0, self._listen)
        loop = controller.cycle.observers
        loop.refused.insert(0, self._report_own_stop)
        loop.link_lost.insert(0, self._lost_in_control_loop)
        loop.cycle_completed.insert(0, self._cycle_completed)

    @property
    def operation(self) -> Operation:
        """The current operation."""
        return self.current.value

    def _listen(self, amplifiers: Mapping[str, Amplifier]) -> None:
        """Listen to amplifiers, by name, whose lines have just been opened."""
        for name, amplifier in amplifiers.items():
            amplifier.listeners = [partial(self._amplifier_event, name)]  # of each attempt

    async def run(self) -> None:
        """Open the amplifiers, run the control loop, and reconnect after every loss, until `close`.

        Amplifiers that do not reply at the start, or refuse, are searched for as after a loss; one
        in a fault leads to the state FAULT. Raises CommandError and InputError for amplifiers that
        do not fit the configuration, RuntimeError if the control loop ends early.
        """
        control_loop = asyncio.create_task(self._run_control_loop(), name="control loop")
        try:
            await self._open()
            self.started.set()
            while self.operation.state is not DaemonState.NOT_READY:
                if control_loop.done():  # it never ends by itself, so it was cancelled
                    raise RuntimeError("control loop has ended before the daemon")
                self.current.note_seen()
                if self.reopening.is_due:
                    await self._reopen()
                elif not await self.current.wait_for(self._is_polling_over, STATUS_INTERVAL):
                    await self._poll()
        finally:
            while self.tasks:  # a task may start another one
                await asyncio.gather(*self.tasks, return_exceptions=True)
            control_loop.cancel()
            await asyncio.gather(control_loop, return_exceptions=True)
            self.current.reports.flush()

    async def close(self, cause: str) -> None:
        """Ramp down, read back, disarm and close the amplifiers; then `run` ends."""
        self.closing.set()
        await self.handle(DaemonEvent(Trigger.CLOSE, cause))
        self.current.reports.flush()

    async def handle(self, event: DaemonEvent) -> None:
        """Apply an event and carry out its actions; raises the error of an action.

        The actions are completed even if the caller is cancelled.
        """
        await asyncio.shield(self._spawn(self._guarded(self._apply(event))))

    def post(self, event: DaemonEvent) -> None:
        """Apply an event immediately and carry out its actions in a task."""
        self._in_background(self._apply(event))

    def stop(self, cause: str, remedy: str | None = None) -> Awaitable[Mapping[str, StopOutcome]]:
        """Quick-stop all amplifiers in any state; await the outcome of each, by name.

        The requests to the amplifiers are queued when this returns. They come before the event, so
        that no failure of the transition can delay them; the event therefore has no action.
        """
        stopping = self._spawn(self._await_stop(self.controller.stop_all()))
        self.current.apply(DaemonEvent(Trigger.STOP, cause, remedy))
        return asyncio.shield(stopping)

    def stop_despite_failure(self) -> Awaitable[object]:
        """Stop all amplifiers, and latch that, after `stop` has failed for a client.

        The failure may lie in `stop_all`, which also waits for closed lines to open. So this calls
        only what `stop_all` begins with, and the requests do not depend on the transition.
        """
        cause = "stopped, though the request failed on its way"
        try:
            return asyncio.ensure_future(self.controller.group.stop())
        finally:
            event = DaemonEvent(Trigger.STOP, cause, fault_remedy(cause))
            call_guarded(partial(self.current.apply, event))

    def renew(self, lease: Lease) -> Lease:
        """Return the lease of the client that armed, renewed; it must not have ended."""
        renewed = lease.renewed(threads.now())
        self.current.replace(replace(self.operation, lease=renewed))
        return renewed

    def withdraw(self, token: str, cause: str) -> None:
        """Disarm if the lease of a token is still in force."""
        lease = self.operation.lease
        if lease is not None and lease.token == token:
            self.post(DaemonEvent(Trigger.DISARM, cause, "arm again"))

    def _apply(self, event: DaemonEvent) -> Coroutine[Any, Any, None]:
        """Apply an event immediately; return its actions, which must be awaited in a task."""
        actions = self.current.apply(event)
        return self._carry_out(actions, self.operation.epoch)

    async def _latch_and_stop(self, error: Exception) -> None:
        """Stop all amplifiers after an unexpected exception, which is a fault."""
        self.current.latch(error)
        await asyncio.shield(self._spawn(self._quick_stop()))
        if self.operation.state is DaemonState.COMM_LOST:  # what should have closed them has failed
            await self._carry_out([Action.RECONNECT], self.operation.epoch)

    def _spawn(self, work: Coroutine[Any, Any, _T]) -> "asyncio.Task[_T]":
        """Run work in a task of its own, for which `run` waits."""
        task = asyncio.ensure_future(work)
        self.tasks.add(task)
        task.add_done_callback(self.tasks.discard)
        return task

    async def _guarded(self, work: Awaitable[object]) -> None:
        """Await work that is not part of other guarded work; stop all if it fails unexpectedly."""
        try:
            await work
        except DriverError:
            raise
        except Exception as error:
            await self._latch_and_stop(error)
            raise

    def _in_background(self, work: Awaitable[object]) -> "asyncio.Task[None]":
        """Run guarded work without a caller in a task; its errors are part of the state."""
        return self._spawn(self._logged(work))

    async def _logged(self, work: Awaitable[object]) -> None:
        """Await guarded work, and log its error."""
        try:
            await self._guarded(work)
        except DriverError as error:
            _logger.info("failed: %s", error)
        except Exception:
            _logger.exception("failed, stopping all amplifiers")

    async def _carry_out(self, actions: Sequence[Action], epoch: int) -> None:
        """Carry out the actions of a transition to an epoch, one after the other."""
        for action in actions:
            match action:
                case Action.VERIFY:
                    await self._over_link(self._verify(epoch), epoch)
                case Action.ARM:
                    await self._over_link(self._arm(), epoch)
                case Action.DISARM:
                    await self._over_link(self.controller.disarm(), epoch)
                case Action.STOP:
                    await self._quick_stop()
                case Action.REACT:
                    await self._quick_stop()
                    await self._apply(DaemonEvent(Trigger.REACTION_DONE))
                case Action.CLEAR:
                    await self._over_link(self._clear(epoch), epoch)
                case Action.RECONNECT:
                    await self.controller.release()
                    self.current.note_change()
                case Action.CLOSE:
                    await self.controller.close()

    async def _over_link(self, work: Awaitable[object], epoch: int) -> None:
        """Await work of an epoch that needs the link; handle the event of its error, and raise."""
        try:
            await work
        except DriverError as error:
            match self._trigger_of(error, epoch):
                case Trigger.LINK_LOST:
                    await self._handle_loss(error)
                case Trigger.DISARM:
                    cause = "an amplifier did not reply to arm"
                    await self._apply(DaemonEvent(Trigger.DISARM, cause))
                case Trigger.FAULT:
                    await self._apply(DaemonEvent(Trigger.FAULT, str(error)))
            raise

    def _trigger_of(self, error: DriverError, epoch: int) -> Trigger | None:
        """Return the kind of event that an error of an action is; None if it is expected.

        epoch: when the action began. A later epoch, or a stop in progress, explains an error.
        """
        if isinstance(error, LinkDegraded) and self.operation.state is DaemonState.SWITCHED_ON:
            return Trigger.DISARM
        if isinstance(error, LinkError):
            return Trigger.LINK_LOST
        is_stopping = isinstance(error, Preempted) and self.operation.is_latched
        if epoch != self.operation.epoch or is_stopping:
            return None
        return Trigger.FAULT

    async def _arm(self) -> None:
        await self.controller.arm()
        await self._apply(DaemonEvent(Trigger.ARMED, self.operation.cause))

    async def _quick_stop(self) -> None:
        """Quick-stop all amplifiers on open lines."""
        await self._await_stop(self.controller.stop())

    async def _await_stop(
        self, stopping: Awaitable[Mapping[str, StopOutcome]]
    ) -> Mapping[str, StopOutcome]:
        """Await a stop; the loss of an amplifier is handled after its return."""
        stopped = await stopping
        self._in_background(self._handle_new_loss())  # which may stop all once more
        return stopped

    async def _verify(self, epoch: int) -> None:
        """Disarm what still plays, then read back all amplifiers."""
        is_armed = is_any_armed(await self.controller.group.statuses())
        if is_armed and epoch == self.operation.epoch:
            await self.controller.disarm()
        problem = await self._read_back(epoch)
        if epoch != self.operation.epoch:
            return  # stopped, or verified and armed, in the meantime
        if problem is None:
            cause = "all amplifiers are disarmed, at level zero and without a fault"
            await self._apply(DaemonEvent(Trigger.VERIFIED, cause))
        else:
            await self._apply(DaemonEvent(Trigger.FAULT, problem))

    async def _clear(self, epoch: int) -> None:
        self._clears.append(epoch)
        try:
            problem = await self._read_back(epoch, clears=True)
        finally:
            self._clears.remove(epoch)
        self._check_none_since(epoch)
        if problem is None:
            await self._apply(DaemonEvent(Trigger.VERIFIED, "acknowledged, and the cause is gone"))
            return
        await self._apply(DaemonEvent(Trigger.FAULT, problem))
        raise CommandRefused(f"{problem}; the cause persists, so nothing was cleared")

    def _check_none_since(self, epoch: int) -> None:
        """Raise Preempted if a stop, fault or other clear came after the request."""
        if epoch != self.operation.epoch:
            raise Preempted(
                "not cleared: a stop, fault or other clear came after the request; check the "
                "status, then clear again"
            )

    async def _read_back(self, epoch: int, *, clears: bool = False) -> str | None:
        """Read back until all amplifiers are silent; return the problem that remains, if any.

        clears: whether Clear is sent before each read; an amplifier that is still ramping down
        ignores it. Ends early when the epoch rises.
        """
        problem = None
        for _ in range(_MAX_READ_BACKS):
            if clears:
                self._check_none_since(epoch)
                await self.controller.clear()
            group = self.controller.group
            problem = find_problem(await group.statuses(), group.amplifiers)
            if problem is None or epoch != self.operation.epoch:
                break
            await asyncio.sleep(_READ_BACK_INTERVAL)
        return problem

    async def _open(self) -> None:
        """Open and verify the amplifiers; search for them if one does not reply as expected."""
        event = DaemonEvent(Trigger.OPENED, "every amplifier has replied")
        try:
            await self.controller.open()
        except (LinkError, CommandRefused, FrameError) as error:
            lost = self.reopening.report_failure(error)
            remedy = reopening_remedy(error)
            event = DaemonEvent(Trigger.NOT_FOUND, str(error), remedy, amplifiers=lost)
        if self.closing.is_set():
            await self.controller.close()
        else:
            await asyncio.shield(self._in_background(self._apply(event)))

    async def _handle_loss(self, error: DriverError) -> None:
        """Handle a loss; concurrent reports of the same loss wait until it is handled."""
        async with self._loss_lock:
            group = self.controller.group
            lost = (*group.members.lost_by, *group.members.degraded)
            if self.operation.state is not DaemonState.COMM_LOST:
                self._report_link("lost", lost, str(error))
            cause = f"amplifier {', '.join(lost)}: {error}" if lost else str(error)
            remedy = reopening_remedy(error)
            event = DaemonEvent(Trigger.LINK_LOST, cause, remedy, amplifiers=lost)
            await self._apply(event)

    async def _handle_new_loss(self) -> None:
        """Handle the loss of an amplifier unless it is handled already."""
        causes = self.controller.group.members.lost_by.values()
        if causes and not self._is_loss_handled:
            await self._handle_loss(LinkError(next(iter(causes))))

    @property
    def _is_loss_handled(self) -> bool:
        """Whether amplifiers are lost or closed already."""
        return self.operation.state in (DaemonState.COMM_LOST, DaemonState.NOT_READY)

    def _report_link(self, change: LinkChange, lost: Sequence[str], message: str) -> None:
        """Report a change of the links to the observers, a moment later."""
        for observer in self.link_observers:
            self.current.reports.add(partial(observer, change, lost, message))

    async def _run_control_loop(self) -> None:
        """Run the control loop; an unforeseen exception is a fault, which can be cleared."""
        while True:
            try:
                await self.controller.cycle.run()
            except Exception as error:
                _logger.exception("control loop failed, stopping all amplifiers")
                await self._repeat_latch_and_stop(error)
            await asyncio.sleep(_LOOP_PAUSE)

    async def _repeat_latch_and_stop(self, error: Exception) -> None:
        """Stop all amplifiers until that works; no heartbeat goes before."""
        while True:
            try:
                return await self._latch_and_stop(error)
            except Exception:
                _logger.exception("stop after a failure of the control loop failed")
                await asyncio.sleep(_LOOP_PAUSE)

    def _cycle_completed(self) -> None:
        """Report what the control loop has done to the amplifiers in a cycle."""
        self._report_own_stop(
            "the control loop has stopped the amplifiers, because an exchange failed"
        )
        self._report_degraded()
        call_guarded(self._alive)

    def _lost_in_control_loop(self, cause: str) -> None:
        """Handle a loss that the control loop has noticed."""
        if not self._is_loss_handled:
            self._in_background(self._handle_loss(LinkError(cause)))

    def _report_own_stop(self, cause: str) -> None:
        """Post a fault if the control loop itself has stopped the amplifiers of an armed plate."""
        is_armed = self.operation.state is DaemonState.OPERATION_ENABLED
        if is_armed and self.controller.group.state in SILENT_GROUP:
            self.post(DaemonEvent(Trigger.FAULT, cause))

    def _report_degraded(self) -> None:
        """Report which armed amplifiers have stopped replying, or that all reply again."""
        group = self.controller.group
        degraded = group.members.degraded
        is_reported = degraded == self.operation.degraded
        if self.operation.state is not DaemonState.OPERATION_ENABLED or is_reported:
            return
        if group.members.lost_by:
            return  # the next heartbeat reports a lost amplifier
        change: LinkChange = "restored"
        level = logging.INFO
        cause = "all amplifiers reply again and play correctly"
        remedy: str | None = None
        if degraded:
            change = "degraded"
            level = logging.WARNING
            no_reply_cause = group.amplifiers[degraded[0]].no_reply_cause
            cause = (
                f"amplifier {', '.join(degraded)} does not reply; nothing new is played: "
                f"{no_reply_cause}"
            )
            remedy = "check cables and supply"
        self.post(DaemonEvent(Trigger.LINK_CHANGED, cause, remedy, amplifiers=degraded))
        _logger.log(level, "link: %s: %s", change, cause, extra={"topic": "link"})
        self._report_link(change, degraded, cause)

    def _amplifier_event(self, name: str, event: Values) -> None:
        """Post a fault that an amplifier reports unsolicited, ahead of the next heartbeat."""
        if not event["fault"] or self.operation.state not in ENERGISED:
            return
        cause = f"amplifier {name} reports {name_of(FAULTS, event['fault'])}"
        if event["channel"] != NO_CHANNEL:
            cause += f", channel {event['channel']}"
        self.post(DaemonEvent(Trigger.FAULT, cause))

    def _is_polling_over(self) -> bool:
        """Whether `run` ends, or must reopen lost amplifiers."""
        return self.operation.state is DaemonState.NOT_READY or self.reopening.is_due

    async def _poll(self) -> None:
        """Read the statuses of disarmed amplifiers, and react to a loss or problem."""
        group = self.controller.group
        if group.state not in SILENT_GROUP:
            return
        epoch = self.operation.epoch
        try:
            statuses = await group.statuses()
        except LinkError as error:
            if not group.members.is_degraded_only(error):
                await asyncio.shield(self._in_background(self._handle_loss(error)))
        except DriverError:
            pass  # preempted by another request, which reports for itself
        except Exception:
            _logger.exception("status read failed")
        else:
            # Otherwise they may have been read before the present epoch, or during a ramp.
            if epoch == self.operation.epoch and not group.members.disarming:
                await self._react_to(statuses)

    async def _react_to(self, statuses: Mapping[str, Values]) -> None:
        """React to statuses of disarmed amplifiers: a fault, or a stop that has not silenced all.

        A clear in progress reads back for itself.
        """
        amplifiers = self.controller.group.amplifiers
        problem = find_problem(statuses, amplifiers)
        match self.operation.state:
            case DaemonState.READY_TO_SWITCH_ON if problem is not None:
                event = DaemonEvent(Trigger.FAULT, problem)
                await asyncio.shield(self._in_background(self._apply(event)))
            case DaemonState.QUICK_STOP_ACTIVE | DaemonState.FAULT:
                is_clearing = self.operation.epoch in self._clears
                if not is_clearing and not are_silent(statuses, amplifiers):
                    _logger.error("stop repeated: %s", problem)
                    await asyncio.shield(self._in_background(self._quick_stop()))

    async def _reopen(self) -> None:
        """Open lost amplifiers again, and leave COMM_LOST; close all lines if any is still lost."""
        try:
            try:
                if await self.reopening.reopen():
                    await self.handle(DaemonEvent(Trigger.RECONNECTED))
            finally:
                if self.operation.state is DaemonState.COMM_LOST:
                    await self.controller.release()
        except DriverError as error:
            _logger.info("failed: %s", error)
        except Exception:
            _logger.exception("reconnection failed")
            await self.current.pause(_RETRY_INTERVAL)


def _log_transition(old: Operation, new: Operation) -> None:
    if new.state is old.state:
        return
    _logger.log(
        _LOG_LEVELS.get(new.state, logging.INFO),
        "%s -> %s: %s",
        old.state,
        new.state,
        new.cause,
        extra={"topic": "state", "cause": new.cause, "remedy": new.remedy},
    )
