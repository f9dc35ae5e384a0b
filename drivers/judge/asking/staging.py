"""Checks of sets by tokens: staged, committed once, in their order, for a second, at a moment."""

import asyncio
from functools import partial

from drivers.protocol.definition import (
    COMMAND,
    HIGH_STEPS,
    HIGH_TIME,
    HIGH_WORDS,
    LAYER,
    MAX_AHEAD,
    QUANTITIES,
    ahead,
)
from era_haptics.lab.conformance.check import driving
from era_haptics.lab.conformance.judge_client import Rows, expect_equal, layer, play, send, stage
from era_haptics.lab.conformance.subject import Subject
from registry import threads

_PLACE = "protocol.md#sets"
_OLD = "BAD_TOKEN"
_AROUND, _NEAR = 0.015, 0.0005  # s; of a moment, in which statuses are dense; that may be either
_SLOWEST, _FASTEST = QUANTITIES["rate"].minimum, QUANTITIES["rate"].maximum
_LONG, _BEHIND = 0.2, 0.02  # s; in which a rate of the clock shows; what was dropped, that it is


@driving(_PLACE)
def stage_and_commit(subject: Subject) -> Rows:
    """It plays a staged set by the commit of its token only, once, and confirms it again."""
    both = layer(0, subject.tone(0, 0.5), ramp=50), layer(1, subject.beside(1, 0.25))
    again = send("Commit", token=2), stage(*both, token=2), play(*both, token=2)
    others = (send("Commit", token=other, code=_OLD) for other in (3, 302, 2 ^ 0x100, 0))
    return [
        subject.arm,
        send("Commit", token=0, code=_OLD),
        subject.one(),
        stage(*both),
        *others,
        send("Commit", token=2),
        subject.follow,
        *again,
        *again,
        *(stage(subject.one(level=0.75), token=3), send("Commit", token=2)),
        send("Commit", token=3),
        play(subject.one(), token=2, code=_OLD),
    ]


@driving(_PLACE)
def repeats_change_nothing(subject: Subject) -> Rows:
    """It starts nothing anew by a commit or set that comes again, even if its vibration ended."""
    one, commit = subject.one(valid_for=300), send("Commit", token=1)
    again = commit, play(one, token=1)
    return [subject.arm, stage(one), commit, 0.2, *again, 0.13, *again]


@driving(_PLACE)
def tokens_wrap(subject: Subject) -> Rows:
    """It takes tokens that are newer by 1 to 32767 modulo 65536, and no others (RFC 1982)."""
    rows: list[Rows] = [
        [
            play(subject.one(level=0.5), token=newer),
            *(
                play(layer(0), token=(newer + ahead) % 0x10000, code=_OLD)
                for ahead in (32_768, 32_769, 65_534)
                if newer + ahead != 0x10000
            ),
        ]
        for newer in (65_535, 1, 32_768, 65_535)
    ]
    return [subject.arm, play(subject.one(), token=65_530), *(row for each in rows for row in each)]


@driving(_PLACE)
def newer_sets_replace(subject: Subject) -> Rows:
    """It keeps the newest staged set alone, and plays what comes with *now* at once."""
    half, quarter = subject.one(level=0.5), subject.one(level=0.25)
    dropped = partial(send, "Commit", code=_OLD)
    return [
        *(subject.arm, stage(quarter), stage(half), dropped(token=1)),
        *(stage(subject.one(), token=1, code=_OLD), send("Commit", token=2)),
        *(stage(subject.one()), half, dropped(token=3)),
        *(stage(subject.one()), send("Silence", ramp=0), dropped(token=5)),
        *(
            stage(subject.one()),
            send("Disarm", ramp=0),
            subject.settle,
            subject.arm,
            dropped(token=6),
        ),
    ]


@driving(_PLACE)
def committed_together(subject: Subject) -> Rows:
    """It starts all layers and channels of a set at one moment."""
    tones = [subject.tone(each, 1 / len(subject.layers)) for each in subject.channels]
    room = subject.can["set_words"] // (LAYER.words + COMMAND.words * len(tones))
    layers = [layer(each, *tones, ramp=subject.ramp) for each in subject.layers[:room]]
    return [[stage(*layers), send("Commit", token=1)]]


