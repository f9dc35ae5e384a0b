"""A supervisor with a control loop and obedient amplifiers, in virtual time.

Arming, stopping and clearing, faults, losses and bugs on the way. Lost amplifiers that may still
play are in test_what_may_play.py.
"""

import asyncio
import contextlib
from collections.abc import Mapping
from itertools import product

import pytest

from cases import shortly
from controller.daemon.amplifier_messages import amplifier_statuses
from controller.operation import current_operation
from controller.operation.operation_states import (
    TRANSITIONS,
    Action,
    DaemonEvent,
    DaemonState,
    Lease,
    Operation,
    Trigger,
)
from drivers.errors import CommandRefused, DriverError, LinkError
from drivers.host.stops import StopOutcome
from drivers.protocol.definition import FAULTS, STATES
from drivers.protocol.records import Values
from drivers.protocol.sets import Command, LayerSet, pack_layers, parts, token_after
from kit.chain import FINGER
from kit.clock import in_virtual_time
from registry import threads
from tests.controller.operation.supervised_plate import (
    ARM,
    CLEAR,
    DISARM,
    LINK_LOST,
    MOVED_FINGER,
    STOP,
    Planted,
    SupervisedPlate,
    supervised,
)

READY = DaemonState.READY_TO_SWITCH_ON
ENABLED = DaemonState.OPERATION_ENABLED
STOPPED = DaemonState.QUICK_STOP_ACTIVE
FAULT = DaemonState.FAULT
LOST = DaemonState.COMM_LOST


@in_virtual_time
async def test_finger_is_felt_only_if_it_arrives_after_the_amplifiers() -> None:
    """Without amplifiers the control loop turns slowly, and an old touch is not played later."""
    async with supervised(is_refusing=True) as plate:
        plate.put(FINGER)
        await asyncio.sleep(3)
        assert len(plate.cycles) < 20
        plate.repair()
        await asyncio.sleep(1)
        await plate.handle(ARM)
        await asyncio.sleep(0.1)
        assert not plate.is_loud

        plate.put(FINGER)
        await asyncio.sleep(0.1)

        assert plate.is_loud


@in_virtual_time
async def test_control_loop_gives_signs_of_life_in_every_state() -> None:
    """Disarmed, armed and without a link."""
    async with supervised() as plate:
        await asyncio.sleep(5)
        await plate.handle(ARM)
        await asyncio.sleep(5)
        plate.far_end.fault("unplug")
        await asyncio.sleep(60)

        assert plate.state is LOST
        assert plate.longest_silence <= 0.6


@in_virtual_time
async def test_lease_that_is_not_renewed_ends() -> None:
    """A lease of 0.3 s, renewed after 0.2 s, disarms the plate after 0.5 s."""
    async with supervised() as plate:
        await plate.handle(DaemonEvent(Trigger.ARM, lease=Lease("me", 0.3)))
        await asyncio.sleep(0.2)
        lease = plate.supervisor.operation.lease
        assert lease is not None

        plate.supervisor.renew(lease)

        await asyncio.sleep(0.29)
        assert plate.state is ENABLED
        await asyncio.sleep(0.011)
        assert not plate.is_armed
        await asyncio.sleep(0.5)
        assert plate.state is READY


@in_virtual_time
async def test_amplifiers_that_cannot_be_disarmed_are_opened_again() -> None:
    """None that may be armed stays open, and each attempt is reported."""
    async with supervised() as plate:
        await plate.handle(ARM)
        disarm = plate.controller.disarm

        async def fail_once() -> None:
            plate.controller.disarm = disarm  # type: ignore[method-assign]
            assert plate.far_end.is_open
            raise LinkError("planned")

        plate.controller.disarm = fail_once  # type: ignore[method-assign]
        plate.forget_requests()

        await plate.handle(LINK_LOST)
        await asyncio.sleep(1)

        assert plate.links == ["retry", "reopened"]
        assert plate.operation.attempts[plate.far_end.port] == 2
        assert plate.state is FAULT


