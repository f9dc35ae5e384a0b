"""Several amplifiers on one wire: separate replies, joint commits and stops."""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Awaitable, Callable
from dataclasses import replace

import pytest
from controller.group.synchronized_play import SynchronizedPlay

from drivers import clock
from drivers.amplifier import WATCHDOG_REACTION, Amplifier
from drivers.errors import LinkError
from drivers.operation.checked_amplifier import CheckedAmplifier
from drivers.protocol.messages import AmplifierState, Reply, Request, Status
from drivers.registry import open_backend
from long_form import shortly
from memory_machine import live_in_memory
from model.rig.rig import Rig
from reconnection import reconnect
from sim.far_ends.wires import Wire
from sim.faults.fault_window import FaultWindow
from virtual_loop import VirtualLoop, in_virtual_time
from wires import SHARED_WIRES, FarSide, far_side, on_two_amplifiers, tones


@pytest.fixture(params=shortly(SHARED_WIRES, ["serial", "modbus+rtu", "can+slcan"]))
def wire(request: pytest.FixtureRequest) -> Wire:
    """Each wire that several amplifiers can share."""
    return SHARED_WIRES[request.param]


@pytest.fixture
def two_amplifiers(coarse_rig: Rig) -> Rig:
    """The paper's plate with its ERAs on two amplifiers."""
    return on_two_amplifiers(coarse_rig)


@contextlib.asynccontextmanager
async def armed(wire: Wire, rig: Rig) -> AsyncIterator[tuple[FarSide, dict[str, Amplifier]]]:
    """Both amplifiers behind one wire in memory, armed."""
    live_in_memory()
    async with far_side(wire, rig) as far:
        both = {
            name: Amplifier(open_backend(url), reply_timeout=1.0) for name, url in far.urls.items()
        }
        for amplifier in both.values():
            await amplifier.open()
        for amplifier in both.values():  # after opening, which may outlast a watchdog
            await amplifier.arm(2.0, session=9)
        yield far, both
        for amplifier in both.values():
            await amplifier.close()


@in_virtual_time
async def test_amplifiers_on_one_line_reply_for_themselves(wire: Wire, two_amplifiers: Rig) -> None:
    """Each has its own identity and level; they share a bus."""
    async with armed(wire, two_amplifiers) as (_, amplifiers):
        found = {name: one.identity.serial_number for name, one in amplifiers.items()}
        assert found == {"east": "SIM-east", "west": "SIM-west"}
        east, west = amplifiers["east"], amplifiers["west"]
        assert east.bus is not None
        assert east.bus == west.bus
        await east.apply(tones(east, 0.2, token=1))
        await west.apply(tones(west, 0.4, token=1))
        assert (await east.status()).levels[0] == pytest.approx(0.2)
        assert (await west.status()).levels[0] == pytest.approx(0.4)


@in_virtual_time
async def test_cancelled_close_closes(wire: Wire, two_amplifiers: Rig) -> None:
    """A cancelled close still releases the wire and the amplifier's number."""
    live_in_memory()
    async with far_side(wire, two_amplifiers) as far:
        amplifier = Amplifier(open_backend(far.url), reply_timeout=1.0)
        await amplifier.open()
        closing = asyncio.create_task(amplifier.close())
        await asyncio.sleep(0)
        closing.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await closing
        other = Amplifier(open_backend(far.url), reply_timeout=1.0)
        await reconnect(other, tries=200)
        await other.close()


@in_virtual_time
async def test_one_amplifier_reopens_while_the_other_stays_lost(
    wire: Wire, two_amplifiers: Rig
) -> None:
    """After a loss of the wire each amplifier is lost until it is reopened itself."""
    live_in_memory()
    async with far_side(replace(wire, unpluggable=True), two_amplifiers) as far:
        east, west = (Amplifier(open_backend(url), reply_timeout=1.0) for url in far.urls.values())
        await east.open()
        await west.open()
        for device in far.devices.values():
            device.inject_fault(FaultWindow("unplug"))
        for one in (east, west):
            async with asyncio.timeout(60):
                while not one.is_lost:
                    with contextlib.suppress(LinkError):
                        await one.status()
        for device in far.devices.values():
            device.recover()
        await reconnect(east, tries=200)
        with pytest.raises(LinkError):
            await west.status()
        await reconnect(west, tries=200)
        assert (
            (await east.status()).state
            is (await west.status()).state
            is AmplifierState.SWITCH_ON_DISABLED
        )
        await east.close()
        await west.close()


