"""Checks of fades and phases, by levels read along them."""

import asyncio
import math
from dataclasses import dataclass

from drivers.conformance.bench import Bench, Sample
from drivers.conformance.check import driving
from drivers.conformance.curve import Curve, expect_curve, raised_cosine, samples_until
from drivers.conformance.ending import is_silent
from drivers.conformance.findings import (
    ContractViolation,
    Inconclusive,
    MeasuredNotApplicable,
    NotApplicable,
    expect,
)
from drivers.errors import CommandRefused
from drivers.guard import SafeCommandSet
from drivers.guard.channel_state import Interval
from drivers.operation.plausibility import CYCLE
from drivers.protocol.messages import Feature

_SETS = "wire-protocol.md#sets-tokens-and-ramps"
_COUNTED = 8  # voices that fit into a ramp, even where an exchange takes long
_LOW = 10.0  # Hz; its period is long against the time of an exchange
_CYCLE_ERROR = 0.12  # error of a phase, in turns, that still tells cases apart
_MAX_ERROR, _TRIES = 1.5 * _CYCLE_ERROR, 5


async def _followed(
    bench: Bench, curve: Curve, when: Interval, ramp: float, what: str, *, channel: int = 0
) -> None:
    """Require that a channel follows a curve along a ramp [s] from a commit, and keeps its end."""
    samples = await samples_until(bench, when.latest + 1.1 * ramp)
    expect_curve(bench, samples, curve, commit=when, lasts=ramp, channel=channel, what=what)


@driving(_SETS)
async def ramp_up(bench: Bench) -> None:
    """It raises a level along a raised cosine, in the time of the ramp, on every channel."""
    await bench.arm()
    ramp, count = bench.ramp, bench.can.channels
    when = await bench.play(*(1.0,) * count, ramp=ramp)
    samples = await samples_until(bench, when.latest + 1.1 * ramp)
    for channel in range(count):
        rising = raised_cosine(ramp, start=0.0, end=bench.level)
        expect_curve(
            bench,
            samples,
            rising,
            commit=when,
            lasts=ramp,
            channel=channel,
            what="of a rising ramp",
        )
    await bench.expect_levels(*(1.0,) * count, why="after a ramp")


@driving(_SETS)
async def ramp_down(bench: Bench) -> None:
    """It lowers levels along a raised cosine, of channels at zero and of those not named."""
    await bench.arm()
    ramp = bench.ramp
    for last in ((0.0,), ()):
        await bench.play(1.0)
        when = await bench.play(*last, ramp=ramp)
        falling = raised_cosine(ramp, start=bench.level, end=0.0)
        await _followed(bench, falling, when, ramp, "of a falling ramp")
        await bench.expect_levels(why="after a ramp to silence")


@driving(_SETS)
async def ramps_of_other_lengths(bench: Bench) -> None:
    """It changes at once without a ramp, and takes the longest ramp as it is."""
    await bench.arm()
    await bench.play(1.0)
    await bench.expect_levels(1.0, why="after ramp 0")
    await bench.play()
    await bench.expect_levels(why="after ramp 0 to silence")
    max_ramp = bench.can.ramp_max
    if not max_ramp:
        raise NotApplicable("it plays without ramps")
    when = await bench.play(1.0, ramp=max_ramp)
    rising = raised_cosine(max_ramp, start=0.0, end=bench.level)
    await _followed(bench, rising, when, max_ramp, "of the longest ramp")


@driving(_SETS)
async def interrupted_ramps(bench: Bench) -> None:
    """It continues an interrupted fade from its present gain."""
    await bench.arm()
    ramp = bench.ramp
    started = await bench.play(1.0, ramp=ramp)
    await bench.pause_until(started.latest + ramp / 2)
    when = await bench.play(ramp=ramp)
    # Its gain at the interruption is known as well as both times are.
    shares = [
        (1 - math.cos(math.pi * min(max(share / ramp, 0.0), 1.0))) / 2
        for share in (when.earliest - started.latest - 0.002, when.latest - started.earliest)
    ]
    low, high = (raised_cosine(ramp, start=bench.level * share, end=0.0) for share in shares)
    for sample in await samples_until(bench, when.latest + 1.1 * ramp):
        level = sample.status.levels[0]
        least = low(sample.when.latest - when.earliest) - bench.tolerance
        greatest = high(sample.when.earliest - when.latest - 0.002) + bench.tolerance
        expect(
            least <= level <= greatest,
            "level of a rise that was interrupted by silence",
            expected=f"{max(least, 0):.4f} to {greatest:.4f}",
            seen=f"{level:.4f}",
        )
    await bench.expect_levels(why="after an interrupted ramp")


