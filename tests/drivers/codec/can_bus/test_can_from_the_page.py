"""An amplifier written from the page for vendors alone, over the whole contract."""

import asyncio
import itertools
from collections.abc import AsyncIterator, Iterator

import pytest

from conformance_bench import results_at
from drivers.amplifier import Amplifier
from drivers.command import CommandSet, DriveCommand
from drivers.conformance import CheckResult, Result
from drivers.guard import Guard, GuardLimits
from drivers.protocol.messages import AmplifierEvent, AmplifierState, Fault
from drivers.registry import open_backend
from vendor_can_wires import in_virtual_time, on_a_bus
from virtual_loop import run_virtual

_numbers = itertools.count()


@pytest.fixture
def vendor() -> Iterator[str]:
    """URL of that amplifier, on a bus of its own."""
    with on_a_bus(f"vendor{next(_numbers)}") as url:
        yield url


@pytest.fixture
async def amplifier(vendor: str) -> AsyncIterator[Amplifier]:
    """That amplifier, open."""
    amplifier = Amplifier(open_backend(vendor), reply_timeout=1.0)
    await amplifier.open()
    yield amplifier
    await amplifier.close()


async def test_vendor_amplifier_is_identified(amplifier: Amplifier) -> None:
    """Texts and capabilities, by expedited and segmented transfers."""
    identity, capabilities = amplifier.identity, amplifier.capabilities
    assert (identity.vendor, identity.product) == ("Elsewhere Ltd", "From the page")
    assert (identity.serial_number, identity.firmware) == ("EL-0042", "0.1")
    assert (capabilities.channels, capabilities.frequency_min) == (4, 20.0)
    assert (capabilities.frequency_max, capabilities.envelope_knots) == (600.0, 0)


async def test_vendor_amplifier_takes_broadcasts_and_sends_emergencies(
    amplifier: Amplifier,
) -> None:
    """A staged set plays at a broadcast commit; its watchdog's fault is an event."""
    received = asyncio.Event()
    tripped = AmplifierEvent(AmplifierState.FAULT, Fault.WATCHDOG)
    amplifier.listen(lambda event: received.set() if event == tripped else None)
    await amplifier.arm(0.1)
    guard = Guard(GuardLimits(40.0, 500.0, 1.0), amplifier.capabilities)
    commands = (DriveCommand(0, 110.0, 0.5), DriveCommand(3, 250.5, 0.25, 90.0))
    safe = guard.check(CommandSet(7, commands, ramp=0.0, valid_for=0.0))
    assert (await amplifier.stage(safe)).commands == commands
    await amplifier.commit_on_bus(7)
    status = await amplifier.status()
    assert (status.token, status.levels) == (7, (0.5, 0.0, 0.0, 0.25))
    async with asyncio.timeout(60):
        await received.wait()
    assert [record.fault for record in await amplifier.faults()] == [Fault.WATCHDOG]


@pytest.mark.long
def test_vendor_amplifier_passes_conformance() -> None:
    """The suite for vendors, in virtual time; it has no envelopes."""

    async def run() -> list[CheckResult]:
        async with in_virtual_time() as url:
            return await results_at(url)

    results = run_virtual(run())
    failed = {one.check.name: one.reason for one in results if one.result is Result.FAILED}
    assert failed == {}
    assert sum(one.result is Result.PASSED for one in results) > 30
