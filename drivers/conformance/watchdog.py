"""Checks of the watchdog: when it trips, what feeds it, and what nothing delays."""

import asyncio
from functools import partial

from drivers import clock
from drivers.conformance.check import driving
from drivers.conformance.client import When
from drivers.conformance.expected import SLACK
from drivers.conformance.findings import expect, expect_equal
from drivers.conformance.material import layer
from drivers.conformance.parts import long_set
from drivers.conformance.subject import Subject
from drivers.protocol.records import Values
from drivers.protocol.sets import LayerSet
from drivers.protocol.table import FAULTS

_PLACE = "protocol.md#sessions-and-the-watchdog"
_TRIP = 0.005  # s; until it trips


async def trips(subject: Subject, time: float, *sets: LayerSet) -> None:
    """Play sets and starve it: it trips at its time [s], is silent 5 ms later, and lists it."""
    await subject.arm(time)
    for one in sets:
        await subject.play(one)
    fed = subject.shown.fed
    subject.starve()
    await subject.pause(0.8 * time)
    await subject.settle()
    await expect_listed(subject, fed)
    await subject.pause(0.05)
    await subject.status()


async def expect_listed(subject: Subject, fed: When) -> None:
    """Require that the newest fault is the watchdog's, at its time by its age."""
    reply = await subject.request("GetFaults")
    expect(bool(reply["faults"]), "faults", expected="one", seen="none")
    newest, time = reply["faults"][0], subject.shown.watchdog
    expect_equal(newest["fault"], FAULTS["WATCHDOG"], "newest fault")
    low = reply.when.earliest - newest["age"] / 1000 - fed.latest - SLACK
    high = reply.when.latest - newest["age"] / 1000 - fed.earliest + SLACK
    limits, seen = f"{time:.3f} to {time + _TRIP:.3f} s", f"{low:.4f} to {high:.4f} s"
    is_met = low <= time + _TRIP and time <= high
    expect(is_met, "time of the fault by its age, since it was fed", expected=limits, seen=seen)


@driving(_PLACE)
async def watchdog(subject: Subject) -> None:
    """It falls silent along 5 ms when its watchdog time has passed, and the fault is latched."""
    whole = layer(0, *map(subject.tone, subject.channels))
    for time in (subject.can["watchdog_min"], min(350, subject.can["watchdog_max"])):
        await subject.in_time(partial(trips, subject, time / 1000, whole))
        (part,) = subject.parts(whole)
        await subject.refused("WRONG_STATE", "Set", **part)
        arm = {"session": subject.other_session, "watchdog": time}
        await subject.refused("WRONG_STATE", "Arm", **arm)
        await subject.refused("WRONG_LATCH", "Clear", latch=(subject.shown.latch + 7) % 0x10000)
        await subject.request("Disarm", ramp=0)
        await subject.clear()
        await subject.status()


@driving(_PLACE)
async def watchdog_unread(subject: Subject) -> None:
    """It trips at its time though nothing is asked of it, and lists the fault with its age."""
    await subject.arm(subject.can["watchdog_min"] / 1000)
    await subject.play(subject.one())
    fed = subject.shown.fed
    subject.starve()
    await asyncio.sleep(subject.shown.watchdog + 0.4)
    await expect_listed(subject, fed)
    await subject.status()


@driving(_PLACE)
async def what_feeds(subject: Subject) -> None:
    """It is fed by Arm, Ping, Set, Commit and Silence of its session, and counts the time left."""
    await subject.arm(0.4)
    session, time = subject.session, round(1000 * subject.shown.watchdog)
    staged = subject.parts(layer(0, subject.tone(0, 0.5)), token=2, now=False)[0]
    for name, values in (
        ("Ping", {"session": session}),
        ("Set", subject.parts(subject.one(), token=1)[0]),
        ("Set", staged),
        ("Commit", {"session": session, "token": 2}),
        ("Commit", {"session": session, "token": 2}),
        ("Set", subject.parts(*long_set(subject), token=3, now=False)[0]),
        ("Silence", {"session": session, "ramp": 0}),
        ("Arm", {"session": session, "watchdog": time}),
    ):
        await asyncio.sleep(0.1)
        await subject.request("GetStatus")
        await subject.request(name, **values)
        await subject.request("GetStatus")


