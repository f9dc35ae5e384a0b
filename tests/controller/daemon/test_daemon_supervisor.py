"""The supervisor in virtual time, with a control loop and an obedient amplifier."""

import asyncio
import itertools

import pytest

from controller.daemon.states import DaemonEvent, DaemonState, Lease, Trigger
from controller.loop.loop import Controller
from controller_bench import DISARMED, STOPPED
from controller_bench import ENABLED as ARMED
from drivers.errors import CommandRefused, LinkError
from drivers.host.line import GRACE
from drivers.protocol.records import Values
from drivers.protocol.sets import Command, LayerSet, pack_layers, parts, token_after
from drivers.protocol.table import FAULTS, STATES
from virtual_loop import in_virtual_time
from watched_supervisor import Watched, watched

ENABLED = DaemonState.OPERATION_ENABLED
ARM, STOP, CLEAR = (DaemonEvent(each) for each in (Trigger.ARM, Trigger.STOP, Trigger.CLEAR))


def slow_down(controller: Controller, *, stop: float) -> None:
    """Let stopping the amplifiers take so long [s]."""
    stop_now = controller.stop

    async def slow_stop() -> None:
        await stop_now()
        await asyncio.sleep(stop)

    controller.stop = slow_stop


@in_virtual_time
async def test_amplifier_that_refuses_at_the_start_is_opened_again_later() -> None:
    """The daemon serves meanwhile, as while none replies."""
    async with watched(refuses=True) as daemon:
        assert daemon.state is DaemonState.COMM_LOST
        daemon.obey()
        await asyncio.sleep(1)
        assert {*daemon.links} == {"retry", "reopened"}
        assert daemon.state is DaemonState.READY_TO_SWITCH_ON


@in_virtual_time
async def test_finger_before_any_amplifier_obeys_ends_with_its_source() -> None:
    """The loop turns as without one, and what comes then plays."""
    async with watched(refuses=True) as daemon:
        daemon.touch()
        await asyncio.sleep(3)
        assert len(daemon.cycles) < 20
        daemon.obey()
        await asyncio.sleep(1)
        await daemon.handle(ARM)
        await asyncio.sleep(0.1)
        assert not any(daemon.far_end.levels)
        daemon.touch()
        await asyncio.sleep(0.1)
        assert any(daemon.far_end.levels)


