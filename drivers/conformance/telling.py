"""Checks of events, broadcasts, addresses, and of what is there besides."""

import asyncio
from collections.abc import Sequence

from drivers import clock
from drivers.conformance.check import driving, reading
from drivers.conformance.client import Client
from drivers.conformance.findings import Optional, Violation, expect, expect_equal
from drivers.conformance.subject import NAMES, SLACK, Subject, layer
from drivers.protocol.records import Record, Refusal, Values
from drivers.protocol.table import (
    EVENT,
    EVENT_RECORD,
    MESSAGES,
    NO_CHANNEL,
    READING_STATES,
    sensor_reading,
)

_MOMENTARY = ("READY_TO_SWITCH_ON", "SWITCHED_ON", "FAULT_REACTION_ACTIVE")  # may last no time
_WINDOW = 100  # ms
_LOW = 1  # steps of frequency: less than a period of the window
_TYPE = 0x7F  # of a frame, without the bit of a reply
_MOVED = 0.1  # s; until an amplifier has taken its address
_SENSORS = "protocol.md#sensors"


@driving("protocol.md#states")
async def events(subject: Subject) -> None:
    """It sends one Event of every change of state, before the reply to its cause."""
    client = subject.client
    if not client.has_events:
        raise Optional("this wire carries no Events")
    stated = subject.has("events")
    client.events.clear()
    client.order.clear()
    await subject.arm(subject.can["watchdog_min"] / 1000)
    expected = [EVENT, MESSAGES["Arm"].number] if stated else [MESSAGES["Arm"].number]
    seen = [each & _TYPE for each in client.order]
    expect_equal(seen, expected, "types of the messages after Arm, the Event before the reply")
    await subject.play(layer(0, subject.tone()))
    subject.starve()
    await subject.until(lambda each: NAMES[each["state"]] == "FAULT", "FAULT")
    await subject.request("Clear", latch=subject.latch)
    await subject.arm()
    await subject.play(layer(0, subject.tone()))
    await subject.request("Disarm", ramp=50)
    await asyncio.sleep(0.1)
    await subject.request("Stop", ramp=0)
    stop = subject.latch
    await subject.request("Clear", latch=stop)
    await asyncio.sleep(0.02)
    reports = [EVENT_RECORD.unpack(each.words, is_strict=False) for each in client.events]
    if not stated:
        expect(not reports, "Events of one that states none", expected="none", seen=reports)
        return
    reported = [
        (NAMES.get(each["state"], each["state"]), each["fault"], each["latch"]) for each in reports
    ]
    required = [
        *(("OPERATION_ENABLED", 0, stop - 2), ("FAULT_REACTION_ACTIVE", 1, stop - 1)),
        *(("FAULT", 1, stop - 1), ("SWITCH_ON_DISABLED", 0, stop - 1)),
        *(("OPERATION_ENABLED", 0, stop - 1), ("SWITCHED_ON", 0, stop - 1)),
        *(("SWITCH_ON_DISABLED", 0, stop - 1), ("QUICK_STOP_ACTIVE", 0, stop)),
        ("SWITCH_ON_DISABLED", 0, stop),
    ]
    # A state that lasts no time may be left out or told.
    needed = [each for each in required if each[0] not in _MOMENTARY or each in reported]
    reported = [each for each in reported if each[0] not in _MOMENTARY or each in required]
    expect_equal(reported, needed, "states, faults and latches of Events")
    channels = {each["channel"] for each in reports}
    expect_equal(channels, {NO_CHANNEL}, "channels of Events")


