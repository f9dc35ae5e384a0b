"""The operation of a plate and its supervisor, in virtual time with an obedient amplifier.

States against a table written by hand; every transition with every observer and every action
raising; courses of faults and losses; and what a stop and the status say an amplifier may play: the
same, and never too little.
"""

import asyncio
import random
import re
from collections.abc import Coroutine, Mapping, Sequence
from contextlib import suppress
from itertools import product
from pathlib import Path
from typing import Any

import pytest

from cases import shortly
from controller.daemon.amplifier_messages import amplifier_statuses
from controller.operation import current_operation
from controller.operation.operation_states import (
    TRANSITIONS,
    Action,
    DaemonEvent,
    DaemonState,
    Operation,
    Trigger,
    after_exception,
    fault_remedy,
    step,
)
from controller.operation.plate_controller import Controller
from drivers.errors import CommandRefused, DriverError
from drivers.host.stops import StopOutcome
from drivers.protocol.definition import FAULTS
from drivers.protocol.records import Values
from drivers.protocol.sets import Command, LayerSet, pack_layers, parts, token_after
from kit.clock import in_virtual_time, run_virtual
from kit.courses import Planted, Step, courses, follow
from kit.fingers import Watched, watched
from registry import threads

STEPS: Sequence[Step] = (
    "ARM",
    "ARM",
    "DISARM",
    "CLEAR",
    "STOP",
    {"touch": ["finger"]},
    "obey",
    "obey",
    {"fault": {"kind": "unplug"}},
    {"fault": {"kind": "drop"}},
    {"fault": {"kind": "drop", "toward": "host"}},
    {"fault": {"kind": "drop", "share": 0.7}},
    {"becomes": "ANOTHER"},
    {"becomes": "SIM-a"},
    {"answers": {"to": ["Stop", "GetStatus"], "levels": [1000, 0, 0]}},
)
"""What happens to a plate and its amplifiers, at random: reached, lost, exchanged, loud or mute."""
PAUSES = (0.0, 0.003, 0.02, 0.1, 0.3, 1.2)
SILENT = "confirmed_silent"
ROOT = Path(__file__).parents[3]


def said_by_status(daemon: Watched) -> Mapping[str, Mapping[str, object]]:
    """What the status says of each amplifier, and what else is known of one that replies."""
    supervisor, controller = daemon.supervisor, daemon.controller
    shown = amplifier_statuses(
        controller.amplifiers,
        controller.urls,
        are_open=controller.group.is_open,
        lost=supervisor.operation.lost,
        what_may_play=supervisor.reopening.what_may_play,
        clock_errors=controller.group.clock_errors,
    )
    now = threads.now()
    said = {name: supervisor.reopening.what_may_play(name).rows(now) for name in controller.urls}
    for each in shown:
        assert (each.silence is None) == (each.state is not None and not each.degraded)
        assert each.silence is None or each.silence.model_dump() == said[each.name]
    may_play = supervisor.operation.lost is not None and any(
        each["silence"] == "may_play" for each in said.values()
    )
    assert supervisor.reopening.assume_energised(now) is may_play
    return said


def _read_group_states() -> Mapping[str, set[str]]:
    """Read the states of the group for each state of the daemon, from the architecture page."""
    states = {}
    for line in (ROOT / "docs/architecture.md").read_text(encoding="utf-8").splitlines():
        words = [set(re.findall("`([A-Z_]+)`", cell)) for cell in line.split("|")[1:-1]]
        if len(words) == 2 and all(words):
            states.update(dict.fromkeys(words[0], words[1]))
    return states


GROUP_STATES = _read_group_states()


def check_agreement(daemon: Watched) -> None:
    """Require that the group has a state of the page's table once nothing is under way."""
    supervisor, group = daemon.supervisor, daemon.controller.group
    assert GROUP_STATES.keys() == {*DaemonState}
    if not supervisor.tasks and not group.members.disarming:
        assert group.state.name in GROUP_STATES[daemon.state]


def check_enough(daemon: Watched, said: Mapping[str, Mapping[str, object]]) -> None:
    """Require that what plays, or is armed, is said to."""
    for each in daemon.far_ends:
        is_alive = each.state == "OPERATION_ENABLED" or any(each.levels)
        assert not is_alive or said[each.name]["silence"] == "may_play", (each.state, said)


