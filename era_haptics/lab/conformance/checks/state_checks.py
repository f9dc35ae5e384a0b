"""Checks of states (arming, sessions, Stop, Disarm, Silence, Clear) and of the watchdog."""

import asyncio
from dataclasses import replace
from functools import partial
from itertools import cycle

from drivers.protocol.definition import FAULTS, NO_CHANNEL, QUANTITIES
from drivers.protocol.sets import token_after
from era_haptics.lab.conformance.check import driving
from era_haptics.lab.conformance.checks.set_checks import long_set
from era_haptics.lab.conformance.judge_client import (
    RequestRows,
    Row,
    expect_equal,
    layer,
    play_now,
    send,
    stage,
)
from era_haptics.lab.conformance.subject import Subject
from registry import threads

_WRONG = "WRONG_STATE"
_DENSE, _NEAR = 0.003, 0.0003  # s; between statuses at most; from samples to the clock
_ROUGH = 20  # steps of level
_READINGS = {"mark": "Mark", "electrical": "GetMeasured"}  # by their features


@driving("protocol.md#states")
def plays_nothing_disarmed(subject: Subject) -> RequestRows:
    """Set, Commit or Silence while disarmed: WRONG_STATE.

    Check the state before the session, the capabilities and the stream. Accept Ping and Disarm in
    this state.
    """
    return _unarmed(subject)


def _unarmed(subject: Subject, ramp: int = 0) -> list[Row]:
    """Return requests that an unarmed amplifier rejects or ignores; ramp of the Disarm [ms]."""
    one, beyond = subject.one(level=0.75), QUANTITIES["ramp"].maximum
    # The state is checked before the capabilities and before repeated layers.
    others: list[Row] = [play_now(one, token=9, code=_WRONG), stage(one, one, token=9, code=_WRONG)]
    refused = send("Commit", token=1, code=_WRONG), send("Silence", ramp=beyond, code=_WRONG)
    return [*others, *refused, send("Ping", session=77), send("Disarm", ramp=ramp)]


def _latched(subject: Subject) -> list[Row]:
    """Make the same for an amplifier that is stopped or in a fault, which does not arm either."""
    serial = subject.identity["serial_number"]
    moves = [send("SetAddress", address=9, serial_number=serial, code=_WRONG)]
    arm = send("Arm", watchdog=QUANTITIES["watchdog"].maximum, session=77, code=_WRONG)
    return [arm, *moves * subject.has("address"), *_unarmed(subject)]


@driving("protocol.md#states")
def arming(subject: Subject) -> RequestRows:
    """Arm after Disarm: silent, high voltage on, earlier sets and tokens forgotten.

    In Arm, drop collected and staged sets and reset the committed token to 0.
    """
    return [
        subject.arm,
        play_now(subject.one(), token=40_000),
        stage(subject.one(), token=40_001),
        send("Disarm", ramp=0),
        subject.settle,
        subject.arm,
        send("Commit", token=40_001, code="BAD_TOKEN"),
        play_now(subject.one(), token=39_999),  # older than 40 000, but the first of this session
    ]


@driving("protocol.md#sessions-and-the-watchdog")
async def watchdog_ranges(subject: Subject) -> None:
    """Arm with watchdog_min or watchdog_max: accepted, trips on time; beyond: BAD_VALUE.

    Compare the time with your stated limits, both inclusive, and count it in real time.
    """
    low, high = subject.can["watchdog_min"], subject.can["watchdog_max"]
    outer = QUANTITIES["watchdog"]
    times = low - 1, high + 1, outer.minimum - 1, outer.maximum + 1, 0, 0xFFFF
    beyond = [time for time in times if not low <= time <= high]
    arm = partial(send, "Arm", session=subject.next_session, code="BAD_VALUE")
    await subject.run([arm(watchdog=time) for time in beyond])
    await subject.send(send("Arm", session=0, watchdog=low, code="BAD_VALUE"))
    # No feeding is needed, and none may be possible on a slow line.
    await subject.arm(low / 1000, is_fed=False)
    await subject.settle()
    await subject.run([send("GetFaults"), subject.clear, partial(subject.arm, high / 1000)])
    await subject.run([send("Disarm", ramp=0)])


