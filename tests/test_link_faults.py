"""Faults of links and amplifiers over every wire, with the required reaction times.

Times are by the amplifier's clock, which is this process's, so that a busy machine does not count.
"""

import asyncio
import contextlib
import gc
import inspect
import math
import threading
from collections.abc import AsyncIterator, Callable, Coroutine
from pathlib import Path
from typing import Any

import pytest
from sim.amplifier.channels import PlayableSet

from drivers import clock
from drivers.amplifier import Amplifier
from drivers.command import CommandSet, DriveCommand
from drivers.errors import CommandRefused, DriverError, LinkDegraded, LinkError
from drivers.garbage_collection import no_long_collections
from drivers.guard import Guard, GuardLimits, SafeCommandSet
from drivers.link.link import REPLY_TIMEOUT as USUAL_TIMEOUT
from drivers.operation.watchdog import HEARTBEAT, MIN_HEARTBEATS_PER_WATCHDOG, loss_detection_time
from drivers.protocol.messages import AmplifierEvent, AmplifierState, Fault, Feature
from drivers.registry import open_backend
from long_form import shortly
from memory_machine import live_in_memory
from model.rig.rig import Rig
from reconnection import reconnect
from sim.far_ends.wires import Wire
from sim.faults.fault_window import FaultKind, FaultWindow
from virtual_loop import run_virtual
from wires import WIRES, FarSide, far_side, patient

WATCHDOG = 0.15  # s
REACTION = 0.005  # s; the ramp to silence after the watchdog
LIMITS = GuardLimits(40.0, 500.0, 1.0)
REPLY_TIMEOUT = 0.5  # s; where no reply is lost
FOUR = (0.2,) * 4  # levels
SHORT_WIRES = ("serial", "modbus+rtu", "can+slcan", "modbus+rtu, 19 200 baud")
"""One of each family, and the slowest; `make test-long` takes the others."""


@pytest.fixture(params=shortly(WIRES, SHORT_WIRES))
async def far(request: pytest.FixtureRequest, coarse_rig: Rig) -> AsyncIterator[FarSide]:
    """The paper's amplifier behind each wire, in real time."""
    async with far_side(WIRES[request.param], coarse_rig, seed=7) as far:
        yield far


class Link:
    """An open amplifier with its guard; watched: with the usual heartbeats on CAN."""

    def __init__(
        self, far: FarSide, *, reply_timeout: float = REPLY_TIMEOUT, watched: bool = False
    ) -> None:
        self.far = far
        url = far.url if watched else patient(far.url)
        self.amplifier = Amplifier(open_backend(url), reply_timeout=reply_timeout)
        self.events: list[AmplifierEvent] = []
        self.amplifier.listen(self.events.append)

    async def __aenter__(self) -> "Link":
        await reconnect(self.amplifier)
        self.guard = Guard(LIMITS, self.amplifier.capabilities)
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.amplifier.close()

    async def again(self) -> None:
        """Reopen, clear and arm after a loss, with all faults over."""
        self.far.device.recover()
        async with asyncio.timeout(60):
            while True:
                with contextlib.suppress(LinkError, CommandRefused):  # not yet silent
                    await reconnect(self.amplifier, tries=20, pause=0.0)
                    await self.amplifier.clear()
                    await self.amplifier.arm(2.0)
                    return

    def tone(self, *levels: float) -> SafeCommandSet:
        """Make a set of these levels, from channel 0 on."""
        token = self.amplifier.next_token()
        commands = tuple(
            DriveCommand(channel, 110.0, level) for channel, level in enumerate(levels or (0.5,))
        )
        return self.guard.check(CommandSet(token, commands, ramp=0.0, valid_for=0.0))


def over_every_wire(test: Callable[..., Coroutine[Any, Any, None]]) -> Callable[..., None]:
    """Run a test of the paper's amplifier behind each wire in virtual time.

    The test takes the far side; its other parameters stay.
    """

    def run(wire: str, coarse_rig: Rig, **parameters: object) -> None:
        async def live() -> None:
            live_in_memory()
            async with far_side(WIRES[wire], coarse_rig, seed=7) as far:
                await test(far, **parameters)

        run_virtual(live())

    own = [*inspect.signature(test).parameters.values()][1:]
    new = [*inspect.signature(run).parameters.values()][:2]
    run.__signature__ = inspect.Signature([*new, *own])  # type: ignore[attr-defined]
    run.__name__, run.__doc__ = test.__name__, test.__doc__
    marked: Callable[..., None] = pytest.mark.parametrize("wire", shortly(WIRES, SHORT_WIRES))(run)
    return marked


