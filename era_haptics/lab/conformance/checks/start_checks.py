"""Checks of the start of a set: tokens, staging, one commit, moments of the clock."""

import asyncio
from functools import partial

from drivers.protocol.definition import (
    CLOCK_UNKNOWN,
    COMMAND,
    HIGH_STEPS,
    HIGH_TIME,
    HIGH_WORDS,
    LAYER,
    MAX_AHEAD,
    QUANTITIES,
    ahead,
)
from drivers.protocol.sets import LayerSet
from drivers.voices import VoiceTransition
from era_haptics.lab.conformance.check import driving
from era_haptics.lab.conformance.judge_client import RequestOutcome
from era_haptics.lab.conformance.outcomes import expect_within
from era_haptics.lab.conformance.request_rows import (
    DISARM_NOW,
    FULL,
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
from era_haptics.lab.expectations.tolerances import CLOCK_DRIFT
from registry import threads

_AROUND = 0.015  # s; statuses are dense this close to a moment
_NEAR = 0.0003  # s; levels can be this much older than their clock
_RISE = 5  # ms; ramp of a set that starts at a moment
_ROUNDING = 0.0015  # of full level
_SAMPLE = 0.00007  # s, at 16 kHz
_SLOWEST, _FASTEST = QUANTITIES["rate"].minimum, QUANTITIES["rate"].maximum
_LONG = 0.2  # s; after this time a clock rate becomes visible
_SETTLING = 0.02  # s; after this time a dropped set becomes visible


@driving("protocol.md#start-of-a-set")
def stage_and_commit(subject: Subject) -> RequestRows:
    """Commit with the staged token: plays once, repeats confirmed; other tokens: BAD_TOKEN.

    Compare all 16 bits of the token. Confirm the token committed last, and reject every token that
    is not staged.
    """
    playing = subject.layer_0()
    layers = [layer(0, subject.tone(0, 0.5), ramp=50), subject.separate_layer(1, 0.25)]
    repetitions = [commit(2), stage(*layers, token=2), play_now(*layers, token=2)]
    rows: list[Row] = [subject.arm, commit(0, "BAD_TOKEN"), playing, stage(*layers)]
    for other_token in (3, 302, 2 ^ 0x100, 0):
        rows.append(commit(other_token, "BAD_TOKEN"))
    rows += [commit(2), subject.follow, *repetitions, *repetitions]
    rows += [stage(subject.layer_0(level=0.75), token=3), commit(2), commit(3)]
    rows.append(play_now(playing, token=2, code="BAD_TOKEN"))
    return rows


@driving("protocol.md#start-of-a-set")
def repeats_change_nothing(subject: Subject) -> RequestRows:
    """Commit or Set of the committed token, again: confirmed, nothing restarts.

    Compare the token with that committed last before you play anything, even if its vibration is
    over.
    """
    timed = subject.layer_0(valid_for=300)
    repetitions = [commit(1), play_now(timed, token=1)]
    return [subject.arm, stage(timed), commit(1), Wait(0.2), *repetitions, Wait(0.13), *repetitions]


@driving("protocol.md#sets")
def tokens_wrap(subject: Subject) -> RequestRows:
    """Token newer by 1 to 32767 modulo 65536: accepted; others: BAD_TOKEN.

    Compute (a - b) modulo 65536 in 16 bits and compare it with 1 to 32767.
    """
    rows: list[Row] = [subject.arm, play_now(subject.layer_0(), token=65_530)]
    for token in (65_535, 1, 32_768, 65_535):
        rows.append(play_now(subject.layer_0(level=0.5), token=token))
        for difference in (32_768, 32_769, 65_534):
            older_token = (token + difference) % 0x10000
            if older_token:
                rows.append(play_now(layer(0), token=older_token, code="BAD_TOKEN"))
    return rows


@driving("protocol.md#parts-of-a-set")
def newer_sets_replace(subject: Subject) -> RequestRows:
    """New staged set, `now`, Silence or Disarm: the set staged before is dropped.

    Keep one staged set. Drop it when a newer set is staged or played and when the amplifier falls
    silent.
    """
    loud = subject.layer_0()
    half = subject.layer_0(level=0.5)
    quarter = subject.layer_0(level=0.25)
    rows: list[Row] = [subject.arm, stage(quarter), stage(half), commit(1, "BAD_TOKEN")]
    rows += [stage(loud, token=1, code="BAD_TOKEN"), commit(2)]
    rows += [stage(loud), half, commit(3, "BAD_TOKEN")]
    rows += [stage(loud), SILENCE_NOW, commit(5, "BAD_TOKEN")]
    rows += [stage(loud), DISARM_NOW, subject.settle, subject.arm, commit(6, "BAD_TOKEN")]
    return rows


@driving("protocol.md#start-of-a-set")
def committed_together(subject: Subject) -> RequestRows:
    """Commit of a set with all layers and channels: all start at the same sample.

    Apply a whole set between two samples, not layer by layer across several.
    """
    fraction = 1 / len(subject.layers)
    tones = [subject.tone(channel, fraction) for channel in subject.channels]
    layer_words = LAYER.words + COMMAND.words * len(tones)
    room = subject.can["set_words"] // layer_words
    layers = [layer(number, *tones, ramp=subject.ramp) for number in subject.layers[:room]]
    return [[stage(*layers), commit(1)]]


@driving("protocol.md#start-of-a-set")
async def starts_at_its_moment(subject: Subject) -> None:
    """Commit with a moment up to 0.5 s ahead: starts there; otherwise immediately.

    Compare the high word of the clock modulo 65536, and start with the first sample at or behind
    the moment.
    """
    soon = min(0.1 * subject.timing.slowness, 0.4)
    beyond = 1.01 * MAX_AHEAD + 2 * min(subject.timing.exchange_time, 1.0)
    for duration in (soon, 0.99 * MAX_AHEAD, beyond, -0.1, 0.0):
        await subject.in_time(partial(_expect_start, subject, duration))
    # Shift the clock so that it wraps before the moment.
    shift = -subject.judge.clock.present - round(0.05 / HIGH_TIME)
    await subject.in_time(partial(_expect_start, subject, soon, shift=shift % HIGH_WORDS))


async def _expect_start(subject: Subject, duration: float, *, shift: int = 0) -> None:
    """Commit a set for a moment `duration` [s] ahead, which repetitions do not move."""
    await subject.arm(shift=shift)
    is_ahead = 0 < duration <= MAX_AHEAD
    is_long = duration > _LONG
    await subject.request("Ping", rate=_FASTEST if is_long else 0)
    content = subject.layer_0(ramp=_RISE)
    await subject.run([stage(content)])
    moment = await subject.commit_in(duration)
    committed_at = threads.now()
    await subject.request("Ping", rate=_SLOWEST if is_long else 0)
    await subject.run([play_now(content, token=1), commit(1)])
    starts_at = committed_at + (duration if is_ahead else 0.0)
    await subject.wait(max(starts_at - _AROUND - threads.now(), 0.0))
    has_clock = subject.can["clock_error"] != CLOCK_UNKNOWN
    while threads.now() < starts_at + _AROUND:
        status = await subject.status()
        if is_ahead and has_clock:
            _expect_rise(subject, content, moment, status)
        await asyncio.sleep(_NEAR)
    subject.dating.expect_steady()
    await subject.run([subject.follow])


def _expect_rise(subject: Subject, content: LayerSet, moment: int, status: RequestOutcome) -> None:
    """Compare the level in a status with the ramp that begins at a moment."""
    can = subject.can
    since = ahead(status["clock"], moment * HIGH_STEPS)
    slack = QUANTITIES["clock_error"].from_wire(can["clock_error"]) + CLOCK_DRIFT * abs(since)
    ramp = min(_RISE, can["ramp_max"]) / 1000
    level = content.commands[0].level / FULL
    rise = VoiceTransition(0.0, ramp, 0j, complex(level), ramp)
    low = abs(rise.at(since - _NEAR - slack))
    high = abs(rise.at(since + _SAMPLE + slack))
    rounding = _ROUNDING + can["level_step"] / FULL
    quantity = f"level {1e3 * since:.2f} ms after the moment, by the amplifier's clock"
    expect_within(status["levels"][0] / FULL, low - rounding, high + rounding, quantity)


@driving("protocol.md#start-of-a-set")
def what_waits_for_its_moment(subject: Subject) -> RequestRows:
    """Set waiting for its moment: a newer set starts it, every silencing request drops it.

    Before a newer Commit or `now` that you accept, start the set that waits. Drop it in Silence,
    Stop, Disarm, faults and an Arm with a new session.
    """
    lead = min(0.1 * subject.timing.slowness, 0.4)
    waiting = stage(subject.layer_0(level=0.25))
    past_moment = partial(subject.past_moment, _SETTLING)
    courses: list[Row] = []
    for rows in _rows_before_the_moment(subject, lead):
        time = lead if len(rows) > 1 else 0.6 * lead
        courses.append([waiting, partial(subject.commit_in, time), *rows, past_moment])
    trip: list[Row] = [
        send("Arm", watchdog=subject.shortest_watchdog),
        subject.feeding.starve,
        subject.settle,
    ]
    late_moment = partial(subject.commit_in, min(3 * lead, 0.45))
    courses.append([waiting, late_moment, *trip, past_moment])
    # No status is read as it starts; its end counts from there.
    timed = subject.layer_0(ramp=subject.ramp, valid_for=subject.scaled(100))
    courses.append([stage(timed), partial(subject.commit_in, lead), Wait(1.25 * lead)])
    return courses


def _rows_before_the_moment(subject: Subject, lead: float) -> list[list[Row]]:
    """Return rows that start a waiting set, drop it or leave it; lead: until its moment [s]."""
    half = subject.separate_layer(1, 0.5)
    same_layer = subject.layer_0(level=0.5)
    part, *_ = subject.sets.parts(half, token=2, now=0, count=3)
    rejected_set = play_now(layer(0, after=True), token=3, code="BAD_VALUE")
    return [
        [SILENCE_NOW],
        [STOP_NOW],
        [DISARM_NOW, subject.settle, subject.arm],
        [send("Arm", watchdog=subject.can["watchdog_max"])],
        [play_now(half)],
        [play_now(same_layer)],
        # It starts before the next set for its own layer.
        [stage(same_layer), commit(2)],
        [send("Set", **part)],
        [stage(half), partial(subject.commit_in, lead / 2)],
        [stage(half), commit(3, "BAD_TOKEN"), rejected_set],
    ]