@driving("protocol.md#states")
def arms_again(subject: Subject) -> RequestRows:
    """Arm with the session held: the watchdog restarts with the new time, playback continues.

    If the session is the one held, only store the new watchdog time and restart the count; keep
    voices, staged sets and the token.
    """
    low, high = subject.shortest_watchdog, subject.can["watchdog_max"]
    return [
        partial(subject.arm, high / 1000),
        subject.one(),
        stage(subject.one(level=0.5)),
        send("Arm", watchdog=low),
        send("Arm", watchdog=high),
        send("Commit", token=2),
    ]


@driving("protocol.md#sessions-and-the-watchdog")
def sessions(subject: Subject) -> RequestRows:
    """Request with another session, or Arm with an ended session: WRONG_SESSION.

    Compare all 16 bits of the session, right after the state. Remember the last session after
    Disarm, Stop and faults, and reject an Arm that repeats it.
    """
    subject.client.session, own = 0x1233, 0x1234
    quarter, maximum = subject.one(level=0.25), subject.can["watchdog_max"]
    outer = QUANTITIES["watchdog"]
    rows = (
        play_now(quarter, token=3, code="WRONG_SESSION"),
        send("Commit", token=2, code="WRONG_SESSION"),
        # The session is checked before the capabilities.
        send("Silence", ramp=QUANTITIES["ramp"].maximum, code="WRONG_SESSION"),
        send("Ping", code="WRONG_SESSION"),
        *(
            send("Arm", watchdog=each, code="WRONG_SESSION")
            for each in (outer.minimum, outer.maximum)
        ),
    )
    others = [
        partial(
            subject.send_all,
            [replace(each, values={**each.values, "session": other}) for each in rows],
        )
        for other in (0x1235, 0x5634, 0x1256, 0xEDCB, 1)
    ]
    return [
        subject.arm,
        subject.one(),
        stage(subject.one()),
        *others,
        send("Ping", session=0, code="BAD_VALUE"),
        send("Disarm", ramp=0),
        subject.settle,
        play_now(quarter, session=0x1235, code=_WRONG),
        send("Arm", watchdog=maximum, session=own, code="WRONG_SESSION"),
        partial(_arm_as, subject, own ^ 0x100),
        play_now(quarter, session=own, code="WRONG_SESSION"),
        send("Stop", ramp=0),
        subject.settle,
        subject.clear,
        send("Arm", watchdog=maximum, code="WRONG_SESSION"),
        partial(_arm_as, subject, own - 7),
    ]


async def _arm_as(subject: Subject, session: int) -> None:
    subject.client.session = session - 1
    await subject.arm()


@driving("protocol.md#states")
def arming_ends_fades(subject: Subject) -> RequestRows:
    """Arm during the fade of a Disarm: silent within 5 ms.

    In Arm, shorten every running fade to 5 ms, and keep rejecting the session that Disarm ended.
    """
    disarm = send("Disarm", ramp=subject.can["ramp_max"])
    ended = send("Arm", watchdog=subject.can["watchdog_max"], code="WRONG_SESSION")
    fades = partial(subject.follow, 0.02)
    return [subject.arm, subject.one(), disarm, ended, subject.arm, fades, subject.one()]


@driving("protocol.md#states")
def stop(subject: Subject) -> RequestRows:
    """Stop with ramp 0: every channel silent, latched; nothing plays or arms before Clear.

    Remove every voice, drop collected, staged and waiting sets, enter QUICK_STOP_ACTIVE with a new
    latch, and answer WRONG_STATE to Arm, Set, Commit and Silence.
    """
    return [
        subject.arm,
        subject.whole(),
        stage(subject.one(level=0.5)),
        send("Stop", ramp=0),
        0.02,
        *_latched(subject),
        send("Commit", token=2, code=_WRONG),
        0.1,
    ]