@pytest.mark.parametrize("wire", ["serial", "modbus-tcp"])
@pytest.mark.parametrize("seed", shortly(range(60), range(6)))
def test_stop_and_status_agree_and_say_enough(wire: str, seed: int) -> None:
    """At any moment of any course, and after it: never reached, lost, exchanged, opened anew."""
    rng = random.Random(seed)

    async def course() -> None:

        async with watched("a", "b", wire=wire, breaks="plate", unplugged=seed % 3 == 0) as daemon:
            for _ in range(8):
                with suppress(DriverError):
                    await daemon.take(rng.choice(STEPS))
                await daemon.waits(rng.choice(PAUSES) * rng.random())
                check_enough(daemon, said_by_status(daemon))
                check_agreement(daemon)
                if rng.random() < 0.5:
                    continue
                stopped = await daemon.supervisor.stop("a test")
                now = threads.now()
                words = {name: each.rows(now) for name, each in stopped.items()}
                known = said_by_status(daemon)
                for name, said in words.items():
                    if said["silence"] == SILENT:
                        assert known[name]["silence"] != "may_play"
                    else:
                        keys = "silence", "may_play_for_s"
                        assert [said[key] for key in keys] == [known[name][key] for key in keys]
                check_enough(daemon, words)
            daemon.obey()
            await daemon.waits(8)  # all are reached again, however long the last pause
            check_agreement(daemon)

    run_virtual(course(), rng=rng)


REACHED: Sequence[Step] = ("recovers", {"waits": 1})
MAY_PLAY, ELAPSED = "may_play", "watchdog_elapsed"
UNPLUG, MUTE = ({"fault": {"kind": kind}} for kind in ("unplug", "drop"))
LOST = (UNPLUG, {"waits": 0.01})
ANOTHER = {"becomes": "ANOTHER"}
LOUD = {"answers": {"to": ["Stop", "GetStatus"], "levels": [1000, 0, 0]}}
STATES: Mapping[str, tuple[Sequence[Step], str, float | None]] = {
    "never reached": ([], MAY_PLAY, None),
    "never reached, another answers": ([ANOTHER, "recovers", {"waits": 3}], MAY_PLAY, None),
    "lost while disarmed": ([*REACHED, *LOST], ELAPSED, 0.0),
    "lost while armed": ([*REACHED, "ARM", *LOST], ELAPSED, 0.0),
    # Not during the first heartbeat, whose reply a stop awaits.
    "mute while armed": ([*REACHED, "ARM", {"waits": 0.01}, MUTE], ELAPSED, 0.0),
    "lost, and opened anew in vain": ([*REACHED, "ARM", MUTE, {"waits": 20}], ELAPSED, 0.0),
    "lost, another answers": (
        [*REACHED, "ARM", UNPLUG, ANOTHER, "recovers", {"waits": 3}],
        ELAPSED,
        0.0,
    ),
    "shows a level": ([*REACHED, "ARM", LOUD], MAY_PLAY, None),
    "shows a level, then lost": ([*REACHED, LOUD, {"waits": 1}, MUTE], MAY_PLAY, None),
    "silent": ([*REACHED, "ARM"], SILENT, None),
    "silent, then shows a level": ([*REACHED, "ARM", "STOP", LOUD], MAY_PLAY, None),
    "silent, then lost": ([*REACHED, "ARM", "STOP", *LOST], ELAPSED, 0.0),
    "exchanged while stopped": ([*REACHED, "ARM", "STOP", ANOTHER, "CLEAR"], ELAPSED, 0.0),
}
"""Steps of an amplifier that is not reached at first, then what a stop says, and for how long."""


@pytest.mark.parametrize("state", STATES)
@in_virtual_time
async def test_stop_says_what_is_known(state: str) -> None:
    """By name of the state; the status says the same, and what an event says of it too."""
    steps, silence, left = STATES[state]
    serial_numbers = {"main": "SIM-main"}
    async with watched(unplugged=True, breaks="plate", serial_numbers=serial_numbers) as daemon:
        for step in steps:
            with suppress(DriverError):
                await daemon.take(step)
        began = threads.now()
        (stopped,) = (await daemon.supervisor.stop("a test")).values()
        assert threads.now() - began < (0.65 if "lost" in state else 0.33)
        said = stopped.rows(threads.now())
        assert (said["silence"], said["may_play_for_s"]) == (silence, left)
        (known,) = said_by_status(daemon).values()
        assert silence == SILENT or known["silence"] == silence
        if "another answers" in state:
            operation = daemon.supervisor.operation
            assert "ANOTHER" in operation.cause
            assert "cable" not in (operation.remedy or "")
        daemon.obey()
        await daemon.waits(8)


