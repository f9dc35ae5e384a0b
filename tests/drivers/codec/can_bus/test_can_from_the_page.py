"""The page for vendors suffices: an amplifier that was written from it alone does what ours do."""

import asyncio
import contextlib
import itertools
from collections.abc import AsyncIterator, Iterator

import pytest

from drivers.amplifier import Amplifier
from drivers.command import CommandSet, DriveCommand
from drivers.conformance import CHECKS, Check, run_check
from drivers.errors import CommandRefused
from drivers.guard import Guard, GuardLimits, SafeCommandSet
from drivers.protocol.messages import AmplifierEvent, AmplifierState, Fault
from drivers.registry import open_backend
from vendor_can import VendorAmplifier

_numbers = itertools.count()


@pytest.fixture
def vendor() -> Iterator[str]:
    """The URL of such an amplifier, on a bus of its own."""
    channel = f"vendor{next(_numbers)}"
    with VendorAmplifier(channel):
        yield f"can+virtual://{channel}?heartbeat=1000#1"


@pytest.fixture
async def amplifier(vendor: str) -> AsyncIterator[Amplifier]:
    """It as the host sees it, open."""
    amplifier = Amplifier(open_backend(vendor), reply_timeout=1.0)
    await amplifier.open()
    yield amplifier
    await amplifier.close()


def tones(amplifier: Amplifier, token: int, level: float, *, ramp: float = 0.0) -> SafeCommandSet:
    """A set on two channels."""
    guard = Guard(GuardLimits(40.0, 500.0, 1.0), amplifier.capabilities)
    commands = (DriveCommand(0, 110.0, level), DriveCommand(3, 250.5, level / 2, 90.0))
    return guard.check(CommandSet(token, commands, ramp=ramp, valid_for=0.0))


async def test_it_is_identified(amplifier: Amplifier) -> None:
    """Texts and capabilities as it has them, by expedited and segmented transfers."""
    identity, capabilities = amplifier.identity, amplifier.capabilities
    assert (identity.vendor, identity.product) == ("Elsewhere Ltd", "From the page")
    assert (identity.serial_number, identity.firmware) == ("EL-0042", "0.1")
    assert (capabilities.channels, capabilities.frequency_min) == (4, 20.0)
    assert (capabilities.frequency_max, capabilities.envelope_knots) == (600.0, 0)
    assert (await amplifier.status()).state is AmplifierState.SWITCH_ON_DISABLED


async def test_it_plays_and_stops(amplifier: Amplifier) -> None:
    """Arm, stage and commit by SYNC, heartbeat, apply, stop, clear, disarm: state, token and levels
    after each; what was asked in the wrong state is refused."""
    with pytest.raises(CommandRefused, match="not armed"):
        await amplifier.apply(tones(amplifier, 1, 0.5))
    assert (await amplifier.arm(2.0)).state is AmplifierState.OPERATION_ENABLED
    achieved = await amplifier.stage(tones(amplifier, 7, 0.5))
    assert [command.phase for command in achieved.commands] == [0.0, 90.0]
    assert not any((await amplifier.heartbeat()).levels)
    await amplifier.commit(7)
    playing = await amplifier.heartbeat()
    assert (playing.token, playing.levels) == (7, (0.5, 0.0, 0.0, 0.25))
    await amplifier.apply(tones(amplifier, 8, 0.2))
    assert (await amplifier.status()).levels == (0.2, 0.0, 0.0, 0.1)
    await amplifier.stage(tones(amplifier, 9, 0.4))
    await amplifier.commit_on_bus(9)
    assert (await amplifier.status()).token == 9
    assert (await amplifier.stop(0.0)).state is AmplifierState.QUICK_STOP_ACTIVE
    assert not any((await amplifier.status()).levels)
    with pytest.raises(CommandRefused, match="stopped"):
        await amplifier.arm(2.0)
    assert (await amplifier.clear()).state is AmplifierState.SWITCH_ON_DISABLED


async def test_its_watchdog_is_told_by_an_emergency(amplifier: Amplifier) -> None:
    """Nobody beats: a latched fault, which the host hears of unasked."""
    came = asyncio.Event()
    amplifier.listen(
        lambda event: (
            came.set() if event == AmplifierEvent(AmplifierState.FAULT, Fault.WATCHDOG) else None
        )
    )
    await amplifier.arm(0.1)
    await amplifier.apply(tones(amplifier, 1, 0.5))
    async with asyncio.timeout(10):
        await came.wait()
    status = await amplifier.status()
    assert (status.state, status.fault) == (AmplifierState.FAULT, Fault.WATCHDOG)
    assert [record.fault for record in await amplifier.faults()] == [Fault.WATCHDOG]
    assert (await amplifier.clear()).state is AmplifierState.SWITCH_ON_DISABLED


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.name)
async def test_it_keeps_the_contract(amplifier: Amplifier, check: Check) -> None:
    """The conformance suite that is for vendors; those about envelopes ask for none here."""
    outcome = await run_check(check, amplifier)
    with contextlib.suppress(CommandRefused):
        await amplifier.disarm()
    assert outcome.problem is None