@driving("protocol.md#states")
def stop_ramps(subject: Subject) -> RequestRows:
    """Stop or Disarm with a ramp: raised cosine to zero; a second one only shortens it.

    Lead every voice from its present amplitude along the raised cosine. Treat a ramp above ramp_max
    as ramp_max, and keep the earlier of two ends.
    """
    whole, fading = subject.whole(), _unarmed(subject, 0xFFFF)
    amid = partial(subject.follow, 0.2 * subject.slowness)
    (stop, slowest_stop), (disarm, slowest_disarm) = (
        [send(name, ramp=each) for each in (subject.ramp, 0xFFFF)] for name in ("Stop", "Disarm")
    )
    first, *_ = subject.parts(subject.one(), token=2, now=0, count=3)
    return [
        (whole, send("Set", **first), stop),
        (whole, disarm),
        (whole, slowest_stop, amid, disarm),
        (whole, slowest_disarm, *fading, subject.clear, amid, stop),
        (whole, send("Stop", ramp=min(2 * subject.can["ramp_max"], 0xFFFF))),
    ]


@driving("protocol.md#layers")
def silence_never_later(subject: Subject) -> RequestRows:
    """Second Stop during a fade: silent at the earlier of both ends.

    Compare the time left of the running fade with the new ramp, and keep the fade that ends first.
    """
    subject.require_ramp()
    slow, quick = send("Stop", ramp=min(400, subject.can["ramp_max"])), send("Stop", ramp=50)
    fading = layer(0, ramp=50)
    return [
        (subject.whole(), slow, quick),
        (subject.whole(), quick, slow),
        (subject.one(), fading, slow),
        # The remaining time of a fade counts, not its duration.
        (subject.whole(), send("Stop", ramp=300), 0.2, send("Stop", ramp=150)),
    ]


@driving("protocol.md#states")
def stop_ends_all(subject: Subject) -> RequestRows:
    """Stop during fades, onsets, endings and waiting sets: all end with the Stop's ramp.

    Fade every voice of every layer, released or not, skip endings, and drop what waits.
    """
    subject.require_ramp()
    stopped = send("Stop", ramp=10)
    return [(*rows, stopped) for rows in subject.transitions(subject.can["ramp_max"])]


@driving("protocol.md#states")
def stops_are_numbered(subject: Subject) -> RequestRows:
    """Every Stop: the next latch number; Clear with another number: WRONG_LATCH.

    Give every Stop and every fault the next 16-bit number, 1 to 65535 and then 1, also while
    disarmed or stopped. Compare all 16 bits in Clear, and change nothing if there is nothing to
    clear.
    """
    latch = token_after(token_after(token_after(subject.latch)))
    others = (latch - 1) % 0x10000, (latch + 1) % 0x10000, latch ^ 0x100
    return [
        send("Stop", ramp=0),
        send("Stop", ramp=0),
        send("Stop", ramp=0),
        *(send("Clear", latch=other, code="WRONG_LATCH") for other in others),
        subject.clear,
        subject.clear,
        subject.arm,
        subject.clear,
        subject.one(),
        subject.clear,
    ]


@driving("protocol.md#states")
def clear_too_early(subject: Subject) -> RequestRows:
    """Clear during the fade of a Stop: the state does not change.

    Leave QUICK_STOP_ACTIVE only when no voice lasts; until then, answer Clear with the present
    Status.
    """
    subject.require_ramp()
    ramp = subject.ramp
    slow, last = send("Stop", ramp=ramp), layer(0, subject.tone(subject.channels[-1]))
    return [subject.arm, last, slow, subject.clear, ramp / 1000 + 0.02, subject.clear]


@driving("protocol.md#start-of-a-set")
def silence(subject: Subject) -> RequestRows:
    """Silence: all layers fade with its ramp, staged sets are dropped, the amplifier stays armed.

    Fade every voice, drop collected, staged and waiting sets, and stay in OPERATION_ENABLED. Reject
    a ramp above ramp_max with BAD_VALUE.
    """
    ending = subject.envelope(0.1, 1, 1)
    several = play_now(
        layer(0, subject.tone(0, 0.5, ending=ending)),
        layer(1, subject.tone(0, 0.4, frequency=subject.other)),
        layer(2, subject.tone(1 % len(subject.channels), 0.1)),
    )
    first, *_, last = subject.parts(subject.one(), token=4, now=0, count=3)
    return [
        subject.arm,
        several,
        stage(subject.one()),
        send("Silence", ramp=subject.ramp),
        subject.follow,
        send("Commit", token=2, code="BAD_TOKEN"),
        subject.one(),
        send("Set", **first),
        send("Silence", ramp=0),
        send("Set", **last),
        send("Silence", ramp=subject.can["ramp_max"] + 1, code="BAD_VALUE"),
    ]