async def eventually(condition: Callable[[], bool]) -> None:
    """Wait for a condition."""
    async with asyncio.timeout(60):
        while True:
            if condition():
                return
            await asyncio.sleep(0.001)


async def beat(amplifier: Amplifier, times: int) -> None:
    """Send heartbeats, one after the other."""
    for _ in range(times):
        await amplifier.heartbeat()


async def beat_on(amplifier: Amplifier) -> None:
    """Send heartbeats as the control loop does, until the amplifier is lost."""
    while True:
        await asyncio.sleep(HEARTBEAT)
        await amplifier.heartbeat()


def fed_at(far: FarSide) -> float:
    """Return when the watchdog was last fed [s], by the amplifier's clock."""
    return far.amplifier._last_fed


@over_every_wire
async def test_amplifier_falls_silent_when_the_host_is_gone(far: FarSide) -> None:
    """Silent within the watchdog time + 5 ms of the last request, then a latched fault."""
    async with Link(far) as link:
        await link.amplifier.arm(WATCHDOG)
        await link.amplifier.apply(link.tone())
        fed = fed_at(far)
    await eventually(lambda: far.silent_from() < math.inf)
    measured = far.silent_from() - fed
    assert WATCHDOG <= measured <= WATCHDOG + REACTION + 1e-9
    await eventually(lambda: far.device.status().state is AmplifierState.FAULT)
    assert far.amplifier.fault is Fault.WATCHDOG


@pytest.mark.parametrize("kind", ["unplug", "hang", "drop"])
@over_every_wire
async def test_cut_link_is_silent_and_detected(far: FarSide, kind: FaultKind) -> None:
    """Silent as above; degraded after three heartbeats and lost after the watchdog; no new sets."""
    async with Link(far, reply_timeout=HEARTBEAT, watched=True) as link:
        await link.amplifier.arm(WATCHDOG)
        await link.amplifier.apply(link.tone())
        cut = clock.now()
        fed = fed_at(far)
        far.device.inject_fault(FaultWindow(kind))
        with pytest.raises(LinkError):
            await beat(link.amplifier, MIN_HEARTBEATS_PER_WATCHDOG)
        assert link.amplifier.is_lost or link.amplifier.is_degraded
        assert link.amplifier.statistics.timeouts <= MIN_HEARTBEATS_PER_WATCHDOG
        assert clock.now() - cut <= MIN_HEARTBEATS_PER_WATCHDOG * HEARTBEAT + 0.05
        while not link.amplifier.is_lost:
            with pytest.raises(LinkError, match="watchdog"):
                await link.amplifier.apply(link.tone())
            with pytest.raises(LinkError):
                await link.amplifier.heartbeat()
        assert clock.now() >= fed_at(far) + WATCHDOG * (kind != "unplug")
        await eventually(lambda: far.silent_from() < math.inf)
        assert far.silent_from() - max(fed, fed_at(far)) <= WATCHDOG + REACTION + 1e-9
        await eventually(lambda: far.device.status().state is AmplifierState.FAULT)
        far.device.recover()
        await reconnect(link.amplifier, tries=200)
        status = await link.amplifier.status()  # reopening does not arm
        assert (status.state, status.levels) == (AmplifierState.FAULT, (0.0,) * 4)


@pytest.mark.parametrize("kind", ["drop", "hang"])
@over_every_wire
async def test_short_stall_degrades_the_link_and_recovers(far: FarSide, kind: FaultKind) -> None:
    """A stall of 100 ms, a watchdog of 250 ms: no new set meanwhile, and the last one plays on."""
    async with Link(far, reply_timeout=USUAL_TIMEOUT, watched=True) as link:
        await link.amplifier.arm(0.25)
        playing = link.tone()
        await link.amplifier.apply(playing)
        far.device.inject_fault(FaultWindow(kind, lasts=0.1))
        with pytest.raises(LinkDegraded):
            await link.amplifier.heartbeat()
        assert link.amplifier.is_degraded
        for refused in (
            lambda: link.amplifier.apply(link.tone(0.1)),
            lambda: link.amplifier.commit(playing.token),
            lambda: link.amplifier.arm(0.25),
        ):
            with pytest.raises(LinkDegraded, match="until it replies"):
                await refused()
        async with asyncio.timeout(0.2):
            while link.amplifier.is_degraded:
                with contextlib.suppress(LinkDegraded):
                    status = await link.amplifier.heartbeat()
                await asyncio.sleep(0.005)
        assert (status.state, status.token) == (AmplifierState.OPERATION_ENABLED, playing.token)
        await link.amplifier.apply(link.tone(0.1))