@pytest.mark.parametrize(
    "status",
    [
        pytest.param({"channels": 3, "levels": [100, 0, 0]}, id="level"),
        pytest.param({"channels": 0, "levels": []}, id="no levels"),
    ],
)
@in_virtual_time
async def test_clear_is_refused_until_the_amplifier_reports_silence(
    status: Mapping[str, object],
) -> None:
    """Even if it reports that it is disarmed; meanwhile, the stop is repeated."""
    async with supervised() as plate:
        await plate.handle(STOP)
        plate.forget_requests()
        plate.answer("GetStatus", state="SWITCH_ON_DISABLED", **status)
        await asyncio.sleep(2)
        assert plate.count("Stop") >= 1

        with pytest.raises(CommandRefused):
            await plate.handle(CLEAR)

        assert plate.state is FAULT


@in_virtual_time
async def test_refused_clear_does_not_end_the_repetition_of_a_stop() -> None:
    """A level remains: the stop is repeated as long as it does, whoever clears meanwhile."""
    async with supervised() as plate:
        await plate.handle(ARM)
        plate.answer("Stop", "GetStatus", levels=[1000, 0, 0])
        stopping = await plate.begin(STOP)
        await asyncio.sleep(0.05)

        with pytest.raises(CommandRefused):
            await plate.handle(CLEAR)
        await stopping
        plate.forget_requests()
        await asyncio.sleep(2)

        assert plate.count("Stop") >= 3
        assert plate.count("Clear") == 0


@pytest.mark.parametrize("pause", [0.001, 0.013], ids=["request", "read-back"])
@in_virtual_time
async def test_stop_during_a_disarming_is_no_fault(pause: float) -> None:
    """Whether it comes with the request to disarm or while its effect is read back."""
    async with supervised() as plate:
        await plate.handle(ARM)
        await asyncio.sleep(0.005)
        plate.far_end.delay(0.01)
        disarming = await plate.begin(DISARM)
        await asyncio.sleep(pause)

        await plate.handle(STOP)
        await asyncio.gather(disarming, return_exceptions=True)

        assert plate.state is STOPPED
        assert plate.far_end.state == "QUICK_STOP_ACTIVE"
        assert FAULT not in plate.states


@in_virtual_time
async def test_amplifier_that_refuses_to_arm_is_a_fault() -> None:
    """The caller gets the refusal, and all amplifiers are disarmed."""
    async with supervised() as plate:
        plate.refuse("Arm")

        with pytest.raises(CommandRefused):
            await plate.handle(ARM)

        assert plate.state is FAULT
        assert not plate.is_armed


@in_virtual_time
async def test_fault_reported_while_arming_stops_all() -> None:
    """An event comes before the reply to Arm; nothing is armed afterwards."""
    async with supervised(breaks="state latched") as plate:
        plate.far_end.delay(0.02)
        event = {"latch": 0, "state": STATES["FAULT"], "fault": FAULTS["ARC"], "channel": 1}

        def report_arc(name: str, _: Values) -> None:
            if name == "Arm":
                for listener in plate.far_end.device.listeners:
                    listener(event, threads.now())

        plate.far_end.lie(report_arc)

        with pytest.raises(CommandRefused):
            await plate.handle(ARM)

        assert plate.count("Stop") >= 1
        await asyncio.sleep(0.1)
        assert plate.state is FAULT
        assert not plate.is_armed
        assert ENABLED not in plate.states


@in_virtual_time
async def test_stall_shorter_than_the_watchdog_ends_without_a_fault() -> None:
    """After three heartbeats without a reply the link is degraded, and what plays goes on.

    The amplifier replies again 25 ms before its watchdog of 250 ms would expire.
    """
    async with supervised() as plate:
        await plate.handle(ARM)
        plate.put(FINGER)
        await asyncio.sleep(0.02)
        plate.lose_requests()
        await asyncio.sleep(0.1)
        plate.put(FINGER)
        await asyncio.sleep(0.06)
        assert (plate.state, plate.degraded) == (ENABLED, ["main"])
        plate.forget_requests()
        plate.put(FINGER)
        await asyncio.sleep(0.02)

        plate.far_end.recover()
        await asyncio.sleep(0.1)

        requests = plate.far_end.names()
        assert "Silence" not in requests
        assert requests.index("GetStatus") < requests.index("Ping")
        assert plate.links == ["degraded", "restored"]
        assert (plate.state, plate.degraded) == (ENABLED, [])
        assert plate.is_loud


