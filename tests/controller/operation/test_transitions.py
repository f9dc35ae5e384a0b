"""Every transition with every observer and every action raising: silent, then armed again."""

import asyncio
from contextlib import suppress
from itertools import product

import pytest

from controller.operation import operator
from controller.operation.operation_states import (
    TRANSITIONS,
    Action,
    DaemonEvent,
    DaemonState,
    DeferredCalls,
    Operation,
    Trigger,
)
from courses import Planted
from drivers.errors import DriverError
from several_fingers import Watched, watched
from stop_path import stop_path
from virtual_lines import in_virtual_time

READY, ENABLED = DaemonState.READY_TO_SWITCH_ON, DaemonState.OPERATION_ENABLED
SILENCING = (Trigger.STOP, Trigger.DISARM, Trigger.FAULT, Trigger.LINK_LOST)
OBSERVERS = ("states", "links", "alive", "cycles", "refused")
METHODS = (
    (Action.VERIFY, "disarm"),
    (Action.ARM, "arm"),
    (Action.DISARM, "disarm"),
    (Action.STOP, "stop"),
    (Action.REACT, "stop"),
    (Action.CLEAR, "clear"),
    (Action.RECONNECT, "release"),
    (Action.RECONNECT, "open"),
)


async def until(made: Watched, *states: DaemonState) -> None:
    """Wait for one of these states, or until nothing happens any more."""
    for _ in range(1000):
        if made.state in states:
            return
        await asyncio.sleep(0.01)
    pytest.fail(f"stays in {made.supervisor.operation}")


async def arm_again(made: Watched) -> None:
    """Clear what is latched, and arm, on a wire that is whole."""
    made.obey()
    for _ in range(10):
        await until(made, READY, ENABLED, DaemonState.QUICK_STOP_ACTIVE, DaemonState.FAULT)
        if made.state is ENABLED:
            return
        trigger = Trigger.ARM if made.state is READY else Trigger.CLEAR
        try:
            await made.handle(DaemonEvent(trigger))
        except DriverError:  # it is being stopped, or this is not the amplifier's state
            await asyncio.sleep(0.5)
    pytest.fail("cannot be armed")


async def enter(made: Watched, state: DaemonState) -> None:
    """Lead the amplifier into OPERATION_ENABLED and the operation into a state."""
    await made.handle(DaemonEvent(Trigger.ARM))
    match state:
        case DaemonState.OPERATION_ENABLED:
            pass
        case DaemonState.FAULT_REACTION_ACTIVE:
            made.delays(0.01)
            made.supervisor.post(DaemonEvent(Trigger.FAULT, "test"))
        case DaemonState.COMM_LOST:
            made.fault("unplug")
            await made.handle(DaemonEvent(Trigger.LINK_LOST, "test"))
        case _:
            latched = state in (DaemonState.QUICK_STOP_ACTIVE, DaemonState.FAULT)
            made.supervisor.operation = Operation(state, "test", is_latched=latched)
    assert made.supervisor.operation.state is state
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
        async with watched() as made:
            await enter(made, state)
            made.failing = observer
            with suppress(DriverError):
                await made.handle(DaemonEvent(trigger, "test"))
            if trigger in SILENCING and state is not DaemonState.COMM_LOST:
                assert made.far_end.requests("Stop", "Disarm"), (state, trigger)
                assert made.far_end.state != "OPERATION_ENABLED"
            await arm_again(made)


@pytest.mark.parametrize(
    ("state", "trigger", "action", "name"),
    [
        (state, trigger, action, name)
        for (state, trigger), (action, name) in product(STEPS, METHODS)
        if action in TRANSITIONS[state, trigger].actions
    ]
    + [(state, trigger, None, "step") for state, trigger in STEPS],
)
@in_virtual_time
async def test_failing_action_ends_in_a_stop(
    monkeypatch: pytest.MonkeyPatch,
    state: DaemonState,
    trigger: Trigger,
    action: Action | None,
    name: str,
) -> None:
    """The amplifier gets a request that silences it, and it can be armed again after a clear.

    Without an action it is the transition itself that fails.
    """
    async with watched() as made:
        await enter(made, state)
        place = made.controller if action else operator
        work, failures = getattr(place, name), [Planted(name)]

        def fail_once(*args: object) -> object:
            if failures:
                raise failures.pop() if action else failures[0]
            return work(*args)

        with monkeypatch.context() as patched:
            patched.setattr(place, name, fail_once)
            with suppress(DriverError, Planted):
                await made.handle(DaemonEvent(trigger, "test"))
            if action:  # which may be due a moment later
                await asyncio.sleep(1)
        await asyncio.sleep(1)
        if not (failures and action) and state is not DaemonState.COMM_LOST:
            assert made.far_end.requests("Stop", *(["Disarm"] if action else []))
            assert made.far_end.state != "OPERATION_ENABLED"
        await arm_again(made)


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
    assert path[0][1].endswith("Connection.buffer_updated")
    assert path[-1][1].endswith("Line._start")
    assert len(path) < 13, path
    assert calls < 100
