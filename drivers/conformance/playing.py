"""Checks of what plays: channels, rounding, ranges."""

import math
from dataclasses import replace
from typing import Any

from drivers.command import CommandSet, DriveCommand
from drivers.conformance.bench import Bench
from drivers.conformance.check import driving
from drivers.conformance.findings import NotApplicable, expect
from drivers.guard import Guard, SafeCommandSet
from drivers.protocol.definition import PROTOCOL
from drivers.protocol.messages import Achieved, AmplifierState, Feature

_SETS = "wire-protocol.md#sets-tokens-and-ramps"
_Q = PROTOCOL.quantities


@driving("wire-protocol.md#states")
async def plays_nothing_disarmed(bench: Bench) -> None:
    """It plays nothing before it is armed, and is silent once armed."""
    amplifier = bench.amplifier
    await bench.refused(amplifier.apply(bench.tones(1.0)), what="an Apply while disarmed")
    staged = bench.tones(1.0)
    await bench.refused(amplifier.stage(staged), what="a Stage while disarmed")
    await bench.refused(amplifier.commit(staged.token), what="a Commit while disarmed")
    status = await bench.arm()
    bench.expect_state(status, AmplifierState.OPERATION_ENABLED, after="Arm")
    expect(status.high_voltage, "high voltage after Arm", expected="on", seen="off")
    expect(status.token == 0, "active_token after Arm", expected=0, seen=status.token)
    expect(not any(status.levels), "levels after Arm", expected="0", seen=status.levels)


@driving("wire-protocol.md#arm")
async def arming_forgets(bench: Bench) -> None:
    """It forgets the staged and the played set when it is armed anew."""
    await bench.arm()
    await bench.play(1.0)
    staged = bench.tones(0.5)
    if bench.has(Feature.STAGING):
        await bench.amplifier.stage(staged)
    await bench.amplifier.disarm(0.0)
    await bench.until(
        lambda status: status.state is AmplifierState.SWITCH_ON_DISABLED,
        what="disarming",
        feed=False,
    )
    status = await bench.arm()
    expect(status.token == 0, "active_token after Arm", expected=0, seen=status.token)
    await bench.expect_levels(why="after Arm")
    commit = bench.amplifier.commit(staged.token)
    await bench.refused(commit, what="a Commit of a set staged before Arm")
    await bench.expect_levels(why="after a refused Commit")


@driving(_SETS)
async def achieved(bench: Bench) -> None:
    """It reports what it really plays: the nearest steps; token and levels read back."""
    await bench.arm()
    requested = DriveCommand(0, bench.frequency + 0.0249, bench.level * 0.987654, 12.3456)
    token = bench.amplifier.next_token()
    reply = await bench.amplifier.apply(
        bench.guard.check(CommandSet(token, (requested,), ramp=0.0, valid_for=0.0))
    )
    channels = [one.channel for one in reply.commands]
    expect(channels == [0], "achieved channels", expected=[0], seen=channels)
    (played,) = reply.commands
    can = bench.can
    for what, error, step in (
        ("frequency", played.frequency - requested.frequency, can.frequency_step),
        ("level", played.level - requested.level, can.level_step),
        ("phase", (played.phase - requested.phase + 180) % 360 - 180, can.phase_step),
    ):
        expect(
            abs(error) <= step / 2 + 1e-9,
            f"achieved {what}",
            expected=f"within half a step of {step:g}",
            seen=f"an error of {error:g}",
        )
    status = await bench.amplifier.status()
    expect(status.token == token, "active_token", expected=token, seen=status.token)
    await bench.expect_levels(played.level / bench.level, why="achieved level")


