"""A supervisor in virtual time, with a control loop and an obedient amplifier."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field

from controller.daemon.states import DaemonEvent, DaemonState
from controller.daemon.supervisor import Supervisor
from controller.loop.loop import Controller
from controller.loop.observer import Observer
from controller.sources.touch import Touch, TouchFrame
from controller_bench import BenchLines, FarEnd, make_bench
from drivers.protocol.records import Refusal, Values
from newest_contact import BuzzNewestContact


class Planted(Exception):
    """A bug."""


@dataclass
class Watched:
    """A running supervisor, the far end of its amplifier, and what it has reported.

    failing: of states, links, refusals, alive and cycles that whose observer raises.
    """

    supervisor: Supervisor
    controller: Controller
    far_end: FarEnd
    states: list[DaemonState] = field(default_factory=list)
    links: list[str] = field(default_factory=list)
    refusals: list[str] = field(default_factory=list)
    alive: list[float] = field(default_factory=list)
    cycles: list[float] = field(default_factory=list)
    failing: str = ""

    @property
    def state(self) -> DaemonState:
        """The state of the daemon."""
        return self.supervisor.operation.state

    async def handle(self, event: DaemonEvent) -> None:
        """Let the supervisor handle an event."""
        await self.supervisor.handle(event)

    def touch(self) -> None:
        """Put a finger on the middle of the plate."""
        now = asyncio.get_running_loop().time()
        self.controller.deliver(TouchFrame("test", now, (Touch(1, 0.5, 0.5),)))

    def touch_elsewhere(self) -> None:
        """Move the finger far enough for another pattern."""
        now = asyncio.get_running_loop().time()
        self.controller.deliver(TouchFrame("test", now, (Touch(1, 0.9, 0.9),)))

    def cut(self) -> None:
        """Let no request reach the amplifier any more."""
        self.far_end.cut()

    def obey(self) -> None:
        """Let the amplifier obey again, and forget the requests so far."""
        self.far_end.asked.clear()
        self.far_end.mend()
        self.far_end.answer = lambda name, values: None

    def answer(self, *names: str, **changed: object) -> None:
        """Let the amplifier report something else in replies of some names."""
        self.far_end.answer = lambda name, values: (
            {**self.far_end.status(), **changed} if name in names else None
        )

    def refuse(self, *names: str) -> None:
        """Let the amplifier refuse requests of some names."""

        def answer(name: str, values: Values) -> None:
            if name in names:
                raise Refusal("as told", "WRONG_STATE")

        self.far_end.answer = answer


@asynccontextmanager
async def watched(*, refuses: bool = False) -> AsyncIterator[Watched]:
    """A supervisor with a running control loop, which must end when it is closed.

    refuses: whether the amplifier refuses all requests at first.
    """
    bench = make_bench()
    loop = asyncio.get_running_loop()

    def heard(name: str, value: object) -> None:
        if daemon.failing == name:
            raise Planted(name)
        getattr(daemon, name).append(value)

    supervisor = Supervisor(
        state_changed=[lambda old, new: heard("states", new.state)],
        link_changed=lambda event, lost, message: heard("links", event),
        alive=lambda: heard("alive", loop.time()),
    )
    observer = Observer(
        cycle_completed=lambda: heard("cycles", loop.time()),
        refused=lambda reason: heard("refusals", reason),
    )
    controller = Controller(
        bench.rig,
        bench.table,
        lines=lambda: BenchLines({"main": bench.far_end}),
        intent_source=BuzzNewestContact(),
        connected=supervisor.connected,
        observer=supervisor.observe(observer),
    )
    daemon = Watched(supervisor, controller, bench.far_end)
    if refuses:
        daemon.refuse("GetCaps")
    running = asyncio.create_task(supervisor.run(controller))
    await supervisor.started.wait()
    await asyncio.sleep(0.005)
    try:
        yield daemon
    finally:
        daemon.failing = ""
        await supervisor.close("end of the test")
        await asyncio.wait_for(running, 20)
        assert not bench.far_end.is_open
