"""Checks of the watchdog, and of the faults that it causes."""

import asyncio
from functools import partial
from itertools import cycle

from drivers.protocol.definition import FAULTS, NO_CHANNEL, QUANTITIES
from era_haptics.lab.conformance.check import driving
from era_haptics.lab.conformance.checks.part_checks import long_set
from era_haptics.lab.conformance.checks.state_checks import rows_while_latched
from era_haptics.lab.conformance.outcomes import expect_equal
from era_haptics.lab.conformance.request_rows import (
    DISARM_NOW,
    SILENCE_NOW,
    STOP_NOW,
    RequestRows,
    Row,
    Wait,
    commit,
    layer,
    play_now,
    send,
    stage,
)
from era_haptics.lab.conformance.subject import Subject
from registry import threads

_READINGS = {"mark": "Mark", "electrical": "GetMeasured"}  # read requests of optional features
_WATCHDOG = QUANTITIES["watchdog"]
_DROPPED = ({"session": 77}, {"token": 1}, {"token": 0x8001})
"""Values for which a part is dropped."""


@driving("protocol.md#sessions-and-the-watchdog")
async def watchdog_ranges(subject: Subject) -> None:
    """Arm with watchdog_min or watchdog_max: accepted, trips on time; beyond: BAD_VALUE.

    Compare the time with your stated limits, both inclusive, and count it in real time.
    """
    low, high = subject.can["watchdog_min"], subject.can["watchdog_max"]
    session = subject.next_session
    for time in (low - 1, high + 1, _WATCHDOG.minimum - 1, _WATCHDOG.maximum + 1, 0, 0xFFFF):
        if not low <= time <= high:
            await subject.run([send("Arm", session=session, watchdog=time, code="BAD_VALUE")])
    await subject.send(send("Arm", session=0, watchdog=low, code="BAD_VALUE"))
    # No feeding is needed, and none may be possible on a slow line.
    await subject.arm(low / 1000, is_fed=False)
    await subject.settle()
    await subject.run([send("GetFaults"), subject.clear, partial(subject.arm, high / 1000)])
    await subject.run([DISARM_NOW])


async def _trip(subject: Subject, time: float, *sets: Row) -> None:
    """Arm with a watchdog [s], play sets, and let it trip: a fault, and silence 5 ms later."""
    starve = subject.feeding.starve
    await subject.run([partial(subject.arm, time), *sets, starve, Wait(0.8 * time)])
    await subject.run([subject.settle, send("GetFaults")])


@driving("protocol.md#sessions-and-the-watchdog")
async def watchdog(subject: Subject) -> None:
    """Watchdog not fed: every channel reaches zero in 5 ms, fault latched until Clear.

    When the count reaches zero, fade all voices in 5 ms, beginning at most 5 ms late, latch
    WATCHDOG, and answer WRONG_STATE to Arm.
    """
    for time in (subject.shortest_watchdog, subject.can["watchdog_max"]):
        await subject.in_time(partial(_trip_and_clear, subject, time))


async def _trip_and_clear(subject: Subject, time: int) -> None:
    """Let it trip after a time [ms]: until Clear it neither plays nor arms."""
    await _trip(subject, time / 1000, subject.all_channels(), stage(subject.layer_0(level=0.5)))
    wrong_latch = (subject.latch + 7) % 0x10000
    await subject.run(
        [
            *rows_while_latched(subject),
            Wait(0.05),
            STOP_NOW,
            send("Clear", latch=wrong_latch, code="WRONG_LATCH"),
            subject.clear,
            send("Arm", watchdog=time, code="WRONG_SESSION"),
        ]
    )


@driving("protocol.md#sessions-and-the-watchdog")
async def trips_amid_fades(subject: Subject) -> None:
    """Watchdog expiry during fades, onsets, endings, waiting sets: silent 5 ms later.

    In a fault, end every voice within 5 ms: shorten each fade, onset or ending that would take
    longer, also of released voices.
    """
    time = subject.shortest_watchdog
    ramp = min(3 * time, subject.ramp_max)
    for sets in subject.transitions(ramp):
        await subject.in_time(partial(_trip, subject, time / 1000, *sets))


@driving("protocol.md#sessions-and-the-watchdog")
async def watchdog_unread(subject: Subject) -> None:
    """Watchdog not fed, no request at all: trips on time, fault listed with its age.

    Run the count from a timer or with the samples, not in the handler of requests.
    """
    await subject.run([partial(subject.arm, 0.0), subject.layer_0(), subject.feeding.starve])
    await asyncio.sleep(subject.judge.watchdog.time + 0.03)
    await subject.run([send("GetFaults")])


@driving("protocol.md#sessions-and-the-watchdog")
def what_feeds(subject: Subject) -> RequestRows:
    """Arm, Ping, Set, Commit or Silence of the session: watchdog_left restarts.

    Restart the count for every accepted request that feeds, including a repeated Commit, a part
    that is kept and a last part that gets Taken.
    """
    first_part, *_, last_part = subject.sets.parts(*long_set(subject), token=3, now=0, count=3)
    feeding_rows: list[Row] = [
        subject.ping,
        subject.layer_0(),
        stage(subject.layer_0(level=0.5)),
        commit(2),
        commit(2),
        stage(subject.layer_0(), token=2),
        send("Set", **first_part),
        send("Set", **last_part),  # another part is missing
        SILENCE_NOW,
        send("Arm", watchdog=subject.can["watchdog_max"]),
    ]
    until_fed_shows = Wait(max(0.02 - subject.timing.exchange_time, 0.0))
    rows: list[Row] = [partial(subject.arm, 0.5)]
    for row in feeding_rows:
        rows += [until_fed_shows, row]
    return rows