@driving("wire-protocol.md#getcaps")
async def steps_as_stated(bench: Bench) -> None:
    """It rounds to the steps that it states, and reports what is rounded."""
    can = bench.can
    stated = {
        "frequency": (can.frequency_step, _Q.frequency.step, bench.frequency),
        "level": (can.level_step, _Q.level.step, bench.level / 2),
        "phase": (can.phase_step, _Q.phase.step, 10.0),
    }
    coarse = {name: one for name, one in stated.items() if one[0] > 3 * one[1]}
    if not coarse:
        raise NotApplicable("its steps are those of the wire")
    await bench.arm()
    for name, (step, finest, start) in coarse.items():
        count = min(_SCANNED, math.floor(step / finest))
        found = set()
        for number in range(count):
            command = DriveCommand(0, bench.frequency, bench.level / 2)
            value: dict[str, Any] = {name: start + number * step / count}
            command = replace(command, **value)
            token = bench.amplifier.next_token()
            requested = CommandSet(token, (command,), ramp=0.0, valid_for=0.0)
            reply = await bench.amplifier.apply(bench.guard.check(requested))
            found.add(getattr(reply.commands[0], name))
        expect(
            len(found) <= 2,
            f"values achieved of {count} requested within one step of {name}",
            expected="at most 2",
            seen=len(found),
        )


_SCANNED = 8


@driving(_SETS)
async def every_channel(bench: Bench) -> None:
    """It plays every channel: each alone, and all together at levels of their own."""
    await bench.arm()
    count = bench.can.channels
    for channel in range(count):
        await bench.apply(bench.tones(1.0, first=channel))
        await bench.expect_levels(*(0.0,) * channel, 1.0, why=f"channel {channel} alone")
    fractions = [1.0 - 0.05 * channel for channel in range(count)]
    await bench.play(*fractions)
    await bench.expect_levels(*fractions, why="all channels")
    await bench.play(*reversed(fractions))
    await bench.expect_levels(*reversed(fractions), why="all channels, in the opposite order")


@driving(_SETS)
async def achieved_of_every_channel(bench: Bench) -> None:
    """It reports the frequency and phase of each channel as its own."""
    await bench.arm()
    can = bench.can
    room = (can.frequency_max - bench.frequency) / (2 * can.channels)
    commands = tuple(
        DriveCommand(
            channel,
            bench.frequency + min(10.0, room) * channel,
            bench.level * (1.0 - 0.05 * channel),
            phase=20.0 * channel - 160.0,
        )
        for channel in range(can.channels)
    )
    token = bench.amplifier.next_token()
    requested = bench.guard.check(CommandSet(token, commands, ramp=0.0, valid_for=0.0))
    if bench.has(Feature.STAGING):
        _expect_achieved(bench, commands, await bench.amplifier.stage(requested), "Stage")
        _expect_achieved(bench, commands, await bench.amplifier.commit(token), "Commit")
    _expect_achieved(bench, commands, await bench.amplifier.apply(requested), "Apply")


def _expect_achieved(
    bench: Bench, commands: tuple[DriveCommand, ...], reply: Achieved, name: str
) -> None:
    can = bench.can
    got = {command.channel: command for command in reply.commands}
    expect(
        sorted(got) == list(range(can.channels)),
        f"channels in the reply to {name}",
        expected=list(range(can.channels)),
        seen=sorted(got),
    )
    for command in commands:
        played = got[command.channel]
        difference = (played.phase - command.phase + 180) % 360 - 180
        is_right = (
            abs(played.frequency - command.frequency) <= can.frequency_step / 2 + 0.026
            and abs(played.level - command.level) <= can.level_step / 2 + 1e-4
            and abs(difference) <= can.phase_step / 2 + 0.01
        )
        expect(
            is_right,
            f"achieved of channel {command.channel} by {name}",
            expected=command,
            seen=played,
        )


@driving(_SETS)
async def unnamed_channels(bench: Bench) -> None:
    """It silences the channels that a set does not contain."""
    await bench.arm()
    full = (1.0,) * bench.can.channels
    await bench.play(*full)
    await bench.expect_levels(*full, why="applied set")
    await bench.play(1.0)
    await bench.expect_levels(1.0, why="set of the first channel")
    await bench.play()
    await bench.expect_levels(why="set without channels")