@driving(_PLACE)
async def starts_at_its_moment(subject: Subject) -> None:
    """It starts a set as its clock comes to the moment of its Commit, at once beyond 0.5 s."""
    soon = min(0.1 * subject.slowness, 0.4)
    beyond = 1.01 * MAX_AHEAD + 2 * min(subject.exchange_time, 1.0)
    for duration in (soon, 0.99 * MAX_AHEAD, beyond, -0.1, 0.0):
        await subject.in_time(partial(_starts, subject, duration))
    present = subject.shown.clock.present
    over_the_end = (HIGH_WORDS - present - round(0.05 / HIGH_TIME)) % HIGH_WORDS
    await subject.in_time(partial(_starts, subject, soon, shift=over_the_end))


async def _starts(subject: Subject, duration: float, *, shift: int = 0) -> None:
    """Commit a set for a moment a time [s] ahead, which repeats do not move."""
    await subject.arm(shift=shift)
    await subject.request("Ping", rate=_FASTEST if duration > _LONG else 0)
    one = subject.one()
    await subject.run([stage(one)])
    at, began = await subject.commit_in(duration), threads.now()
    await subject.request("Ping", rate=_SLOWEST if duration > _LONG else 0)
    await subject.run([play(one, token=1), send("Commit", token=1)])
    is_ahead = 0 < duration <= MAX_AHEAD
    await subject.pause(max(duration * is_ahead - _AROUND - threads.now() + began, 0.0))
    while threads.now() < began + duration * is_ahead + _AROUND:
        shown = await subject.status()
        since = ahead(shown["clock"], at * HIGH_STEPS)
        if is_ahead and abs(since) > _NEAR:
            what = f"whether it plays {1e3 * since:.1f} ms behind its moment, by its clock"
            expect_equal(shown["levels"][0] > 0, since > 0, what)
        await asyncio.sleep(_NEAR)
    await subject.run([subject.follow])


@driving(_PLACE)
def what_waits_for_its_moment(subject: Subject) -> Rows:
    """It starts what waits before a newer Commit or *now*, and drops it with all that silences."""
    half = layer(1, subject.beside(1, 0.5))
    left = min(0.1 * subject.slowness, 0.4)
    waiting = stage(subject.one(level=0.25))
    arm = send("Arm", watchdog=subject.can["watchdog_max"])
    first, *_ = subject.parts(half, token=2, now=0, count=3)
    refused = play(layer(0, after=True), token=3, code="BAD_VALUE")
    ends: list[Rows] = [
        *([send(name, ramp=0)] for name in ("Silence", "Stop")),
        [send("Disarm", ramp=0), subject.settle, subject.arm],
        [arm],
        *([play(one)] for one in (half, subject.one(level=0.5))),
        # It starts before what comes for its own layer.
        [stage(subject.one(level=0.5)), send("Commit", token=2)],
        [send("Set", **first)],
        [stage(half), partial(subject.commit_in, left / 2)],
        [stage(half), send("Commit", token=3, code=_OLD), refused],
    ]
    past = partial(subject.past_moment, _BEHIND)
    trips: Rows = [send("Arm", watchdog=subject.shortest_watchdog), subject.starve, subject.settle]
    later = [waiting, partial(subject.commit_in, min(3 * left, 0.45)), *trips, past]
    # No status is read as it starts; its end counts from there.
    timed = subject.one(ramp=subject.ramp, valid_for=subject.lasting(100))
    unseen = stage(timed), partial(subject.commit_in, left)
    lefts = [left if len(each) > 1 else 0.6 * left for each in ends]
    courses = [
        [waiting, partial(subject.commit_in, each), *rows, past]
        for rows, each in zip(ends, lefts, strict=True)
    ]
    return [*courses, later, [*unseen, 1.25 * left]]