@driving("protocol.md#what-a-host-does-and-may-rely-on", "serial", "rtu", "can")
async def broadcasts(subject: Subject) -> None:
    """It obeys a Commit or Stop that is for all, without a reply, and no other broadcast."""
    client = subject.client

    async def send(name: str, **values: object) -> None:
        message = MESSAGES[name]
        data = client.request(message.number, message.request.pack(values), to=0)
        heard = await client.send(data)
        expect(not heard, f"replies to a {name} for all", expected="none", seen=len(heard))

    await send("Arm", session=9, watchdog=subject.can["watchdog_max"])
    status = (await subject.request("GetStatus")).values
    expect_equal(NAMES[status["state"]], "SWITCH_ON_DISABLED", "state after an Arm for all")
    await subject.arm(0.5)
    session, watchdog = subject.session, subject.watchdog
    await subject.play(layer(0, subject.tone()))
    (part,) = subject.parts(layer(0, subject.tone(0, 0.5)))
    await subject.request("Ping", session=session)
    for name, values in (
        ("Set", part),
        ("Silence", {"session": session, "ramp": 0}),
        ("Ping", {"session": session}),
        *(("Disarm", {"ramp": 0}), ("Clear", {"latch": subject.latch})),
        ("Commit", {"session": subject.other_session, "token": subject.token}),
    ):
        await send(name, **values)
        await subject.expect_not_fed(f"a {name} for all")
        await subject.expect_levels(1.0, why=f"after a {name} for all")
    token = await subject.stage(layer(0, subject.tone(0, 0.5)))
    await asyncio.sleep(0.1)
    began = clock.now()
    await send("Commit", session=session, token=token)
    reply = await subject.request("GetStatus")
    expect_equal(reply["token"], token, "token after a Commit for all")
    least = watchdog - (reply.when.latest - began) - SLACK
    left = reply.values["watchdog_left"] / 1000
    expect(left >= least, "watchdog_left after it", expected=f"at least {least:.3f} s", seen=left)
    await subject.expect_levels(0.5, why="Commit for all")
    latch = subject.latch
    subject.starve()
    await send("Stop", ramp=0)
    status = (await subject.request("GetStatus")).values
    shown = NAMES[status["state"]], status["latch"], status["levels"][0]
    expect_equal(shown, ("QUICK_STOP_ACTIVE", latch % 0xFFFF + 1, 0), "state, latch, level after")


@driving("protocol.md#set-the-address")
async def addresses(subject: Subject) -> None:
    """It takes a new address by its serial number while it is disarmed, and replies there alone."""
    subject.require("address")
    client, own = subject.client, subject.client.address
    serial = str(subject.identity["serial_number"])
    free = await _free(client, own)
    for wrong in (serial + "x", serial[:-1], ""):
        if wrong != serial:
            await subject.refused("BAD_VALUE", "SetAddress", address=free, serial_number=wrong)
    (good,) = [MESSAGES["SetAddress"].request.pack({"address": free, "serial_number": serial})]
    for address in (0, client.addresses + 1):
        words = [address, *good[1:]]
        what = f"SetAddress {address}"
        await subject.refused_words("BAD_VALUE", "SetAddress", words, what=what)
    await subject.arm()
    await subject.refused("WRONG_STATE", "SetAddress", address=free, serial_number=serial)
    await subject.request("Disarm", ramp=0)
    await asyncio.sleep(0.05)
    try:
        await subject.request("SetAddress", address=free, serial_number=serial)
        await asyncio.sleep(_MOVED)
        expect_equal(await _is_at(client, own), False, "whether it replies at its old address")
        expect_equal(await _is_at(client, free), True, "whether it replies at its new address")
    finally:
        for address in (free, own):
            if await _is_at(client, address):
                break
        if client.address != own:
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


@driving("protocol.md#messages")
async def measured(subject: Subject) -> None:
    """It measures voltage and current of every channel, armed or not, more where more plays."""
    subject.require("electrical")
    silent = await _voltages(subject)
    await subject.arm()
    for channel in subject.channels:
        await subject.play(layer(0, subject.tone(channel)))
        await asyncio.sleep(0.05)
        playing = await _voltages(subject)
        is_more = playing[channel] > silent[channel]
        seen = f"{playing[channel]} of {playing}"
        what = f"voltage of channel {channel} that plays"
        expect(is_more, what, expected=f"above {silent[channel]}", seen=seen)


