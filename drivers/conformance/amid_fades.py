"""Checks of what holds while something still fades or is timed: watchdog, refusals."""

import asyncio
from collections.abc import Awaitable, Callable
from functools import partial

from drivers import clock
from drivers.conformance.bench import Bench
from drivers.conformance.cases import settle
from drivers.conformance.check import driving
from drivers.conformance.curve import raised_cosine
from drivers.conformance.findings import (
    ContractViolation,
    Inconclusive,
    NotApplicable,
    expect,
)
from drivers.conformance.watchdog import expect_trip
from drivers.errors import CommandRefused
from drivers.guard import SafeCommandSet
from drivers.guard.channel_state import Interval
from drivers.protocol.definition import PROTOCOL
from drivers.protocol.messages import Feature

_SETS = "wire-protocol.md#sets-tokens-and-ramps"
_APART = 1.25  # of two frequencies, so far apart that their voices cannot be one
_LASTING = 5.0  # of the watchdog: how long what plays would go on without it
_COUNTED = 8  # voices that fit into a ramp, even where an exchange takes long
_SEEN = 0.02  # s; that the watchdog runs down before a request that must not fill it


@driving("wire-protocol.md#watchdog")
async def trips_amid_fades(bench: Bench) -> None:
    """It trips its watchdog amid ramps and valid_for, and silences every voice by it."""
    bench.require(Feature.WATCHDOG)
    long = _LASTING * bench.can.watchdog_min
    ramp = min(long, bench.can.ramp_max)
    other = _other_frequency(bench)

    def tones(fraction: float, frequency: float | None = None) -> SafeCommandSet:
        return bench.tones(fraction, ramp=ramp, frequency=frequency)

    cases: list[tuple[str, list[Callable[[], SafeCommandSet]]]] = []
    if bench.has(Feature.VALID_FOR):
        cases.append(("amid valid_for", [lambda: bench.tones(1.0, valid_for=long)]))
    if ramp > 2 * bench.can.watchdog_min:
        cases += [
            ("while a level rises", [lambda: tones(1.0)]),
            ("while a voice fades", [lambda: bench.tones(1.0), lambda: bench.tones(ramp=ramp)]),
            ("amid a cross-fade", [lambda: bench.tones(1.0), lambda: tones(0.5, other)]),
        ]
    if not cases:
        raise NotApplicable("nothing that it plays ends later than its shortest watchdog")

    async def trips(why: str, sets: list[Callable[[], SafeCommandSet]]) -> None:
        await bench.arm(bench.can.watchdog_min)
        for make in sets:
            await bench.apply(make())
        await expect_trip(bench, why=why)

    for case in cases:
        await settle(bench, partial(trips, *case))


def _other_frequency(bench: Bench) -> float:
    """Another frequency, as far from that of the test as can be."""
    limits = bench.guard.limits
    higher = min(_APART * bench.frequency, limits.frequency_max)
    lower = max(bench.frequency / _APART, limits.frequency_min)
    return max(higher, lower, key=lambda one: abs(one - bench.frequency))


@driving("wire-protocol.md#states")
async def disarming_refuses_sets(bench: Bench) -> None:
    """It refuses sets while it falls silent by a Disarm, and goes on falling silent."""
    ramp = bench.can.ramp_max
    if not ramp:
        raise NotApplicable("it stops without ramps")
    await bench.arm()
    await bench.play(1.0)
    amplifier, falling = bench.amplifier, raised_cosine(ramp, start=bench.level, end=0.0)
    later = bench.tones(0.75)
    _, started = await bench.timed(amplifier.disarm(ramp))
    calls: list[tuple[str, Callable[[], Awaitable[object]]]] = [
        ("an Apply", lambda: amplifier.apply(bench.tones(1.0)))
    ]
    if bench.has(Feature.STAGING):
        calls += [
            ("a Stage", lambda: amplifier.stage(later)),
            ("a Commit", lambda: amplifier.commit(later.token)),
        ]
    for name, call in calls:
        await bench.refused(call(), what=f"{name} amid a Disarm")
        await asyncio.sleep(ramp / 10)
        sample = await bench.sample()
        highest = falling(sample.when.earliest - started.latest - 0.002) + bench.tolerance
        level = sample.status.levels[0]
        expect(
            level <= highest,
            f"level after {name} amid a Disarm",
            expected=f"at most {highest:.4f}",
            seen=f"{level:.4f}",
        )