# The whole table by hand, from the states and the fault table of the wire protocol: the next state
# (= for the same) and the actions in order. A dot: nothing changes. Conditions have tests of their
# own.
EVENTS = """
OPENED NOT_FOUND VERIFIED ARM ARMED DISARM STOP CLEAR FAULT REACTION_DONE LINK_LOST CLOSE
NOT_READY             SD:v CL:n .    .    .   .     =:   .   .    .   .     NR:x
SWITCH_ON_DISABLED    .    .    RS:  .    .   .     QS:  .   FR:r .   CL:sn NR:x
READY_TO_SWITCH_ON    .    .    .    SO:a .   .     QS:  .   FR:r .   CL:n  NR:x
SWITCHED_ON           .    .    .    .    OE: SD:dv QS:  .   FR:r .   CL:sn NR:x
OPERATION_ENABLED     .    .    .    .    .   SD:dv QS:  .   FR:r .   CL:sn NR:x
QUICK_STOP_ACTIVE     .    .    SD:v .    .   .     =:   =:c FR:r .   CL:sn NR:x
FAULT_REACTION_ACTIVE .    .    .    .    .   .     =:   .   .    FA: CL:sn NR:x
FAULT                 .    .    SD:v .    .   .     =:   =:c =:s  .   CL:sn NR:x
COMM_LOST             .    .    .    .    .   .     =:   .   .    .   =:n   NR:x
"""
STATE_CODES = {
    "NR": DaemonState.NOT_READY,
    "SD": DaemonState.SWITCH_ON_DISABLED,
    "RS": DaemonState.READY_TO_SWITCH_ON,
    "SO": DaemonState.SWITCHED_ON,
    "OE": DaemonState.OPERATION_ENABLED,
    "QS": DaemonState.QUICK_STOP_ACTIVE,
    "FR": DaemonState.FAULT_REACTION_ACTIVE,
    "FA": DaemonState.FAULT,
    "CL": DaemonState.COMM_LOST,
}
ACTIONS = {
    "v": Action.VERIFY,
    "a": Action.ARM,
    "d": Action.DISARM,
    "s": Action.STOP,
    "r": Action.REACT,
    "c": Action.CLEAR,
    "n": Action.RECONNECT,
    "x": Action.CLOSE,
}
UNTABLED = (Trigger.RECONNECTED, Trigger.LINK_CHANGED)
LATCHED = [DaemonState.QUICK_STOP_ACTIVE, DaemonState.FAULT_REACTION_ACTIVE, DaemonState.FAULT]
LOST_AT, ENERGISED_UNTIL = 0.0, 0.35


HEAD, *ROWS = (line.split() for line in EVENTS.strip("\n").splitlines())
TABLE = {
    (DaemonState(state), Trigger[trigger]): entry
    for state, *entries in ROWS
    for trigger, entry in zip(HEAD, entries, strict=True)
}
"""The table above by state and trigger, without those that have tests of their own."""


def operations(state: DaemonState) -> list[Operation]:
    """All operations in a state, with every combination of flags."""
    return [
        Operation(state, "why", None, latched)
        for latched in (False, True)
        if latched or state not in LATCHED
    ]


@pytest.mark.parametrize("state", DaemonState)
@pytest.mark.parametrize(
    "trigger", [each for each in Trigger if each not in UNTABLED], ids=lambda each: each.name
)
def test_step_follows_table(state: DaemonState, trigger: Trigger) -> None:
    """The next state and the actions are those of the table, whatever the flags."""
    to, _, letters = TABLE[state, trigger].partition(":")
    for operation in operations(state):
        after, actions = step(operation, DaemonEvent(trigger, "because", "do this"), LOST_AT)
        expected = (STATE_CODES.get(to, state), [ACTIONS[letter] for letter in letters])
        if (state, trigger) == (DaemonState.NOT_READY, Trigger.OPENED) and operation.is_latched:
            expected = (DaemonState.QUICK_STOP_ACTIVE, [Action.STOP])
        assert (after.state, [*actions]) == expected
        if after.state is not state:
            is_fault = after.state in (DaemonState.FAULT_REACTION_ACTIVE, DaemonState.FAULT)
            remedy = fault_remedy("because") if is_fault else "do this"
            assert (after.cause, after.remedy) == ("because", remedy)
        if trigger is Trigger.STOP:
            assert after.is_latched