@over_every_wire
async def test_amplifier_without_replies_is_not_fed_for_ever(far: FarSide) -> None:
    """It hears the host, which hears nothing: its watchdog still ends what it plays."""
    async with Link(far, reply_timeout=USUAL_TIMEOUT, watched=True) as link:
        await link.amplifier.arm(WATCHDOG)
        await link.amplifier.apply(link.tone())
        far.device.inject_fault(FaultWindow("drop", toward="host"))
        unheard = clock.now()
        while not link.amplifier.is_lost:
            with pytest.raises(LinkError):
                await link.amplifier.heartbeat()
            await asyncio.sleep(HEARTBEAT)
        assert far.silent_from() - unheard <= MIN_HEARTBEATS_PER_WATCHDOG * HEARTBEAT + WATCHDOG
        assert clock.now() >= far.silent_from()


@pytest.mark.parametrize("kind", ["drop", "hang"])
@over_every_wire
async def test_lost_amplifier_is_stopped_over_its_open_wire(far: FarSide, kind: FaultKind) -> None:
    """Without reopening; nothing else is sent, and it stays lost."""
    async with Link(far, reply_timeout=USUAL_TIMEOUT, watched=True) as link:
        await link.amplifier.arm(2.0)
        await link.amplifier.apply(link.tone())
        link.amplifier._watchdog = 0.0  # it is lost although it plays
        far.device.inject_fault(FaultWindow(kind))
        while not link.amplifier.is_lost:
            with pytest.raises(LinkError):
                await link.amplifier.heartbeat()
        far.device.recover()
        assert far.silent_from() == math.inf
        with pytest.raises(LinkError):
            await link.amplifier.apply(link.tone())
        assert (await link.amplifier.stop()).state is AmplifierState.QUICK_STOP_ACTIVE
        assert link.amplifier.is_lost


@over_every_wire
async def test_unplugged_wire_is_detected_within_60_ms(far: FarSide) -> None:
    """Also without a request, every time."""
    async with Link(far) as host:
        for _ in range(3):
            pulled = clock.now()
            far.device.inject_fault(FaultWindow("unplug"))
            await eventually(lambda: host.amplifier.is_lost)
            assert clock.now() - pulled <= 0.060
            far.device.recover()
            await reconnect(host.amplifier, tries=200)


@pytest.mark.parametrize("name", shortly(WIRES, SHORT_WIRES))
def test_wire_recovers_after_overlapping_faults(name: str, coarse_rig: Rig) -> None:
    """Unplugged for 0.2 s, and 0.1 s later for 0.3 s: usable after 0.4 s."""

    async def is_usable(host: Link) -> bool:
        amplifier = Amplifier(open_backend(host.far.url))
        try:
            await amplifier.open()
        except LinkError:
            return False
        finally:
            await amplifier.close()
        return True

    async def use(host: Link) -> None:
        await host.amplifier.close()
        host.far.device.inject_fault(FaultWindow("unplug", lasts=0.2))
        await asyncio.sleep(0.1)
        host.far.device.inject_fault(FaultWindow("unplug", lasts=0.3))
        await asyncio.sleep(0.2)
        assert not await is_usable(host)
        await asyncio.sleep(0.2)
        assert await is_usable(host)

    in_virtual_time(name, coarse_rig, use)


SLOW_WIRES = {
    "serial, 115 200 baud": Wire("serial", speed=115_200),
    "modbus+rtu, 115 200 baud": Wire("modbus-rtu", speed=115_200),
    "modbus+rtu, 19 200 baud": Wire("modbus-rtu", speed=19_200),
    "can+slcan, 125 kbit/s": Wire("slcan", speed=125_000),
}


