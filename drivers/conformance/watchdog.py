"""Checks of the watchdog: when it trips, what feeds it, and what nothing delays."""

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from functools import partial

from drivers import clock
from drivers.conformance.check import driving
from drivers.conformance.client import When
from drivers.conformance.findings import expect, expect_equal
from drivers.conformance.parts import long_set
from drivers.conformance.subject import DRIFT, NAMES, SLACK, Subject, flag, layer
from drivers.protocol.records import Values
from drivers.protocol.sets import LayerSet
from drivers.protocol.table import FAULTS

_PLACE = "protocol.md#sessions-and-the-watchdog"
_TRIP, _FADE, _SETTLING = 0.005, 0.005, 0.01  # s; until it begins, lasts, and shows
_TRIPPED = ("FAULT_REACTION_ACTIVE", "FAULT")


def _shortest(subject: Subject) -> float:
    return float(subject.can["watchdog_min"] / 1000)


async def expect_trip(subject: Subject, fed: When, why: str, time: float) -> None:
    """Require that the watchdog trips a time [s] after it was fed, and that all falls silent."""
    subject.starve()
    latch = subject.latch
    await asyncio.sleep(max(fed.earliest + 0.8 * time - clock.now(), 0.0))
    when, _ = await subject.until(
        lambda each: NAMES[each["state"]] in _TRIPPED, f"FAULT ({why})", timeout=time + 0.3
    )
    earliest = fed.earliest + time * (1 - DRIFT) - SLACK
    latest = fed.latest + (time + _TRIP) * (1 + DRIFT) + SLACK
    is_met = earliest <= when.latest and when.earliest <= latest
    seen = f"{1e3 * (when.latest - fed.earliest):.1f} ms after it was fed"
    limit = f"{1e3 * time:.0f} to {1e3 * (time + _TRIP):.0f} ms"
    expect(is_met, f"end of the watchdog ({why})", expected=limit, seen=seen)
    silent, _ = await subject.until(lambda each: not any(each["levels"]), f"silence ({why})")
    latest += _FADE
    seen = f"{1e3 * (silent.earliest - fed.latest):.1f} ms after it was fed"
    limit = f"at most {1e3 * (time + _TRIP + _FADE):.0f} ms"
    expect(silent.earliest <= latest, f"silence by the watchdog ({why})", expected=limit, seen=seen)
    settled, status = await subject.until(
        lambda each: NAMES[each["state"]] == "FAULT" and not flag(each, "high_voltage"),
        f"FAULT without high voltage ({why})",
    )
    is_soon = settled.earliest <= latest + _SETTLING
    what = f"FAULT without high voltage ({why})"
    expect(is_soon, what, expected="10 ms after silence", seen=f"{settled.earliest - latest:.3f} s")
    shown = status["fault"], status["watchdog_left"], status["latch"], any(status["tokens"])
    expected = FAULTS["WATCHDOG"], 0, latch % 0xFFFF + 1, False
    expect_equal(shown, expected, f"fault, watchdog_left, latch, tokens ({why})")
    await _expect_listed(subject, fed, time, why)


async def _expect_listed(subject: Subject, fed: When, time: float, why: str) -> None:
    """Require that the newest fault is the watchdog's, at its time by its age."""
    reply = await subject.request("GetFaults")
    faults = reply["faults"]
    expect(bool(faults), f"faults ({why})", expected="one", seen="none")
    expect_equal(faults[0]["fault"], FAULTS["WATCHDOG"], f"newest fault ({why})")
    age = faults[0]["age"] / 1000
    earliest = fed.earliest + time * (1 - DRIFT) - SLACK
    latest = fed.latest + (time + _TRIP) * (1 + DRIFT) + SLACK
    is_met = earliest <= reply.when.latest - age and reply.when.earliest - age <= latest
    seen = f"{1e3 * (reply.when.latest - age - fed.earliest):.1f} ms after it was fed"
    what, limit = f"time of the fault by its age ({why})", f"{1e3 * time:.0f} ms"
    expect(is_met, what, expected=limit, seen=seen)


async def _clear(subject: Subject) -> None:
    await subject.request("Clear", latch=subject.latch)


@driving(_PLACE)
async def watchdog(subject: Subject) -> None:
    """It falls silent along 5 ms when its watchdog time has passed, and the fault is latched."""
    longer = min(0.35, subject.can["watchdog_max"] / 1000)
    for time in (_shortest(subject), longer):
        await subject.in_time(partial(_trips, subject, time))


