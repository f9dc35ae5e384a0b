"""Several amplifiers on one wire: their own replies, and one commit for all."""

import asyncio
import contextlib
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from dataclasses import replace

import pytest
import serial

from drivers.amplifier import Amplifier
from drivers.command import CommandSet, DriveCommand
from drivers.errors import LinkError
from drivers.guard import Guard, GuardLimits, SafeCommandSet
from drivers.protocol.messages import AmplifierState, Status
from drivers.registry import open_backend
from model.rig.rig import Channel, Rig
from reconnection import reconnect
from sim.far_ends.wires import Wire
from sim.faults.fault_window import FaultWindow
from wires import SHARED_WIRES, FarSide, far_side, patient


@pytest.fixture(params=list(SHARED_WIRES))
def wire(request: pytest.FixtureRequest) -> Wire:
    """Each wire that several can share."""
    return SHARED_WIRES[request.param]


@pytest.fixture
def two_amplifiers(coarse_rig: Rig) -> Rig:
    """The paper's plate with its ERAs on two amplifiers."""
    wiring = {
        name: Channel("west" if number % 2 else "east", number // 2)
        for number, name in enumerate(coarse_rig.wiring)
    }
    urls = {"east": "sim://", "west": "sim://"}
    return replace(coarse_rig, wiring=wiring, amplifiers=urls)


@pytest.fixture
async def far(wire: Wire, two_amplifiers: Rig) -> AsyncIterator[FarSide]:
    """Both amplifiers behind one wire."""
    async with far_side(wire, two_amplifiers) as far:
        yield far


@pytest.fixture
async def amplifiers(far: FarSide) -> AsyncIterator[dict[str, Amplifier]]:
    """Both of them, armed."""
    both = {
        name: Amplifier(open_backend(patient(url)), reply_timeout=1.0)
        for name, url in far.urls.items()
    }
    for amplifier in both.values():
        await amplifier.open()
    for amplifier in both.values():  # once all are there, for opening may take as long as watchdogs
        await amplifier.arm(2.0)
    yield both
    for amplifier in both.values():
        await amplifier.close()


def tone(amplifier: Amplifier, level: float, token: int) -> SafeCommandSet:
    """A set on channel 0 under a token."""
    guard = Guard(GuardLimits(40.0, 500.0, 1.0), amplifier.capabilities)
    wanted = CommandSet(token, (DriveCommand(0, 110.0, level),), ramp=0.0, valid_for=0.0)
    return guard.check(wanted)


async def test_amplifiers_on_one_line_reply_for_themselves(
    amplifiers: dict[str, Amplifier],
) -> None:
    """Asked at the same time, each gives its own identity and level; they share a bus."""
    found = {name: one.identity.serial_number for name, one in amplifiers.items()}
    assert found == {"east": "SIM-east", "west": "SIM-west"}
    east, west = amplifiers["east"], amplifiers["west"]
    assert east.bus is not None
    assert east.bus == west.bus
    await east.apply(tone(east, 0.2, 1))
    await west.apply(tone(west, 0.4, 1))
    assert (await east.status()).levels[0] == pytest.approx(0.2)
    assert (await west.status()).levels[0] == pytest.approx(0.4)


async def test_amplifiers_on_one_line_open_concurrently(far: FarSide) -> None:
    """Who comes while another opens their wire waits for it, and each answers for itself."""
    both = {
        name: Amplifier(open_backend(patient(url)), reply_timeout=1.0)
        for name, url in far.urls.items()
    }
    await asyncio.gather(*(amplifier.open() for amplifier in both.values()))
    for name, amplifier in both.items():
        assert amplifier.identity.serial_number == f"SIM-{name}"
        await amplifier.close()


async def test_amplifier_opens_while_another_closes(
    far: FarSide, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The port that the one still closes, which may take a while, is not in the other's way."""
    close = serial.Serial.close

    def slowly(port: serial.Serial) -> None:
        time.sleep(0.01)
        close(port)

    monkeypatch.setattr(serial.Serial, "close", slowly)
    east, west = (
        Amplifier(open_backend(patient(url)), reply_timeout=1.0) for url in far.urls.values()
    )
    await east.open()
    for number in range(12):
        closing = asyncio.create_task(east.close())
        await asyncio.sleep(number / 1000)  # somewhere in it
        await west.open()
        await closing
        assert west.identity.serial_number != east.identity.serial_number
        await west.status()
        east, west = west, east
    await east.close()


async def test_cancelled_close_closes(far: FarSide) -> None:
    """Given up half way, it holds neither the wire nor the amplifier's number back for good."""
    amplifier = Amplifier(open_backend(patient(far.url)), reply_timeout=1.0)
    await amplifier.open()
    closing = asyncio.create_task(amplifier.close())
    await asyncio.sleep(0)
    closing.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await closing
    other = Amplifier(open_backend(patient(far.url)), reply_timeout=1.0)
    await reconnect(other, tries=200)
    await other.close()


async def test_one_amplifier_reopens_while_the_other_stays_lost(
    wire: Wire, two_amplifiers: Rig
) -> None:
    """After a loss of the wire each is lost until it is opened itself, in any order."""
    async with far_side(replace(wire, unpluggable=True), two_amplifiers) as far:
        east, west = (
            Amplifier(open_backend(patient(url)), reply_timeout=1.0) for url in far.urls.values()
        )
        await east.open()
        await west.open()
        for device in far.devices.values():
            device.inject_fault(FaultWindow("unplug"))
        for one in (east, west):
            async with asyncio.timeout(10):
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


async def test_broadcast_commit_starts_all_together(
    far: FarSide, amplifiers: dict[str, Amplifier]
) -> None:
    """What is staged waits; after the broadcast, whose time is known, both play it, from moments
    within 5 ms."""
    for name, level in (("east", 0.2), ("west", 0.4)):
        await amplifiers[name].stage(tone(amplifiers[name], level, 7))
    assert not any((await amplifiers["west"].status()).levels)
    begin = asyncio.get_running_loop().time()
    await amplifiers["east"].commit_on_bus(7)
    assert begin <= amplifiers["east"].last_sent
    for name, level in (("east", 0.2), ("west", 0.4)):
        status = await amplifiers[name].status()
        assert (status.token, status.levels[0]) == (7, pytest.approx(level))
    origins = [one.outputs[0][0].origin for one in far.bench.amplifiers.values()]
    assert max(origins) - min(origins) < 0.005


@pytest.mark.parametrize("silence", [Amplifier.stop, Amplifier.disarm])
async def test_stop_does_not_wait_for_a_stuck_amplifier(
    far: FarSide,
    amplifiers: dict[str, Amplifier],
    silence: Callable[[Amplifier, float], Awaitable[Status]],
) -> None:
    """One that does not answer for a second holds the stop of the other up by no more than 8 ms,
    and 10 ms where its answer could run into it; what it was asked is asked again. The machine can
    only add to it, so the best try counts."""
    east, west = amplifiers["east"], amplifiers["west"]
    now = asyncio.get_running_loop().time
    took = []
    for _ in range(10):
        far.devices["west"].inject_fault(FaultWindow("hang"))
        stuck = [asyncio.create_task(west.heartbeat()) for _ in range(3)]
        await asyncio.sleep(0.005)  # the first is on the line
        begin = now()
        await silence(east, 0.0)
        took.append(now() - begin)
        far.devices["west"].recover()
        assert all(isinstance(status, Status) for status in await asyncio.gather(*stuck))
        if took[-1] < 0.050:
            return
        await east.clear()
    raise AssertionError(f"stopped after {', '.join(f'{1e3 * one:.0f} ms' for one in took)}")


async def test_broadcast_stop_silences_all(amplifiers: dict[str, Amplifier]) -> None:
    """A broadcast stop needs no answer and latches in both."""
    for amplifier in amplifiers.values():
        await amplifier.apply(tone(amplifier, 0.3, 1))
    await amplifiers["west"].stop_on_bus(0.0)
    for amplifier in amplifiers.values():
        status = await amplifier.status()
        assert status.state is AmplifierState.QUICK_STOP_ACTIVE
        assert not any(status.levels)