@in_virtual_time
async def test_touch_during_a_stall_is_played_after_it() -> None:
    """A finger that is not reported for 150 ms counts as lifted; put down elsewhere, it is felt."""
    async with supervised() as plate:
        await plate.handle(ARM)
        plate.put(FINGER)
        await asyncio.sleep(0.02)
        plate.lose_requests()
        await asyncio.sleep(0.16)
        assert (plate.state, plate.degraded) == (ENABLED, ["main"])
        plate.forget_requests()
        plate.put(MOVED_FINGER)
        await asyncio.sleep(0.02)

        plate.far_end.recover()
        await asyncio.sleep(0.1)

        requests = plate.far_end.names()
        assert requests.index("Silence") < requests.index("Set")
        assert plate.links == ["degraded", "restored"]
        assert (plate.state, plate.degraded) == (ENABLED, [])
        assert plate.is_loud


@in_virtual_time
async def test_amplifier_that_plays_another_set_after_a_stall_is_stopped() -> None:
    """Another program may have played it meanwhile."""
    async with supervised(breaks="plate") as plate:
        await plate.handle(ARM)
        await asyncio.sleep(0.02)
        plate.lose_requests()
        await asyncio.sleep(0.15)
        plate.far_end.recover()
        foreign_set = LayerSet(0, 0, 0, (Command(0, 2000, 1000, 0),))
        (request,) = parts(
            pack_layers([foreign_set]),
            session=plate.far_end.amplifier.session,
            token=token_after(plate.far_end.status()["token"]),
            now=True,
        )

        plate.far_end.obey("Set", request, threads.now())
        await asyncio.sleep(0.2)

        assert plate.state is FAULT
        assert plate.count("Stop") >= 1


@in_virtual_time
async def test_set_that_was_not_staged_stops_all_and_is_a_fault() -> None:
    """An amplifier reports it for one set, and nothing more: the plate does not stay armed."""
    async with supervised() as plate:
        await plate.handle(ARM)
        await asyncio.sleep(0.01)
        plate.answer("Set", staged=0, played=0)

        plate.put(FINGER)
        await asyncio.sleep(0.1)

        assert plate.state is FAULT
        assert plate.far_end.state == "QUICK_STOP_ACTIVE"
        assert "era clear" in (plate.supervisor.operation.remedy or "")


def fail(*_: object) -> None:
    """Fail by a bug."""
    raise Planted


