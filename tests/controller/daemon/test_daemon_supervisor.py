"""The supervisor in virtual time, between a control loop and amplifiers that obey."""

import asyncio
import itertools
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from typing import Any

import pytest

from controller.daemon.states import DaemonEvent, StateMachine, Trigger
from controller.daemon.states import DaemonState as DaemonState
from controller.daemon.supervisor import Supervisor
from controller.loop.loop import Controller
from controller.loop.observer import Observer
from controller.sources.touch import Touch, TouchFrame
from controller_bench import make_bench
from drivers.amplifier import Amplifier
from drivers.errors import CommandRefused, LinkError
from drivers.operation.watchdog import HEARTBEAT
from drivers.protocol.messages import (
    AmplifierState,
    Apply,
    Arm,
    Clear,
    Disarm,
    Fault,
    GetStatus,
    Nak,
    NakCode,
    Ping,
    Reply,
    Request,
    Status,
    Stop,
)
from virtual_loop import in_virtual_time

ARM = DaemonEvent(Trigger.ARM, "somebody armed")


@dataclass
class Watched:
    """A supervisor that runs, with the far end of its amplifier and what it told."""

    supervisor: Supervisor
    controller: Controller
    far_end: Any
    states: list[DaemonState] = field(default_factory=list)
    links: list[str] = field(default_factory=list)
    refusals: list[str] = field(default_factory=list)
    alive: list[float] = field(default_factory=list)

    @property
    def state(self) -> DaemonState:
        """The daemon's."""
        return self.supervisor.machine.state

    def touch(self) -> None:
        """A finger at the middle."""
        now = asyncio.get_running_loop().time()
        self.controller.deliver(TouchFrame("test", now, (Touch(1, 0.5, 0.5),)))

    def status(
        self, state: AmplifierState, fault: Fault = Fault.NONE, level: float = 0.0
    ) -> Status:
        """What the amplifier could say."""
        return Status(state, fault, 0, False, 25.0, 0.0, (level, 0.0))


@asynccontextmanager
async def watched() -> AsyncIterator[Watched]:
    """A supervisor whose control loop runs; closed in the end, when its loop must have ended."""
    bench = make_bench()
    amplifiers = {"main": Amplifier(bench.far_end)}
    loop = asyncio.get_running_loop()

    def changed(old: StateMachine, new: StateMachine) -> None:
        made.states.append(new.state)

    supervisor = Supervisor(
        amplifiers,
        state_changed=changed,
        link_changed=lambda event, lost, message: made.links.append(event),
        alive=lambda: made.alive.append(loop.time()),
    )
    controller = Controller(
        bench.rig,
        bench.table,
        amplifiers=amplifiers,
        observer=supervisor.observe(Observer(refused=lambda reason: made.refusals.append(reason))),
    )
    made = Watched(supervisor, controller, bench.far_end)
    await supervisor.open(controller)
    running = asyncio.create_task(supervisor.run())
    await asyncio.sleep(0.001)
    try:
        yield made
    finally:
        await supervisor.close("the test is over")
        await running
        assert not bench.far_end.is_open


@in_virtual_time
async def test_it_starts_disarmed_and_ready() -> None:
    """Opened, read back, ready; nothing was armed, and nothing played for a finger."""
    async with watched() as daemon:
        assert daemon.states == [DaemonState.SWITCH_ON_DISABLED, DaemonState.READY_TO_SWITCH_ON]
        daemon.touch()
        await asyncio.sleep(1)
        assert not daemon.far_end.requests(Arm, Apply, Ping)


@in_virtual_time
async def test_heartbeats_come_from_the_control_loop_alone() -> None:
    """While a turn of the loop takes its time, no heartbeat is sent, whatever else runs."""
    async with watched() as daemon:
        await daemon.supervisor.handle(ARM)
        await asyncio.sleep(1)
        times = daemon.far_end.times(Ping)
        assert len(times) >= 18
        gaps = [late - early for early, late in itertools.pairwise(times)]
        assert max(gaps) == pytest.approx(HEARTBEAT, abs=1e-6)
        before = len(times)
        step = daemon.controller.step

        async def hung() -> None:
            await asyncio.sleep(3)
            await step()

        daemon.controller.step = hung  # type: ignore[method-assign]
        await asyncio.sleep(0.06)
        alive = len(daemon.alive)
        await asyncio.sleep(2)
        assert len(daemon.far_end.times(Ping)) <= before + 1
        assert len(daemon.alive) == alive
        daemon.controller.step = step  # type: ignore[method-assign]
        await asyncio.sleep(1.5)


