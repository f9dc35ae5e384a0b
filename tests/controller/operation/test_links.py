"""The supervisor in virtual time, with a control loop and an obedient amplifier."""

import asyncio
from collections.abc import Mapping
from pathlib import Path

import pytest

from controller.daemon.messages import amplifier_statuses
from controller.operation.operation_states import DaemonEvent, DaemonState, Trigger
from controller.play.loop import Controller
from courses import courses, follow
from drivers.errors import CommandRefused
from drivers.host.dialogue import Stopped
from drivers.protocol.records import Values
from drivers.protocol.sets import Command, LayerSet, pack_layers, parts, token_after
from registry import threads
from several_fingers import Watched, watched
from virtual_lines import in_virtual_time

ARMED, STOPPED = "OPERATION_ENABLED", "QUICK_STOP_ACTIVE"
ENABLED = DaemonState.OPERATION_ENABLED
ARM, STOP, CLEAR = (DaemonEvent(each) for each in (Trigger.ARM, Trigger.STOP, Trigger.CLEAR))


COURSES = courses(Path(__file__).with_name("courses.yaml"))


@pytest.mark.parametrize("name", COURSES)
def test_supervisor_keeps_to_its_course(name: str) -> None:
    """Every step is as it is in the file."""
    follow(COURSES[name], watched)


def slow_down(controller: Controller, *, stop: float) -> None:
    """Let stopping the amplifiers take so long [s]."""
    stop_now = controller.stop

    async def slow_stop() -> Mapping[str, Stopped]:
        stopped = await stop_now()
        await asyncio.sleep(stop)
        return stopped

    controller.stop = slow_stop


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
            daemon.supervisor.post(STOP)
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


async def stall(daemon: Watched, seconds: float) -> None:
    """Let the amplifier hear nothing for a time [s]."""
    daemon.fault("drop", toward="amplifier")
    await asyncio.sleep(seconds)
    daemon.recovers()


@in_virtual_time
async def test_amplifier_that_plays_another_set_after_a_stall_is_stopped() -> None:
    """Another program may have played it meanwhile."""
    async with watched(breaks="plate") as daemon:
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
        daemon.far_end.obey("Set", part, threads.now())
        await asyncio.sleep(0.2)
        assert daemon.state is DaemonState.FAULT
        assert daemon.far_end.requests("Stop")


@in_virtual_time
async def test_stop_in_progress_is_not_repeated(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """A look at the amplifiers finds it at work; one after its end, without silence, does not."""
    monkeypatch.setattr("controller.operation.links.STATUS_INTERVAL", 0.02)
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
                what_may_play=daemon.supervisor.what_may_play,
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
