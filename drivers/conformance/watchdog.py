"""Checks of the watchdog: when it trips, what feeds it, and what nothing delays."""

import asyncio
import math
from functools import partial
from itertools import chain

from drivers import clock
from drivers.conformance.check import driving
from drivers.conformance.client import When, expect, expect_equal, expect_within
from drivers.conformance.expected import SLACK
from drivers.conformance.material import Rows, layer, play, send, stage
from drivers.conformance.staging import long_set
from drivers.conformance.subject import Subject
from drivers.protocol.sets import LayerSet
from drivers.protocol.table import FAULTS

_PLACE = "protocol.md#sessions-and-the-watchdog"
_TRIP = 0.005  # s; until it trips


async def _trips(subject: Subject, time: float, *sets: LayerSet) -> None:
    """Play sets and starve it: it trips at its time [s], is silent 5 ms later, and lists it."""
    await subject.run([partial(subject.arm, time), *sets])
    fed = subject.shown.fed
    await subject.run([subject.starve, 0.8 * time, subject.settle])
    await _expect_listed(subject, fed)
    rows = (
        *(play(*sets[:1], code="WRONG_STATE"), 0.05),
        send("Arm", session=77, watchdog=round(1000 * time), code="WRONG_STATE"),
        send("Clear", latch=(subject.shown.latch + 7) % 0x10000, code="WRONG_LATCH"),
        *(send("Disarm", ramp=0), subject.clear),
    )
    await subject.run(rows)


async def _expect_listed(subject: Subject, fed: When) -> None:
    """Require that the newest fault is the watchdog's, at its time by its age."""
    reply = await subject.request("GetFaults")
    expect(bool(reply["faults"]), "faults", expected="one", seen="none")
    newest, time = reply["faults"][0], subject.shown.watchdog
    expect_equal(newest["fault"], FAULTS["WATCHDOG"], "newest fault")
    low = reply.when.earliest - newest["age"] / 1000 - fed.latest - SLACK
    high = reply.when.latest - newest["age"] / 1000 - fed.earliest + SLACK
    what = "time of the fault by its age, since it was fed"
    expect_within(time, low - _TRIP, high, what)


@driving(_PLACE)
async def watchdog(subject: Subject) -> None:
    """It falls silent along 5 ms when its watchdog time has passed, and the fault is latched."""
    for time in (subject.can["watchdog_min"], min(350, subject.can["watchdog_max"])):
        await subject.in_time(partial(_trips, subject, time / 1000, subject.whole()))


@driving(_PLACE)
async def trips_amid_fades(subject: Subject) -> None:
    """It trips at its time and is silent 5 ms later, whatever plays, fades, ends or waits."""
    time = subject.can["watchdog_min"]
    for sets in subject.transitions(min(3 * time, subject.can["ramp_max"])):
        await subject.in_time(partial(_trips, subject, time / 1000, *sets))


@driving(_PLACE)
async def watchdog_unread(subject: Subject) -> None:
    """It trips at its time though nothing is asked of it, and lists the fault with its age."""
    await subject.run([partial(subject.arm, 0.0), subject.one(), subject.starve])
    await asyncio.sleep(subject.shown.watchdog + 0.4)
    await _expect_listed(subject, subject.shown.fed)
    await subject.status()


@driving(_PLACE)
def what_feeds(subject: Subject) -> Rows:
    """It is fed by Arm, Ping, Set, Commit and Silence of its session, and counts the time left."""
    long, *_ = subject.parts(*long_set(subject), token=3, now=0)
    feeds = (
        *(subject.ping, subject.one(), stage(subject.one(level=0.5))),
        *(send("Commit", token=2), send("Commit", token=2), send("Set", **long)),
        *(send("Silence", ramp=0), send("Arm", watchdog=subject.can["watchdog_max"])),
    )
    return [partial(subject.arm, 0.5), *(row for feed in feeds for row in (0.1, feed))]


@driving(_PLACE)
def what_does_not_feed(subject: Subject) -> Rows:
    """It is fed by nothing else: no reading, nothing that it refuses, no other session."""
    (part,) = subject.parts(subject.one(), token=7)
    flawed = {**part, "stream": [0xFFFF, 0, 0]}
    flaws = "BAD_VALUE", "BAD_CHANNEL", "BAD_LENGTH"
    idle: Rows = [
        *(send(name) for name in ("GetStatus", "GetCaps", "GetFaults")),
        *(send("GetAchieved", layer=0), send("Clear", latch=0)),
        send("Ping", session=77, code="WRONG_SESSION"),
        play(subject.one(), token=7, session=77, code="WRONG_SESSION"),
        play(subject.one(), token=0x8001, code="BAD_TOKEN"),
        send("Set", **flawed, code=flaws),
        send("Commit", token=20_000, code="BAD_TOKEN"),
        send("Commit", token=1, session=77, code="WRONG_SESSION"),
        send("Silence", ramp=0, session=77, code="WRONG_SESSION"),
        send("Arm", watchdog=500, session=77, code="WRONG_SESSION"),
        send("Ping", raw=(1, 0), code="BAD_LENGTH"),
        partial(subject.client.exchange, 63, ()),
    ]
    rows: list[Rows] = [(subject.ping, 0.02, each) for each in idle]
    return [partial(subject.arm, 0.5), subject.one(), *chain(*rows)]


@driving(_PLACE)
async def trips_amid_other_requests(subject: Subject) -> None:
    """It trips at its time amid requests that do not feed it."""
    await subject.run([partial(subject.arm, 0.0), subject.one(), subject.starve])
    others = (
        *(send("GetFaults"), send("GetAchieved", layer=0), send("Clear", latch=0)),
        *(send("Ping", session=77, code="WRONG_SESSION"), partial(subject.client.exchange, 63, ())),
    )
    while clock.now() < subject.shown.fed.earliest + 0.7 * subject.shown.watchdog:
        await subject.run(others)
    await subject.settle()


@driving("protocol.md#messages")
async def fault_list(subject: Subject) -> None:
    """It lists faults, the newest first, by their ages, also after they were cleared."""
    for _ in range(2):
        await _trips(subject, subject.can["watchdog_min"] / 1000, layer(0, subject.tone()))
    fed, least = subject.shown.fed, 1000 * subject.shown.watchdog
    newest, second, *_ = (await subject.request("GetFaults"))["faults"]
    shown, apart = (newest["fault"], second["fault"]), second["age"] - newest["age"]
    expect_equal(shown, 2 * (FAULTS["WATCHDOG"],), "faults of two trips")
    expect_within(apart, least, math.inf, "time between two trips [ms]")
    await asyncio.sleep(0.1)
    await _expect_listed(subject, fed)