async def _trips(subject: Subject, time: float, *sets: Row) -> None:
    """Play sets and starve it: it trips at its time [s], is silent 5 ms later, and lists it."""
    await subject.run(
        [
            partial(subject.arm, time),
            *sets,
            subject.starve,
            0.8 * time,
            subject.settle,
            send("GetFaults"),
        ]
    )


async def _trips_for_good(subject: Subject, time: int) -> None:
    """Have it trip after a time [ms]: it plays and arms no more until it is cleared."""
    await _trips(subject, time / 1000, subject.whole(), stage(subject.one(level=0.5)))
    await subject.run(
        [
            *_latched(subject),
            0.05,
            send("Stop", ramp=0),
            send("Clear", latch=(subject.latch + 7) % 0x10000, code="WRONG_LATCH"),
            subject.clear,
            send("Arm", watchdog=time, code="WRONG_SESSION"),
        ]
    )


@driving("protocol.md#sessions-and-the-watchdog")
async def watchdog(subject: Subject) -> None:
    """Watchdog not fed: every channel reaches zero in 5 ms, fault latched until Clear.

    When the count reaches zero, fade all voices in 5 ms, beginning at most 5 ms late, latch
    WATCHDOG, and answer WRONG_STATE to Arm.
    """
    for time in (subject.shortest_watchdog, subject.can["watchdog_max"]):
        await subject.in_time(partial(_trips_for_good, subject, time))


@driving("protocol.md#sessions-and-the-watchdog")
async def trips_amid_fades(subject: Subject) -> None:
    """Watchdog expiry during fades, onsets, endings, waiting sets: silent 5 ms later.

    In a fault, end every voice within 5 ms: shorten each fade, onset or ending that would take
    longer, also of released voices.
    """
    time = subject.shortest_watchdog
    for sets in subject.transitions(min(3 * time, subject.can["ramp_max"])):
        await subject.in_time(partial(_trips, subject, time / 1000, *sets))


@driving("protocol.md#sessions-and-the-watchdog")
async def watchdog_unread(subject: Subject) -> None:
    """Watchdog not fed, no request at all: trips on time, fault listed with its age.

    Run the count from a timer or with the samples, not in the handler of requests.
    """
    await subject.run([partial(subject.arm, 0.0), subject.one(), subject.starve])
    await asyncio.sleep(subject.shown.watchdog + 0.03)
    await subject.run([send("GetFaults")])


@driving("protocol.md#sessions-and-the-watchdog")
def what_feeds(subject: Subject) -> RequestRows:
    """Arm, Ping, Set, Commit or Silence of the session: watchdog_left restarts.

    Restart the count for every accepted request that feeds, including a repeated Commit, a part
    that is kept and a last part that gets Taken.
    """
    first, *_, last = subject.parts(*long_set(subject), token=3, now=0, count=3)
    feeds = (
        subject.ping,
        subject.one(),
        stage(subject.one(level=0.5)),
        send("Commit", token=2),
        send("Commit", token=2),
        stage(subject.one(), token=2),
        send("Set", **first),
        send("Set", **last),  # another part is missing
        send("Silence", ramp=0),
        send("Arm", watchdog=subject.can["watchdog_max"]),
    )
    apart = max(0.02 - subject.exchange_time, 0.0)  # s; until it shows that it was fed
    return [partial(subject.arm, 0.5), *(row for feed in feeds for row in (apart, feed))]


