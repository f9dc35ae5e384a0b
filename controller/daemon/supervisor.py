"""Runs the daemon's state table on a controller: events in, actions done, the link kept up."""

import asyncio
import contextlib
import logging
from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial

from controller.daemon.reopening import TICK, reopen, what_is_wrong
from controller.daemon.states import ACKNOWLEDGE, Action, Event, Kind, Machine, State, step
from controller.group.amplifier_group import Phase
from controller.loop.loop import Controller
from controller.loop.observer import Observer
from drivers import clock
from drivers.amplifier import Amplifier
from drivers.errors import CommandRefused, DriverError, LinkError
from drivers.link.turns import Preempted
from drivers.protocol.messages import AmplifierEvent, AmplifierState, Fault, Status

LOOK_EVERY = 0.5  # s; how often a disarmed amplifier is asked how it is
_READ_BACKS = 15
_READ_BACK_PAUSE = 0.02  # s

_LOG_LEVELS = {State.COMM_LOST: logging.ERROR, State.FAULT_REACTION_ACTIVE: logging.ERROR}

_SETTLED = (AmplifierState.SWITCH_ON_DISABLED, AmplifierState.READY_TO_SWITCH_ON)


_logger = logging.getLogger(__name__)


class Supervisor:
    """Keeps a controller's amplifiers open, armed only as the state table allows, and silent else.

    controller: made with `observe(observer)` of this; amplifiers: the same as the controller's.
    state_changed is told of every change, old and new; link_told, with amplifiers and a message,
    that the link to them is lost, and, without amplifiers, of each attempt to come back (retry) and
    that it is reopened; alive is called whenever the control loop, or what stands in for it while
    there is no link, has run.
    """

    def __init__(
        self,
        amplifiers: Mapping[str, Amplifier],
        *,
        state_changed: Callable[[Machine, Machine], None],
        link_told: Callable[[str, Sequence[str], str], None],
        alive: Callable[[], None],
    ) -> None:
        self.machine = Machine()
        self._amplifiers = amplifiers
        self._state_changed = state_changed
        self._link_told = link_told
        self._alive = alive
        self._controller: Controller | None = None
        self._refusal = ""
        self._tasks: set[asyncio.Task[None]] = set()
        self._losing = asyncio.Lock()  # held until all are closed that were lost

    def observe(self, observer: Observer) -> Observer:
        """The observer that the controller is to be made with: this one, and ours before it."""

        def refused(reason: str) -> None:
            self._refusal = reason
            if not self._is_stopped_by_itself:  # or the fault that follows tells
                observer.refused(reason)

        def turned() -> None:
            self._look_at_phase()
            self._alive()
            observer.turned()

        return replace(observer, refused=refused, turned=turned)

    async def open(self, controller: Controller) -> None:
        """Open the amplifiers and find out how they are; raises what `Controller.open` raises.

        One that is in a fault, or refuses, is no reason not to begin: the state tells.
        """
        self._controller = controller
        for name, amplifier in self._amplifiers.items():
            amplifier.listen(partial(self._heard, name))
        await controller.open()
        try:
            await self.handle(Event(Kind.OPENED, "every amplifier has answered"))
        except LinkError:
            raise
        except DriverError as error:
            _quiet_logger.warning("%s", error)

    async def run(self) -> None:
        """Run the control loop, and come back after every loss, until `close`."""
        watching = asyncio.create_task(self._watch())
        try:
            while self.machine.state is not State.NOT_READY:
                try:
                    await self._the_controller.run()
                except LinkError as error:
                    await self._quietly(self._lost(error))
                while self.machine.state is State.COMM_LOST:
                    await self._come_back()
        finally:
            watching.cancel()
            await asyncio.gather(watching, *self._tasks, return_exceptions=True)

    async def close(self, cause: str) -> None:
        """Silent, read back, disarmed, closed; ends `run`."""
        await self.handle(Event(Kind.CLOSE, cause))

    async def handle(self, event: Event) -> None:
        """See an event through, with all that follows; raises what went wrong in doing so."""
        for action in self._step(event):
            await self._do(action)

    def tell(self, event: Event) -> None:
        """Take an event in at once, and do what follows beside; for those who cannot wait."""
        actions = self._step(event)

        async def do_all() -> None:
            for action in actions:
                await self._do(action)

        task = asyncio.ensure_future(self._quietly(do_all()))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    @property
    def _the_controller(self) -> Controller:
        if self._controller is None:
            raise RuntimeError("the supervisor was not opened")
        return self._controller

    def _step(self, event: Event) -> tuple[Action, ...]:
        """One step of the table; a change is told before anything is done."""
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
        controller = self._the_controller
        match action:
            case Action.VERIFY:
                await self._on_the_link(self._verify())
            case Action.ARM:
                await self._arm()
            case Action.DISARM:
                await self._on_the_link(controller.disarm())
            case Action.STOP:
                await self._stop()
            case Action.REACT:
                await self._stop()
                await self.handle(Event(Kind.REACTED, self.machine.cause, self.machine.remedy))
            case Action.CLEAR:
                await self._on_the_link(self._clear())
            case Action.RECONNECT | Action.CLOSE:
                await controller.close()

    async def _on_the_link(self, work: Awaitable[object]) -> None:
        """Do something that needs the link; its loss, or a refusal, is an event of its own."""
        try:
            await work
        except LinkError as error:
            await self._lost(error)
            raise
        except Preempted:
            raise  # no fault of the amplifiers': what it gave way to is an event of its own
        except DriverError as error:
            await self.handle(Event(Kind.FAULT, str(error), ACKNOWLEDGE))
            raise

    async def _stop(self) -> None:
        """Stop all; raises LinkError where one did not hear it, which is a loss from now on."""
        await self._the_controller.stop()
        for amplifier in self._amplifiers.values():
            if amplifier.is_lost and self.machine.state not in (State.COMM_LOST, State.NOT_READY):
                await self._on_the_link(amplifier.status())  # raises at once why it is lost

    async def _arm(self) -> None:
        try:
            await self._the_controller.arm()
        except LinkError as error:
            await self._lost(error)
            raise
        except DriverError as error:
            # Where somebody stopped or disarmed meanwhile, that is why, and it is no fault.
            if self.machine.state is State.SWITCHED_ON:
                await self.handle(Event(Kind.FAULT, str(error), ACKNOWLEDGE))
            raise
        await self.handle(Event(Kind.ARMED, self.machine.cause))

    async def _verify(self) -> None:
        """Disarm whatever still plays, then look whether all are as they should be."""
        statuses = await self._statuses()
        if any(each.state is AmplifierState.OPERATION_ENABLED for each in statuses.values()):
            await self._the_controller.disarm()
        problem = await self._unsound()
        if self.machine.state is not State.SWITCH_ON_DISABLED:
            return  # somebody has stopped them meanwhile: that is why they are not settled
        if problem is None:
            await self.handle(Event(Kind.SOUND, "all amplifiers are sound, disarmed and at zero"))
        else:
            await self.handle(Event(Kind.FAULT, problem, ACKNOWLEDGE))

    async def _clear(self) -> None:
        # An amplifier that still falls silent overhears it, so it is said again at each look.
        problem = await self._unsound(before_each=self._acknowledge)
        self._check_acknowledged()
        if problem is None:
            await self.handle(Event(Kind.SOUND, "acknowledged, and the cause is gone"))
            return
        await self.handle(Event(Kind.FAULT, problem, ACKNOWLEDGE))
        raise CommandRefused(f"{problem}; the cause is not gone, so nothing was cleared")

    async def _acknowledge(self) -> None:
        """Clear what was acknowledged; raises Preempted where there is something since."""
        self._check_acknowledged()
        try:
            await self._the_controller.clear()
        except Preempted:
            self._check_acknowledged()
            raise

    def _check_acknowledged(self) -> None:
        if not self.machine.acknowledged:
            raise Preempted(
                "somebody has stopped the amplifiers since, or there is a fault since: that is not "
                "cleared; find the cause, then clear again"
            )

    async def _unsound(
        self, *, before_each: Callable[[], Awaitable[None]] | None = None
    ) -> str | None:
        """What is wrong with an amplifier that should be disarmed, once ramps had their time.

        before_each: to be done before each look. It ends where the state is another.
        """
        problem, begun_in = None, self.machine.state
        for _ in range(_READ_BACKS):
            if before_each is not None:
                await before_each()
            problem = _problem(await self._statuses())
            if problem is None or self.machine.state is not begun_in:
                break
            await asyncio.sleep(_READ_BACK_PAUSE)
        return problem

    async def _statuses(self) -> dict[str, Status]:
        """How each amplifier is; asked again where a stop or disarm went before it."""
        while True:
            with contextlib.suppress(Preempted):
                return {name: await each.status() for name, each in self._amplifiers.items()}
            await asyncio.sleep(_READ_BACK_PAUSE)

    async def _lost(self, error: LinkError) -> None:
        """See a loss through; whoever comes with the same one waits for that, then reopens."""
        async with self._losing:
            lost = [name for name, amplifier in self._amplifiers.items() if amplifier.is_lost]
            wrong = what_is_wrong(error)
            if self.machine.state is not State.COMM_LOST:  # told already
                self._link_told("lost", lost, wrong)
            cause = f"amplifier {', '.join(lost)}: {wrong}" if lost else wrong
            remedy = (
                "look at cables and supply; the daemon tries again by itself, and stays disarmed"
            )
            await self.handle(Event(Kind.LINK_LOST, cause, remedy))

    async def _come_back(self) -> None:
        """Do the next thing towards leaving COMM_LOST."""
        if self.machine.reopened:  # it lasts as long as a lost amplifier may play
            await asyncio.sleep(TICK)
            self._alive()
            await self._quietly(self.handle(Event(Kind.TICK)))
        elif await reopen(
            self._the_controller,
            is_wanted=lambda: self.machine.state is State.COMM_LOST,
            told=lambda event, message: self._link_told(event, (), message),
            alive=self._alive,
        ):
            await self._quietly(self.handle(Event(Kind.REOPENED)))

    async def _watch(self) -> None:
        """Ask disarmed amplifiers how they are; armed ones are asked by the control loop."""
        while True:
            await asyncio.sleep(LOOK_EVERY)
            if self._the_controller.phase is not Phase.DISARMED:
                continue
            try:
                problem = _problem(await self._statuses())
            except LinkError as error:
                if self._the_controller.phase is Phase.DISARMED:
                    await self._quietly(self._lost(error))
            except DriverError:
                continue  # somebody else took the turn: that will tell
            except Exception:
                _quiet_logger.exception("the amplifiers could not be asked how they are")
            else:
                if problem is not None and self.machine.state is State.READY_TO_SWITCH_ON:
                    await self._quietly(self.handle(Event(Kind.FAULT, problem, ACKNOWLEDGE)))

    def _look_at_phase(self) -> None:
        """After a turn of the control loop: it is a fault if that has stopped the amplifiers."""
        if self._is_stopped_by_itself:
            self.tell(Event(Kind.FAULT, self._refusal or "an amplifier refused", ACKNOWLEDGE))

    @property
    def _is_stopped_by_itself(self) -> bool:
        """Whether the control loop has stopped the amplifiers, and nobody has asked for it."""
        is_armed = self.machine.state is State.OPERATION_ENABLED
        return is_armed and self._the_controller.phase is Phase.DISARMED

    def _heard(self, name: str, event: AmplifierEvent) -> None:
        """What an amplifier says unasked; a heartbeat would tell later."""
        if event.fault is Fault.NONE or self.machine.state is not State.OPERATION_ENABLED:
            return
        channel = "" if event.channel is None else f", channel {event.channel}"
        cause = f"amplifier {name} reports {event.fault.name}{channel}"
        self.tell(Event(Kind.FAULT, cause, ACKNOWLEDGE))

    async def _quietly(self, work: Awaitable[None]) -> None:
        """Do something for nobody who could be told what goes wrong: the state tells it."""
        try:
            await work
        except DriverError as error:
            _quiet_logger.info("not done: %s", error)


_quiet_logger = logging.getLogger(f"{__name__}.beside")


def _problem(statuses: Mapping[str, Status]) -> str | None:
    """What is wrong with amplifiers that should be disarmed, at zero and without a fault."""
    for name, status in statuses.items():
        if status.state not in _SETTLED or status.fault is not Fault.NONE:
            fault = "" if status.fault is Fault.NONE else f", fault {status.fault.name}"
            return f"amplifier {name} is in {status.state.name}{fault}"
        if any(status.levels):
            return f"amplifier {name} reports a level though it is disarmed"
    return None