@pytest.mark.parametrize(
    "state", [DaemonState.SWITCHED_ON, DaemonState.OPERATION_ENABLED, *LATCHED]
)
def test_step_returns_latched_when_link_lost_while_energised(state: DaemonState) -> None:
    """A loss while energised leads to FAULT, so that it must be acknowledged before arming."""
    before = Operation(state, is_latched=state in LATCHED)
    unplugged = DaemonEvent(
        Trigger.LINK_LOST,
        *("unplugged", "look at cables"),
        amplifiers=("main",),
    )
    lost, _ = step(before, unplugged, LOST_AT)
    assert lost.lost == (LOST_AT, "unplugged", ("main",))
    back, _ = step(lost, DaemonEvent(Trigger.RECONNECTED), ENERGISED_UNTIL)
    assert back.state is DaemonState.FAULT
    assert back.cause.endswith("unplugged")
    assert "era clear" in (back.remedy or "")


@pytest.mark.parametrize("state", DaemonState)
def test_step_leaves_comm_lost_alone_when_reconnected(state: DaemonState) -> None:
    """For FAULT if anything is latched; in other states nothing changes."""
    for operation in operations(state):
        after, actions = step(operation, DaemonEvent(Trigger.RECONNECTED), ENERGISED_UNTIL)
        if state is not DaemonState.COMM_LOST:
            assert (after, actions) == (operation, ())
        elif operation.is_latched:
            assert (after.state, actions) == (DaemonState.FAULT, ())
        else:
            assert (after.state, actions) == (DaemonState.SWITCH_ON_DISABLED, (Action.VERIFY,))


@pytest.mark.parametrize("state", DaemonState)
def test_degraded_link_changes_no_state(state: DaemonState) -> None:
    """Its cause is said while armed."""
    before = Operation(state, "why")
    degraded, actions = step(before, DaemonEvent(Trigger.LINK_CHANGED, "no reply"), 0.0)
    is_armed = state is DaemonState.OPERATION_ENABLED
    assert (degraded.state, degraded.cause, actions) == (
        state,
        "no reply" if is_armed else "why",
        (),
    )


@pytest.mark.parametrize("state", DaemonState)
def test_unexpected_exception_is_latched(state: DaemonState) -> None:
    """It is a fault where amplifiers are open, and elsewhere one once they are."""
    after = after_exception(Operation(state), "a bug")
    assert after.is_latched
    if state in (DaemonState.NOT_READY, DaemonState.COMM_LOST):
        assert after.state is state
    else:
        assert (after.state, after.cause) == (DaemonState.FAULT, "a bug")


def test_remedy_of_every_fault_of_an_amplifier_is_its_own() -> None:
    """In whatever words it is reported; of any other cause it is to find it."""
    remedies = {fault_remedy(f"amplifier main: got FAULT with fault {name}") for name in FAULTS}
    assert len(remedies) == len(FAULTS)
    assert fault_remedy("a bug") == fault_remedy("fault NONE")


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
            made.supervisor.current.value = Operation(state, "test", is_latched=latched)
    assert made.supervisor.operation.state is state
    made.far_end.asked.clear()


OPEN_TRANSITIONS = [
    (state, trigger)
    for state, trigger in TRANSITIONS
    if state is not DaemonState.NOT_READY and trigger is not Trigger.CLOSE
]


@pytest.mark.parametrize("observer", shortly(OBSERVERS, [*OBSERVERS][:1]))
@in_virtual_time
async def test_failing_observer_changes_no_transition(observer: str) -> None:
    """Whatever state and event: silent after what silences, and it can be armed again."""
    for state, trigger in OPEN_TRANSITIONS:
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
        for (state, trigger), (action, name) in product(OPEN_TRANSITIONS, METHODS)
        if action in TRANSITIONS[state, trigger].actions
    ]
    + [(state, trigger, None, "step") for state, trigger in OPEN_TRANSITIONS],
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
        place = made.controller if action else current_operation
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
async def test_failing_fault_reaction_stops_once() -> None:
    """An exception in the reaction to a polled fault leads to one more stop, in one more epoch."""
    async with watched() as daemon:
        controller, failures = daemon.controller, [Planted("stop")]
        stop = controller.stop

        def fail_once() -> Coroutine[Any, Any, Mapping[str, StopOutcome]]:
            if failures:
                raise failures.pop()
            return stop()

        controller.stop = fail_once
        epoch = daemon.supervisor.operation.epoch
        daemon.answer("GetStatus", state="FAULT", fault="INTERNAL")
        await asyncio.sleep(2)
        assert daemon.state is DaemonState.FAULT
        assert len(daemon.far_end.requests("Stop")) == 1
        assert daemon.supervisor.operation.epoch == epoch + 2  # the fault, and the exception