@in_virtual_time
async def test_the_control_loop_says_that_it_is_alive() -> None:
    """Disarmed as armed, and while there is no link: no gap is longer than half a second."""
    async with watched() as daemon:
        await asyncio.sleep(5)
        await daemon.supervisor.handle(ARM)
        await asyncio.sleep(5)
        daemon.far_end.answer = unreachable
        await asyncio.sleep(60)
        assert daemon.state is DaemonState.COMM_LOST
        moments = [*daemon.alive, asyncio.get_running_loop().time()]
        assert max(b - a for a, b in itertools.pairwise(moments)) <= 0.6
        daemon.far_end.answer = lambda request: None
        await asyncio.sleep(6)
        assert daemon.state is DaemonState.FAULT


def unreachable(request: Request) -> Reply | None:
    """No answer to anything, ever."""
    raise LinkError("the wire is cut")


@pytest.mark.parametrize("kind", [Trigger.STOP, Trigger.FAULT])
def test_a_stop_that_is_not_heard_is_told_as_a_loss(kind: Trigger) -> None:
    """At once, to whoever asked for it, not with the next look half a second later; and latched."""

    @in_virtual_time
    async def run() -> None:
        async with watched() as daemon:
            daemon.far_end.answer = unreachable
            with pytest.raises(LinkError, match=r"the wire is cut.*energised"):
                await daemon.supervisor.handle(DaemonEvent(kind, "somebody stopped"))
            assert daemon.state is DaemonState.COMM_LOST
            assert daemon.links == ["lost"]
            daemon.far_end.answer = lambda request: None
            await asyncio.sleep(1)
            assert daemon.state is DaemonState.FAULT

    run()


@in_virtual_time
async def test_a_loss_that_two_find_is_seen_through_before_anything_is_opened_again() -> None:
    """A command finds it, and the control loop while that stops the others, which takes a while."""
    async with watched() as daemon:
        controller, opened = daemon.controller, list[bool]()
        stop, close, open_again = controller.stop, controller.close, controller.open
        step = controller.step

        async def slow_stop() -> None:
            await stop()
            await asyncio.sleep(0.3)

        async def early_close() -> None:
            assert not opened, "what was opened again is closed"
            await close()

        async def noted_open() -> None:
            opened.append(True)
            await open_again()

        async def lost_step() -> None:
            controller.step = step  # type: ignore[method-assign]
            raise LinkError("the wire is cut")

        controller.stop = slow_stop  # type: ignore[method-assign]
        controller.close = early_close  # type: ignore[method-assign]
        controller.open = noted_open  # type: ignore[method-assign]
        daemon.far_end.answer = unreachable
        stopping = asyncio.create_task(
            daemon.supervisor.handle(DaemonEvent(Trigger.STOP, "somebody"))
        )
        await asyncio.sleep(0.4)  # it stops what else there may be once more, for it is lost
        daemon.far_end.answer = lambda request: None
        controller.step = lost_step  # type: ignore[method-assign]
        controller.reconsider()
        with pytest.raises(LinkError):
            await stopping
        await asyncio.sleep(1)
        controller.close = close  # type: ignore[method-assign]
        assert len(opened) == 1
        assert daemon.links == ["lost", "reopened"]
        assert daemon.state is DaemonState.FAULT


@in_virtual_time
async def test_a_daemon_that_ends_while_a_loss_is_seen_through_ends() -> None:
    """Nobody waits for the other: by then amplifiers are closed, which is no loss to be told."""
    async with watched() as daemon:
        stop = daemon.controller.stop

        async def slow_stop() -> None:
            await stop()
            await asyncio.sleep(0.3)

        daemon.controller.stop = slow_stop  # type: ignore[method-assign]
        daemon.far_end.answer = unreachable
        stopping = asyncio.create_task(
            daemon.supervisor.handle(DaemonEvent(Trigger.STOP, "somebody"))
        )
        await asyncio.sleep(0.4)
        assert daemon.state is DaemonState.COMM_LOST
    with pytest.raises(LinkError, match="the wire is cut"):
        await asyncio.wait_for(stopping, 5)
    assert daemon.links == ["lost"]


@in_virtual_time
async def test_a_lost_link_is_tried_again_with_growing_pauses() -> None:
    """0.1 s at first, each pause twice the one before up to 5 s; back again, nothing is armed."""
    async with watched() as daemon:
        await daemon.supervisor.handle(ARM)
        daemon.far_end.answer = unreachable
        daemon.far_end.asked.clear()
        await asyncio.sleep(30)
        assert daemon.state is DaemonState.COMM_LOST
        tries = [time for time, _ in daemon.far_end.asked][-9:]
        pauses = [round(b - a, 3) for a, b in itertools.pairwise(tries)]
        assert pauses[-2:] == [5.0, 5.0]
        assert pauses[0] < 1
        assert daemon.links[0] == "lost"
        assert set(daemon.links[1:]) == {"retry"}
        daemon.far_end.answer = lambda request: None
        daemon.far_end.asked.clear()
        await asyncio.sleep(6)
        assert daemon.state is DaemonState.FAULT
        assert not daemon.far_end.requests(Arm, Apply)
        await daemon.supervisor.handle(DaemonEvent(Trigger.CLEAR))
        assert daemon.state is DaemonState.READY_TO_SWITCH_ON


