"""Check of the address, where it can be set: what must not change it."""

import asyncio
import contextlib
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from drivers.amplifier import Amplifier
from drivers.conformance.bench import Bench
from drivers.conformance.check import driving
from drivers.conformance.findings import ContractViolation, NotApplicable, expect
from drivers.errors import CommandRefused, DriverError, FrameError
from drivers.protocol.messages import Feature, SetAddress
from drivers.registry import open_backend
from drivers.urls.address import with_address

_FREE = (63, 62)  # addresses that every wire has, and lines of few amplifiers do not use
_TAKING = 0.1  # s; until an amplifier has taken an address, on any wire


@driving("wire-protocol.md#setaddress", "wire-modbus.md#messages", "wire-can.md#objects")
async def addresses(bench: Bench) -> None:
    """It keeps its address while armed, and by a SetAddress of another serial number."""
    bench.require(Feature.ADDRESS)
    own = bench.amplifier.identity.serial_number
    if not own:
        raise NotApplicable("it states no serial number")
    raw = bench.raw
    free = next(one for one in _FREE if one != raw.address)
    other = own[:-1] + ("0" if own[-1] != "0" else "1")
    stays, moves = SetAddress(raw.address, own), SetAddress(free, other)
    async with _restored(bench, free, own):
        for request in raw.address_requests(stays, moves):
            outcome = await raw.send(request)
            await _expect_there(bench, free, request.name)
            allowed = " or ".join(sorted(request.allowed))
            expect(outcome in request.allowed, request.name, expected=allowed, seen=outcome)
        for serial_number in (other, own + "0", own[:-1]):
            await _ordered(bench, free, serial_number)
            await _expect_there(bench, free, "SetAddress of another serial number")
        await bench.arm()
        await bench.play(1.0)
        await _ordered(bench, free, own)
        await _expect_there(bench, free, "SetAddress while armed")
        await bench.expect_levels(1.0, why="after a SetAddress while armed")


async def _ordered(bench: Bench, address: int, serial_number: str) -> None:
    """Have an address set, which the wire may refuse."""
    with contextlib.suppress(CommandRefused, FrameError):
        await bench.amplifier.set_address(address, serial_number)


async def _expect_there(bench: Bench, free: int, after: str) -> None:
    """Require a reply at its address."""
    await asyncio.sleep(0.01)
    try:
        await bench.beat()
    except DriverError as error:
        raise ContractViolation(
            f"address after {after}",
            expected=bench.raw.address,
            seen=f"another: {error}",
            is_certain=await _is_at(bench, free),
        ) from None


async def _is_at(bench: Bench, address: int) -> bool:
    """Whether the amplifier replies at an address."""
    moved = Amplifier(open_backend(with_address(bench.raw.url, address)))
    try:
        await moved.open()
    except DriverError:
        return False
    finally:
        await moved.close()
    return True


@asynccontextmanager
async def _restored(bench: Bench, free: int, serial_number: str) -> AsyncIterator[None]:
    """Give the amplifier its address again at the end, if it has taken the free one."""
    try:
        yield
    finally:
        if not await _replies(bench):
            await _move_back(bench, free, serial_number)


async def _replies(bench: Bench) -> bool:
    try:
        await bench.amplifier.status()
    except DriverError:
        return False
    return True


async def _move_back(bench: Bench, free: int, serial_number: str) -> None:
    """Silence the amplifier at the free address, and give it its own again."""
    moved = Amplifier(open_backend(with_address(bench.raw.url, free)), serial_number=serial_number)
    with contextlib.suppress(DriverError):  # it is not there either: the link was lost
        try:
            await moved.open(take_over=True)
            await moved.stop(0.0)
            await asyncio.sleep(0.05)
            await moved.clear()
            await moved.set_address(bench.raw.address, serial_number)
        finally:
            await moved.close()
        await asyncio.sleep(_TAKING)