ARMED, STOPPED = "OPERATION_ENABLED", "QUICK_STOP_ACTIVE"
ARM, STOP, CLEAR = (DaemonEvent(each) for each in (Trigger.ARM, Trigger.STOP, Trigger.CLEAR))

COURSES = courses(Path(__file__).with_name("courses.yaml"))


@pytest.mark.parametrize("name", COURSES)
def test_supervisor_keeps_to_its_course(name: str) -> None:
    """Every step is as it is in the file."""
    follow(COURSES[name], watched)


def slow_down(controller: Controller, *, stop: float) -> None:
    """Let stopping the amplifiers take so long [s]."""
    stop_now = controller.stop_all

    async def slow_stop() -> Mapping[str, StopOutcome]:
        stopped = await stop_now()
        await asyncio.sleep(stop)
        return stopped

    controller.stop_all = slow_stop


@in_virtual_time
async def test_end_of_the_control_loop_ends_the_daemon() -> None:
    """By whatever cancels it: nothing can be armed without it."""

    async def cancel_loop() -> None:
        async with watched():
            (loop,) = (each for each in asyncio.all_tasks() if each.get_name() == "control loop")
            loop.cancel()
            await asyncio.sleep(1)

    with pytest.raises(RuntimeError, match="control loop"):
        await cancel_loop()


@in_virtual_time
async def test_epochs_of_two_daemons_differ() -> None:
    """An acknowledgement of what another daemon latched is none; all are exact in JSON numbers."""
    epochs = set()
    for _ in range(2):
        async with watched() as daemon:
            epochs.add(daemon.supervisor.operation.epoch)
    assert len(epochs) == 2
    assert max(epochs) < 2**32


@in_virtual_time
async def test_loss_is_handled_before_reopening_when_found_twice() -> None:
    """By a command and by the control loop, while the command still stops other amplifiers."""
    async with watched() as daemon:
        controller, opened = daemon.controller, list[bool]()
        release, open_again, cycle = controller.release, controller.open, controller.cycle
        step = cycle.step

        async def early_release() -> None:
            assert not opened, "closed after it was reopened"
            await release()

        async def noted_open() -> None:
            await open_again()
            opened.append(True)

        async def lost_step() -> None:
            cycle.step = step
            for lost in cycle.observers.link_lost:
                lost("wire cut")

        slow_down(controller, stop=0.3)
        controller.release, controller.open = early_release, noted_open
        daemon.fault("unplug")
        stopping = asyncio.create_task(daemon.handle(STOP))
        await asyncio.sleep(0.01)
        cycle.step = lost_step
        cycle.request_update()
        await asyncio.sleep(0.7)  # it stops the others again because of the loss
        daemon.obey()
        await stopping
        await asyncio.sleep(1)
        controller.release = release
        assert len(opened) == 1
        assert (daemon.links[0], daemon.links[-1]) == ("lost", "reopened")
        assert daemon.links.count("lost") == 1
        assert daemon.state is DaemonState.FAULT


@in_virtual_time
async def test_close_ends_handling_of_loss() -> None:
    """Neither waits for the other, and closed amplifiers are no further loss."""
    async with watched() as daemon:
        slow_down(daemon.controller, stop=0.3)
        daemon.fault("unplug")
        stopping = asyncio.create_task(daemon.handle(STOP))
        await asyncio.sleep(0.7)
        assert daemon.state is DaemonState.COMM_LOST
    await asyncio.wait_for(stopping, 5)
    assert daemon.links.count("lost") == 1


