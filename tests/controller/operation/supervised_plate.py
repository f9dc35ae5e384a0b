"""A plate under a running supervisor, with obedient amplifiers on lines in memory."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

from controller.operation.operation_states import DaemonEvent, DaemonState, Trigger
from controller.operation.supervisor import Supervisor
from drivers.protocol.definition import FAULTS, STATES
from drivers.protocol.records import Refusal, Values
from kit.chain import FINGER, OTHER, Chain, set_chain
from registry import threads

ARM = DaemonEvent(Trigger.ARM)
DISARM = DaemonEvent(Trigger.DISARM)
STOP = DaemonEvent(Trigger.STOP)
CLEAR = DaemonEvent(Trigger.CLEAR)
LINK_LOST = DaemonEvent(Trigger.LINK_LOST)
MOVED_FINGER = (FINGER[0], *OTHER[1:])
"""The finger of the chain after it was put down at another place."""


class Planted(Exception):
    """A bug."""


def encoded(field: str, value: object) -> object:
    """A value as it is on the wire: states and faults have names and numbers."""
    if field == "state":
        return STATES[str(value)]
    if field == "fault":
        return FAULTS[str(value)]
    return value


@dataclass
class SupervisedPlate(Chain):
    """A chain under a running supervisor."""

    supervisor: Supervisor = field(init=False)
    states: list[DaemonState] = field(default_factory=list)
    """The states that the supervisor has reported."""
    links: list[str] = field(default_factory=list)
    """The link events that it has reported."""
    alive: list[float] = field(default_factory=list)
    """When it gave a sign of life [s]."""
    cycles: list[float] = field(default_factory=list)
    """When a cycle of the control loop was completed [s]."""
    failing_observer: str = ""
    """Which of states, links, alive, cycles and refused has an observer that raises."""

    @property
    def state(self) -> DaemonState:
        """The state of the daemon."""
        return self.supervisor.operation.state

    @property
    def is_loud(self) -> bool:
        """Whether any channel plays."""
        return any(max(levels) > 0 for levels in self.levels().values())

    @property
    def is_armed(self) -> bool:
        """Whether the daemon or any amplifier is armed."""
        states = [self.state.name, *(far_end.state for far_end in self.far_ends)]
        return "OPERATION_ENABLED" in states

    @property
    def longest_silence(self) -> float:
        """The longest time between two signs of life [s]."""
        times = [*self.alive, threads.now()]
        return max(end - start for start, end in pairwise(times))

    @property
    def degraded(self) -> list[str]:
        """The amplifiers that do not reply at present."""
        return [*self.supervisor.operation.degraded]

    async def handle(self, event: DaemonEvent) -> None:
        """Let the supervisor handle an event, and a stop as a client's."""
        if event.trigger is Trigger.STOP:
            await self.supervisor.stop(event.cause)
        else:
            await self.supervisor.handle(event)

    async def begin(self, event: DaemonEvent) -> "asyncio.Task[None]":
        """Begin to handle an event."""
        handling = asyncio.create_task(self.handle(event))
        await asyncio.sleep(0)
        return handling

    async def stop(self) -> dict[str, bool]:
        """Stop all; for each amplifier, whether it has confirmed silence."""
        outcomes = await self.supervisor.stop("a test")
        return {name: outcome.is_confirmed for name, outcome in outcomes.items()}

    def is_energised_in(self, seconds: float) -> bool:
        """Whether lost amplifiers will be regarded as energised in some seconds from now."""
        return self.supervisor.reopening.assume_energised(threads.now() + seconds)

    def count(self, request: str) -> int:
        """How often the first amplifier got a request since requests were last forgotten."""
        return len(self.far_end.requests(request))

    def lose_replies(self) -> None:
        """Lose everything that the first amplifier sends."""
        self.far_end.fault("drop", toward="host")

    def lose_requests(self) -> None:
        """Lose everything that the first amplifier is sent."""
        self.far_end.fault("drop", toward="amplifier")

    def answer(self, *requests: str, **changes: object) -> None:
        """Change fields of the replies of the first amplifier to these requests."""
        values = {field: encoded(field, value) for field, value in changes.items()}

        def change_reply(name: str, request: Values) -> Values | None:
            if name not in requests:
                return None
            reply = self.far_end.obey(name, request, threads.now())
            return {**reply, **values}

        self.far_end.lie(change_reply)

    def refuse(self, request: str) -> None:
        """Let the first amplifier refuse a request."""

        def refuse_it(name: str, _: Values) -> None:
            if name == request:
                raise Refusal("planned", "WRONG_STATE")

        self.far_end.lie(refuse_it)

    def replace_amplifier(self) -> None:
        """Put an amplifier with another serial number in place of the first."""
        self.far_end.amplifier.identity["serial_number"] = "ANOTHER"
        self.far_end.disturb()

    def forget_requests(self) -> None:
        """Forget all requests so far, and how often each line was opened."""
        self.operation.attempts.clear()
        for far_end in self.far_ends:
            far_end.asked.clear()

    def repair(self) -> None:
        """End all faults, delays and changed replies, and forget the requests so far."""
        self.forget_requests()
        for far_end in self.far_ends:
            far_end.delay(0.0)
            far_end.recover()
            far_end.answer = lambda name, values: None

    def observe(self, name: str, value: object) -> None:
        """Note what the supervisor reports, unless the observer is to fail."""
        if self.failing_observer == name:
            raise Planted(name)
        getattr(self, name).append(value)

    def connect_observers(self) -> None:
        """Start to note what the supervisor and its control loop report."""
        self.supervisor.current.observers.append(lambda _, new: self.observe("states", new.state))
        self.supervisor.link_observers.append(lambda link, *_: self.observe("links", link))
        observers = self.controller.cycle.observers
        observers.cycle_completed.append(lambda: self.observe("cycles", threads.now()))
        observers.refused.append(lambda reason: self.observe("refused", reason))


@asynccontextmanager
async def supervised(
    *amplifiers: str,
    is_refusing: bool = False,
    is_unplugged: bool = False,
    breaks: str | None = None,
    **options: Any,
) -> AsyncIterator[SupervisedPlate]:
    """A supervisor with a running control loop, which must end when it is closed.

    amplifiers: one unless more are named; is_refusing, is_unplugged: whether the first refuses to
    state its capabilities, or is not reached, at the start; breaks: the only rules that may be
    broken, as for `Chain.judge`; options: as for `set_chain`.
    """
    async with set_chain(*amplifiers, of=SupervisedPlate, **options) as plate:
        plate.supervisor = Supervisor(
            plate.controller, alive=lambda: plate.observe("alive", threads.now())
        )
        plate.connect_observers()
        if is_refusing:
            plate.refuse("GetCaps")
        if is_unplugged:
            plate.far_end.fault("unplug")
        running = asyncio.create_task(plate.supervisor.run())
        await plate.supervisor.started.wait()
        await asyncio.sleep(0.005)
        try:
            yield plate
        finally:
            plate.failing_observer = ""
            plate.host_rules.commanded("disarm")
            await plate.supervisor.close("end of the test")
            await asyncio.wait_for(running, 20)
        still_open = [far_end.name for far_end in plate.far_ends if far_end.is_open]
        assert still_open == []
        plate.judge(breaks)
