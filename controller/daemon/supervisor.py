"""Runs the daemon's state machine: applies events, carries out actions, restores lost links."""

import asyncio
import logging
from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial

from controller.daemon.read_back import READ_BACK_INTERVAL, find_problem, read_statuses
from controller.daemon.reconnect import ALIVE_INTERVAL, LinkChange, error_text, reconnect
from controller.daemon.states import (
    ACKNOWLEDGE,
    Action,
    DaemonEvent,
    DaemonState,
    StateMachine,
    Trigger,
    step,
)
from controller.group.amplifier_group import Phase
from controller.loop.loop import Controller
from controller.loop.observer import Observer
from drivers import clock
from drivers.amplifier import Amplifier
from drivers.errors import CommandRefused, DriverError, LinkError
from drivers.link.turns import Preempted
from drivers.protocol.messages import AmplifierEvent, AmplifierState, Fault

STATUS_INTERVAL = 0.5  # s; between status requests to disarmed amplifiers
_MAX_READ_BACKS = 15

_LOG_LEVELS = {
    DaemonState.COMM_LOST: logging.ERROR,
    DaemonState.FAULT_REACTION_ACTIVE: logging.ERROR,
}

_logger = logging.getLogger(__name__)
_rate_limited_logger = logging.getLogger(f"{__name__}.background")


