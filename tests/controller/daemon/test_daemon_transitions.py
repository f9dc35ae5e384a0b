"""Every transition with every observer and every action raising: silent, then armed again."""

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass
from itertools import product

import pytest

from controller.daemon.deferred_calls import DeferredCalls
from controller.daemon.states import (
    TRANSITIONS,
    Action,
    DaemonEvent,
    DaemonState,
    StateMachine,
    Trigger,
)
from controller.daemon.supervisor import Supervisor
from controller.loop.loop import Controller
from controller.loop.observer import Observer
from controller_bench import BenchLines, FarEnd, make_bench
from drivers.errors import DriverError
from newest_contact import BuzzNewestContact
from stop_path import stop_path
from virtual_loop import in_virtual_time

READY, ENABLED = DaemonState.READY_TO_SWITCH_ON, DaemonState.OPERATION_ENABLED
SILENCING = (Trigger.STOP, Trigger.DISARM, Trigger.LEASE_LOST, Trigger.FAULT, Trigger.LINK_LOST)
OBSERVERS = ("state_changed", "link_changed", "alive", "cycle_completed", "refused")
METHODS = {
    Action.VERIFY: "disarm",
    Action.ARM: "arm",
    Action.DISARM: "disarm",
    Action.STOP: "stop",
    Action.REACT: "stop",
    Action.CLEAR: "clear",
    Action.RECONNECT: "release",
}


class Planted(Exception):
    """A bug."""


@dataclass
class Scene:
    """A running supervisor and its far end; failing: name of what raises."""

    supervisor: Supervisor
    controller: Controller
    far_end: FarEnd
    failing: str = ""

    def may_fail(self, name: str) -> Callable[..., None]:
        """An observer that raises while it is the failing one."""

        def observer(*_: object) -> None:
            if self.failing == name:
                raise Planted(name)

        return observer

    async def until(self, *states: DaemonState) -> None:
        """Wait for one of these states, or until nothing happens any more."""
        for _ in range(1000):
            if self.supervisor.machine.state in states:
                return
            await asyncio.sleep(0.01)
        pytest.fail(f"stays in {self.supervisor.machine}")

    async def arm_again(self) -> None:
        """Clear what is latched, and arm, on a wire that is whole."""
        self.far_end.mend()
        self.far_end.answer, self.far_end.delay = (lambda name, values: None), 0.0
        for _ in range(10):
            await self.until(READY, ENABLED, DaemonState.QUICK_STOP_ACTIVE, DaemonState.FAULT)
            if (state := self.supervisor.machine.state) is ENABLED:
                return
            trigger = Trigger.ARM if state is READY else Trigger.CLEAR
            try:
                await self.supervisor.handle(DaemonEvent(trigger))
            except DriverError:  # it is being stopped, or this is not the amplifier's state
                await asyncio.sleep(0.5)
        pytest.fail("cannot be armed")


@asynccontextmanager
async def scene() -> AsyncIterator[Scene]:
    """A supervisor that runs, ready to be armed."""
    bench = make_bench()
    made: Scene
    supervisor = Supervisor(
        state_changed=[lambda *_: made.may_fail("state_changed")()],
        link_changed=lambda *_: made.may_fail("link_changed")(),
        alive=lambda: made.may_fail("alive")(),
    )
    observer = Observer(
        cycle_completed=lambda: made.may_fail("cycle_completed")(),
        refused=lambda reason: made.may_fail("refused")(),
    )
    controller = Controller(
        bench.rig,
        bench.table,
        lines=lambda: BenchLines({"main": bench.far_end}),
        intent_source=BuzzNewestContact(),
        connected=supervisor.connected,
        observer=supervisor.observe(observer),
    )
    made = Scene(supervisor, controller, bench.far_end)
    running = asyncio.create_task(supervisor.run(controller))
    await made.until(READY)
    try:
        yield made
    finally:
        made.failing = ""
        await supervisor.close("end of the test")
        await asyncio.wait_for(running, 20)