@in_virtual_time
async def test_clear_does_not_acknowledge_a_stop_since_its_statuses(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """They were read as silent, without a fault and cleared before it came."""
    async with watched() as daemon:
        await daemon.handle(STOP)
        group = daemon.controller.group
        read = group.statuses

        async def stopped_since() -> dict[str, Values]:
            statuses = await read()
            monkeypatch.setattr(group, "statuses", read)
            daemon.supervisor.stop("a test")
            return statuses

        monkeypatch.setattr(group, "statuses", stopped_since)
        with pytest.raises(CommandRefused, match="not cleared"):
            await daemon.handle(CLEAR)
        await asyncio.sleep(0.1)
        assert daemon.state is DaemonState.QUICK_STOP_ACTIVE


@in_virtual_time
async def test_second_clear_leaves_a_plate_alone_that_the_first_has_cleared() -> None:
    """Its own comes late: what was armed meanwhile stays so, and it is no fault."""
    async with watched() as daemon:
        await daemon.handle(STOP)
        clear = daemon.controller.clear
        pauses = [0.0, 0.035]

        async def clear_late() -> None:
            await asyncio.sleep(pauses.pop(0))
            await clear()

        daemon.controller.clear = clear_late
        clears = [asyncio.create_task(daemon.handle(CLEAR)) for _ in range(2)]
        await clears[0]
        assert daemon.state is DaemonState.READY_TO_SWITCH_ON
        await daemon.handle(ARM)
        await asyncio.gather(*clears, return_exceptions=True)
        await asyncio.sleep(0.1)
        assert daemon.state is ENABLED
        assert daemon.far_end.state == ARMED


@in_virtual_time
async def test_amplifier_that_plays_another_set_after_a_stall_is_stopped() -> None:
    """Another program may have played it meanwhile."""
    async with watched(breaks="plate") as daemon:
        await daemon.handle(ARM)
        await asyncio.sleep(0.02)
        daemon.fault("drop", toward="amplifier")
        await asyncio.sleep(0.15)  # in which the amplifier hears nothing
        daemon.recovers()
        far = daemon.far_end.amplifier
        (part,) = parts(
            pack_layers([LayerSet(0, 0, 0, (Command(0, 2000, 1000, 0),))]),
            session=far.session,
            token=token_after(daemon.far_end.status()["token"]),
            now=True,
        )
        daemon.far_end.obey("Set", part, threads.now())
        await asyncio.sleep(0.2)
        assert daemon.state is DaemonState.FAULT
        assert daemon.far_end.requests("Stop")


@in_virtual_time
async def test_stop_in_progress_is_not_repeated(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """A look at the amplifiers finds it at work; one after its end, without silence, does not."""
    monkeypatch.setattr("controller.operation.supervisor.STATUS_INTERVAL", 0.02)
    async with watched("main") as daemon:
        daemon.answer("Stop", "GetStatus", levels=[1000, 0, 0], state="QUICK_STOP_ACTIVE")
        stopping = asyncio.ensure_future(daemon.supervisor.stop("a test"))
        await asyncio.sleep(0.1)
        assert not stopping.done()
        assert "stop repeated" not in caplog.text
        await stopping
        await asyncio.sleep(0.1)
        assert "stop repeated" in caplog.text


@in_virtual_time
async def test_reports_of_an_amplifier_are_shown(caplog: pytest.LogCaptureFixture) -> None:
    """What it limits, with who feels less, and its temperature; it plays on, and is logged once."""
    async with watched() as daemon:

        def reports() -> dict[str, str]:
            (shown,) = amplifier_statuses(
                daemon.controller.amplifiers,
                daemon.controller.urls,
                are_open=True,
                lost=None,
                what_may_play=daemon.supervisor.reopening.what_may_play,
                clock_errors=daemon.controller.group.clock_errors,
                targets=["panel 1"],
            )
            return {each.kind: each.cause + each.remedy for each in shown.reports}

        await daemon.handle(ARM)
        daemon.answer("Ping", "GetStatus", flags=0b101, temperature=2000)
        await asyncio.sleep(1)
        assert daemon.state is ENABLED
        assert reports().keys() == {"limited", "hot"}
        assert "panel 1" in reports()["limited"]
        assert sum(hasattr(record, "remedy") for record in caplog.records) == 2
        daemon.obey()
        await asyncio.sleep(11)
        assert not reports()


@in_virtual_time
async def test_run_waits_for_a_task_that_another_task_starts_at_the_end() -> None:
    """Nothing that a task has begun is left behind when the supervisor has ended."""
    ended = list[str]()
    async with watched() as daemon:
        spawn = daemon.supervisor._spawn

        async def check() -> None:
            await asyncio.sleep(0.1)
            ended.append("check")

        async def stop() -> None:
            await asyncio.sleep(1)
            spawn(check())

        spawn(stop())
    assert ended == ["check"]
