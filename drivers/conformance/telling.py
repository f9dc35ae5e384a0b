"""Checks of events, broadcasts and addresses."""

import asyncio

from drivers import clock
from drivers.conformance.check import driving
from drivers.conformance.client import Client, Optional, Violation, When, expect_equal
from drivers.conformance.expected import NAMES
from drivers.conformance.material import layer, send, stage
from drivers.conformance.subject import Subject
from drivers.protocol.records import Values
from drivers.protocol.table import EVENT, EVENT_RECORD, MESSAGES, NO_CHANNEL

_MOMENTARY = ("READY_TO_SWITCH_ON", "SWITCHED_ON", "FAULT_REACTION_ACTIVE")  # may last no time
_TYPE = 0x7F  # of a frame, without the bit of a reply
_MOVED = 0.1  # s; until an amplifier has taken its address


@driving("protocol.md#states")
async def events(subject: Subject) -> None:
    """It sends one Event of every change of state, before the reply to its cause."""
    client = subject.client
    if not client.has_events:
        raise Optional("this wire carries no Events")
    client.events.clear()
    client.order.clear()
    await subject.arm(0.0)
    types = [EVENT, MESSAGES["Arm"].number][not subject.has("events") :]
    seen = [each & _TYPE for each in client.order]
    expect_equal(seen, types, "types of the messages after Arm, the Event before the reply")
    await subject.run(
        [
            *(subject.one(), subject.starve, subject.settle, subject.clear),
            *(subject.arm, subject.one(), send("Disarm", ramp=50), subject.settle),
            *(send("Stop", ramp=0), subject.clear, 0.02),
        ]
    )
    second = subject.shown.latch
    first = second - 1
    required = [
        *(("OPERATION_ENABLED", 0, first - 1), ("FAULT_REACTION_ACTIVE", 1, first)),
        *(("FAULT", 1, first), ("SWITCH_ON_DISABLED", 0, first), ("OPERATION_ENABLED", 0, first)),
        *(("SWITCHED_ON", 0, first), ("SWITCH_ON_DISABLED", 0, first)),
        *(("QUICK_STOP_ACTIVE", 0, second), ("SWITCH_ON_DISABLED", 0, second)),
    ]
    reports = [EVENT_RECORD.unpack(each.words, is_strict=False) for each in client.events]
    reported = [(NAMES.get(each["state"]), each["fault"], each["latch"]) for each in reports]
    # A state that lasts no time may be left out or told.
    needed = [each for each in required if each[0] not in _MOMENTARY or each in reported]
    shown = [each for each in reported if each[0] not in _MOMENTARY or each in required]
    is_stated = subject.has("events")
    expect_equal(shown, needed if is_stated else [], "states, faults and latches of Events")
    channels = {each["channel"] for each in reports}
    expect_equal(channels - {NO_CHANNEL}, set(), "channels of Events")


@driving("protocol.md#what-a-host-does-and-may-rely-on", "serial", "rtu", "can")
async def broadcasts(subject: Subject) -> None:
    """It obeys a Commit or Stop that is for all, without a reply, and no other broadcast."""

    async def send_to_all(name: str, *, is_obeyed: bool = False, **values: object) -> None:
        message, sent = MESSAGES[name], clock.now()
        words = message.request.pack({"session": subject.session, **values})
        data = subject.client.request(message.number, words, to=0)
        await subject.client.expect_silence(data, f"a {name} for all")
        if is_obeyed:
            subject.shown.carried_out(name, values, When(sent, clock.now()))
        await subject.request("GetStatus")

    await send_to_all("Arm", watchdog=subject.can["watchdog_max"])
    await subject.arm(0.5)
    half = layer(0, subject.tone(0, 0.5))
    for name, values in (
        ("Set", subject.parts(half, token=2)[0]),
        *(("Silence", {"ramp": 0}), ("Ping", {}), ("Disarm", {"ramp": 0})),
        ("Clear", {"latch": subject.shown.latch}),
        ("Commit", {"session": 77, "token": 2}),
    ):
        await subject.run([subject.one(), subject.ping])
        await send_to_all(name, **values)
    await subject.run([stage(half), 0.1])
    await send_to_all("Commit", is_obeyed=True, token=subject.token)
    await subject.starve()
    await send_to_all("Stop", is_obeyed=True, ramp=0)


@driving("protocol.md#set-the-address")
async def addresses(subject: Subject) -> None:
    """It takes a new address by its serial number while it is disarmed, and replies there alone."""
    if not subject.has("address"):
        raise Optional("it states no address")
    client, own = subject.client, subject.client.address
    serial = str(subject.identity["serial_number"])
    free = await _free(client, own)
    right: Values = {"address": free, "serial_number": serial}
    _, *text = MESSAGES["SetAddress"].request.pack(right)
    others = {serial + "x", serial[:-1], ""} - {serial}
    named: list[Values] = [{**right, "serial_number": other} for other in others]
    beyond = [[address, *text] for address in (0, client.addresses + 1)]
    await subject.run(
        [
            *(send("SetAddress", **each, code="BAD_VALUE") for each in named),
            *(send("SetAddress", raw=each, code="BAD_VALUE") for each in beyond),
            *(subject.arm, send("SetAddress", **right, code="WRONG_STATE")),
            *(send("Disarm", ramp=0), subject.settle),
        ]
    )
    try:
        await subject.request("SetAddress", **right)
        await asyncio.sleep(_MOVED)
        expect_equal(await _is_at(client, own), False, "whether it replies at its old address")
        expect_equal(await _is_at(client, free), True, "whether it replies at its new address")
    finally:
        if await _is_at(client, free):
            await subject.request("SetAddress", address=own, serial_number=serial)
            await asyncio.sleep(_MOVED)
        client.address = own
        client.heard.clear()
    expect_equal(await _is_at(client, own), True, "whether it replies at its first address again")


async def _is_at(client: Client, address: int) -> bool:
    client.address = address
    try:
        await client.hello()
    except Violation:
        return False
    return True


async def _free(client: Client, own: int) -> int:
    """Return an address at which nothing replies."""
    try:
        for address in range(client.addresses - 1, 1, -1):
            if address != own and not await _is_at(client, address):
                return address
        raise Optional("every address is taken")
    finally:
        client.address = own