async def enter(made: Scene, state: DaemonState) -> None:
    """Lead the amplifier into OPERATION_ENABLED and the machine into a state."""
    await made.supervisor.handle(DaemonEvent(Trigger.ARM))
    match state:
        case DaemonState.OPERATION_ENABLED:
            pass
        case DaemonState.FAULT_REACTION_ACTIVE:
            made.far_end.delay = 0.02
            made.supervisor.post(DaemonEvent(Trigger.FAULT, "test"))
        case DaemonState.COMM_LOST:
            made.far_end.cut()
            await made.supervisor.handle(DaemonEvent(Trigger.LINK_LOST, "test"))
        case _:
            latched = state in (DaemonState.QUICK_STOP_ACTIVE, DaemonState.FAULT)
            made.supervisor.machine = StateMachine(state, "test", is_latched=latched)
    assert made.supervisor.machine.state is state
    made.far_end.asked.clear()


STEPS = [
    (state, trigger)
    for state, trigger in TRANSITIONS
    if state is not DaemonState.NOT_READY and trigger is not Trigger.CLOSE
]


@pytest.mark.parametrize("observer", OBSERVERS)
@in_virtual_time
async def test_failing_observer_changes_no_transition(observer: str) -> None:
    """Whatever state and event: silent after what silences, and it can be armed again."""
    for state, trigger in STEPS:
        async with scene() as made:
            await enter(made, state)
            made.failing = observer
            with suppress(DriverError):
                await made.supervisor.handle(DaemonEvent(trigger, "test"))
            if trigger in SILENCING and state is not DaemonState.COMM_LOST:
                assert made.far_end.requests("Stop", "Disarm"), (state, trigger)
                assert made.far_end.state != "OPERATION_ENABLED"
            await made.arm_again()


@pytest.mark.parametrize(
    ("state", "trigger", "action"),
    [
        (state, trigger, action)
        for (state, trigger), action in product(STEPS, METHODS)
        if any(action in transition.actions for transition in TRANSITIONS[state, trigger])
    ],
)
@in_virtual_time
async def test_failing_action_ends_in_a_stop(
    monkeypatch: pytest.MonkeyPatch, state: DaemonState, trigger: Trigger, action: Action
) -> None:
    """The amplifier gets a request that silences it, and it can be armed again after a clear."""
    async with scene() as made:
        await enter(made, state)
        work: Callable[..., Awaitable[object]] = getattr(made.controller, METHODS[action])
        failures = [Planted(action.name)]

        async def fail_once(*args: object) -> object:
            if failures:
                raise failures.pop()
            return await work(*args)

        with monkeypatch.context() as patched:
            patched.setattr(made.controller, METHODS[action], fail_once)
            with suppress(DriverError, Planted):
                await made.supervisor.handle(DaemonEvent(trigger, "test"))
            await asyncio.sleep(1)
        if not failures and state is not DaemonState.COMM_LOST:
            assert made.far_end.requests("Stop", "Disarm")
            assert made.far_end.state != "OPERATION_ENABLED"
        await made.arm_again()


@pytest.mark.parametrize(("state", "trigger"), STEPS)
@in_virtual_time
async def test_failing_step_ends_in_a_stop(
    monkeypatch: pytest.MonkeyPatch, state: DaemonState, trigger: Trigger
) -> None:
    """An exception in the transition itself stops the amplifier; cleared, it can be armed."""
    async with scene() as made:
        await enter(made, state)

        def fail(*_: object) -> None:
            raise Planted("step")

        with monkeypatch.context() as patched:
            patched.setattr("controller.daemon.operation.step", fail)
            with suppress(DriverError):
                await made.supervisor.handle(DaemonEvent(trigger, "test"))
        if state is not DaemonState.COMM_LOST:
            assert made.far_end.requests("Stop")
            assert made.far_end.state != "OPERATION_ENABLED"
        await made.arm_again()


@in_virtual_time
async def test_flush_makes_each_call_once() -> None:
    """In order, with those that are added meanwhile; nothing is left for the event loop."""
    problems: list[object] = []
    asyncio.get_running_loop().set_exception_handler(lambda _, context: problems.append(context))
    calls, made = DeferredCalls(), list[int]()
    calls.add(lambda: made.append(1))
    calls.add(lambda: calls.add(lambda: made.append(3)))
    calls.add(lambda: made.append(2))
    calls.flush()
    await asyncio.sleep(1.0)
    assert made == [1, 2, 3]
    assert not problems


def test_stop_takes_one_turn_and_few_functions() -> None:
    """Nothing waits on its way, and what it passes through can be read in a few minutes."""
    path, calls = stop_path()
    assert path[0].endswith("Connection.buffer_updated")
    assert path[-1].endswith("Line._send")
    assert len(path) < 20, path
    assert calls < 100