def in_virtual_time(
    name: str, rig: Rig, use: Callable[["Link"], Coroutine[Any, Any, None]]
) -> None:
    """Use the amplifier behind this wire in virtual time, with the default timeouts."""

    async def run() -> None:
        live_in_memory()
        async with (
            far_side({**WIRES, **SLOW_WIRES}[name], rig, seed=7) as far,
            Link(far, reply_timeout=USUAL_TIMEOUT, watched=True) as host,
        ):
            await use(host)

    run_virtual(run())


@pytest.mark.parametrize("kind", ["hang", "drop"])
@pytest.mark.parametrize("name", shortly([*WIRES, *SLOW_WIRES], SHORT_WIRES))
def test_silent_amplifier_is_detected_within_three_heartbeats(
    name: str, kind: FaultKind, coarse_rig: Rig
) -> None:
    """Within 150 ms of the worst moment, right after a reply, with the loop's heartbeats."""

    async def use(host: Link) -> None:
        for _ in range(10):
            await host.again()
            host.far.device.inject_fault(FaultWindow(kind))
            hung = clock.now()
            with pytest.raises(LinkError):
                await beat_on(host.amplifier)
            assert clock.now() - hung <= MIN_HEARTBEATS_PER_WATCHDOG * HEARTBEAT

    in_virtual_time(name, coarse_rig, use)


@pytest.mark.parametrize("name", shortly([*WIRES, *SLOW_WIRES], SHORT_WIRES))
def test_loss_during_a_set_is_detected_within_loss_detection_time(
    name: str, coarse_rig: Rig
) -> None:
    """The computed time, from the worst moment: three heartbeats except at 19 200 Bd."""

    async def use(host: Link) -> None:
        bound = loss_detection_time([host.amplifier.round_trip()])
        is_late = name == "modbus+rtu, 19 200 baud"
        assert (bound > MIN_HEARTBEATS_PER_WATCHDOG * HEARTBEAT) == is_late
        for _ in range(5):
            await host.again()
            host.far.device.inject_fault(FaultWindow("hang"))
            hung = clock.now()
            await asyncio.sleep(HEARTBEAT)
            with pytest.raises(LinkError):
                await host.amplifier.apply(host.tone(*FOUR))
            assert clock.now() - hung <= bound
            assert (clock.now() - hung > MIN_HEARTBEATS_PER_WATCHDOG * HEARTBEAT) == is_late

    in_virtual_time(name, coarse_rig, use)


@pytest.mark.parametrize("name", shortly([*WIRES, *SLOW_WIRES], SHORT_WIRES))
def test_slow_wire_is_not_lost(name: str, coarse_rig: Rig) -> None:
    """Sets and heartbeats that occupy the whole wire are not repeated."""

    async def use(host: Link) -> None:
        await host.amplifier.arm(2.0)
        for _ in range(20):
            wanted = host.tone(*FOUR)
            assert (await host.amplifier.apply(wanted)).token == wanted.token
            await beat(host.amplifier, 3)
        assert host.amplifier.statistics.retries == 0

    in_virtual_time(name, coarse_rig, use)


@over_every_wire
async def test_token_is_applied_once_under_frame_loss(far: FarSide) -> None:
    """With 20 % of all frames lost each way, confirmed sets play exactly once."""
    played: list[int] = []  # in the order of their commits
    play = far.amplifier._play

    def noted(playable: PlayableSet, now: float) -> object:
        reply = play(playable, now)
        played.append(playable.token)
        return reply

    far.amplifier._play = noted
    confirmed = []
    async with Link(far, reply_timeout=0.03) as link:
        await link.amplifier.arm(2.0)
        far.device.inject_fault(FaultWindow("drop", share=0.2))
        for number in range(40):
            safe = link.tone(0.1 + 0.01 * (number % 10))
            try:
                achieved = await link.amplifier.apply(safe)
            except LinkError:
                await link.again()
                far.device.inject_fault(FaultWindow("drop", share=0.2))
                continue
            except CommandRefused:  # a wire on which a set takes several frames
                continue
            assert achieved.token == safe.token
            assert achieved.commands[0].level == pytest.approx(safe.commands[0].level)
            confirmed.append(achieved.token)
        lost = link.amplifier.statistics.timeouts
        far.device.recover()
    assert lost >= 3
    assert len(confirmed) >= 15
    assert len(played) == len(set(played))
    assert set(confirmed) <= set(played)
    assert [token for token in played if token in confirmed] == confirmed