@in_virtual_time
async def test_comm_lost_lasts_as_long_as_a_lost_amplifier_may_play() -> None:
    """Reopened after 0.1 s already, it is still `assume energised` until 0.35 s have passed."""
    async with watched() as daemon:
        await daemon.supervisor.handle(ARM)
        lost = asyncio.get_running_loop().time()
        await daemon.supervisor.handle(DaemonEvent(Trigger.LINK_LOST, "cut"))
        await asyncio.sleep(0.2)
        assert daemon.links == ["reopened"]
        assert daemon.state is DaemonState.COMM_LOST
        assert daemon.supervisor.machine.assume_energised(lost + 0.2)
        await asyncio.sleep(0.25)
        assert daemon.state is DaemonState.FAULT


@in_virtual_time
async def test_an_amplifier_that_comes_back_armed_is_disarmed() -> None:
    """Lost for less than its watchdog, it may be as it was: it is told before anything else."""
    async with watched() as daemon:
        await daemon.supervisor.handle(ARM)
        daemon.far_end.answer = unreachable
        await asyncio.sleep(0.2)
        assert daemon.state is DaemonState.COMM_LOST
        daemon.far_end.state = AmplifierState.OPERATION_ENABLED
        daemon.far_end.asked.clear()
        daemon.far_end.answer = lambda request: None
        await asyncio.sleep(1)
        assert daemon.state is DaemonState.FAULT
        assert daemon.far_end.requests(Disarm)
        assert daemon.far_end.state is AmplifierState.SWITCH_ON_DISABLED


@in_virtual_time
async def test_clear_is_refused_while_the_cause_is_there() -> None:
    """An amplifier that stays in its fault keeps the daemon in it; then clear works."""
    async with watched() as daemon:
        await daemon.supervisor.handle(ARM)
        hot = daemon.status(AmplifierState.FAULT, Fault.OVER_TEMPERATURE)
        daemon.far_end.answer = lambda request: hot if isinstance(request, Ping) else None
        await asyncio.sleep(0.2)
        assert daemon.state is DaemonState.FAULT
        assert "OVER_TEMPERATURE" in daemon.supervisor.machine.cause
        assert daemon.refusals == []  # the state has told it
        assert daemon.far_end.requests(Stop)
        daemon.far_end.answer = lambda request: (
            hot if isinstance(request, Clear | GetStatus) else None
        )
        with pytest.raises(CommandRefused, match="persists"):
            await daemon.supervisor.handle(DaemonEvent(Trigger.CLEAR))
        assert daemon.state is DaemonState.FAULT
        daemon.far_end.answer = lambda request: None
        await asyncio.sleep(10)
        assert daemon.state is DaemonState.FAULT
        await daemon.supervisor.handle(DaemonEvent(Trigger.CLEAR))
        assert daemon.state is DaemonState.READY_TO_SWITCH_ON


@in_virtual_time
async def test_clear_waits_for_level_zero() -> None:
    """A level that is still reported is no silence, whatever state the amplifier is in."""
    async with watched() as daemon:
        await daemon.supervisor.handle(DaemonEvent(Trigger.STOP, "stop"))
        loud = daemon.status(AmplifierState.SWITCH_ON_DISABLED, level=0.01)
        daemon.far_end.answer = lambda request: loud if isinstance(request, GetStatus) else None
        with pytest.raises(CommandRefused, match="level"):
            await daemon.supervisor.handle(DaemonEvent(Trigger.CLEAR))
        assert daemon.state is DaemonState.FAULT


@in_virtual_time
async def test_clear_right_after_a_stop_waits_for_the_ramp() -> None:
    """An amplifier takes no Clear before it is silent: it is told again once it is."""
    loop = asyncio.get_running_loop()
    async with watched() as daemon:
        await daemon.supervisor.handle(ARM)
        await daemon.supervisor.handle(DaemonEvent(Trigger.STOP, "stop"))
        silent = loop.time() + 0.05
        stopping = daemon.status(AmplifierState.QUICK_STOP_ACTIVE)
        daemon.far_end.answer = lambda request: stopping if loop.time() < silent else None
        await daemon.supervisor.handle(DaemonEvent(Trigger.CLEAR))
        assert daemon.state is DaemonState.READY_TO_SWITCH_ON


