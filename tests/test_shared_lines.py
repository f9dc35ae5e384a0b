"""Several amplifiers on one wire: their own replies, and one commit for all."""

import asyncio
from collections.abc import AsyncIterator
from dataclasses import replace

import pytest

from drivers.amplifier import Amplifier
from drivers.command import CommandSet, DriveCommand
from drivers.guard import Guard, GuardLimits, SafeCommand
from drivers.protocol.messages import State
from drivers.registry import open_backend
from model.rig import Channel, Rig
from wires import SHARED_WIRES, FarSide, far_side


@pytest.fixture(params=list(SHARED_WIRES))
async def far(request: pytest.FixtureRequest, coarse_rig: Rig) -> AsyncIterator[FarSide]:
    """The paper's plate with its ERAs on two amplifiers, behind one wire."""
    wiring = {
        name: Channel("west" if number % 2 else "east", number // 2)
        for number, name in enumerate(coarse_rig.wiring)
    }
    urls = {"east": "sim://", "west": "sim://"}
    rig = replace(coarse_rig, wiring=wiring, amplifiers=urls)
    async with far_side(SHARED_WIRES[request.param], rig) as far:
        yield far


@pytest.fixture
async def amplifiers(far: FarSide) -> AsyncIterator[dict[str, Amplifier]]:
    """Both of them, armed."""
    both = {name: Amplifier(open_backend(url), reply_timeout=1.0) for name, url in far.urls.items()}
    for amplifier in both.values():
        await amplifier.open()
        await amplifier.arm(2.0)
    yield both
    for amplifier in both.values():
        await amplifier.close()


def tone(amplifier: Amplifier, level: float, token: int) -> SafeCommand:
    """A set on channel 0 under a token."""
    guard = Guard(GuardLimits(40.0, 500.0, 1.0), amplifier.capabilities)
    wanted = CommandSet(token, (DriveCommand(0, 110.0, level),), ramp=0.0, valid_for=0.0)
    return guard.check(wanted)


async def test_each_answers_for_itself(amplifiers: dict[str, Amplifier]) -> None:
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


async def test_they_may_be_opened_at_once(far: FarSide) -> None:
    """Who comes while another opens their wire waits for it, and each answers for itself."""
    both = {name: Amplifier(open_backend(url), reply_timeout=1.0) for name, url in far.urls.items()}
    await asyncio.gather(*(amplifier.open() for amplifier in both.values()))
    for name, amplifier in both.items():
        assert amplifier.identity.serial_number == f"SIM-{name}"
        await amplifier.close()


async def test_one_commit_is_played_by_all_at_one_moment(
    far: FarSide, amplifiers: dict[str, Amplifier]
) -> None:
    """What is staged waits; after the broadcast both play it, from moments within 5 ms."""
    for name, level in (("east", 0.2), ("west", 0.4)):
        await amplifiers[name].stage(tone(amplifiers[name], level, 7))
    assert not any((await amplifiers["west"].status()).levels)
    await amplifiers["east"].commit_on_bus(7)
    for name, level in (("east", 0.2), ("west", 0.4)):
        status = await amplifiers[name].status()
        assert (status.token, status.levels[0]) == (7, pytest.approx(level))
    origins = [one.outputs[0][0].origin for one in far.bench.amplifiers.values()]
    assert max(origins) - min(origins) < 0.005


async def test_one_stop_silences_all(amplifiers: dict[str, Amplifier]) -> None:
    """A broadcast stop needs no answer and latches in both."""
    for amplifier in amplifiers.values():
        await amplifier.apply(tone(amplifier, 0.3, 1))
    await amplifiers["west"].stop_on_bus(0.0)
    for amplifier in amplifiers.values():
        status = await amplifier.status()
        assert status.state is State.QUICK_STOP_ACTIVE
        assert not any(status.levels)
