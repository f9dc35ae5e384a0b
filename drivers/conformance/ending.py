"""Checks of how a vibration ends: stop, disarm, valid_for; and of what is latched then."""

import asyncio
from collections.abc import Awaitable, Callable
from functools import partial
from typing import TypeAlias

from drivers import clock
from drivers.conformance.bench import Bench
from drivers.conformance.cases import settle
from drivers.conformance.check import driving
from drivers.conformance.curve import expect_curve, raised_cosine, samples_until
from drivers.conformance.findings import expect
from drivers.guard.channel_state import Interval
from drivers.operation.plausibility import CYCLE
from drivers.protocol.messages import AmplifierState, Feature, Status

_STATES = "wire-protocol.md#states"
_SETS = "wire-protocol.md#sets-tokens-and-ramps"
_Silence: TypeAlias = Callable[[float], Awaitable[Status]]
_OFF = 0.01  # s; until state and high voltage follow silence


def is_silent(status: Status) -> bool:
    """Whether no channel has a level."""
    return not any(status.levels)


def _is_off(status: Status) -> bool:
    return is_silent(status) and not status.high_voltage


@driving("wire-protocol.md#stop")
async def quick_stop(bench: Bench) -> None:
    """It stops on request, and stays stopped until cleared."""
    await bench.arm()
    await bench.play(*(1.0,) * bench.can.channels)
    status = await bench.amplifier.stop(0.0)
    bench.expect_state(status, AmplifierState.QUICK_STOP_ACTIVE, after="a Stop")
    expect(not any(status.levels), "levels after a Stop", expected="0", seen=status.levels)
    await bench.refused(bench.amplifier.apply(bench.tones(1.0)), what="an Apply while stopped")
    await bench.refused(bench.arm(), what="Arm while stopped")
    status = await bench.amplifier.disarm(0.0)
    bench.expect_state(status, AmplifierState.QUICK_STOP_ACTIVE, after="Disarm while stopped")
    status = (await bench.sample()).status
    expect(
        not status.high_voltage, "high voltage while stopped and silent", expected="off", seen="on"
    )
    status = await bench.amplifier.clear()
    bench.expect_state(status, AmplifierState.SWITCH_ON_DISABLED, after="Clear")
    status = await bench.amplifier.stop(0.0)
    bench.expect_state(status, AmplifierState.QUICK_STOP_ACTIVE, after="a Stop while disarmed")


@driving("wire-protocol.md#stop")
async def stop_ramp(bench: Bench) -> None:
    """It falls silent along the ramp of a Stop, a raised cosine, then switches the voltage off."""
    await bench.arm()
    await bench.play(*(1.0,) * bench.can.channels)
    ramp = bench.ramp
    status, when = await bench.timed(bench.amplifier.stop(ramp))
    bench.expect_state(status, AmplifierState.QUICK_STOP_ACTIVE, after="a Stop")
    samples = await samples_until(bench, when.latest + 0.9 * ramp, feed=False)
    falling = raised_cosine(ramp, start=bench.level, end=0.0)
    for channel in range(bench.can.channels):
        expect_curve(
            bench, samples, falling, commit=when, lasts=ramp, channel=channel, what="of a Stop"
        )
    off = await bench.time_of(_is_off, since=when, due=ramp, what="high voltage off after a Stop")
    bench.expect_time("high voltage off after a Stop", off, low=0.0, high=ramp + _OFF)


@driving("wire-protocol.md#numbers")
async def stop_ramp_clipped(bench: Bench) -> None:
    """It clips the ramp of a Stop into its range."""
    await bench.arm()
    await bench.play(1.0)
    max_ramp = bench.can.ramp_max
    if bench.has_raw:
        request, earliest = bench.raw.stop_out_of_range(), clock.now()
        outcome = await bench.raw.send(request)
        expect(outcome in request.allowed, request.name, expected="a reply", seen=outcome)
        when = Interval(earliest, earliest + 2 * bench.exchange_time)
    else:
        _, when = await bench.timed(bench.amplifier.stop(max_ramp))
    samples = await samples_until(bench, when.latest + 1.1 * max_ramp, feed=False)
    falling = raised_cosine(max_ramp, start=bench.level, end=0.0)
    expect_curve(bench, samples, falling, commit=when, lasts=max_ramp, what="of the longest Stop")