@driving("protocol.md#sessions-and-the-watchdog")
async def what_does_not_feed(subject: Subject) -> None:
    """Readings, rejected requests, other sessions, dropped parts: watchdog_left runs down.

    Restart the count only after all checks of the request have passed.
    """
    layers = long_set(subject)
    first_part, *_ = subject.sets.parts(*layers, token=7, now=0, count=3)
    set_parts = subject.sets.parts(*layers, token=8, now=0, count=3)
    await subject.run([subject.arm, subject.layer_0()])
    for row in [
        *_readings(subject),
        *_rejected_sets(subject),
        *(send("Set", **{**first_part, **dropped}) for dropped in _DROPPED),
        *_rejected_requests(subject),
    ]:
        await subject.unfed()
        await subject.run([row])
    incomplete = commit(7, "INCOMPLETE")
    await subject.run([send("Set", **first_part), Wait(0.02), incomplete])
    part_rows = [send("Set", **part) for part in set_parts]
    staged_again = part_rows[0]  # which is dropped
    await subject.run([*part_rows, Wait(0.02), staged_again])


def _readings(subject: Subject) -> list[Row]:
    """Return requests that only read, and a Clear without anything to clear."""
    rows: list[Row] = [
        send("GetStatus"),
        send("GetCaps"),
        send("GetFaults"),
        send("GetAchieved", layer=0),
        send("Clear", latch=0),
        subject.client.hello,
    ]
    rows += [send(name) for feature, name in _READINGS.items() if subject.has(feature)]
    return rows


def _rejected_sets(subject: Subject) -> list[Row]:
    """Return sets that are rejected."""
    (part,) = subject.sets.parts(subject.layer_0(), token=7)
    flawed = {**part, "stream": [0xFFFF, 0, 0]}
    return [
        send("Ping", session=77, code="WRONG_SESSION"),
        play_now(subject.layer_0(), token=7, session=77, code="WRONG_SESSION"),
        play_now(subject.layer_0(), token=0x8001, code="BAD_TOKEN"),
        send("Set", **flawed, code=("BAD_VALUE", "BAD_CHANNEL", "BAD_LENGTH")),
    ]


def _rejected_requests(subject: Subject) -> list[Row]:
    """Return requests other than sets that are rejected."""
    return [
        commit(20_000, "BAD_TOKEN"),
        send("Commit", token=1, session=77, code="WRONG_SESSION"),
        send("Silence", ramp=0, session=77, code="WRONG_SESSION"),
        send("Arm", watchdog=500, session=77, code="WRONG_SESSION"),
        send("Ping", raw=(1, 0, 0), code="BAD_LENGTH"),
        send("GetAchieved", raw=[16], code="BAD_VALUE"),
        partial(subject.client.exchange, 63, ()),
        send("Silence", ramp=subject.ramp_max + 1, code="BAD_VALUE"),
        send("Arm", watchdog=subject.can["watchdog_max"] + 1, code="BAD_VALUE"),
    ]


@driving("protocol.md#sessions-and-the-watchdog")
async def trips_amid_other_requests(subject: Subject) -> None:
    """Requests that do not feed, without a pause: the watchdog trips on time.

    Do not let the reception of frames restart or delay the count.
    """
    await subject.run([partial(subject.arm, 0.0), subject.layer_0(), subject.feeding.starve])
    rows: RequestRows = (
        send("GetFaults"),
        send("GetAchieved", layer=0),
        send("Clear", latch=0),
        send("Ping", session=77, code="WRONG_SESSION"),
        partial(subject.client.exchange, 63, ()),
    )
    judge = subject.judge
    end = judge.watchdog.fed.earliest + 0.7 * judge.watchdog.time - subject.timing.exchange_time
    for row in cycle(rows):
        if threads.now() > end:
            break
        await subject.run([row])
    await subject.settle()


@driving("protocol.md#readings")
async def fault_list(subject: Subject) -> None:
    """GetFaults after two faults: newest first with ages; Clear does not remove them.

    Store at least two faults with the time of each, newest first, and keep them until power-down.
    Channel 255 if no channel is at fault.
    """
    watchdog_fault = FAULTS["WATCHDOG"], NO_CHANNEL
    expected = [watchdog_fault, watchdog_fault, *await _listed_faults(subject)]
    tone = layer(0, subject.tone())
    trip = partial(_trip, subject, subject.shortest_watchdog / 1000, tone)
    read = partial(_listed_faults, subject)
    clear = subject.clear
    await subject.run([trip, clear, trip, clear, STOP_NOW, clear, read, Wait(0.1)])
    faults = await _listed_faults(subject)
    count = max(len(faults), 2)
    expect_equal(faults, expected[:count], "listed faults and channels")


async def _listed_faults(subject: Subject) -> list[tuple[int, int]]:
    """Return the number and the channel of each listed fault."""
    reply = await subject.request("GetFaults")
    return [(row["fault"], row["channel"]) for row in reply["faults"]]