@driving(_SETS)
async def earlier_ends_stay(bench: Bench) -> None:
    """It keeps the end of a fade to silence that ends sooner than the ramp of the next set."""
    await bench.arm()
    short, long = bench.ramp / 2, min(2 * bench.ramp, bench.can.ramp_max)
    await bench.play(1.0)
    started = await bench.play(ramp=short)
    await bench.pause_until(started.latest + short / 4)
    reached = (await bench.levels())[0]
    await bench.play(ramp=long)
    for sample in await samples_until(bench, started.latest + 0.9 * short):
        level = sample.status.levels[0]
        expect(
            level <= reached + bench.tolerance,
            "level of a fade before a longer one",
            expected=f"at most {reached:.4f}",
            seen=f"{level:.4f}",
        )
    what = "silence of a fade before a longer one"
    silent = await bench.time_of(is_silent, since=started, due=short, what=what)
    bench.expect_time(what, silent, low=0.0, high=short + CYCLE)


@driving(_SETS)
async def voices(bench: Bench) -> None:
    """It sounds as many voices of a channel as it states, and refuses one more until one ends.

    Of many only the first are counted.
    """
    if not bench.ramp:
        raise NotApplicable("it plays without ramps")
    await bench.arm()
    count = min(bench.can.voices, _COUNTED)
    token, fading_from = await _fill(bench, count)
    if bench.can.voices == count:
        one_more = bench.amplifier.apply(_tone(bench, 0.25))
        try:
            _, when = await bench.timed(one_more)
        except CommandRefused:
            pass
        else:
            if when.latest > fading_from.earliest + bench.ramp:
                raise Inconclusive(f"{count} sets took as long as a ramp")
            what = f"a voice beyond the {count} that it states"
            raise ContractViolation(what, expected="refused", seen="a reply")
    status = await bench.amplifier.status()
    what = "active_token of the last voice that it has room for"
    expect(status.token == token, what, expected=token, seen=status.token)
    await bench.wait(1.25 * bench.ramp)
    await bench.expect_levels(0.5, why="fade that went on after others")
    await bench.amplifier.apply(_tone(bench, 0.25))
    await bench.wait(1.25 * bench.ramp)
    await bench.expect_levels(0.25, why="set after the end of a fade")


async def _fill(bench: Bench, count: int) -> tuple[int, Interval]:
    """Begin so many voices; returns the token of the last, and when the first began to fade."""
    await bench.play(1.0)
    fades = []
    for number in range(2, count + 1):
        requested = _tone(bench, 0.5)
        try:
            _, when = await bench.timed(bench.amplifier.apply(requested))
        except CommandRefused as refused:
            raise ContractViolation(
                f"voice {number} of the {bench.can.voices} that it states",
                expected="a reply",
                seen=str(refused),
            ) from None
        fades.append(when)
    return requested.token, fades[0]


def _tone(bench: Bench, fraction: float) -> SafeCommandSet:
    """Make a set by a guard of its own, which knows of no fade and so holds nothing back."""
    return bench.tones(fraction, ramp=bench.ramp, guard=bench.guard_as(bench.can))


@dataclass(frozen=True)
class _FollowingTone:
    """A tone that follows one of its frequency and phase 0 after a part of a turn.

    amid: the level amid the ramp between them, relative to that before.
    """

    name: str
    cycles: float
    phase: float
    keep_phase: bool
    amid: float


_TONES = (
    _FollowingTone("half a turn later", 0.5, 0.0, False, 0.0),
    _FollowingTone("half a turn later, its phase kept", 0.5, 0.0, True, 1.0),
    _FollowingTone("of the opposite phase, kept", 0.5, 180.0, True, 0.0),
    _FollowingTone("of 90 degrees, a quarter of a turn later", 0.25, 90.0, False, 1.0),
)