async def _voltages(subject: Subject) -> Sequence[int]:
    shown = (await subject.request("GetMeasured")).values
    expect_equal(shown["count"], len(subject.channels), "number of channels that are measured")
    return [each["channel_voltage"] for each in shown["channels"]]


async def _sensors(subject: Subject) -> list[Values]:
    """Read all descriptions of sensors."""
    subject.require("sensors")
    found: list[Values] = []
    while True:
        shown = (await subject.request("GetSensors", first=len(found))).values
        found += shown["sensors"]
        if len(found) >= shown["all"]:
            return found
        expect(bool(shown["sensors"]), "sensors from a number on", expected="some", seen="none")


@reading(_SENSORS)
async def sensors(subject: Subject) -> None:
    """It describes its sensors, always alike, each once, of its own channels."""
    found = await _sensors(subject)
    expect_equal(await _sensors(subject), found, "sensors, read again")
    for number, one in enumerate(found):
        is_own = one["channel"] in (*subject.channels, NO_CHANNEL)
        expect(is_own, f"channel of sensor {number}", expected="its own or none", seen=one)
        expect(one["range"] > 0, f"range of sensor {number}", expected="above 0", seen=one["range"])
        expect(found.count(one) == 1, f"sensor {number}", expected="unlike others", seen=one)


async def _read_until_over(subject: Subject) -> tuple[Values, list[Values]]:
    """Return a reading once its window is over, and the values of every sensor."""
    await asyncio.sleep(_WINDOW / 1000 + 0.02)
    shown = (await subject.request("GetReading", first=0)).values
    record = Record(*sensor_reading(shown["tones"]).fields)
    read: list[Values] = []
    while True:
        at = 0
        for _ in range(shown["count"]):
            try:
                row, at = record.read(shown["sensors"], at)
            except Refusal as error:
                raise Violation("sensors of a reading", expected="whole", seen=error) from None
            read.append(row)
        if not shown["count"] or len(read) >= len(await _sensors(subject)):
            return shown, read
        shown = (await subject.request("GetReading", first=len(read))).values


@driving(_SENSORS)
async def readings(subject: Subject) -> None:
    """It reads tones at its sensors over a window, without feeding, and says what disturbed it."""
    found = await _sensors(subject)
    highest = min([each["frequency_max"] for each in found] + [subject.highest])
    tone = min(max(subject.frequency, 400), highest)
    request: Values = {"reading": 7, "window": _WINDOW, "tones": 1, "frequencies": [tone]}
    await subject.arm()
    await subject.play(layer(0, subject.tone(frequency=tone)))
    await asyncio.sleep(0.3)
    await subject.request("Ping", session=subject.session)
    started = await subject.request("Measure", **request)
    await subject.expect_not_fed("Measure")
    shown = started["reading"], started["token"]
    expect_equal(shown, (7, subject.token), "reading, token of a reading that begins")
    whole, read = await _read_until_over(subject)
    expect_equal((whole["reading"], whole["window_left"]), (7, 0), "reading, window_left, over")
    expect_equal(len(read), len(found), "sensors that were read")
    again = await subject.request("Measure", **{**request, "reading": 8})
    await subject.play(layer(0, subject.tone(0, 0.5, frequency=tone)))
    disturbed, _ = await _read_until_over(subject)
    states = [each["state"] for each in (started, whole, again, disturbed)]
    expected = [READING_STATES[name] for name in ("RUNNING", "COMPLETE", "RUNNING", "DISTURBED")]
    expect_equal(states, expected, "states of two readings, the second disturbed")
    for frequencies in ([_LOW], [tone, tone], [tone, tone + 1]):
        wrong = {**request, "tones": len(frequencies), "frequencies": frequencies}
        await subject.refused("BAD_VALUE", "Measure", **wrong)