async def _trips(subject: Subject, time: float) -> None:
    await subject.arm(time)
    fed = await subject.play(layer(0, *map(subject.tone, subject.channels)))
    await expect_trip(subject, fed, f"of {1e3 * time:.0f} ms", time)
    await subject.refused(
        "WRONG_STATE", "Arm", session=subject.other_session, watchdog=round(1000 * time)
    )
    await subject.refused("WRONG_LATCH", "Clear", latch=(subject.latch + 7) % 0x10000)
    (part,) = subject.parts(layer(0, subject.tone()))
    await subject.refused("WRONG_STATE", "Set", **part)
    stopped = (await subject.request("Disarm", ramp=0)).values
    expect_equal(NAMES[stopped["state"]], "FAULT", "state after a Disarm in FAULT")
    await _clear(subject)
    status = (await subject.request("GetStatus")).values
    shown = NAMES[status["state"]], status["fault"]
    expect_equal(shown, ("SWITCH_ON_DISABLED", 0), "state, fault after Clear")


@driving(_PLACE)
async def watchdog_unread(subject: Subject) -> None:
    """It trips at its time though nothing is asked of it, and lists the fault with its age."""
    time = _shortest(subject)
    await subject.arm(time)
    fed = await subject.play(layer(0, subject.tone()))
    subject.starve()
    await asyncio.sleep(time + 0.4)
    await _expect_listed(subject, fed, time, "nothing was asked")
    status = (await subject.request("GetStatus")).values
    expect_equal(NAMES[status["state"]], "FAULT", "state after the watchdog time")


@driving(_PLACE)
async def watchdog_left(subject: Subject) -> None:
    """It counts the time down that is left."""
    fed = (await subject.arm(0.5)).when
    for moment in (0.1, 0.2, 0.3):
        await asyncio.sleep(max(fed.earliest + moment - clock.now(), 0.0))
        reply = await subject.request("GetStatus")
        low = subject.watchdog - (reply.when.latest - fed.earliest)
        high = subject.watchdog - (reply.when.earliest - fed.latest)
        left = reply.values["watchdog_left"] / 1000
        expected = f"{low:.3f} to {high:.3f} s"
        is_met = low - SLACK <= left <= high + SLACK
        expect(is_met, f"watchdog_left {moment:g} s after Arm", expected=expected, seen=left)


@driving(_PLACE)
async def what_feeds(subject: Subject) -> None:
    """It is fed by Arm, Ping, Set, Commit and Silence of its session."""
    await subject.arm(0.4)
    session, time = subject.session, round(1000 * subject.watchdog)
    await subject.play(layer(0, subject.tone()))
    staged: list[int] = []

    async def stage() -> None:
        staged.append(await subject.stage(layer(0, subject.tone(0, 0.5))))

    async def part() -> None:
        long = long_set(subject)
        await subject.request("Set", **subject.parts(*long, now=False)[0])

    feeds: Sequence[tuple[str, Callable[[], Awaitable[object]]]] = (
        ("Ping", lambda: subject.request("Ping", session=session)),
        ("Set with now", lambda: subject.play(layer(0, subject.tone()))),
        ("Set", stage),
        ("Commit", lambda: subject.commit(staged[-1])),
        ("Commit again", lambda: subject.commit(staged[-1])),
        ("part of a Set", part),
        ("Silence", lambda: subject.request("Silence", session=session, ramp=0)),
        ("Arm", lambda: subject.request("Arm", session=session, watchdog=time)),
    )
    for name, feed in feeds:
        await asyncio.sleep(0.1)
        began = clock.now()
        await feed()
        reply = await subject.request("GetStatus")
        low = subject.watchdog - (reply.when.latest - began) - SLACK
        left = reply.values["watchdog_left"] / 1000
        expected = f"at least {low:.3f} s"
        expect(left >= low, f"watchdog_left after {name}", expected=expected, seen=left)