@in_virtual_time
async def test_control_loop_whose_failure_cannot_be_stopped_runs_again_once_it_can(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Until its stop succeeds it sends no heartbeat; once cleared and armed, it does."""
    async with supervised(breaks="heartbeat") as plate:
        await plate.handle(ARM)
        cycle = plate.controller.cycle
        with monkeypatch.context() as stop_bug:
            stop_bug.setattr(plate.controller, "stop", fail)
            with monkeypatch.context() as step_bug:
                step_bug.setattr(cycle, "step", fail)
                cycle.request_update()
                await asyncio.sleep(0.02)
            plate.forget_requests()
            await asyncio.sleep(0.5)
            assert plate.count("Ping") == 0
            assert plate.far_end.state == "FAULT"  # its watchdog has expired
        await asyncio.sleep(0.5)
        await plate.handle(CLEAR)
        await plate.handle(ARM)
        plate.forget_requests()

        await asyncio.sleep(1)

        assert plate.state is ENABLED
        assert plate.count("Ping") >= 18


@in_virtual_time
async def test_unexpected_exception_in_the_control_loop_is_a_fault(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It silences before the watchdog would, is latched, and the plate plays after a clear."""
    async with supervised() as plate:
        await plate.handle(ARM)
        plate.put(FINGER)
        await asyncio.sleep(0.05)
        assert plate.is_loud

        with monkeypatch.context() as bug:
            bug.setattr(plate.controller.cycle, "step", fail)
            plate.controller.cycle.request_update()
            await asyncio.sleep(0.1)
        assert plate.state is FAULT
        assert plate.far_end.state == "QUICK_STOP_ACTIVE"
        assert not plate.is_loud
        assert "Planted" in plate.supervisor.operation.cause

        await plate.handle(CLEAR)
        await plate.handle(ARM)
        plate.put(MOVED_FINGER)
        await asyncio.sleep(0.1)
        assert plate.state is ENABLED
        assert plate.is_loud


@pytest.mark.parametrize("is_disarming", [False, True], ids=["armed", "disarming"])
@in_virtual_time
async def test_end_does_not_wait_for_a_mute_amplifier(*, is_disarming: bool) -> None:
    """On a network that may deliver for 1 s the amplifier is stopped, and all ends within 0.9 s."""
    async with supervised(wire="modbus-tcp", breaks="plate") as plate:
        await plate.handle(ARM)
        plate.far_end.fault("drop")
        disarming = await plate.begin(DISARM) if is_disarming else None
        await asyncio.sleep(0.1)
        closed_from = threads.now()

        await plate.supervisor.close("end")

        assert threads.now() - closed_from <= 0.9
        if disarming is not None:
            await asyncio.gather(disarming, return_exceptions=True)
        plate.far_end.recover()


@in_virtual_time
async def test_end_of_the_control_loop_ends_the_daemon() -> None:
    """Without the control loop nothing can be armed."""

    async def cancel_loop() -> None:
        async with supervised():
            tasks = {task.get_name(): task for task in asyncio.all_tasks()}
            tasks["control loop"].cancel()
            await asyncio.sleep(1)

    with pytest.raises(RuntimeError, match="control loop"):
        await cancel_loop()


@in_virtual_time
async def test_epochs_of_two_daemons_differ() -> None:
    """A client of one daemon cannot acknowledge what another has latched.

    All epochs are exact in JSON numbers.
    """
    epochs = set[int]()
    for _ in range(2):
        async with supervised() as plate:
            epochs.add(plate.supervisor.operation.epoch)
    assert len(epochs) == 2
    assert max(epochs) < 2**32


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
"""The method of the controller by which each action is carried out."""
OPEN_TRANSITIONS = [
    (state, trigger)
    for state, trigger in TRANSITIONS
    if state is not DaemonState.NOT_READY and trigger is not Trigger.CLOSE
]


async def arm_again(plate: SupervisedPlate) -> None:
    """Clear what is latched, and arm, on a wire that is whole."""
    plate.repair()
    events = {READY: ARM, STOPPED: CLEAR, FAULT: CLEAR}
    for _ in range(1000):
        if plate.state is ENABLED:
            return
        event = events.get(plate.state)
        if event is not None:
            with contextlib.suppress(DriverError):  # as of a stop that is under way
                await plate.handle(event)
        await asyncio.sleep(0.01)
    pytest.fail(f"cannot be armed, stays in {plate.supervisor.operation}")


async def enter(plate: SupervisedPlate, state: DaemonState) -> None:
    """Lead the amplifier into OPERATION_ENABLED and the operation into a state."""
    await plate.handle(ARM)
    match state:
        case DaemonState.OPERATION_ENABLED:
            pass
        case DaemonState.FAULT_REACTION_ACTIVE:
            plate.far_end.delay(0.01)
            plate.supervisor.post(DaemonEvent(Trigger.FAULT, "test"))
        case DaemonState.COMM_LOST:
            plate.far_end.fault("unplug")
            await plate.handle(DaemonEvent(Trigger.LINK_LOST, "test"))
        case _:
            operation = Operation(state, "test", is_latched=state in (STOPPED, FAULT))
            plate.supervisor.current.value = operation
    assert plate.supervisor.operation.state is state
    plate.far_end.asked.clear()


@pytest.mark.parametrize("observer", shortly(OBSERVERS, OBSERVERS[:1]))
@in_virtual_time
async def test_failing_observer_changes_no_transition(observer: str) -> None:
    """In every state, what silences does so although an observer fails; it can be armed again."""
    for state, trigger in OPEN_TRANSITIONS:
        async with supervised() as plate:
            await enter(plate, state)
            plate.failing_observer = observer

            with contextlib.suppress(DriverError):
                await plate.handle(DaemonEvent(trigger, "test"))

            if trigger in SILENCING and state is not LOST:
                assert plate.far_end.requests("Stop", "Disarm"), (state, trigger)
                assert plate.far_end.state != "OPERATION_ENABLED", (state, trigger)
            await arm_again(plate)


FAILING_ACTIONS = [
    (state, trigger, method)
    for (state, trigger), (action, method) in product(OPEN_TRANSITIONS, METHODS)
    if action in TRANSITIONS[state, trigger].actions
]


@pytest.mark.parametrize(("state", "trigger", "method"), FAILING_ACTIONS)
@in_virtual_time
async def test_action_that_fails_once_ends_in_a_stop(
    monkeypatch: pytest.MonkeyPatch, state: DaemonState, trigger: Trigger, method: str
) -> None:
    """The amplifier gets a request that silences it, and it can be armed again after a clear."""
    async with supervised() as plate:
        await enter(plate, state)
        work = getattr(plate.controller, method)
        failures = list[Planted]()

        def fail_once(*args: object) -> object:
            if failures:
                return work(*args)
            failures.append(Planted(method))
            raise failures[0]

        with monkeypatch.context() as bug:
            bug.setattr(plate.controller, method, fail_once)
            with contextlib.suppress(DriverError, Planted):
                await plate.handle(DaemonEvent(trigger, "test"))
            await asyncio.sleep(1)  # some actions are due a moment later
        await asyncio.sleep(1)

        if failures and state is not LOST:
            assert plate.far_end.requests("Stop", "Disarm")
            assert plate.far_end.state != "OPERATION_ENABLED"
        await arm_again(plate)


@pytest.mark.parametrize(("state", "trigger"), OPEN_TRANSITIONS)
@in_virtual_time
async def test_failing_transition_ends_in_a_stop(
    monkeypatch: pytest.MonkeyPatch, state: DaemonState, trigger: Trigger
) -> None:
    """A bug in the state table itself stops the amplifier, which can be armed again afterwards."""
    async with supervised() as plate:
        await enter(plate, state)

        with monkeypatch.context() as bug:
            bug.setattr(current_operation, "step", fail)
            with contextlib.suppress(DriverError, Planted):
                await plate.handle(DaemonEvent(trigger, "test"))
        await asyncio.sleep(1)

        if state is not LOST:
            assert plate.count("Stop") >= 1
            assert plate.far_end.state != "OPERATION_ENABLED"
        await arm_again(plate)


def slow_down_stops(plate: SupervisedPlate, seconds: float) -> None:
    """Let stopping all amplifiers take so much longer."""
    stop_all = plate.controller.stop_all

    async def stop_slowly() -> Mapping[str, StopOutcome]:
        outcomes = await stop_all()
        await asyncio.sleep(seconds)
        return outcomes

    plate.controller.stop_all = stop_slowly  # type: ignore[method-assign]


@in_virtual_time
async def test_loss_found_twice_is_handled_once_and_before_reopening() -> None:
    """A command finds it, and the control loop while the command still stops other amplifiers."""
    async with supervised() as plate:
        controller = plate.controller
        cycle = controller.cycle
        release, open_lines, step = controller.release, controller.open, cycle.step
        order = list[str]()

        async def note_release() -> None:
            order.append("release")
            await release()

        async def note_open() -> None:
            await open_lines()
            order.append("open")

        async def lose_wire() -> None:
            cycle.step = step  # type: ignore[method-assign]
            for observer in cycle.observers.link_lost:
                observer("wire cut")

        slow_down_stops(plate, 0.3)
        controller.release = note_release  # type: ignore[method-assign]
        controller.open = note_open  # type: ignore[method-assign]
        plate.far_end.fault("unplug")
        stopping = asyncio.create_task(plate.handle(STOP))
        await asyncio.sleep(0.01)
        cycle.step = lose_wire  # type: ignore[method-assign]
        cycle.request_update()
        await asyncio.sleep(0.7)  # it stops the others again because of the loss
        plate.repair()
        await stopping
        await asyncio.sleep(1)
        controller.release = release  # type: ignore[method-assign]

        assert order.count("open") == 1
        assert order[-1] == "open"
        assert plate.links.count("lost") == 1
        assert (plate.links[0], plate.links[-1]) == ("lost", "reopened")
        assert plate.state is FAULT


@in_virtual_time
async def test_close_ends_handling_of_loss() -> None:
    """Neither waits for the other, and closed amplifiers are no further loss."""
    async with supervised() as plate:
        slow_down_stops(plate, 0.3)
        plate.far_end.fault("unplug")
        stopping = asyncio.create_task(plate.handle(STOP))
        await asyncio.sleep(0.7)
        assert plate.state is LOST
    await asyncio.wait_for(stopping, 5)
    assert plate.links.count("lost") == 1


@in_virtual_time
async def test_clear_does_not_acknowledge_a_stop_since_its_statuses(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The statuses that it has read are of a time before that stop."""
    async with supervised() as plate:
        await plate.handle(STOP)
        group = plate.controller.group
        read_statuses = group.statuses

        async def stop_after_reading() -> dict[str, Values]:
            statuses = await read_statuses()
            monkeypatch.setattr(group, "statuses", read_statuses)
            plate.supervisor.stop("a test")
            return statuses

        monkeypatch.setattr(group, "statuses", stop_after_reading)

        with pytest.raises(CommandRefused, match="not cleared"):
            await plate.handle(CLEAR)

        await asyncio.sleep(0.1)
        assert plate.state is STOPPED


@in_virtual_time
async def test_second_clear_leaves_a_plate_alone_that_the_first_has_cleared() -> None:
    """The second arrives after the plate was armed, which is no fault."""
    async with supervised() as plate:
        await plate.handle(STOP)
        clear = plate.controller.clear
        pauses = [0.0, 0.035]

        async def clear_late() -> None:
            await asyncio.sleep(pauses.pop(0))
            await clear()

        plate.controller.clear = clear_late  # type: ignore[method-assign]
        first = asyncio.create_task(plate.handle(CLEAR))
        second = asyncio.create_task(plate.handle(CLEAR))
        await first
        assert plate.state is READY

        await plate.handle(ARM)
        await asyncio.gather(second, return_exceptions=True)
        await asyncio.sleep(0.1)

        assert plate.state is ENABLED
        assert plate.far_end.state == "OPERATION_ENABLED"


def reported_messages(plate: SupervisedPlate) -> dict[str, str]:
    """What the status reports of the amplifier, by kind."""
    (status,) = amplifier_statuses(
        plate.controller.amplifiers,
        plate.controller.urls,
        are_open=True,
        lost=None,
        what_may_play=plate.supervisor.reopening.what_may_play,
        clock_errors=plate.controller.group.clock_errors,
        targets=["panel 1"],
    )
    return {report.kind: report.cause + report.remedy for report in status.reports}


@in_virtual_time
async def test_reports_of_an_amplifier_are_shown(caplog: pytest.LogCaptureFixture) -> None:
    """A limit, with the fingers that feel less, and the temperature; each is logged once."""
    async with supervised() as plate:
        await plate.handle(ARM)

        plate.answer("Ping", "GetStatus", flags=0b101, temperature=2000)
        await asyncio.sleep(1)

        assert plate.state is ENABLED
        messages = reported_messages(plate)
        assert messages.keys() == {"limited", "hot"}
        assert "panel 1" in messages["limited"]
        logged = [record for record in caplog.records if hasattr(record, "remedy")]
        assert len(logged) == 2
        plate.repair()
        await asyncio.sleep(11)
        assert reported_messages(plate) == {}