@pytest.mark.parametrize("kind", ["corrupt", "truncate", "duplicate", "delay"])
@over_every_wire
async def test_reply_is_never_credited_to_another_request(far: FarSide, kind: FaultKind) -> None:
    """Every reply belongs to its request while a third of the frames has a fault."""
    patience = 0.5 if kind == "duplicate" else 0.03
    async with Link(far, reply_timeout=patience) as link:
        await link.amplifier.arm(2.0)
        far.device.inject_fault(FaultWindow(kind, share=0.3, delay=0.05))
        right = 0
        for _ in range(15):
            safe = link.tone(0.3)
            try:
                achieved = await link.amplifier.apply(safe)
            except LinkError:
                await link.again()
                far.device.inject_fault(FaultWindow(kind, share=0.3, delay=0.05))
                continue
            except DriverError:  # late, repeated, truncated or damaged
                continue
            assert achieved.token == safe.token
            right += 1
        await link.again()
        assert right >= 3
        assert (await link.amplifier.stop()).state is AmplifierState.QUICK_STOP_ACTIVE


@over_every_wire
async def test_damaged_set_is_counted_and_not_played(far: FarSide) -> None:
    """A set damaged on its way is not played; damaged replies are counted."""
    async with Link(far, reply_timeout=0.03) as host:
        await host.amplifier.arm(2.0)
        first = host.tone(0.4)
        await host.amplifier.apply(first)
        far.device.inject_fault(FaultWindow("corrupt", toward="amplifier"))
        with pytest.raises(DriverError):
            await host.amplifier.apply(host.tone(0.9))
        far.bench.advance(clock.now())
        assert far.device.status().token == first.token
        assert far.device.status().levels[0] == pytest.approx(0.4)
        await host.again()
        far.device.inject_fault(FaultWindow("corrupt", toward="host"))
        with pytest.raises(DriverError):
            await host.amplifier.heartbeat()
        seen = host.amplifier.statistics
        if not far.url.startswith(
            ("can+", "modbus+tcp")
        ):  # which discard damaged frames themselves
            assert seen.invalid_frames + seen.unexpected_frames > 0


@over_every_wire
async def test_one_valid_frame_resynchronizes(far: FarSide) -> None:
    """The next frame after a damaged one is understood."""
    async with Link(far, reply_timeout=2.0) as link:
        for _ in range(5):
            far.device.inject_fault(FaultWindow("corrupt", toward="amplifier"))
            with pytest.raises(TimeoutError):
                async with asyncio.timeout(0.03):
                    await link.amplifier.heartbeat()
            far.device.recover()
            before = link.amplifier.statistics.timeouts
            await link.amplifier.heartbeat()
            assert link.amplifier.statistics.timeouts == before


@over_every_wire
async def test_incomplete_set_is_not_played(far: FarSide) -> None:
    """No part of a set plays if a part is lost."""
    async with Link(far, reply_timeout=0.03) as link:
        await link.amplifier.arm(2.0)
        first = link.tone(0.4)
        await link.amplifier.apply(first)
        far.device.inject_fault(FaultWindow("incomplete_set"))
        with pytest.raises(DriverError):
            await link.amplifier.apply(link.tone(*FOUR))
        far.bench.advance(clock.now())
        status = far.device.status()
        assert status.token == first.token
        assert status.levels == pytest.approx((0.4, 0.0, 0.0, 0.0), abs=1e-4)


@over_every_wire
async def test_refusals_do_not_multiply_requests(far: FarSide) -> None:
    """20 heartbeats, as many as in a second, take at most 50 frames."""
    async with Link(far) as link:
        await link.amplifier.arm(2.0)
        far.device.inject_fault(FaultWindow("nak_storm"))
        before = link.amplifier.statistics
        for _ in range(20):
            with pytest.raises(CommandRefused, match="busy"):
                await link.amplifier.heartbeat()
        after = link.amplifier.statistics
        assert after.refusals - before.refusals == 20
        assert after.frames_out - before.frames_out <= 50
        far.device.recover()
        assert (await link.amplifier.heartbeat()).state is AmplifierState.OPERATION_ENABLED