@in_virtual_time
async def test_unforeseen_exception_in_the_control_loop_is_a_fault(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Silent before the watchdog expires, latched, and once cleared it plays again."""
    async with watched() as daemon:
        await daemon.handle(ARM)

        def fail(*_: object, **__: object) -> None:
            raise ZeroDivisionError("a bug")

        with monkeypatch.context() as planted:
            planted.setattr("controller.loop.loop.applied_by", fail)
            daemon.touch()
            await asyncio.sleep(0.1)
        assert daemon.state is DaemonState.FAULT
        assert "a bug" in daemon.supervisor.operation.cause
        assert (daemon.far_end.state, {*daemon.far_end.levels}) == (STOPPED, {0})
        await daemon.handle(CLEAR)
        await daemon.handle(ARM)
        daemon.touch_elsewhere()
        await asyncio.sleep(0.1)
        assert (daemon.state, any(daemon.far_end.levels)) == (ENABLED, True)


@in_virtual_time
async def test_control_loop_whose_failure_cannot_be_stopped_runs_again_once_it_can() -> None:
    """No heartbeat is sent before that; once cleared and armed, they are."""
    async with watched() as daemon:
        await daemon.handle(ARM)
        controller = daemon.controller
        step, stop = controller.step, controller.stop

        async def fail() -> None:
            raise ZeroDivisionError("a bug")

        def fail_to_stop() -> None:
            raise OSError("another bug")

        controller.step, controller.stop = fail, fail_to_stop
        controller.request_update()
        await asyncio.sleep(0.02)
        controller.step = step
        begun = len(daemon.far_end.times("Ping"))
        await asyncio.sleep(0.5)
        assert len(daemon.far_end.times("Ping")) == begun
        assert daemon.far_end.state != ARMED  # its watchdog has expired
        controller.stop = stop
        await asyncio.sleep(0.5)
        await daemon.handle(CLEAR)
        await daemon.handle(ARM)
        await asyncio.sleep(1)
        assert daemon.state is ENABLED
        assert len(daemon.far_end.times("Ping")) >= begun + 18


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
async def test_control_loop_gives_signs_of_life_in_every_state() -> None:
    """Disarmed, armed and without a link: no gap exceeds 0.6 s."""
    async with watched() as daemon:
        await asyncio.sleep(5)
        await daemon.handle(ARM)
        await asyncio.sleep(5)
        daemon.cut()
        await asyncio.sleep(60)
        assert daemon.state is DaemonState.COMM_LOST
        moments = [*daemon.alive, asyncio.get_running_loop().time()]
        assert max(b - a for a, b in itertools.pairwise(moments)) <= 0.6


@in_virtual_time
async def test_loss_is_handled_before_reopening_when_found_twice() -> None:
    """By a command and by the control loop, while the command still stops other amplifiers."""
    async with watched() as daemon:
        controller, opened = daemon.controller, list[bool]()
        release, open_again, step = controller.release, controller.open, controller.step

        async def early_release() -> None:
            assert not opened, "closed after it was reopened"
            await release()

        async def noted_open() -> None:
            await open_again()
            opened.append(True)

        async def lost_step() -> None:
            controller.step = step
            for each in controller.observers:
                each.link_lost("wire cut")

        slow_down(controller, stop=0.3)
        controller.release, controller.open = early_release, noted_open
        daemon.cut()
        stopping = asyncio.create_task(daemon.handle(STOP))
        await asyncio.sleep(0.01)
        controller.step = lost_step
        controller.request_update()
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
        daemon.cut()
        stopping = asyncio.create_task(daemon.handle(STOP))
        await asyncio.sleep(0.7)
        assert daemon.state is DaemonState.COMM_LOST
    await asyncio.wait_for(stopping, 5)
    assert daemon.links.count("lost") == 1


@in_virtual_time
async def test_lease_that_is_not_renewed_ends() -> None:
    """A renewal prolongs it; then the plate is disarmed at its end."""
    async with watched() as daemon:
        lease = Lease("me", 0.3)
        await daemon.handle(DaemonEvent(Trigger.ARM, lease=lease))
        await asyncio.sleep(0.2)
        daemon.supervisor.renew(lease.token)
        await asyncio.sleep(0.29)
        assert daemon.state is ENABLED
        await asyncio.sleep(0.011)
        assert daemon.state is not ENABLED
        await asyncio.sleep(0.5)
        assert daemon.state is DaemonState.READY_TO_SWITCH_ON


@in_virtual_time
async def test_loss_while_reopened_amplifiers_are_waited_for_opens_them_again() -> None:
    """Before the watchdog of the first loss has passed; the first loss stays latched."""
    async with watched() as daemon:
        await daemon.handle(ARM)
        daemon.far_end.attempts.clear()
        await daemon.handle(DaemonEvent(Trigger.LINK_LOST))
        await asyncio.sleep(0.1)
        assert (daemon.state, len(daemon.far_end.attempts)) == (DaemonState.COMM_LOST, 1)
        await daemon.handle(DaemonEvent(Trigger.LINK_LOST))
        await asyncio.sleep(0.5)
        assert (daemon.state, len(daemon.far_end.attempts)) == (DaemonState.FAULT, 2)


@in_virtual_time
async def test_stop_while_a_lost_amplifier_is_waited_for_opens_none_again() -> None:
    """It reaches those that were reopened, and is latched."""
    async with watched() as daemon:
        await daemon.handle(ARM)
        daemon.far_end.attempts.clear()
        await daemon.handle(DaemonEvent(Trigger.LINK_LOST))
        await asyncio.sleep(0.1)
        stopped = await daemon.supervisor.stop("a test")
        assert [each.is_confirmed for each in stopped.values()] == [True]
        assert daemon.state is DaemonState.COMM_LOST
        await asyncio.sleep(0.5)
        assert (daemon.state, len(daemon.far_end.attempts)) == (DaemonState.FAULT, 1)


@in_virtual_time
async def test_amplifiers_that_cannot_be_disarmed_are_opened_again() -> None:
    """None that may be armed stays open, and each attempt is reported."""
    async with watched() as daemon:
        await daemon.handle(ARM)
        disarm, failures = daemon.controller.disarm, [LinkError("injected")]

        async def fail_once() -> None:
            if failures:
                assert daemon.far_end.is_open
                raise failures.pop()
            await disarm()

        daemon.controller.disarm = fail_once
        daemon.far_end.attempts.clear()
        await daemon.handle(DaemonEvent(Trigger.LINK_LOST))
        await asyncio.sleep(1)
        assert (daemon.links, len(daemon.far_end.attempts)) == (["retry", "reopened"], 2)
        assert daemon.state is DaemonState.FAULT


@in_virtual_time
async def test_comm_lost_lasts_while_lost_amplifier_may_play() -> None:
    """Reopened after 0.1 s, it counts as energised until its watchdog of 0.25 s has passed."""
    async with watched() as daemon:
        await daemon.handle(ARM)
        lost = asyncio.get_running_loop().time()
        await daemon.handle(DaemonEvent(Trigger.LINK_LOST))
        await asyncio.sleep(0.2)
        assert daemon.links == ["reopened"]
        assert daemon.state is DaemonState.COMM_LOST
        assert daemon.supervisor.assume_energised(lost + 0.2)
        await asyncio.sleep(0.25)
        assert daemon.state is DaemonState.FAULT


@in_virtual_time
async def test_lost_amplifier_may_play_for_as_long_as_a_network_delivers() -> None:
    """1 s, in which what was sent last may arrive, and its watchdog of 0.25 s."""
    async with watched() as daemon:
        await daemon.handle(ARM)
        daemon.touch()
        await asyncio.sleep(0.1)
        lost = asyncio.get_running_loop().time()
        daemon.far_end.is_mute = True  # replies do not come back, and then the connection ends
        await asyncio.sleep(0.08)
        daemon.cut()
        await asyncio.sleep(0.5)
        assert daemon.state is DaemonState.COMM_LOST
        assert daemon.supervisor.assume_energised(lost + 1.2)
        assert not daemon.supervisor.assume_energised(lost + 1.6)


@pytest.mark.parametrize("levels", [[100, 0], [0], list[int]()])
@in_virtual_time
async def test_clear_is_refused_while_levels_are_not_all_zero(levels: list[int]) -> None:
    """Even if the amplifier reports that it is disarmed; the stop is repeated meanwhile."""
    async with watched() as daemon:
        await daemon.handle(STOP)
        daemon.far_end.asked.clear()
        daemon.answer("GetStatus", state=STATES[DISARMED], channels=len(levels), levels=levels)
        await asyncio.sleep(2.0)
        assert daemon.far_end.requests("Stop")
        with pytest.raises(CommandRefused):
            await daemon.handle(CLEAR)
        assert daemon.state is DaemonState.FAULT


@in_virtual_time
async def test_clear_is_repeated_during_ramp_of_stop() -> None:
    """An amplifier ignores Clear until it is silent."""
    loop = asyncio.get_running_loop()
    async with watched() as daemon:
        await daemon.handle(ARM)
        await daemon.handle(STOP)
        silent = loop.time() + 0.05
        stopping = daemon.far_end.status()
        daemon.far_end.answer = lambda name, values: (
            stopping if loop.time() < silent and name in ("Clear", "GetStatus") else None
        )
        await daemon.handle(CLEAR)
        assert daemon.state is DaemonState.READY_TO_SWITCH_ON


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
            daemon.supervisor.post(STOP)
            return statuses

        monkeypatch.setattr(group, "statuses", stopped_since)
        with pytest.raises(CommandRefused, match="not cleared"):
            await daemon.handle(CLEAR)
        await asyncio.sleep(0.1)
        assert daemon.state is DaemonState.QUICK_STOP_ACTIVE


@in_virtual_time
async def test_clear_that_is_refused_ends_no_repetition_of_a_stop() -> None:
    """A level stays: the stop goes on for as long as it does, whoever clears meanwhile."""
    async with watched() as daemon:
        await daemon.handle(ARM)
        daemon.answer("Stop", "GetStatus", levels=[1000, 0])
        stopping = asyncio.create_task(daemon.handle(STOP))
        await asyncio.sleep(0.05)
        with pytest.raises(CommandRefused):
            await daemon.handle(CLEAR)
        await stopping
        daemon.far_end.asked.clear()
        await asyncio.sleep(2)
        assert len(daemon.far_end.requests("Stop")) > 2
        assert not daemon.far_end.requests("Clear")


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


@pytest.mark.parametrize("delay", [0.001, 0.005, 0.009, 0.013])
@in_virtual_time
async def test_stop_while_disarming_is_no_fault(delay: float) -> None:
    """At any moment of the disarming and its read-back."""
    async with watched() as daemon:
        await daemon.handle(ARM)
        await asyncio.sleep(0.005)
        daemon.far_end.delay = 0.010
        disarming = asyncio.create_task(daemon.handle(DaemonEvent(Trigger.DISARM)))
        await asyncio.sleep(delay)
        await daemon.handle(STOP)
        await asyncio.gather(disarming, return_exceptions=True)
        assert daemon.state is DaemonState.QUICK_STOP_ACTIVE
        assert DaemonState.FAULT not in daemon.states
        assert daemon.far_end.state == STOPPED


@in_virtual_time
async def test_stop_while_arming_is_no_fault() -> None:
    """The arming is refused and the amplifier is not armed."""
    async with watched() as daemon:
        daemon.far_end.delay = 0.005
        arming = asyncio.create_task(daemon.handle(ARM))
        await asyncio.sleep(0.002)
        await daemon.handle(STOP)
        with pytest.raises(CommandRefused):
            await arming
        assert daemon.state is DaemonState.QUICK_STOP_ACTIVE
        assert DaemonState.OPERATION_ENABLED not in daemon.states
        assert daemon.far_end.state != ARMED


@in_virtual_time
async def test_amplifier_that_refuses_to_arm_is_a_fault() -> None:
    """The caller gets the refusal, and all amplifiers are disarmed."""
    async with watched() as daemon:
        daemon.refuse("Arm")
        with pytest.raises(CommandRefused):
            await daemon.handle(ARM)
        assert daemon.state is DaemonState.FAULT
        assert daemon.far_end.state != ARMED


@in_virtual_time
async def test_fault_reported_while_arming_stops_all() -> None:
    """Before the reply to Arm; nothing is armed afterwards."""
    async with watched() as daemon:
        daemon.far_end.delay = 0.02
        arming = asyncio.create_task(daemon.handle(ARM))
        await asyncio.sleep(0.005)
        daemon.far_end.report(state=STATES["FAULT"], fault=FAULTS["ARC"], channel=1)
        await asyncio.sleep(GRACE + 0.001)
        assert daemon.far_end.requests("Stop")
        with pytest.raises(CommandRefused):
            await arming
        await asyncio.sleep(0.1)
        assert daemon.state is DaemonState.FAULT
        assert DaemonState.OPERATION_ENABLED not in daemon.states
        assert daemon.far_end.state != ARMED


@in_virtual_time
async def test_fault_of_disarmed_amplifier_is_noticed() -> None:
    """Within a second, without any request of a client."""
    async with watched() as daemon:
        daemon.answer("GetStatus", state=STATES["FAULT"], fault=FAULTS["INTERNAL"])
        await asyncio.sleep(1)
        assert daemon.state is DaemonState.FAULT


async def stall(daemon: Watched, seconds: float) -> None:
    """Let the amplifier hear nothing for a time [s]."""
    daemon.far_end.is_deaf = True
    await asyncio.sleep(seconds)
    daemon.far_end.is_deaf = False


@in_virtual_time
async def test_stall_shorter_than_watchdog_ends_without_fault() -> None:
    """Three heartbeats without a reply degrade the link; new touches are played once it is back."""
    async with watched() as daemon:
        await daemon.handle(ARM)
        daemon.touch()
        await asyncio.sleep(0.02)
        stalling = asyncio.create_task(stall(daemon, 0.18))
        await asyncio.sleep(0.16)
        assert (daemon.state, daemon.controller.degraded) == (ENABLED, ("main",))
        begun = len(daemon.far_end.asked)
        daemon.touch_elsewhere()
        await stalling
        await asyncio.sleep(0.1)
        kinds = daemon.far_end.names(begun)
        assert kinds.index("GetStatus") < kinds.index("Set")
        assert (daemon.state, daemon.controller.degraded) == (ENABLED, ())
        assert daemon.links == ["degraded", "restored"]
        assert any(daemon.far_end.levels)


@in_virtual_time
async def test_amplifier_that_plays_another_set_after_a_stall_is_stopped() -> None:
    """Another program may have played it meanwhile."""
    async with watched() as daemon:
        await daemon.handle(ARM)
        await asyncio.sleep(0.02)
        await stall(daemon, 0.15)
        far = daemon.far_end.amplifier
        (part,) = parts(
            pack_layers([LayerSet(0, 0, 0, (Command(0, 2000, 1000, 0),))]),
            session=far.session,
            token=token_after(daemon.far_end.status()["token"]),
            now=True,
        )
        daemon.far_end.obey("Set", part, asyncio.get_running_loop().time())
        await asyncio.sleep(0.2)
        assert daemon.state is DaemonState.FAULT
        assert daemon.far_end.requests("Stop")


@in_virtual_time
async def test_set_that_was_not_staged_stops_all_and_is_a_fault() -> None:
    """An amplifier says so of one set: no request says more, and the plate does not stay armed."""
    async with watched() as daemon:
        await daemon.handle(ARM)
        await asyncio.sleep(0.01)

        def stage_nothing(name: str, values: Values) -> Values | None:
            if name != "Set":
                return None
            reply = daemon.far_end.obey(name, values, asyncio.get_running_loop().time())
            return {**reply, "staged": 0, "played": 0}

        daemon.far_end.answer = stage_nothing
        daemon.touch()
        await asyncio.sleep(0.1)
        assert daemon.far_end.state == STOPPED
        assert daemon.state is DaemonState.FAULT
        assert "era clear" in (daemon.supervisor.operation.remedy or "")
