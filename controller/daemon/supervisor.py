"""Keeps the amplifiers of a plate connected, and armed only as its operation allows.

It carries out the actions of the state machine, tells it of faults and losses, and opens lost
amplifiers again.
"""

import asyncio
import contextlib
import logging
import math
from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Literal

from controller.daemon.deferred_calls import call_guarded
from controller.daemon.operation import Operation, StateObserver
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
    Trigger,
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
from drivers.host.amplifier import Amplifier
from drivers.host.stop import Stopped
from drivers.pauses import pauses
from drivers.protocol.records import Values
from drivers.protocol.table import FAULTS, NO_CHANNEL, name_of
from model.errors import InputError

STATUS_INTERVAL = 0.5  # s; between status requests to disarmed amplifiers
_MAX_READ_BACKS = 15
_RECHECK = 0.05  # s; of whether the watchdog of a lost amplifier has passed
_WATCHDOG_MARGIN = 0.1  # s; of an amplifier that another host may have armed
_SEARCHING = "check cables and supply; the daemon reconnects by itself and stays disarmed"

LinkChange = Literal["degraded", "restored", "lost", "retry", "reopened"]

_logger = logging.getLogger(__name__)
_rate_limited_logger = logging.getLogger(f"{__name__}.background")


class Supervisor(Operation):
    """The operation of the plate by the amplifiers of a controller.

    The controller must be created with `observe(observer)` and `connected` of this supervisor.
    link_changed receives the kind of change, the lost amplifiers ("lost" only) and a message; alive
    is called after each cycle of the control loop, which runs in every state.
    """

    def __init__(
        self,
        *,
        state_changed: Sequence[StateObserver],
        link_changed: Callable[[LinkChange, Sequence[str], str], None],
        alive: Callable[[], None],
    ) -> None:
        super().__init__(state_changed)
        self._link_observer = link_changed
        self._alive = alive
        self.started = asyncio.Event()  # the amplifiers are open, or searched for
        self._closing = asyncio.Event()
        self._controller_if_running: Controller | None = None
        self._loss_lock = asyncio.Lock()  # held until the lost amplifiers are closed
        self._clears: list[int] = []  # epochs of those in progress
        self._is_degraded = False  # as reported last

    def observe(self, observer: Observer) -> Observer:
        """Wrap an observer so that the supervisor sees refusals, losses and cycles first."""

        def refused(reason: str) -> None:
            if not self._check_own_stop(reason):
                observer.refused(reason)

        def link_lost(cause: str) -> None:
            if not self._is_loss_handled:
                self._spawn(self._in_background(self._handle_loss(LinkError(cause))))
            observer.link_lost(cause)

        def cycle_completed() -> None:
            self._check_own_stop(
                "the control loop has stopped the amplifiers, because an exchange failed"
            )
            self._check_degraded()
            call_guarded(self._alive)
            observer.cycle_completed()

        return replace(
            observer, refused=refused, link_lost=link_lost, cycle_completed=cycle_completed
        )

    def connected(self, amplifiers: Mapping[str, Amplifier]) -> None:
        """Listen to the events of amplifiers, by name, whose lines have been opened."""
        for name, amplifier in amplifiers.items():
            amplifier.listeners.append(partial(self._amplifier_event, name))

    async def run(self, controller: Controller) -> None:
        """Open the amplifiers, run the control loop, and reconnect after every loss, until `close`.

        Amplifiers that do not reply at the start, or refuse, are searched for as after a loss; one
        in a fault leads to the state FAULT. Raises CommandError and InputError for
        amplifiers that do not fit the configuration, RuntimeError if the control loop ends early.
        """
        self._controller_if_running = controller
        loop = asyncio.create_task(self._run_control_loop(), name="control loop")
        try:
            await self._open()
            self.started.set()
            while self.machine.state is not DaemonState.NOT_READY:
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
                await self._controller.run()
            except Exception as error:
                _logger.exception("control loop failed, stopping all amplifiers")
                while not await self._is_stopped_after(error):
                    pass
            await asyncio.sleep(_RECHECK)

    async def _is_stopped_after(self, error: Exception) -> bool:
        """Whether a failed control loop is stopped; it sends no heartbeat before. Else pause."""
        try:
            await self._fail(error)
        except Exception:
            _rate_limited_logger.exception("stop after a failure of the control loop failed")
            await asyncio.sleep(_RECHECK)
            return False
        return True

    async def close(self, cause: str) -> None:
        """Ramp down, read back, disarm and close the amplifiers; ends `run`."""
        self._closing.set()
        if self._controller_if_running is not None:
            await self.handle(DaemonEvent(Trigger.CLOSE, cause))
        self._reports.flush()

    def assume_energised(self, now: float) -> bool:
        """Whether a lost amplifier may still be playing at a time [s].

        Over a network for longer: there a request without reply may arrive late, and feed its
        watchdog.
        """
        lost = self.machine.lost
        return lost is not None and now < max(lost.energised_until, self._may_play_until)

    def stop(self, cause: str, remedy: str | None = None) -> Awaitable[Mapping[str, Stopped]]:
        """Quick-stop all amplifiers in any state; await the outcome of each, by name.

        The requests to the amplifiers are queued when this returns.
        """
        stopping = self._spawn(self._stopped(self._controller.stop()))
        self._step(DaemonEvent(Trigger.STOP, cause, remedy))
        return asyncio.shield(stopping)

    @property
    def _controller(self) -> Controller:
        if self._controller_if_running is None:
            raise RuntimeError("supervisor is not running")
        return self._controller_if_running

    @property
    def _may_play_until(self) -> float:
        """When [s] the watchdog must have silenced each amplifier as identified last."""
        known = self._controller.amplifiers.values()
        return max((each.feeding.may_play_until for each in known), default=-math.inf)

    def _energised_until(self, now: float) -> float:
        """When [s] amplifiers that are lost now must be silent; one never seen may be armed."""
        if self._controller.amplifiers:
            return self._may_play_until
        return now + self._controller.watchdog + _WATCHDOG_MARGIN

    def _link_changed(self, change: LinkChange, lost: Sequence[str], message: str) -> None:
        report = partial(self._link_observer, change, lost, message)
        call_guarded(partial(self._reports.add, report))

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
            case Action.RECONNECT:
                await self._controller.release()
                self._changed.set()
            case Action.CLOSE:
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

    @property
    def _is_loss_handled(self) -> bool:
        """Whether amplifiers are lost or closed already."""
        return self.machine.state in (DaemonState.COMM_LOST, DaemonState.NOT_READY)

    async def _check_links(self) -> None:
        """Handle the loss of an amplifier unless it is handled already."""
        causes = self._controller.group.lost_by.values()
        if causes and not self._is_loss_handled:
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
        self._clears.append(epoch)
        try:
            problem = await self._read_back(epoch, clears=True)
        finally:
            self._clears.remove(epoch)
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

    @property
    def _must_reopen(self) -> bool:
        """Whether amplifiers are lost, and all lines are closed."""
        return self.machine.state is DaemonState.COMM_LOST and self._controller.is_released

    async def _fail(self, error: Exception) -> None:
        await super()._fail(error)
        if self.machine.state is DaemonState.COMM_LOST:  # what should have closed them has failed
            await self._do(Action.RECONNECT, self.machine.epoch)

    async def _restore_link(self) -> None:
        """Reopen the amplifiers, with growing pauses; leave COMM_LOST once they are all silent."""
        try:
            try:
                await self._reconnect()
            finally:
                if self.machine.state is DaemonState.COMM_LOST:
                    await self._controller.release()
        except DriverError as error:
            _rate_limited_logger.info("failed: %s", error)
        except Exception:
            _rate_limited_logger.exception("reconnection failed")
            await self._pause(STATUS_INTERVAL)

    async def _reconnect(self) -> None:
        for pause in pauses():
            if self.machine.state is not DaemonState.COMM_LOST:
                return
            if await self._reopen():
                break
            await self._pause(pause)
        while self.assume_energised(clock.now()) and not self._closing.is_set():
            await self._pause(_RECHECK)
        if self._controller.is_open:  # none was lost again
            await self.handle(DaemonEvent(Trigger.RECONNECTED))

    async def _reopen(self) -> bool:
        """Open all amplifiers, disarmed; none that may be armed stays open."""
        try:
            await self._controller.open()
            await self._controller.disarm()  # a short loss may not have expired the watchdog
        except (DriverError, InputError) as error:
            self._link_changed("retry", (), str(error))
            await self._controller.release()
            return False
        self._link_changed("reopened", (), "all amplifiers reply again and are disarmed")
        return True

    async def _pause(self, duration: float) -> None:
        """Wait for a time [s], or until `close`."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(duration):
                await self._closing.wait()

    async def _poll(self) -> None:
        """Read the status of disarmed amplifiers; the control loop reads that of armed ones.

        Then pause, or until the state changes. A stop or fault reaction that has not silenced all
        of them is repeated.
        """
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(STATUS_INTERVAL):
                while self.machine.state is not DaemonState.NOT_READY and not self._must_reopen:
                    await self._changed.wait()
                    self._changed.clear()
                return
        if not self._controller.is_open or self._controller.group.is_armed:
            return
        try:
            await self._check_disarmed()
        except LinkError as error:
            if not self._controller.group.is_degraded_only(error):
                await self._in_background(self._handle_loss(error))
        except DriverError:
            pass  # preempted by another request, which reports for itself
        except Exception:
            _rate_limited_logger.exception("status read failed")

    async def _check_disarmed(self) -> None:
        epoch, group = self.machine.epoch, self._controller.group
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
            and self.machine.epoch not in self._clears  # a clear reads back for itself
        ):
            _rate_limited_logger.error("stop repeated: %s", problem)
            await self._stop()

    def _check_own_stop(self, cause: str) -> bool:
        """Post a fault where the loop itself has stopped the amplifiers of an armed plate."""
        is_armed = self.machine.state is DaemonState.OPERATION_ENABLED
        group = self._controller.group
        is_stopped = is_armed and self._controller.is_open and not group.is_armed
        if is_stopped:
            self.post(DaemonEvent(Trigger.FAULT, cause, ACKNOWLEDGE))
        return is_stopped

    def _check_degraded(self) -> None:
        """Note that armed amplifiers have ceased to reply, or that all reply again."""
        degraded = self._controller.degraded
        if self.machine.state is not DaemonState.OPERATION_ENABLED:
            self._is_degraded = False
        elif bool(degraded) is self._is_degraded or self._controller.group.lost_by:
            pass  # of one that is lost the next heartbeat says so
        elif degraded:
            cause = f"amplifier {', '.join(degraded)} does not reply; nothing new is played"
            self._link_event("degraded", degraded, cause, "check cables and supply")
        else:
            cause = "all amplifiers reply again and play what they should"
            self._link_event("restored", (), cause, "era disarm, or era stop")

    def _link_event(
        self, change: LinkChange, degraded: Sequence[str], cause: str, remedy: str
    ) -> None:
        """Say that the link of armed amplifiers is degraded, or restored."""
        self._is_degraded = bool(degraded)
        self.post(DaemonEvent(Trigger.LINK_CHANGED, cause, remedy))
        level = logging.WARNING if degraded else logging.INFO
        _rate_limited_logger.log(level, "link: %s: %s", change, cause, extra={"topic": "link"})
        self._link_changed(change, degraded, cause)

    def _amplifier_event(self, name: str, event: Values) -> None:
        """Post a fault that an amplifier reports unsolicited, ahead of the next heartbeat."""
        if not event["fault"] or self.machine.state not in ENERGISED:
            return
        channel = "" if event["channel"] == NO_CHANNEL else f", channel {event['channel']}"
        cause = f"amplifier {name} reports {name_of(FAULTS, event['fault'])}{channel}"
        self.post(DaemonEvent(Trigger.FAULT, cause, ACKNOWLEDGE))
