"""Runs the daemon's state machine: applies events, carries out actions, restores lost links.

Actions come before observers: these are called a moment later, each guarded (`DeferredCalls`). An
unexpected exception in a transition or action ends in a stop of all amplifiers and in FAULT.
"""

import asyncio
import contextlib
import logging
from collections.abc import Awaitable, Callable, Coroutine, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Literal, TypeVar

from controller.daemon.deferred_calls import DeferredCalls, call_guarded
from controller.daemon.lease import Lease, check_lease
from controller.daemon.read_back import (
    READ_BACK_INTERVAL,
    are_silent,
    find_problem,
    is_any_armed,
)
from controller.daemon.states import (
    ACKNOWLEDGE,
    ENERGISED,
    Action,
    DaemonEvent,
    DaemonState,
    StateMachine,
    Trigger,
    failed,
    step,
)
from controller.loop.loop import Controller
from controller.loop.observer import Observer
from drivers import clock
from drivers.errors import (
    CommandRefused,
    DriverError,
    FrameError,
    LinkDegraded,
    LinkError,
    Preempted,
)
from drivers.host.amplifier import WATCHDOG, Amplifier
from drivers.host.comparison import name_of
from drivers.host.group import Group, GroupState
from drivers.host.stop import Stopped
from drivers.pauses import pauses
from drivers.protocol.records import Values
from drivers.protocol.table import FAULTS, NO_CHANNEL
from model.errors import InputError
from registry.plugins import failure_text

STATUS_INTERVAL = 0.5  # s; between status requests to disarmed amplifiers
_MAX_READ_BACKS = 15
_RECHECK = 0.05  # s; of whether the watchdog of a lost amplifier has passed
_SEARCHING = "check cables and supply; the daemon reconnects by itself and stays disarmed"

_LOG_LEVELS = {
    DaemonState.COMM_LOST: logging.ERROR,
    DaemonState.FAULT_REACTION_ACTIVE: logging.ERROR,
}

LEASE_OVER = DaemonEvent(Trigger.LEASE_LOST, "the arming lease was not renewed", "arm again")
LinkChange = Literal["degraded", "restored", "lost", "retry", "reopened"]
StateObserver = Callable[[StateMachine, StateMachine], None]
"""Receives the old and the new state machine."""

_logger = logging.getLogger(__name__)
_rate_limited_logger = logging.getLogger(f"{__name__}.background")
_T = TypeVar("_T")