@driving(_STATES)
async def clear_too_early(bench: Bench) -> None:
    """It clears no stop before it is silent."""
    await bench.arm()
    await bench.play(1.0)
    ramp = bench.ramp
    status, when = await bench.timed(bench.amplifier.stop(ramp))
    for share in (0.2, 0.6):
        await bench.pause_until(when.latest + share * ramp)
        cleared, sent = await bench.timed(bench.amplifier.clear(status.latch))
        if sent.latest < when.earliest + 0.9 * ramp:
            bench.expect_state(
                cleared,
                AmplifierState.QUICK_STOP_ACTIVE,
                after="Clear amid a ramp",
                is_certain=True,
            )
    falling = raised_cosine(ramp, start=bench.level, end=0.0)
    samples = await samples_until(bench, when.latest + 1.1 * ramp, feed=False)
    for sample in samples:
        highest = falling(sample.when.earliest - when.latest - 0.002) + bench.tolerance
        level = sample.status.levels[0]
        expect(
            level <= highest, "level after Clear", expected=f"{highest:.4f}", seen=f"{level:.4f}"
        )
    await bench.amplifier.clear(status.latch)
    await bench.until(
        lambda status: status.state is AmplifierState.SWITCH_ON_DISABLED, what="Clear", feed=False
    )


@driving(_STATES)
async def silence_never_later(bench: Bench) -> None:
    """It lets a further Stop or Disarm shorten the ramp to silence, never extend it."""
    amplifier, full = bench.amplifier, bench.can.ramp_max
    stop, disarm = amplifier.stop, amplifier.disarm

    async def silenced(
        first: _Silence, start: float, then: _Silence, after: float, at: float
    ) -> None:
        await bench.arm()
        await bench.play(1.0)
        _, started = await bench.timed(first(start))
        await bench.pause_until(started.latest + at * start)
        _, second = await bench.timed(then(after))
        due = min(started.latest + start, second.latest + after) - started.latest
        what = f"silence after {start:g} s, then {after:g} s"
        silent = await bench.time_of(is_silent, since=started, due=due, what=what)
        bench.expect_time(what, silent, low=0.0, high=due + CYCLE)

    for case in (
        (stop, full, stop, 0.0, 0.1),
        (stop, full / 4, stop, full, 0.1),
        (stop, full / 4, stop, full / 4, 0.15),
        (stop, full, stop, full / 8, 0.25),
        (disarm, full / 4, stop, full, 0.1),
        (disarm, full, stop, 0.0, 0.1),
        (stop, full / 4, disarm, full, 0.1),
    ):
        await settle(bench, partial(silenced, *case))


@driving("wire-protocol.md#sets-tokens-and-ramps")
async def stop_ends_fades(bench: Bench) -> None:
    """It ends a fade that a set began, along the ramp of a Stop, if that is sooner."""
    full = bench.can.ramp_max

    async def ended(set_ramp: float, stop_ramp_: float) -> None:
        await bench.arm()
        await bench.play(1.0)
        started = await bench.play(ramp=set_ramp)
        await bench.pause_until(started.latest + 0.1 * set_ramp)
        _, stopped = await bench.timed(bench.amplifier.stop(stop_ramp_))
        due = min(started.latest + set_ramp, stopped.latest + stop_ramp_) - started.latest
        what = "silence of a fading set after a Stop"
        silent = await bench.time_of(is_silent, since=started, due=due, what=what)
        bench.expect_time(what, silent, low=0.0, high=due + CYCLE)

    for ramps in ((full, full / 8), (full / 4, full)):
        await settle(bench, partial(ended, *ramps))


