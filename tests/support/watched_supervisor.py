"""The chain under a supervisor, in virtual time; events of the daemon are steps of its courses."""

import asyncio
import itertools
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from typing import Any

from controller.operation.links import Supervisor
from controller.operation.operation_states import DaemonEvent, DaemonState, Lease, Trigger
from courses import Acted, Planted, Step
from drivers.errors import LinkError
from registry import threads
from set_chain import set_chain


@dataclass
class Watched(Acted):
    """A chain under a running supervisor, and what that has reported.

    failing: of states, links, refusals, alive and cycles that whose observer raises.
    """

    supervisor: Supervisor = field(init=False)
    states: list[DaemonState] = field(default_factory=list)
    links: list[str] = field(default_factory=list)
    alive: list[float] = field(default_factory=list)
    cycles: list[float] = field(default_factory=list)
    failing: str = ""

    @property
    def state(self) -> DaemonState:
        """The state of the daemon."""
        return self.supervisor.operation.state

    @property
    def is_armed(self) -> bool:
        """Whether the daemon is, or any amplifier."""
        return self.state is DaemonState.OPERATION_ENABLED or super().is_armed

    @property
    def is_alive(self) -> bool:
        """Whether it never was without a sign of life for more than 0.6 s."""
        moments = [*self.alive, threads.now()]
        return max(b - a for a, b in itertools.pairwise(moments)) <= 0.6

    @property
    def turns_often(self) -> bool:
        """Whether the control loop has made more turns than those of a few seconds at rest."""
        return len(self.cycles) >= 20

    async def take(self, step: Step) -> None:
        """Take a step, which may be an event in capitals."""
        if isinstance(step, str) and step.isupper():
            await self.does(step)
        else:
            await super().take(step)

    async def handle(self, event: DaemonEvent) -> None:
        """Let the supervisor handle an event."""
        await self.supervisor.handle(event)

    async def does(self, trigger: str) -> None:
        """Let the supervisor handle an event of this kind."""
        await self.handle(DaemonEvent(Trigger[trigger]))

    async def leases(self, seconds: float) -> None:
        """Arm for a client, for so long."""
        await self.handle(DaemonEvent(Trigger.ARM, lease=Lease("me", seconds)))

    def renews(self) -> None:
        """Renew the lease."""
        assert self.supervisor.operation.lease is not None
        self.supervisor.renew(self.supervisor.operation.lease)

    async def stops(self, **confirmed: bool) -> None:
        """Stop all; it is confirmed, or not, that they are silent."""
        stopped = await self.supervisor.stop("as told")
        assert {name: each.is_confirmed for name, each in stopped.items()} == confirmed

    def becomes(self, serial_number: str) -> None:
        """Have another amplifier in place of the first."""
        self.far_end.amplifier.identity["serial_number"] = serial_number
        self.far_end.disturb()

    def fails_once(self, method: str) -> None:
        """Let a method of the controller fail once, while the amplifier is reached."""
        work, failures = getattr(self.controller, method), [LinkError("as told")]

        async def fail() -> None:
            if failures:
                assert self.far_end.is_open
                raise failures.pop()
            await work()

        setattr(self.controller, method, fail)

    def was_never(self, *states: str) -> None:
        """Require that it was in none of these states."""
        assert not {*states} & {*self.states}

    def energised_in(self, seconds: float, expected: bool) -> None:
        """Require that amplifiers are taken for energised, or not, in some seconds."""
        now = threads.now()
        assert self.supervisor.assume_energised(now + seconds) is expected


@asynccontextmanager
async def watched(
    *amplifiers: str,
    refuses: bool = False,
    unplugged: bool = False,
    breaks: str | None = None,
    **options: Any,
) -> AsyncIterator[Watched]:
    """A supervisor with a running control loop, which must end when it is closed.

    amplifiers: one unless more are named; refuses: whether it refuses all requests at first;
    unplugged: whether the first is not reached then;
    breaks: the only rules of the witness that are broken; options: as for `set_chain`.
    """

    def heard(name: str, value: object) -> None:
        if daemon.failing == name:
            raise Planted(name)
        getattr(daemon, name).append(value)

    supervisor = Supervisor(
        state_changed=[lambda old, new: heard("states", new.state)],
        link_changed=lambda event, lost, message: heard("links", event),
        alive=lambda: heard("alive", threads.now()),
    )
    options = {"connected": supervisor.connected, "observe": supervisor.observe, **options}
    async with set_chain(*amplifiers, of=Watched, **options) as daemon:
        daemon.supervisor, supervisor.controller = supervisor, daemon.controller
        loop = daemon.controller.cycle.observers
        loop.cycle_completed.append(lambda: heard("cycles", threads.now()))
        loop.refused.append(lambda reason: heard("refused", reason))
        if refuses:
            daemon.refuse("GetCaps")
        if unplugged:
            daemon.fault("unplug", of=0)
        running = asyncio.create_task(supervisor.run())
        await supervisor.started.wait()
        await asyncio.sleep(0.005)
        try:
            yield daemon
        finally:
            daemon.failing = ""
            daemon.witness.commanded("disarm")
            await supervisor.close("end of the test")
            await asyncio.wait_for(running, 20)
            assert not any(each.is_open for each in daemon.far_ends)
        daemon.judge(breaks)
