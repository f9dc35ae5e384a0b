"""A supervisor in virtual time, with a control loop and obedient amplifiers, and courses of it.

A course is an entry of a YAML file, a list of steps. A step is a method of `Watched`, `refuses` if
the amplifiers or the supervisor must refuse it, or `is`: values of its properties, by their names.
"""

import asyncio
import inspect
import itertools
from collections.abc import AsyncIterator, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

from chain import Chain
from controller.daemon.states import DaemonEvent, DaemonState, Lease, Trigger
from controller.daemon.supervisor import Supervisor
from controller.loop.observer import Observer
from drivers import clock
from drivers.errors import CommandRefused, LinkError
from drivers.protocol.records import Refusal, Values
from drivers.protocol.table import FAULTS, STATES
from set_chain import FINGER, OTHER, set_chain
from sim.faults.fault_window import FaultKind
from virtual_loop import run_virtual

Step = str | Mapping[str, Any]


class Planted(Exception):
    """A bug."""


@dataclass
class Watched(Chain):
    """A chain under a running supervisor, and what that has reported.

    failing: of states, links, refusals, alive and cycles that whose observer raises.
    """

    supervisor: Supervisor = field(init=False)
    states: list[DaemonState] = field(default_factory=list)
    links: list[str] = field(default_factory=list)
    alive: list[float] = field(default_factory=list)
    cycles: list[float] = field(default_factory=list)
    failing: str = ""
    lease: str = ""
    under_way: dict[str, "asyncio.Task[None]"] = field(default_factory=dict)

    @property
    def state(self) -> DaemonState:
        """The state of the daemon."""
        return self.supervisor.operation.state

    @property
    def amplifiers(self) -> str:
        """Their states, each once."""
        return ", ".join(dict.fromkeys(each.state for each in self.far_ends))

    @property
    def is_loud(self) -> bool:
        """Whether any amplifier plays."""
        return any(map(any, self.levels().values()))

    @property
    def opened(self) -> int:
        """How often a line to the first amplifier was opened."""
        return self.operation.attempts[self.far_end.port]

    @property
    def degraded(self) -> list[str]:
        """Amplifiers that do not reply but may play."""
        return [*self.controller.group.degraded]

    @property
    def is_armed(self) -> bool:
        """Whether the daemon is, or any amplifier."""
        return "OPERATION_ENABLED" in (self.state, *self.amplifiers.split(", "))

    @property
    def is_alive(self) -> bool:
        """Whether it never was without a sign of life for more than 0.6 s."""
        moments = [*self.alive, clock.now()]
        return max(b - a for a, b in itertools.pairwise(moments)) <= 0.6

    @property
    def turns_often(self) -> bool:
        """Whether the control loop has made more turns than those of a few seconds at rest."""
        return len(self.cycles) >= 20

    async def handle(self, event: DaemonEvent) -> None:
        """Let the supervisor handle an event."""
        await self.supervisor.handle(event)

    async def does(self, trigger: str) -> None:
        """Let the supervisor handle an event of this kind."""
        await self.handle(DaemonEvent(Trigger[trigger]))

    async def leases(self, seconds: float) -> None:
        """Arm for a client, for so long."""
        lease = Lease("me", seconds)
        self.lease = lease.token
        await self.handle(DaemonEvent(Trigger.ARM, lease=lease))

    def renews(self) -> None:
        """Renew the lease."""
        self.supervisor.renew(self.lease)

    async def begins(self, trigger: str) -> None:
        """Begin to handle an event, and let the loop turn."""
        self.under_way[trigger] = asyncio.create_task(self.does(trigger))
        await asyncio.sleep(0)

    async def ends(self, trigger: str) -> None:
        """Wait until an event was handled."""
        await self.under_way.pop(trigger)

    async def ends_anyhow(self, trigger: str) -> None:
        """Wait until an event was handled, or refused."""
        await asyncio.gather(self.under_way.pop(trigger), return_exceptions=True)

    async def stops(self, **confirmed: bool) -> None:
        """Stop all; it is confirmed, or not, that they are silent."""
        stopped = await self.supervisor.stop("as told")
        assert {name: each.is_confirmed for name, each in stopped.items()} == confirmed

    async def waits(self, seconds: float) -> None:
        """Let time pass."""
        await asyncio.sleep(seconds)

    def touch(self) -> None:
        """Put a finger on the plate."""
        self.put(FINGER)

    def touch_elsewhere(self) -> None:
        """Move the finger far enough for another pattern."""
        self.put((FINGER[0], *OTHER[1:]))

    def fault(self, kind: FaultKind, **given: Any) -> None:
        """Let a fault of all amplifiers begin."""
        for each in self.far_ends:
            each.fault(kind, **given)

    def recovers(self) -> None:
        """End all faults."""
        for each in self.far_ends:
            each.recover()

    def delays(self, seconds: float) -> None:
        """Let replies of all amplifiers leave them so much later."""
        for each in self.far_ends:
            each.delay(seconds)

    def obey(self) -> None:
        """Let the amplifiers obey again, and forget the requests so far."""
        self.forget()
        self.delays(0.0)
        self.recovers()
        for each in self.far_ends:
            each.answer = lambda name, values: None

    def forget(self) -> None:
        """Forget the requests so far, and how often a line was opened."""
        self.operation.attempts.clear()
        for each in self.far_ends:
            each.asked.clear()

    def answer(self, *names: str, **changed: object) -> None:
        """Let the amplifier report something else in replies of some names."""
        changed = {what: _coded(what, value) for what, value in changed.items()}
        self.far_end.lie(
            lambda name, values: {**self.far_end.status(), **changed} if name in names else None
        )

    def answers(self, to: Sequence[str], **changed: object) -> None:
        """Do the same by names in a list."""
        self.answer(*to, **changed)

    def freezes(self, seconds: float) -> None:
        """Let the amplifier ignore Clear, and report what it reports now, for so long."""
        until = clock.now() + seconds
        status = self.far_end.status()
        self.far_end.lie(
            lambda name, values: (
                status if clock.now() < until and name in ("Clear", "GetStatus") else None
            )
        )

    def reports(self, when: str, **event: Any) -> None:
        """Let the amplifier send an event as it is about to carry out a request of a name."""
        values = {"latch": 0, **{what: _coded(what, value) for what, value in event.items()}}

        def report(name: str, _: Values) -> None:
            for listener in self.far_end.device.listeners:
                if name == when:
                    listener(values, clock.now())

        self.far_end.lie(report)

    def refuse(self, *names: str) -> None:
        """Let the last amplifier refuse requests of some names."""

        def answer(name: str, values: Values) -> None:
            if name in names:
                raise Refusal("as told", "WRONG_STATE")

        self.far_ends[-1].lie(answer)

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

    def asked(self, **least: int) -> None:
        """Require that the first amplifier was asked at least so often; not at all for 0."""
        for name, count in least.items():
            found = len(self.far_end.requests(name))
            assert found >= count, (name, found)
            assert count or not found, (name, found)

    def asked_in_order(self, *names: str) -> None:
        """Require that the amplifier was asked first for the one, then for the other."""
        kinds = self.far_end.names()
        found = [kinds.index(name) for name in names]
        assert found == sorted(found), kinds

    def energised_in(self, seconds: float, expected: bool) -> None:
        """Require that amplifiers are taken for energised, or not, in some seconds."""
        now = clock.now()
        assert self.supervisor.assume_energised(now + seconds) is expected

    async def refuses(self, step: Step) -> None:
        """Require that a step is refused."""
        with pytest.raises(CommandRefused):
            await self.take(step)

    async def take(self, step: Step) -> None:
        """Take a step."""
        ((name, given),) = step.items() if isinstance(step, Mapping) else [(step, [])]
        if name == "is":
            found = {what: getattr(self, what) for what in given}
            assert found == {**given}, (found, self.states, self.far_end.names()[-5:])
        elif name.isupper():
            await self.does(name)
        else:
            method = getattr(self, name.replace(" ", "_"))
            if name == "refuses" or not isinstance(given, list | Mapping):
                done = method(given)
            else:
                done = method(**given) if isinstance(given, Mapping) else method(*given)
            if inspect.isawaitable(done):
                await done