@driving("wire-protocol.md#disarm")
async def disarm(bench: Bench) -> None:
    """It falls silent along the ramp of Disarm, then switches the high voltage off."""
    await bench.arm()
    await bench.play(*(1.0,) * bench.can.channels)
    ramp = bench.ramp
    status, when = await bench.timed(bench.amplifier.disarm(ramp))
    bench.expect_state(status, AmplifierState.SWITCHED_ON, after="Disarm")
    samples = await samples_until(bench, when.latest + 0.8 * ramp, feed=False)
    falling = raised_cosine(ramp, start=bench.level, end=0.0)
    expect_curve(bench, samples, falling, commit=when, lasts=0.75 * ramp, what="of a Disarm")

    def is_disarmed(status: Status) -> bool:
        return status.state is AmplifierState.SWITCH_ON_DISABLED and is_silent(status)

    off = await bench.time_of(is_disarmed, since=when, due=ramp, what="disarming")
    bench.expect_time("disarming", off, low=ramp, high=ramp + _OFF)
    # Some wires report levels, high voltage and state separately: once more, all after the state.
    status = await bench.amplifier.status()
    voltage = "on" if status.high_voltage else "off"
    for what, expected, seen in (
        ("levels", (0.0,) * bench.can.channels, status.levels),
        ("high voltage", "off", voltage),
        ("watchdog_left", 0.0, status.watchdog_left),
    ):
        what = f"{what} after Disarm"
        expect(seen == expected, what, expected=expected, seen=seen, is_certain=True)
    await bench.refused(bench.amplifier.apply(bench.tones(1.0)), what="an Apply while disarmed")


@driving(_SETS)
async def valid_for(bench: Bench) -> None:
    """It ends a vibration when valid_for ends, stays armed, and keeps the staged set."""
    bench.require(Feature.VALID_FOR)
    await bench.arm()
    for lasts in (0.05, 0.3):
        ending, staged = bench.tones(1.0, valid_for=lasts), bench.tones(0.5)
        when = await bench.apply(ending)
        if bench.has(Feature.STAGING):
            await bench.amplifier.stage(staged)
        what = f"end of a vibration of {lasts:g} s"
        silent = await bench.time_of(is_silent, since=when, due=lasts, what=what, feed=True)
        bench.expect_time(what, silent, low=lasts, high=lasts + CYCLE)
        status = (await bench.sample()).status
        bench.expect_state(status, AmplifierState.OPERATION_ENABLED, after="valid_for")
        expect(status.high_voltage, "high voltage after valid_for", expected="on", seen="off")
        await bench.amplifier.apply(ending)
        await bench.expect_levels(why="ended set applied again")
        if bench.has(Feature.STAGING):
            await bench.amplifier.commit(ending.token)
            await bench.expect_levels(why="ended set committed again")
            await bench.amplifier.commit(staged.token)
            await bench.expect_levels(0.5, why="commit of a set staged before another ended")


@driving(_SETS)
async def valid_for_is_of_its_set(bench: Bench) -> None:
    """It ends a set by its own valid_for: not by that of an earlier one, not without one."""
    bench.require(Feature.VALID_FOR)
    await bench.arm()
    first = await bench.play(1.0, valid_for=0.15)
    repeated = bench.tones(0.75, valid_for=0.0)
    await bench.apply(repeated)
    await bench.pause_until(first.latest + 0.1)
    await bench.beat()
    await bench.pause_until(first.latest + 0.25)
    await bench.expect_levels(0.75, why="of a set without valid_for, after that of the one before")
    lasting = bench.tones(1.0, valid_for=0.2)
    when = await bench.apply(lasting)
    await asyncio.sleep(0.1)
    await bench.apply(lasting)  # the same again: it changes nothing
    what = "end of a vibration that was applied twice"
    silent = await bench.time_of(is_silent, since=when, due=0.2, what=what, feed=True)
    bench.expect_time(what, silent, low=0.2, high=0.2 + CYCLE)
    await bench.wait(0.6)
    await bench.play(1.0)
    await bench.wait(0.6)
    await bench.expect_levels(1.0, why="without valid_for, after 0.6 s")


@driving(_STATES)
async def arming_ends_fades(bench: Bench) -> None:
    """It fades what still plays within 5 ms when it is armed amid a Disarm."""
    await bench.arm()
    await bench.play(1.0)
    ramp = bench.can.ramp_max
    _, started = await bench.timed(bench.amplifier.disarm(ramp))
    await bench.pause_until(started.latest + 0.1 * ramp)
    status = await bench.arm()
    bench.expect_state(status, AmplifierState.OPERATION_ENABLED, after="Arm amid a Disarm")
    what = "silence after Arm amid a Disarm"
    silent = await bench.time_of(is_silent, since=bench.fed, due=0.005, what=what)
    bench.expect_time(what, Interval(0.0, silent.latest), low=0.0, high=0.005)