@pytest.mark.parametrize("later", [0.001, 0.015, 0.030])
@in_virtual_time
async def test_a_stop_is_not_acknowledged_by_who_asked_before_it(later: float) -> None:
    """A clear that is said again and again ends with the next stop: who asked is told, nothing
    more is said to the amplifier, and the state is that of the stop."""
    async with watched() as daemon:
        await daemon.supervisor.handle(DaemonEvent(Trigger.STOP, "the first"))
        stopping = daemon.status(AmplifierState.QUICK_STOP_ACTIVE)
        daemon.far_end.answer = lambda request: stopping
        daemon.far_end.delay = 0.004
        clearing = asyncio.create_task(daemon.supervisor.handle(DaemonEvent(Trigger.CLEAR)))
        await asyncio.sleep(later)
        await daemon.supervisor.handle(DaemonEvent(Trigger.STOP, "the second"))
        daemon.far_end.answer = lambda request: None
        with pytest.raises(CommandRefused, match="clear again"):
            await clearing
        await asyncio.sleep(1)
        assert daemon.state is DaemonState.QUICK_STOP_ACTIVE
        orders = daemon.far_end.requests(Stop, Clear)
        assert isinstance(orders[-1], Stop)
        await daemon.supervisor.handle(DaemonEvent(Trigger.CLEAR))
        assert daemon.state is DaemonState.READY_TO_SWITCH_ON


@pytest.mark.parametrize("later", [0.001, 0.005, 0.009, 0.013])
@in_virtual_time
async def test_a_stop_while_disarming_is_a_stop_and_no_fault(later: float) -> None:
    """At whatever moment of the disarm and the look whether all are silent it comes."""
    async with watched() as daemon:
        await daemon.supervisor.handle(ARM)
        await asyncio.sleep(0.005)
        daemon.far_end.delay = 0.010
        disarming = asyncio.create_task(daemon.supervisor.handle(DaemonEvent(Trigger.DISARM)))
        await asyncio.sleep(later)
        await daemon.supervisor.handle(DaemonEvent(Trigger.STOP, "stop"))
        await asyncio.gather(disarming, return_exceptions=True)
        assert daemon.state is DaemonState.QUICK_STOP_ACTIVE
        assert DaemonState.FAULT not in daemon.states
        assert daemon.far_end.state is AmplifierState.QUICK_STOP_ACTIVE


@in_virtual_time
async def test_an_amplifier_that_will_not_be_armed_is_a_fault() -> None:
    """Whoever asked is told, nothing stays armed, and somebody must acknowledge."""
    async with watched() as daemon:
        daemon.far_end.answer = lambda request: (
            Nak(NakCode.WRONG_STATE) if isinstance(request, Arm) else None
        )
        with pytest.raises(CommandRefused):
            await daemon.supervisor.handle(ARM)
        assert daemon.state is DaemonState.FAULT
        assert daemon.far_end.requests(Disarm)


@in_virtual_time
async def test_a_stop_while_arming_is_a_stop_and_no_fault() -> None:
    """The arming is refused, the state is that of the stop, and the amplifier is not armed."""
    async with watched() as daemon:
        daemon.far_end.delay = 0.005
        arming = asyncio.create_task(daemon.supervisor.handle(ARM))
        await asyncio.sleep(0.002)
        await daemon.supervisor.handle(DaemonEvent(Trigger.STOP, "stop"))
        with pytest.raises(CommandRefused):
            await arming
        assert daemon.state is DaemonState.QUICK_STOP_ACTIVE
        assert DaemonState.OPERATION_ENABLED not in daemon.states
        assert daemon.far_end.state is not AmplifierState.OPERATION_ENABLED


@in_virtual_time
async def test_a_fault_of_a_disarmed_amplifier_is_seen() -> None:
    """Within a second, though nobody asks for anything."""
    async with watched() as daemon:
        sick = daemon.status(AmplifierState.FAULT, Fault.INTERNAL)
        daemon.far_end.answer = lambda request: sick if isinstance(request, GetStatus) else None
        await asyncio.sleep(1)
        assert daemon.state is DaemonState.FAULT


@in_virtual_time
async def test_closing_while_playing_ends_in_silence_read_back() -> None:
    """Ramp to zero in 50 ms, the level read back, disarmed, closed: in less than a second."""
    loop = asyncio.get_running_loop()
    async with watched() as daemon:
        await daemon.supervisor.handle(ARM)
        daemon.touch()
        await asyncio.sleep(0.02)
        assert daemon.far_end.levels[0] > 0
        begin = loop.time()
        await daemon.supervisor.close("told to end")
        assert loop.time() - begin < 0.5
        asked = [request for time, request in daemon.far_end.asked if time >= begin]
        silence = next(request for request in asked if isinstance(request, Apply))
        assert silence.command_set.is_silent
        assert silence.command_set.ramp == pytest.approx(0.05)
        kinds = [type(request) for request in asked]
        assert kinds.index(Apply) < kinds.index(GetStatus) < kinds.index(Disarm)