class Supervisor:
    """Keeps the amplifiers of a controller connected, and armed only as the state machine allows.

    The controller must be created with `observe(observer)` and `connected` of this supervisor.
    state_changed are called a moment after every transition; link_changed receives the kind of
    change, the lost amplifiers ("lost" only) and a message; alive is called after each cycle of the
    control loop and periodically while there is none. watchdog [s]: of armed amplifiers.
    """

    def __init__(
        self,
        *,
        state_changed: Sequence[StateObserver],
        link_changed: Callable[[LinkChange, Sequence[str], str], None],
        alive: Callable[[], None],
        watchdog: float = WATCHDOG,
    ) -> None:
        self.machine = StateMachine(watchdog=watchdog)
        self._state_observers = (_log_transition, *state_changed)
        self._link_observer = link_changed
        self._alive_observer = alive
        self.started = asyncio.Event()  # the amplifiers are open, or searched for
        self._closing = asyncio.Event()
        self._reports = DeferredCalls()
        self._controller_if_running: Controller | None = None
        self._control_loop: asyncio.Task[None] | None = None
        self._tasks: set[asyncio.Task[Any]] = set()
        self._loss_lock = asyncio.Lock()  # held until the lost amplifiers are closed
        self._clears = 0  # in progress

    def observe(self, observer: Observer) -> Observer:
        """Wrap an observer so that the supervisor sees refusals and cycles first."""

        def refused(reason: str) -> None:
            is_armed = self.machine.state is DaemonState.OPERATION_ENABLED
            if is_armed and self._controller.group_state is GroupState.DISARMED:
                # The control loop has stopped the amplifiers by itself.
                self.post(DaemonEvent(Trigger.FAULT, reason, ACKNOWLEDGE))
            else:
                observer.refused(reason)

        def cycle_completed() -> None:
            self.tick()
            self._check_own_stop()
            self._check_degraded()
            self._alive()
            observer.cycle_completed()

        return replace(observer, refused=refused, cycle_completed=cycle_completed)

    def connected(self, amplifiers: Mapping[str, Amplifier]) -> None:
        """Listen to the events of amplifiers, by name, whose lines have been opened."""
        for name, amplifier in amplifiers.items():
            amplifier.listeners.append(partial(self._amplifier_event, name))

    async def run(self, controller: Controller) -> None:
        """Open the amplifiers, run the control loop, and reconnect after every loss, until `close`.

        Amplifiers that do not reply at the start, or refuse, are searched for as after a loss; one
        in a fault leads to the state FAULT. Raises CommandError and InputError for
        amplifiers that do not fit the configuration.
        """
        self._controller_if_running = controller
        polling = asyncio.create_task(self._poll())
        try:
            await self._open()
            self.started.set()
            while self.machine.state is not DaemonState.NOT_READY:
                if self.machine.state is DaemonState.COMM_LOST:
                    await self._restore_link()
                else:
                    await self._run_control_loop()
        finally:
            polling.cancel()
            await asyncio.gather(polling, *self._tasks, return_exceptions=True)
            self._reports.flush()

    async def _run_control_loop(self) -> None:
        """Run the control loop until it ends or a reconnection cancels it; handle its error."""
        loop = self._control_loop = asyncio.create_task(self._controller.run(), name="control loop")
        try:
            await asyncio.wait({loop})
        finally:
            self._control_loop = None
            loop.cancel()
            await asyncio.wait({loop})
        error = None if loop.cancelled() else loop.exception()
        is_over = self.machine.state in (DaemonState.COMM_LOST, DaemonState.NOT_READY)
        if error is None and self._controller.group_state is GroupState.CLOSED and not is_over:
            error = LinkError("the amplifiers must be open, got closed ones; they are opened again")
        if isinstance(error, LinkError):
            await self._in_background(self._handle_loss(error))
        elif isinstance(error, DriverError):
            raise error
        elif isinstance(error, Exception):  # unforeseen: a fault, which can be cleared
            _logger.error("control loop failed, stopping all amplifiers", exc_info=error)
            await self._fail(error)
            await asyncio.sleep(_RECHECK)

    async def close(self, cause: str) -> None:
        """Ramp down, read back, disarm and close the amplifiers; ends `run`."""
        self._closing.set()
        if self._controller_if_running is not None:
            await self.handle(DaemonEvent(Trigger.CLOSE, cause))
        self._reports.flush()

    def assume_energised(self, now: float) -> bool:
        """Whether a lost amplifier may still be playing at a time [s]; over a network for longer.

        There a request without reply may arrive late, and feed its watchdog.
        """
        machine, controller = self.machine, self._controller_if_running
        if machine.state is not DaemonState.COMM_LOST or controller is None:
            return False
        known = controller.amplifiers.values()
        may_play = any(each.feeding.may_play_until > now for each in known)
        return machine.assume_energised(now) or may_play

    def stop(self, cause: str, remedy: str | None = None) -> Awaitable[Mapping[str, Stopped]]:
        """Quick-stop all amplifiers in any state; await the outcome of each, by name.

        The requests to the amplifiers are queued when this returns.
        """
        stopping = self._spawn(self._stopped(self._controller.stop()))
        self._step(DaemonEvent(Trigger.STOP, cause, remedy))
        return asyncio.shield(stopping)

    def latch_stop(self, cause: str) -> None:
        """Latch a stop that was requested of the amplifiers already; raises nothing."""
        call_guarded(partial(self._step, DaemonEvent(Trigger.STOP, cause, ACKNOWLEDGE)))

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

    def tick(self) -> None:
        """End the lease if it has expired."""
        if self.machine.is_lease_over(clock.now()):
            self.post(LEASE_OVER)

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

    @property
    def _controller(self) -> Controller:
        if self._controller_if_running is None:
            raise RuntimeError("supervisor is not running")
        return self._controller_if_running

    def _spawn(self, work: Coroutine[Any, Any, _T]) -> "asyncio.Task[_T]":
        """Run work in a task that `run` waits for."""
        task = asyncio.ensure_future(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return task

    def _step(self, event: DaemonEvent) -> tuple[Action, ...]:
        """Apply one transition; return its actions."""
        before = self.machine
        try:
            self.machine, actions = step(before, event, clock.now())
        except Exception as error:
            self.machine, actions = failed(before, failure_text(error)), (Action.STOP,)
        self._report_transition(before)
        return actions

    def _report_transition(self, before: StateMachine) -> None:
        """Notify the observers of a new state, deferred."""
        if self.machine.state is not before.state:
            for observer in self._state_observers:
                call_guarded(partial(self._reports.add, partial(observer, before, self.machine)))

    def _link_changed(self, change: LinkChange, lost: Sequence[str], message: str) -> None:
        report = partial(self._link_observer, change, lost, message)
        call_guarded(partial(self._reports.add, report))

    def _alive(self) -> None:
        call_guarded(self._alive_observer)

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
        if self.machine.state is DaemonState.COMM_LOST and self._control_loop is not None:
            self._control_loop.cancel()  # so that amplifiers are reopened

    async def _do(self, action: Action, epoch: int) -> None:
        match action:
            case Action.VERIFY:
                await self._over_link(self._verify(epoch), epoch)
            case Action.ARM:
                await self._over_link(self._arm(), epoch)
            case Action.DISARM:
                await self._over_link(self._controller.disarm(), epoch)
            case Action.STOP:
                await self._stop()
            case Action.REACT:
                await self._stop()
                cause, remedy = self.machine.cause, self.machine.remedy
                await self.handle(DaemonEvent(Trigger.REACTION_DONE, cause, remedy))
            case Action.CLEAR:
                await self._over_link(self._clear(epoch), epoch)
            case Action.RECONNECT | Action.CLOSE:
                await self._controller.close()

    async def _over_link(self, work: Awaitable[object], epoch: int) -> None:
        """Await work that needs the link; a loss or refusal becomes an event, then is raised.

        Not where it is explained: by what has raised the epoch since, or by a stop that goes on.
        """
        try:
            await work
        except LinkError as error:
            if isinstance(error, LinkDegraded) and self.machine.state is DaemonState.SWITCHED_ON:
                await self.handle(DaemonEvent(Trigger.DISARM, "an amplifier did not reply to arm"))
            else:
                await self._handle_loss(error)
            raise
        except DriverError as error:
            is_stopping = isinstance(error, Preempted) and self.machine.is_latched
            if epoch == self.machine.epoch and not is_stopping:
                await self.handle(DaemonEvent(Trigger.FAULT, str(error), ACKNOWLEDGE))
            raise

    async def _stopped(self, stopping: Awaitable[Mapping[str, Stopped]]) -> Mapping[str, Stopped]:
        """Await a stop of all amplifiers; one that is lost is a lost link."""
        outcomes = await stopping
        try:
            await self._check_links()
        except Exception:
            _rate_limited_logger.exception("handling of a lost link failed")
        return outcomes

    async def _stop(self) -> None:
        await self._stopped(self._controller.stop())

    async def _check_links(self) -> None:
        """Handle the loss of an amplifier unless it is handled already."""
        is_handled = self.machine.state in (DaemonState.COMM_LOST, DaemonState.NOT_READY)
        causes = self._controller.group.lost_by.values()
        if causes and not is_handled:
            await self._handle_loss(LinkError(next(iter(causes))))

    async def _open(self) -> None:
        """Open and verify the amplifiers; without a good reply they are searched for."""
        try:
            await self._controller.open()
            if self._closing.is_set():
                await self._controller.close()
                return
        except (LinkError, CommandRefused, FrameError) as error:
            if self._closing.is_set():
                return
            self._link_changed("retry", (), str(error))
            event = DaemonEvent(Trigger.NOT_FOUND, str(error), _SEARCHING)
            await self._in_background(self.handle(event))
            return
        opened = DaemonEvent(Trigger.OPENED, "every amplifier has replied")
        await self._in_background(self.handle(opened))

    async def _arm(self) -> None:
        await self._controller.arm()
        await self.handle(DaemonEvent(Trigger.ARMED, self.machine.cause))

    async def _verify(self, epoch: int) -> None:
        """Disarm what still plays, then read back all amplifiers."""
        is_armed = is_any_armed(await self._controller.group.statuses())
        if is_armed and epoch == self.machine.epoch:
            await self._controller.disarm()
        problem = await self._read_back(epoch)
        if epoch != self.machine.epoch:
            return  # stopped, or verified and armed, in the meantime
        if problem is None:
            cause = "all amplifiers are disarmed, at level zero and without a fault"
            await self.handle(DaemonEvent(Trigger.VERIFIED, cause))
        else:
            await self.handle(DaemonEvent(Trigger.FAULT, problem, ACKNOWLEDGE))

    async def _clear(self, epoch: int) -> None:
        self._clears += 1
        try:
            problem = await self._read_back(epoch, clears=True)
        finally:
            self._clears -= 1
        self._check_none_since(epoch)
        if problem is None:
            await self.handle(DaemonEvent(Trigger.VERIFIED, "acknowledged, and the cause is gone"))
            return
        await self.handle(DaemonEvent(Trigger.FAULT, problem, ACKNOWLEDGE))
        raise CommandRefused(f"{problem}; the cause persists, so nothing was cleared")

    def _check_none_since(self, epoch: int) -> None:
        """Raise Preempted if a stop, fault or other clear came after an acknowledgement."""
        if epoch != self.machine.epoch:
            raise Preempted(
                "not cleared: a stop, fault or other clear came after the request; find the cause "
                "of what is latched, then clear again"
            )

    async def _read_back(self, epoch: int, *, clears: bool = False) -> str | None:
        """Read back until all amplifiers are silent; return the problem that remains, if any.

        clears: before each read, for one that is still ramping down ignores Clear. Ends early
        when the epoch rises.
        """
        problem = None
        for _ in range(_MAX_READ_BACKS):
            if clears:
                self._check_none_since(epoch)
                await self._controller.clear()
            group = self._controller.group
            problem = find_problem(await group.statuses(), group.amplifiers)
            if problem is None or epoch != self.machine.epoch:
                break
            await asyncio.sleep(READ_BACK_INTERVAL)
        return problem

    async def _handle_loss(self, error: LinkError) -> None:
        """Handle a loss; concurrent reports of the same loss wait until it is handled."""
        async with self._loss_lock:
            group = self._controller.group
            lost = [name for name in group.amplifiers if name in (*group.lost_by, *group.degraded)]
            text = str(error)
            if self.machine.state is not DaemonState.COMM_LOST:
                self._link_changed("lost", lost, text)
            cause = f"amplifier {', '.join(lost)}: {text}" if lost else text
            await self.handle(DaemonEvent(Trigger.LINK_LOST, cause, _SEARCHING))

    async def _restore_link(self) -> None:
        """Reopen the amplifiers, with growing pauses; leave COMM_LOST once they are all silent."""
        try:
            await self._controller.close()  # a pending close would close it again
            for pause in pauses():
                if self.machine.state is not DaemonState.COMM_LOST:
                    return
                if await self._reopen():
                    break
                await self._pause(pause)
            while self.assume_energised(clock.now()) and not self._closing.is_set():
                await self._pause(_RECHECK)
            if self._controller.group_state is GroupState.DISARMED:  # none was lost again
                await self.handle(DaemonEvent(Trigger.RECONNECTED))
        except DriverError as error:
            _rate_limited_logger.info("failed: %s", error)
        except Exception:
            _rate_limited_logger.exception("reconnection failed")
            await self._pause(STATUS_INTERVAL)

    async def _reopen(self) -> bool:
        """Open all amplifiers, disarmed; none that may be armed stays open."""
        try:
            await self._controller.open()
            await self._controller.disarm()  # a short loss may not have expired the watchdog
        except (DriverError, InputError) as error:
            self._link_changed("retry", (), str(error))
            await self._controller.close()
            return False
        self._link_changed("reopened", (), "all amplifiers reply again and are disarmed")
        return True

    async def _pause(self, duration: float) -> None:
        """Wait for a time [s], or until `close`."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(duration):
                await self._closing.wait()

    async def _poll(self) -> None:
        """Poll the status of disarmed amplifiers; the control loop polls armed ones.

        A stop or fault reaction that has not silenced all of them is repeated. While there is no
        control loop, these are the signs of life.
        """
        while True:
            await asyncio.sleep(STATUS_INTERVAL)
            if self._control_loop is None:
                self._alive()
            if self._controller.group_state is not GroupState.DISARMED:
                continue
            try:
                await self._check_disarmed(self._controller.group)
            except LinkError as error:
                if not self._controller.group.is_degraded_only(error):
                    await self._in_background(self._handle_loss(error))
            except DriverError:
                pass  # preempted by another request, which reports for itself
            except Exception:
                _rate_limited_logger.exception("status read failed")

    async def _check_disarmed(self, group: Group) -> None:
        epoch = self.machine.epoch
        statuses = await group.statuses()
        if epoch != self.machine.epoch:
            return  # they may have been read before
        problem, state = find_problem(statuses, group.amplifiers), self.machine.state
        if problem is not None and state is DaemonState.READY_TO_SWITCH_ON:
            fault = DaemonEvent(Trigger.FAULT, problem, ACKNOWLEDGE)
            await self._in_background(self.handle(fault))
        elif (
            not are_silent(statuses, group.amplifiers)
            and state in (DaemonState.QUICK_STOP_ACTIVE, DaemonState.FAULT)
            and not (self._clears and self.machine.is_acknowledged)  # it reads back for itself
        ):
            _rate_limited_logger.error("stop repeated: %s", problem)
            await self._stop()

    def _check_own_stop(self) -> None:
        """Post a fault where amplifiers of an armed plate are armed no longer, without a reason."""
        is_armed = self.machine.state is DaemonState.OPERATION_ENABLED
        if is_armed and self._controller.group_state is not GroupState.ARMED:
            cause = "the control loop has stopped the amplifiers, because an exchange failed"
            self.post(DaemonEvent(Trigger.FAULT, cause, ACKNOWLEDGE))

    def _check_degraded(self) -> None:
        """Note that armed amplifiers have ceased to reply, or that all reply again."""
        degraded = self._controller.degraded
        is_armed = self.machine.state is DaemonState.OPERATION_ENABLED
        if not is_armed or bool(degraded) is self.machine.is_degraded:
            return
        if degraded:
            cause = f"amplifier {', '.join(degraded)} does not reply; nothing new is played"
            self.post(DaemonEvent(Trigger.LINK_DEGRADED, cause, "check cables and supply"))
            _rate_limited_logger.warning("link: degraded: %s", cause, extra={"topic": "link"})
            self._link_changed("degraded", degraded, cause)
        elif not self._controller.group.lost_by:  # the next heartbeat reports those
            cause = "all amplifiers reply again and play what they should"
            self.post(DaemonEvent(Trigger.LINK_RESTORED, cause, "era disarm, or era stop"))
            _rate_limited_logger.info("link: restored: %s", cause, extra={"topic": "link"})
            self._link_changed("restored", (), cause)

    def _amplifier_event(self, name: str, event: Values) -> None:
        """Post a fault that an amplifier reports unsolicited, ahead of the next heartbeat."""
        if not event["fault"] or self.machine.state not in ENERGISED:
            return
        channel = "" if event["channel"] == NO_CHANNEL else f", channel {event['channel']}"
        cause = f"amplifier {name} reports {name_of(FAULTS, event['fault'])}{channel}"
        self.post(DaemonEvent(Trigger.FAULT, cause, ACKNOWLEDGE))

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
    _logger.log(
        _LOG_LEVELS.get(after.state, logging.INFO),
        "%s -> %s",
        before.state,
        after.state,
        extra={"topic": "state", "cause": after.cause, "remedy": after.remedy},
    )