@driving(_PLACE)
async def what_does_not_feed(subject: Subject) -> None:
    """It is fed by nothing else: no reading, nothing that it refuses, no other session."""
    await subject.arm(0.5)
    await subject.play(subject.one())
    other, session = subject.other_session, subject.session
    (part,) = subject.parts(subject.one(), token=2)
    flawed = {**part, "token": 7, "stream": [0xFFFF, 0, 0]}
    requests: tuple[tuple[str, Values], ...] = (
        *(("GetStatus", {}), ("GetCaps", {}), ("GetFaults", {}), ("GetAchieved", {"layer": 0})),
        *(("Clear", {"latch": 0}), ("Ping", {"session": other}), ("Set", flawed)),
        *(("Set", {**part, "session": other}), ("Set", {**part, "token": 0x8001})),
        ("Commit", {"session": session, "token": 20_000}),
        ("Commit", {"session": other, "token": 1}),
        *(("Silence", {"session": other, "ramp": 0}), ("Arm", {"session": other, "watchdog": 500})),
    )
    for name, values in requests:
        await subject.ping()
        await asyncio.sleep(0.02)
        await subject.answer(name, **values)
        await subject.request("GetStatus")
    await subject.client.exchange(63, ())
    await subject.answer("Ping", session, 0)
    await asyncio.sleep(0.02)
    await subject.request("GetStatus")


@driving(_PLACE)
async def trips_amid_other_requests(subject: Subject) -> None:
    """It trips at its time amid requests that do not feed it."""
    await subject.arm(subject.can["watchdog_min"] / 1000)
    await subject.play(subject.one())
    subject.starve()
    while clock.now() < subject.shown.fed.earliest + 0.7 * subject.shown.watchdog:
        for name, values in (
            *(("GetFaults", {}), ("GetAchieved", {"layer": 0}), ("Clear", {"latch": 0})),
            *(("Ping", {"session": subject.other_session}), ("GetStatus", {})),
        ):
            await subject.answer(name, **values)
        await subject.client.exchange(63, ())
    await subject.settle()


@driving(_PLACE)
async def trips_amid_fades(subject: Subject) -> None:
    """It trips at its time and is silent 5 ms later, whatever plays, fades, ends or waits."""
    time = max(subject.can["watchdog_min"] / 1000, 0.1)
    ramp = min(round(3000 * time), subject.can["ramp_max"])
    slow = subject.envelope(0.1, 1, 1, 1)
    first, onset = subject.one(), subject.one(subject.tone(onset=slow))
    ended, other = subject.one(subject.tone(ending=slow)), subject.tone(frequency=subject.other)
    cases: tuple[list[LayerSet], ...] = (
        [subject.one(ramp=ramp)],
        [first, layer(0, ramp=ramp)],
        [first, layer(0, other, ramp=ramp)],
        [subject.one(valid_for=60_000)],
        [onset],
        [ended],
        [ended, layer(0)],
        [onset, layer(0, subject.tone(), after=True)],
        [layer(number, subject.tone()) for number in subject.layers],
    )
    for sets in cases:
        await subject.in_time(partial(trips, subject, time, *sets))


@driving("protocol.md#messages")
async def fault_list(subject: Subject) -> None:
    """It lists faults, the newest first, by their ages, also after they were cleared."""
    for _ in range(2):
        await trips(subject, subject.can["watchdog_min"] / 1000)
        await subject.clear()
    fed = subject.shown.fed
    await expect_listed(subject, fed)
    faults = (await subject.request("GetFaults"))["faults"]
    expect(len(faults) > 1, "faults after two trips", expected="two at least", seen=len(faults))
    shown = [each["fault"] for each in faults[:2]]
    expect_equal(shown, 2 * [FAULTS["WATCHDOG"]], "faults of two trips")
    apart = faults[1]["age"] - faults[0]["age"]
    least = 1000 * subject.shown.watchdog
    expect(apart >= least, "time between two trips", expected=f"{least:g} ms at least", seen=apart)
    await asyncio.sleep(0.1)
    await expect_listed(subject, fed)