@driving(_PLACE)
async def what_does_not_feed(subject: Subject) -> None:
    """It is fed by nothing else: no reading, nothing that it refuses, no other session."""
    await subject.arm(0.5)
    await subject.play(layer(0, subject.tone()))
    other, session = subject.other_session, subject.session
    (part,) = subject.parts(layer(0, subject.tone()))
    old = (subject.token - 1 + 0x8000) % 0x10000
    flawed = {**part, "token": subject.token + 5, "stream": [0xFFFF, 0, 0]}
    requests: Sequence[tuple[str, Values]] = (
        *(("GetStatus", {}), ("GetCaps", {}), ("GetFaults", {}), ("GetAchieved", {"layer": 0})),
        *(
            ("Clear", {"latch": 0}),
            ("Ping", {"session": other}),
            ("Set", {**part, "session": other}),
        ),
        *(("Set", {**part, "token": old}), ("Set", flawed)),
        *(
            ("Commit", {"session": session, "token": 20_000}),
            ("Commit", {"session": other, "token": 1}),
        ),
        *(("Silence", {"session": other, "ramp": 0}), ("Arm", {"session": other, "watchdog": 500})),
    )
    for name, values in requests:
        await subject.request("Ping", session=session)
        await asyncio.sleep(0.02)
        await subject.answer(name, values)
        await subject.expect_not_fed(name)
    await subject.request("Ping", session=session)
    await asyncio.sleep(0.02)
    await subject.client.exchange(63, ())
    await subject.answer_to("Ping", [session, 0])
    await subject.expect_not_fed("requests of no message")


@driving(_PLACE)
async def trips_amid_other_requests(subject: Subject) -> None:
    """It trips at its time amid requests that do not feed it."""
    await subject.arm(_shortest(subject))
    fed = await subject.play(layer(0, subject.tone()))
    subject.starve()
    while clock.now() < fed.earliest + 0.7 * subject.watchdog:
        for name, values in (
            *(("GetFaults", {}), ("GetAchieved", {"layer": 0}), ("Clear", {"latch": 0})),
            *(("Ping", {"session": subject.other_session}), ("GetStatus", {})),
        ):
            await subject.answer(name, values)
        await subject.client.exchange(63, ())
    await expect_trip(subject, fed, "amid other requests", subject.watchdog)


@driving(_PLACE)
async def trips_amid_fades(subject: Subject) -> None:
    """It trips at its time and is silent 5 ms later, whatever plays, fades, ends or waits."""
    time = max(_shortest(subject), 0.1)
    ramp = min(round(3000 * time), subject.can["ramp_max"])
    slow = subject.envelope(0.1, 1, 1, 1)
    tone, other = subject.tone(), subject.tone(frequency=subject.other)
    first = layer(0, tone)
    cases: Sequence[tuple[str, Sequence[LayerSet]]] = (
        ("amid a rise", [layer(0, tone, ramp=ramp)]),
        ("amid a fall", [first, layer(0, ramp=ramp)]),
        ("amid a cross-fade", [first, layer(0, other, ramp=ramp)]),
        ("before valid_for ends", [layer(0, tone, valid_for=60_000)]),
        ("amid an onset", [layer(0, subject.tone(onset=slow))]),
        ("with an ending", [layer(0, subject.tone(ending=slow))]),
        ("amid an ending", [layer(0, subject.tone(ending=slow)), layer(0)]),
        (
            "with a set that waits",
            [layer(0, subject.tone(onset=slow)), layer(0, tone, after=True)],
        ),
        ("on all layers", [layer(number, tone) for number in subject.layers]),
    )

    async def trips(why: str, sets: Sequence[LayerSet]) -> None:
        await subject.arm(time)
        for each in sets:
            fed = await subject.play(each)
        await expect_trip(subject, fed, why, subject.watchdog)
        await asyncio.sleep(0.05)
        await subject.expect_levels(why=f"50 ms after the watchdog tripped {why}")
        await _clear(subject)

    for case in cases:
        await subject.in_time(partial(trips, *case))


@driving("protocol.md#messages")
async def fault_list(subject: Subject) -> None:
    """It lists faults, the newest first, by their ages, also after they were cleared."""
    ages = []
    for _ in range(2):
        await subject.arm(_shortest(subject))
        subject.starve()
        await subject.until(lambda each: NAMES[each["state"]] == "FAULT", "FAULT")
        await _clear(subject)
        ages.append(clock.now())
    reply = await subject.request("GetFaults")
    faults = reply.values["faults"]
    expect(len(faults) > 1, "faults after two trips", expected="two at least", seen=len(faults))
    for at, one in zip(reversed(ages), faults, strict=False):
        expect_equal(one["fault"], FAULTS["WATCHDOG"], "fault of a trip of the watchdog")
        age = reply.when.latest - at
        is_met = abs(one["age"] / 1000 - age) < 0.05 + reply.when.latest - reply.when.earliest
        expect(is_met, "age of a fault", expected=f"{age:.2f} s", seen=one["age"] / 1000)
    await asyncio.sleep(0.1)
    older = (await subject.request("GetFaults")).values["faults"][0]["age"]
    is_met = older - faults[0]["age"] >= 90
    expect(is_met, "age of a fault 0.1 s later", expected="0.1 s more", seen=older)