@driving(_SETS)
async def phases(bench: Bench) -> None:
    """It counts phases from the commit, or with keep phase from the tone that plays."""
    bench.require(Feature.PHASE)
    frequency = max(_LOW, bench.can.frequency_min)
    if 2 * await bench.fastest_exchange() * frequency > _CYCLE_ERROR:
        raise MeasuredNotApplicable(
            "the wire is too slow to tell phases apart at its lowest frequency"
        )
    found = [await _well_timed(bench, case, frequency) for case in _TONES]
    for case, (_, error) in zip(_TONES, found, strict=True):
        if error > _MAX_ERROR:
            raise Inconclusive(f"the time of a tone {case.name} is known to {error:.2f} turns")
    if all(level > 0.9 * bench.level for level, _ in found):
        # However late this program was: at these times one of them is silent where they do.
        raise NotApplicable("its levels do not show that tones of one frequency interfere")
    for case, (level, error) in zip(_TONES, found, strict=True):
        allowed = bench.level * (math.pi * error + 0.02) + bench.tolerance
        expect(
            abs(level - case.amid * bench.level) <= allowed,
            f"level amid a ramp to a tone {case.name}",
            expected=f"{case.amid * bench.level:.3f} within {allowed:.3f}",
            seen=f"{level:.4f}",
        )


async def _well_timed(bench: Bench, case: _FollowingTone, frequency: float) -> tuple[float, float]:
    """Return the level amid the ramp to a tone, as soon as an attempt was not delayed."""
    for _ in range(_TRIES):
        level, error = await _level_after(bench, case, frequency)
        if error <= _MAX_ERROR:
            break
    return level, error


async def _level_after(bench: Bench, case: _FollowingTone, frequency: float) -> tuple[float, float]:
    """Return the level amid the ramp to a tone, and the error of its time, in turns or ramps."""
    await bench.arm()
    first = await bench.apply(bench.tones(1.0, frequency=frequency))
    # Whole turns before, so that the pause is longer than an exchange.
    requested = first.earliest + (math.ceil(0.02 * frequency) + case.cycles) / frequency
    await bench.pause_until(requested)
    second = await bench.apply(
        bench.tones(
            1.0,
            frequency=frequency,
            phase=case.phase,
            keep_phase=case.keep_phase,
            ramp=bench.ramp,
        )
    )
    level, missed = await _level_amid(bench, second, bench.ramp)
    await bench.amplifier.disarm(0.0)
    await asyncio.sleep(0.01)
    delays = (second.earliest - first.latest, second.latest - first.earliest)
    turns = [one * frequency - case.cycles for one in delays]
    error = max(abs(one - round(one)) for one in turns)
    # Half a ramp turns opposite gains as half a turn does phases.
    return level, missed + (0.0 if case.keep_phase else error)


async def _level_amid(bench: Bench, when: Interval, ramp: float) -> tuple[float, float]:
    """Read the level nearest to the middle of a ramp [s]; how far off it may be, in ramps."""
    middle = (when.earliest + when.latest + ramp) / 2
    await bench.pause_until(middle - 0.01)
    samples = await samples_until(bench, middle + 0.01 + bench.exchange_time, feed=False)

    def missed(sample: Sample) -> float:
        early = when.latest + ramp / 2 - sample.when.earliest
        return max(early, sample.when.latest - when.earliest - ramp / 2) / ramp

    nearest = min(samples or [await bench.sample()], key=missed)
    return nearest.status.levels[0], missed(nearest)


@driving(_SETS)
async def ramps_of_valid_for(bench: Bench) -> None:
    """It ends a vibration after valid_for along the ramp of its set, and stays armed."""
    bench.require(Feature.VALID_FOR)
    await bench.arm()
    ramp, lasts = bench.ramp / 2, 1.5 * bench.ramp
    when = await bench.play(1.0, ramp=ramp, valid_for=lasts)
    rising = raised_cosine(ramp, start=0.0, end=bench.level)
    falling = raised_cosine(ramp, start=bench.level, end=0.0).after(lasts)
    both = Curve(
        lambda time: min(rising(time), falling(time)), (*rising.breakpoints, *falling.breakpoints)
    )
    samples = await samples_until(bench, when.latest + lasts + 1.2 * ramp)
    expect_curve(
        bench, samples, both, commit=when, lasts=lasts + ramp, what="of a set with valid_for"
    )