@driving(_SETS)
async def all_or_nothing(bench: Bench) -> None:
    """It accepts a set whole or not at all; the playing and the staged set stay."""
    await bench.arm()
    before = bench.tones(1.0)
    await bench.apply(before)
    staged = bench.tones(0.25)
    if bench.has(Feature.STAGING):
        await bench.amplifier.stage(staged)
    other = bench.tones(0.5, token=before.token)
    for what, requested in [*_impossible(bench), ("the token of another", other)]:
        await bench.refused(bench.amplifier.apply(requested), what=f"a set with {what}")
        status = await bench.amplifier.status()
        expect(
            status.token == before.token,
            f"active_token after a set with {what}",
            expected=before.token,
            seen=status.token,
        )
        await bench.expect_levels(1.0, why=f"after a set with {what}")
    if bench.has(Feature.STAGING):
        await bench.amplifier.commit(staged.token)
        await bench.expect_levels(0.25, why="commit of a set staged before refused ones")


def _impossible(bench: Bench) -> list[tuple[str, SafeCommandSet]]:
    """Make sets of which one value is beyond the capabilities, as far as the wire can say it."""
    can, sets = bench.can, list[tuple[str, SafeCommandSet]]()

    def add(what: str, guard: Guard, *commands: DriveCommand, ramp: float = 0.0) -> None:
        token = bench.amplifier.next_token()
        sets.append((what, guard.check(CommandSet(token, commands, ramp=ramp, valid_for=0.0))))

    good = DriveCommand(0, bench.frequency, bench.level / 2)
    if can.channels < _Q.channel_count.maximum:
        beyond = replace(good, channel=can.channels)
        add("a channel that does not exist", bench.wider(channels=can.channels + 1), good, beyond)
    high = can.frequency_max + can.frequency_step + 0.1
    if high <= _Q.frequency.high:
        wide = bench.wider(frequency_max=_Q.frequency.high)
        add("a frequency above the highest", wide, replace(good, frequency=high))
    low = can.frequency_min - can.frequency_step - 0.1
    if low >= 10.0:
        wide = bench.wider(frequency_min=0.0)
        add("a frequency below the lowest", wide, replace(good, frequency=low))
    if can.level_max + can.level_step < 1.0:
        loud = replace(good, level=can.level_max + can.level_step)
        add("a level above the highest", bench.wider(level_max=1.0), loud)
    if can.ramp_max < _Q.ramp.high:
        slow = can.ramp_max + 0.001
        add("a ramp above the longest", bench.wider(ramp_max=_Q.ramp.high), good, ramp=slow)
    return sets


@driving("wire-protocol.md#getcaps")
async def stated_ranges(bench: Bench) -> None:
    """It accepts what is just within its ranges."""
    can = bench.can
    for watchdog in (can.watchdog_min, can.watchdog_max):
        status = await bench.arm(watchdog)
        bench.expect_state(
            status, AmplifierState.OPERATION_ENABLED, after=f"Arm with {watchdog:g} s"
        )
        await bench.amplifier.disarm(0.0)
    await bench.arm()
    await bench.amplifier.identify()
    again = bench.amplifier.capabilities
    expect(again == can, "capabilities once armed", expected=can, seen=again)
    if not bench.has(Feature.STAGING):  # nothing is played that loud
        return
    for frequency in (bench.guard.limits.frequency_min, bench.guard.limits.frequency_max):
        command = DriveCommand(can.channels - 1, frequency, bench.guard.limits.level)
        token = bench.amplifier.next_token()
        requested = CommandSet(token, (command,), ramp=can.ramp_max, valid_for=0.0)
        reply = await bench.amplifier.stage(bench.guard.check(requested))
        expect(bool(reply.commands), "staged commands", expected="one", seen="none")