def _coded(what: str, value: Any) -> Any:
    """The number of a state or a fault that is named; all else as it is."""
    codes = {"state": STATES, "fault": FAULTS}.get(what, {})
    return codes.get(value, value) if isinstance(value, str) else value


@asynccontextmanager
async def watched(
    *amplifiers: str, refuses: bool = False, breaks: str | None = None, **options: Any
) -> AsyncIterator[Watched]:
    """A supervisor with a running control loop, which must end when it is closed.

    amplifiers: one unless more are named; refuses: whether it refuses all requests at first;
    breaks: the only rules of the witness that are broken; options: as for `set_chain`.
    """

    def heard(name: str, value: object) -> None:
        if daemon.failing == name:
            raise Planted(name)
        getattr(daemon, name).append(value)

    supervisor = Supervisor(
        state_changed=[lambda old, new: heard("states", new.state)],
        link_changed=lambda event, lost, message: heard("links", event),
        alive=lambda: heard("alive", clock.now()),
    )
    options = {"connected": supervisor.connected, "observer": supervisor.observer(), **options}
    async with set_chain(*amplifiers, of=Watched, **options) as daemon:
        daemon.supervisor, supervisor.controller = supervisor, daemon.controller
        daemon.controller.observers.append(
            Observer(
                cycle_completed=lambda: heard("cycles", clock.now()),
                refused=lambda reason: heard("refused", reason),
            )
        )
        if refuses:
            daemon.refuse("GetCaps")
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


def courses(path: Path) -> dict[str, Mapping[str, Any]]:
    """The courses of a file by their names: `steps`, and options of `watched`."""
    return dict(YAML(typ="safe").load(path))


def follow(course: Mapping[str, Any]) -> None:
    """Take all steps of a course, in virtual time."""

    given = {**course}

    async def run() -> None:
        steps, amplifiers = given.pop("steps"), given.pop("amplifiers", ())
        async with watched(*amplifiers, **given) as daemon:
            for step in steps:
                await daemon.take(step)

    run_virtual(run())