@driving("protocol.md#sessions-and-the-watchdog")
async def what_does_not_feed(subject: Subject) -> None:
    """Readings, rejected requests, other sessions, dropped parts: watchdog_left runs down.

    Restart the count only after all checks of the request have passed.
    """
    (part,) = subject.parts(subject.one(), token=7)
    flawed = {**part, "stream": [0xFFFF, 0, 0]}
    made = long_set(subject)
    first, *_ = subject.parts(*made, token=7, now=0, count=3)
    flaws = "BAD_VALUE", "BAD_CHANNEL", "BAD_LENGTH"
    idle: RequestRows = [
        *(send(name) for name in ("GetStatus", "GetCaps", "GetFaults")),
        send("GetAchieved", layer=0),
        send("Clear", latch=0),
        subject.client.hello,
        *(send(name) for feature, name in _READINGS.items() if subject.has(feature)),
        send("Ping", session=77, code="WRONG_SESSION"),
        play_now(subject.one(), token=7, session=77, code="WRONG_SESSION"),
        play_now(subject.one(), token=0x8001, code="BAD_TOKEN"),
        send("Set", **flawed, code=flaws),
        send("Set", **first, session=77),
        *(send("Set", **{**first, "token": token}) for token in (1, 0x8001)),
        send("Commit", token=20_000, code="BAD_TOKEN"),
        send("Commit", token=1, session=77, code="WRONG_SESSION"),
        send("Silence", ramp=0, session=77, code="WRONG_SESSION"),
        send("Arm", watchdog=500, session=77, code="WRONG_SESSION"),
        send("Ping", raw=(1, 0, 0), code="BAD_LENGTH"),
        send("GetAchieved", raw=[16], code="BAD_VALUE"),
        partial(subject.client.exchange, 63, ()),
        send("Silence", ramp=subject.can["ramp_max"] + 1, code="BAD_VALUE"),
        send("Arm", watchdog=subject.can["watchdog_max"] + 1, code="BAD_VALUE"),
    ]
    collected: RequestRows = (
        send("Set", **first),
        0.02,
        send("Commit", token=7, code="INCOMPLETE"),
    )
    whole = [send("Set", **each) for each in subject.parts(*made, token=8, now=0, count=3)]
    staged: RequestRows = (*whole, 0.02, whole[0])  # which is dropped
    await subject.run([subject.arm, subject.one()])
    for each in idle:
        await subject.unfed()
        await subject.run([each])
    await subject.run([*collected, *staged])


@driving("protocol.md#sessions-and-the-watchdog")
async def trips_amid_other_requests(subject: Subject) -> None:
    """Requests that do not feed, without a pause: the watchdog trips on time.

    Do not let the reception of frames restart or delay the count.
    """
    await subject.run([partial(subject.arm, 0.0), subject.one(), subject.starve])
    others: RequestRows = (
        send("GetFaults"),
        send("GetAchieved", layer=0),
        send("Clear", latch=0),
        send("Ping", session=77, code="WRONG_SESSION"),
        partial(subject.client.exchange, 63, ()),
    )
    last = subject.shown.fed[0] + 0.7 * subject.shown.watchdog - subject.exchange_time
    for row in cycle(others):
        if threads.now() > last:
            break
        await subject.run([row])
    await subject.settle()


@driving("protocol.md#readings")
async def fault_list(subject: Subject) -> None:
    """GetFaults after two faults: newest first with ages; Clear does not remove them.

    Store at least two faults with the time of each, newest first, and keep them until power-down.
    Channel 255 if no channel is at fault.
    """

    async def listed() -> list[tuple[int, int]]:
        rows = (await subject.request("GetFaults"))["faults"]
        return [(each["fault"], each["channel"]) for each in rows]

    trip = partial(_trips, subject, subject.shortest_watchdog / 1000, layer(0, subject.tone()))
    before = [(FAULTS["WATCHDOG"], NO_CHANNEL)] * 2 + await listed()
    stopped = send("Stop", ramp=0), subject.clear
    await subject.run([trip, subject.clear, trip, subject.clear, *stopped, listed, 0.1])
    found = await listed()
    expect_equal(found, before[: max(len(found), 2)], "listed faults and channels")