@in_virtual_time
async def test_broadcast_commit_starts_all_together(
    wire: Wire, two_amplifiers: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both play their staged sets from one moment, that of the frame.

    However long the simulation of one amplifier holds up that of the next.
    """
    async with armed(wire, two_amplifiers) as (far, amplifiers):
        loop, exchange = asyncio.get_running_loop(), far.bench.exchange
        assert isinstance(loop, VirtualLoop)

        def exchange_slowly(name: str, request: Request, *, now: float) -> Reply | None:
            loop.now += 0.002
            return exchange(name, request, now=now)

        monkeypatch.setattr(far.bench, "exchange", exchange_slowly)
        for name, level in (("east", 0.2), ("west", 0.4)):
            await amplifiers[name].stage(tones(amplifiers[name], level, token=7))
        assert not any((await amplifiers["west"].status()).levels)
        begin = asyncio.get_running_loop().time()
        await amplifiers["east"].commit_on_bus(7)
        assert begin <= amplifiers["east"].last_sent_at
        for name, level in (("east", 0.2), ("west", 0.4)):
            status = await amplifiers[name].status()
            assert (status.token, status.levels[0]) == (7, pytest.approx(level))
        origins = [one.outputs[0][0].origin for one in far.bench.amplifiers.values()]
        assert max(origins) == min(origins)


@in_virtual_time
async def test_broadcast_commit_feeds_every_watchdog(wire: Wire, two_amplifiers: Rig) -> None:
    """The host knows of each when it was fed, within the time that an amplifier may take."""
    async with armed(wire, two_amplifiers) as (far, amplifiers):
        play = SynchronizedPlay({name: CheckedAmplifier(one) for name, one in amplifiers.items()})
        for token, level in ((1, 0.2), (2, 0.4)):
            sets = {name: tones(one, level, token=token) for name, one in amplifiers.items()}
            assert await play.play(sets, {}, may_play=lambda: True) is not None
            east, west = amplifiers["east"].last_fed_at, amplifiers["west"].last_fed_at
            assert east == pytest.approx(west, abs=1e-4)
            left = [device.status().watchdog_left for device in far.devices.values()]
            assert max(left) <= east + 2.0 + WATCHDOG_REACTION - clock.now()


@pytest.mark.parametrize("kind", ["can+socketcand", "can+slcan"])
@in_virtual_time
async def test_can_amplifiers_start_at_the_end_of_one_frame(kind: str, two_amplifiers: Rig) -> None:
    """By their own clocks the same moment, whatever either of them has sent before."""
    wire = replace(SHARED_WIRES[kind], speed=500_000)
    async with armed(wire, two_amplifiers) as (far, amplifiers):
        both = far.bench.amplifiers.values()
        for token in range(1, 6):
            for name, one in amplifiers.items():
                for _ in range(token if name == "east" else 1):
                    await one.status()
                await one.stage(tones(one, 0.1 * token, token=token))
            await amplifiers["east"].commit_on_bus(token)
            for one in amplifiers.values():
                assert (await one.status()).token == token
            origins = [one.outputs[0][-1].origin for one in both]
            assert origins[0] == origins[1] > 0


@pytest.mark.parametrize("silence", [Amplifier.stop, Amplifier.disarm])
@in_virtual_time
async def test_stop_does_not_wait_for_a_stuck_amplifier(
    wire: Wire,
    two_amplifiers: Rig,
    silence: Callable[[Amplifier, float], Awaitable[Status]],
) -> None:
    """It waits 8 ms, 10 ms more where a reply could collide; requests are repeated then."""
    async with armed(wire, two_amplifiers) as (far, amplifiers):
        east, west = amplifiers["east"], amplifiers["west"]
        for _ in range(10):
            far.devices["west"].inject_fault(FaultWindow("hang"))
            stuck = [asyncio.create_task(west.heartbeat()) for _ in range(3)]
            await asyncio.sleep(0.005)  # the first is sent
            begin = clock.now()
            await silence(east, 0.0)
            assert clock.now() - begin < 0.050
            far.devices["west"].recover()
            assert all(isinstance(status, Status) for status in await asyncio.gather(*stuck))
            await east.clear()
            await east.arm(2.0)


@in_virtual_time
async def test_broadcast_stop_silences_all(wire: Wire, two_amplifiers: Rig) -> None:
    """A broadcast stop has no reply and latches in both."""
    async with armed(wire, two_amplifiers) as (_, amplifiers):
        for amplifier in amplifiers.values():
            await amplifier.apply(tones(amplifier, 0.3, token=1))
        await amplifiers["west"].stop_on_bus(0.0)
        for amplifier in amplifiers.values():
            status = await amplifier.status()
            assert status.state is AmplifierState.QUICK_STOP_ACTIVE
            assert not any(status.levels)


@in_virtual_time
async def test_stop_precedes_what_waits_for_the_end_of_a_broadcast(two_amplifiers: Rig) -> None:
    """Over RTU, requested while a broadcast commit is on the line, whose frame takes over 1 ms."""
    async with armed(SHARED_WIRES["modbus+rtu"], two_amplifiers) as (_, amplifiers):
        east, west = amplifiers.values()
        for amplifier in (east, west):
            await amplifier.stage(tones(amplifier, 0.3, token=1))

        async def commit() -> Status:
            await east.commit_on_bus(1)
            return await east.status()

        committing = asyncio.create_task(commit())
        await asyncio.sleep(0.0025)  # silence, and a part of the frame
        await west.stop_on_bus(0.0)
        assert (await committing).state is AmplifierState.QUICK_STOP_ACTIVE