@over_every_wire
async def test_reboot_is_detected_and_does_not_rearm(far: FarSide) -> None:
    """Silent at once; afterwards it is disarmed and refuses sets."""
    async with Link(far) as link:
        await link.amplifier.arm(2.0)
        await link.amplifier.apply(link.tone())
        begin = clock.now()
        far.device.inject_fault(FaultWindow("reboot", lasts=0.05))
        assert far.silent_from() - begin <= 0.01
        try:
            status = await link.amplifier.heartbeat()
        except LinkError:  # on a wire that reports restarts
            await reconnect(link.amplifier, tries=50)
            status = await link.amplifier.status()
        assert status.state is AmplifierState.SWITCH_ON_DISABLED
        with pytest.raises(CommandRefused):
            await link.amplifier.apply(link.tone())


@over_every_wire
async def test_reopening_refuses_another_serial_number(far: FarSide) -> None:
    """The serial number must not change."""
    async with Link(far) as link:
        await link.amplifier.close()
        assert link.amplifier._serial_number == far.amplifier.identity.serial_number
        link.amplifier._serial_number = "OTHER"
        with pytest.raises(LinkError, match="OTHER"):
            await reconnect(link.amplifier, tries=3, pause=0.0)
        assert link.amplifier.is_lost


@pytest.mark.parametrize("kind", ["arc", "over_voltage", "channel"])
@over_every_wire
async def test_amplifier_fault_silences_and_latches(far: FarSide, kind: FaultKind) -> None:
    """Within 5 ms, high voltage off, until it is cleared."""
    async with Link(far) as link:
        await link.amplifier.arm(2.0)
        await link.amplifier.apply(link.tone())
        begin = clock.now()
        far.device.inject_fault(FaultWindow(kind))
        assert far.silent_from() - begin <= REACTION + 0.01  # with the test's own time
        await eventually(lambda: far.device.status().state is AmplifierState.FAULT)
        status = await link.amplifier.status()
        assert status.fault.name == kind.upper()
        assert not status.high_voltage
        with pytest.raises(CommandRefused):
            await link.amplifier.apply(link.tone())
        if Feature.EVENTS in link.amplifier.capabilities.features:
            await eventually(lambda: AmplifierState.FAULT in [event.state for event in link.events])
        await link.amplifier.clear()
        assert (await link.amplifier.arm(2.0)).state is AmplifierState.OPERATION_ENABLED


@over_every_wire
async def test_over_temperature_derates_and_then_trips(far: FarSide) -> None:
    """Hot first, then a latched fault until it is cool."""
    async with Link(far) as link:
        await link.amplifier.arm(2.0)
        await link.amplifier.apply(link.tone(0.6))
        far.device.inject_fault(FaultWindow("over_temperature", lasts=0.3))
        async with asyncio.timeout(60):
            while (
                status := await link.amplifier.heartbeat()
            ).state is AmplifierState.OPERATION_ENABLED:
                assert status.temperature > 70
                await asyncio.sleep(0.01)
        assert status.fault is Fault.OVER_TEMPERATURE
        await asyncio.sleep(0.2)
        assert (await link.amplifier.clear()).state is AmplifierState.SWITCH_ON_DISABLED


def in_use() -> tuple[int, int, int]:
    """Count descriptors, threads and tasks, without asyncio's idle workers."""
    gc.collect()
    threads = [one for one in threading.enumerate() if not one.name.startswith("asyncio_")]
    return len(list(Path("/dev/fd").iterdir())), len(threads), len(asyncio.all_tasks())


async def replug(link: Link) -> None:
    """Lose the link and reopen it ten times; assert that nothing is left behind."""
    far = link.far
    before: tuple[int, int, int] | None = None
    for number in range(10):
        far.device.inject_fault(FaultWindow("unplug"))
        with pytest.raises(LinkError):
            await beat(link.amplifier, MIN_HEARTBEATS_PER_WATCHDOG)
        far.device.recover()
        await reconnect(link.amplifier, tries=200)
        if number == 2:
            before = in_use()
    after = in_use()
    assert before is not None
    assert all(now <= then for now, then in zip(after, before, strict=True)), (before, after)


async def test_replugging_leaks_nothing(far: FarSide) -> None:
    """Unplug, plug in, reopen: descriptors, threads and tasks stay constant."""
    async with Link(far) as link:
        with no_long_collections():  # of the suite's own objects
            await replug(link)
        assert (await link.amplifier.arm(2.0)).state is AmplifierState.OPERATION_ENABLED