@driving(_SETS)
async def no_room_changes_nothing(bench: Bench) -> None:
    """It refuses a voice too many whole: fades, staged set and watchdog go on; not at ramp 0."""
    if not bench.ramp:
        raise NotApplicable("it plays without ramps")
    if bench.can.voices > _COUNTED:
        raise NotApplicable(f"it has more than {_COUNTED} voices")
    await bench.arm()
    full = await _crowd(bench)
    await _expect_no_room(bench, bench.amplifier.apply(_tone(bench, 0.25)), full, "an Apply")
    staged = _tone(bench, 0.25)
    is_kept = bench.has(Feature.STAGING) and 1.5 * bench.ramp < 0.9 * PROTOCOL.staged_life
    if bench.has(Feature.STAGING):
        _, bench.fed = await bench.timed(bench.amplifier.stage(staged))
        staged_at = bench.fed.earliest
        await _expect_no_room(bench, bench.amplifier.commit(staged.token), full, "a Commit")
    await bench.wait(1.25 * bench.ramp)
    others = (0.5,) * (min(bench.can.channels, 2) - 1)
    await bench.expect_levels(0.5, *others, why="fades that went on after a refused set")
    if is_kept:
        await _accepted(bench, bench.amplifier.commit(staged.token), staged_at)
        await bench.wait(1.25 * bench.ramp)
        await bench.expect_levels(0.25, why="staged set, committed again after a fade")
    await _crowd(bench)
    await _accepted(bench, bench.amplifier.apply(_tone(bench, 0.75, ramp=0.0)), None)
    await bench.expect_levels(0.75, why="after ramp 0 amid fades")


async def _crowd(bench: Bench) -> Interval:
    """Sound all voices of the first channel, with the second rising; when the first began to fade.

    Of the second channel, if there is one, it is the first voice.
    """
    await bench.play(1.0)
    fades = []
    for number in range(2, bench.can.voices + 1):
        is_last = number == bench.can.voices
        fractions = (0.5,) * (min(bench.can.channels, 2) if is_last else 1)
        try:
            fades.append(await bench.apply(_tone(bench, *fractions)))
        except CommandRefused as refused:
            raise ContractViolation(
                f"voice {number} of the {bench.can.voices} that it states",
                expected="a reply",
                seen=str(refused),
            ) from None
    return fades[0]


def _tone(bench: Bench, *fractions: float, ramp: float | None = None) -> SafeCommandSet:
    """Make a set by a guard of its own, which knows of no fade and so holds nothing back."""
    lasts = bench.ramp if ramp is None else ramp
    return bench.tones(*fractions, ramp=lasts, guard=bench.guard_as(bench.can))


async def _expect_no_room(bench: Bench, call: Awaitable[object], full: Interval, name: str) -> None:
    """Require that a set is refused amid fades, and does not feed the watchdog."""
    await asyncio.sleep(_SEEN)
    try:
        await call
    except CommandRefused:
        pass
    else:
        if clock.now() > full.earliest + bench.ramp:
            raise Inconclusive(f"what precedes {name} took as long as a ramp")
        raise ContractViolation(f"{name} without room", expected="refused", seen="a reply")
    if bench.has(Feature.WATCHDOG):
        bench.expect_not_fed(await bench.sample(), by=f"{name} without room")


async def _accepted(bench: Bench, call: Awaitable[object], staged_at: float | None) -> None:
    """Require that a set is not refused; staged_at: when it was staged, at the earliest [s]."""
    try:
        _, bench.fed = await bench.timed(call)
    except CommandRefused as refused:
        if staged_at is not None and clock.now() - staged_at > 0.95 * PROTOCOL.staged_life:
            raise Inconclusive("the staged set had become too old") from None
        what = "a set at ramp 0 amid fades" if staged_at is None else "a Commit after the fades"
        raise ContractViolation(what, expected="a reply", seen=str(refused)) from None