class Supervisor:
    """Keeps the amplifiers of a controller connected, and armed only as the state machine allows.

    The controller must be created with `observe(observer)` of this supervisor and the same
    amplifiers. state_changed receives the old and new state machine at every transition;
    link_changed the kind of change, the lost amplifiers ("lost" only) and a message; alive is
    called after each cycle of the control loop and periodically while there is no link.
    """

    def __init__(
        self,
        amplifiers: Mapping[str, Amplifier],
        *,
        state_changed: Callable[[StateMachine, StateMachine], None],
        link_changed: Callable[[LinkChange, Sequence[str], str], None],
        alive: Callable[[], None],
    ) -> None:
        self.machine = StateMachine()
        self._amplifiers = amplifiers
        self._state_changed = state_changed
        self._link_changed = link_changed
        self._alive = alive
        self._opened_controller: Controller | None = None
        self._refusal = ""
        self._tasks: set[asyncio.Task[None]] = set()
        self._loss_lock = asyncio.Lock()  # held until the lost amplifiers are closed

    def observe(self, observer: Observer) -> Observer:
        """Wrap an observer so that the supervisor sees refusals and cycles first."""

        def refused(reason: str) -> None:
            self._refusal = reason
            if not self._has_stopped_itself:  # the fault that follows reports it
                observer.refused(reason)

        def cycle_completed() -> None:
            self._check_phase()
            self._alive()
            observer.cycle_completed()

        return replace(observer, refused=refused, cycle_completed=cycle_completed)

    async def open(self, controller: Controller) -> None:
        """Open and verify the amplifiers; raises what `Controller.open` raises.

        An amplifier in a fault, or one that refuses, leads to the state FAULT instead.
        """
        self._opened_controller = controller
        for name, amplifier in self._amplifiers.items():
            amplifier.listen(partial(self._amplifier_event, name))
        await controller.open()
        try:
            await self.handle(DaemonEvent(Trigger.OPENED, "every amplifier has replied"))
        except LinkError:
            raise
        except DriverError as error:
            _rate_limited_logger.warning("%s", error)

    async def run(self) -> None:
        """Run the control loop, and reconnect after every loss, until `close`."""
        polling = asyncio.create_task(self._poll_disarmed())
        try:
            while self.machine.state is not DaemonState.NOT_READY:
                try:
                    await self._controller.run()
                except LinkError as error:
                    await self._in_background(self._handle_loss(error))
                while self.machine.state is DaemonState.COMM_LOST:
                    await self._restore_link()
        finally:
            polling.cancel()
            await asyncio.gather(polling, *self._tasks, return_exceptions=True)

    async def close(self, cause: str) -> None:
        """Ramp down, read back, disarm and close the amplifiers; ends `run`."""
        await self.handle(DaemonEvent(Trigger.CLOSE, cause))

    async def handle(self, event: DaemonEvent) -> None:
        """Apply an event and carry out its actions; raises the error of an action."""
        for action in self._step(event):
            await self._do(action)

    def post(self, event: DaemonEvent) -> None:
        """Apply an event at once and carry out its actions in a task."""
        actions = self._step(event)

        async def do_all() -> None:
            for action in actions:
                await self._do(action)

        task = asyncio.ensure_future(self._in_background(do_all()))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    @property
    def _controller(self) -> Controller:
        if self._opened_controller is None:
            raise RuntimeError("supervisor is not open")
        return self._opened_controller

    def _step(self, event: DaemonEvent) -> tuple[Action, ...]:
        """Apply one transition and report it; return its actions."""
        before = self.machine
        self.machine, actions = step(before, event, clock.now())
        after = self.machine
        if after.state is not before.state:
            _logger.log(
                _LOG_LEVELS.get(after.state, logging.INFO),
                "%s -> %s",
                before.state,
                after.state,
                extra={"topic": "state", "cause": after.cause, "remedy": after.remedy},
            )
            self._state_changed(before, after)
        return actions

    async def _do(self, action: Action) -> None:
        match action:
            case Action.VERIFY:
                await self._over_link(self._verify())
            case Action.ARM:
                await self._arm()
            case Action.DISARM:
                await self._over_link(self._controller.disarm())
            case Action.STOP:
                await self._stop()
            case Action.REACT:
                await self._stop()
                cause, remedy = self.machine.cause, self.machine.remedy
                await self.handle(DaemonEvent(Trigger.REACTION_DONE, cause, remedy))
            case Action.CLEAR:
                await self._over_link(self._clear())
            case Action.RECONNECT | Action.CLOSE:
                await self._controller.close()

    async def _over_link(self, work: Awaitable[object]) -> None:
        """Await work that needs the link; a loss or refusal becomes an event, then is raised."""
        try:
            await work
        except LinkError as error:
            await self._handle_loss(error)
            raise
        except Preempted:
            raise  # not a fault: the request that preempted it is an event of its own
        except DriverError as error:
            await self.handle(DaemonEvent(Trigger.FAULT, str(error), ACKNOWLEDGE))
            raise

    async def _stop(self) -> None:
        """Stop all amplifiers; raises LinkError for one that did not reply, now a lost link."""
        await self._controller.stop()
        for amplifier in self._amplifiers.values():
            if amplifier.is_lost and self.machine.state not in (
                DaemonState.COMM_LOST,
                DaemonState.NOT_READY,
            ):
                await self._over_link(amplifier.status())  # raises the cause of the loss at once

    async def _arm(self) -> None:
        try:
            await self._controller.arm()
        except LinkError as error:
            await self._handle_loss(error)
            raise
        except DriverError as error:
            # A stop or disarm in the meantime explains the error and is not a fault.
            if self.machine.state is DaemonState.SWITCHED_ON:
                await self.handle(DaemonEvent(Trigger.FAULT, str(error), ACKNOWLEDGE))
            raise
        await self.handle(DaemonEvent(Trigger.ARMED, self.machine.cause))

    async def _verify(self) -> None:
        """Disarm what still plays, then read back all amplifiers."""
        statuses = await read_statuses(self._amplifiers)
        if any(each.state is AmplifierState.OPERATION_ENABLED for each in statuses.values()):
            await self._controller.disarm()
        problem = await self._read_back()
        if self.machine.state is not DaemonState.SWITCH_ON_DISABLED:
            return  # stopped in the meantime, so they need not be disarmed yet
        if problem is None:
            cause = "all amplifiers are disarmed, at level zero and without a fault"
            await self.handle(DaemonEvent(Trigger.VERIFIED, cause))
        else:
            await self.handle(DaemonEvent(Trigger.FAULT, problem, ACKNOWLEDGE))

    async def _clear(self) -> None:
        # An amplifier that is still ramping down ignores Clear, so it is repeated before each read.
        problem = await self._read_back(before_each=self._acknowledge)
        self._check_acknowledged()
        if problem is None:
            await self.handle(DaemonEvent(Trigger.VERIFIED, "acknowledged, and the cause is gone"))
            return
        await self.handle(DaemonEvent(Trigger.FAULT, problem, ACKNOWLEDGE))
        raise CommandRefused(f"{problem}; the cause persists, so nothing was cleared")

    async def _acknowledge(self) -> None:
        """Clear the amplifiers; raises Preempted if a stop or fault came after the request."""
        self._check_acknowledged()
        try:
            await self._controller.clear()
        except Preempted:
            self._check_acknowledged()
            raise

    def _check_acknowledged(self) -> None:
        if not self.machine.is_acknowledged:
            raise Preempted(
                "not cleared: a stop or fault came after the request; find the cause, then clear "
                "again"
            )

    async def _read_back(
        self, *, before_each: Callable[[], Awaitable[None]] | None = None
    ) -> str | None:
        """Read back until all amplifiers are silent; return the problem that remains, if any.

        before_each: awaited before each read. Ends early when the state changes.
        """
        problem, initial_state = None, self.machine.state
        for _ in range(_MAX_READ_BACKS):
            if before_each is not None:
                await before_each()
            problem = find_problem(await read_statuses(self._amplifiers))
            if problem is None or self.machine.state is not initial_state:
                break
            await asyncio.sleep(READ_BACK_INTERVAL)
        return problem

    async def _handle_loss(self, error: LinkError) -> None:
        """Handle a loss; concurrent reports of the same loss wait until it is handled."""
        async with self._loss_lock:
            lost = [name for name, amplifier in self._amplifiers.items() if amplifier.is_lost]
            text = error_text(error)
            if self.machine.state is not DaemonState.COMM_LOST:
                self._link_changed("lost", lost, text)
            cause = f"amplifier {', '.join(lost)}: {text}" if lost else text
            remedy = "check cables and supply; the daemon reconnects by itself and stays disarmed"
            await self.handle(DaemonEvent(Trigger.LINK_LOST, cause, remedy))

    async def _restore_link(self) -> None:
        """Take the next step towards leaving COMM_LOST."""
        if self.machine.is_reconnected:  # wait for the watchdog of the lost amplifier
            await asyncio.sleep(ALIVE_INTERVAL)
            self._alive()
            await self._in_background(self.handle(DaemonEvent(Trigger.TICK)))
        elif await reconnect(
            self._controller,
            should_continue=lambda: self.machine.state is DaemonState.COMM_LOST,
            report=lambda change, message: self._link_changed(change, (), message),
            alive=self._alive,
        ):
            await self._in_background(self.handle(DaemonEvent(Trigger.RECONNECTED)))

    async def _poll_disarmed(self) -> None:
        """Poll the status of disarmed amplifiers; the control loop polls armed ones."""
        while True:
            await asyncio.sleep(STATUS_INTERVAL)
            if self._controller.phase is not Phase.DISARMED:
                continue
            try:
                problem = find_problem(await read_statuses(self._amplifiers))
            except LinkError as error:
                if self._controller.phase is Phase.DISARMED:
                    await self._in_background(self._handle_loss(error))
            except DriverError:
                continue  # preempted by another request, which reports for itself
            except Exception:
                _rate_limited_logger.exception("status read failed")
            else:
                is_ready = self.machine.state is DaemonState.READY_TO_SWITCH_ON
                if problem is not None and is_ready:
                    fault = DaemonEvent(Trigger.FAULT, problem, ACKNOWLEDGE)
                    await self._in_background(self.handle(fault))

    def _check_phase(self) -> None:
        """Post a fault if the control loop has stopped the amplifiers by itself."""
        if self._has_stopped_itself:
            cause = self._refusal or "an amplifier refused a command"
            self.post(DaemonEvent(Trigger.FAULT, cause, ACKNOWLEDGE))

    @property
    def _has_stopped_itself(self) -> bool:
        """Whether the control loop has stopped the amplifiers without a request to do so."""
        is_armed = self.machine.state is DaemonState.OPERATION_ENABLED
        return is_armed and self._controller.phase is Phase.DISARMED

    def _amplifier_event(self, name: str, event: AmplifierEvent) -> None:
        """Post a fault that an amplifier reports by itself, ahead of the next heartbeat."""
        is_armed = self.machine.state is DaemonState.OPERATION_ENABLED
        if event.fault is Fault.NONE or not is_armed:
            return
        channel = "" if event.channel is None else f", channel {event.channel}"
        cause = f"amplifier {name} reports {event.fault.name}{channel}"
        self.post(DaemonEvent(Trigger.FAULT, cause, ACKNOWLEDGE))

    async def _in_background(self, work: Awaitable[None]) -> None:
        """Await work without a caller: its errors are already part of the state."""
        try:
            await work
        except DriverError as error:
            _rate_limited_logger.info("failed: %s", error)
