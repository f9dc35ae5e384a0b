"""Checks of sets, tokens and ramps."""

import asyncio
from dataclasses import replace

from drivers.command import CommandSet, DriveCommand
from drivers.conformance.bench import LEVEL_TOLERANCE, Bench, expect
from drivers.protocol.definition import PROTOCOL
from drivers.protocol.messages import AmplifierState


async def plays_nothing_disarmed(bench: Bench) -> None:
    """It plays nothing before it is armed, and plays no earlier set once armed."""
    await bench.refused(bench.amplifier.apply(bench.tones(1.0)), what="an apply while disarmed")
    status = await bench.arm()
    bench.expect_state(status, AmplifierState.OPERATION_ENABLED, after="Arm")
    expect(status.high_voltage, "high voltage after Arm is off")
    expect(status.token == 0, f"token after Arm must be 0, got {status.token}")
    expect(not any(status.levels), f"levels after Arm are {status.levels}")


async def achieved(bench: Bench) -> None:
    """It reports what it really plays: the nearest steps; token and levels read back."""
    await bench.arm()
    requested = DriveCommand(0, bench.frequency + 0.0249, bench.level * 0.987654, 12.3456)
    token = bench.amplifier.next_token()
    achieved = await bench.amplifier.apply(
        bench.guard.check(CommandSet(token, (requested,), ramp=0.0, valid_for=0.0))
    )
    expect(
        [one.channel for one in achieved.commands] == [0],
        "achieved channels differ from the requested ones",
    )
    (played,) = achieved.commands
    can = bench.can
    for what, error, step in (
        ("frequency", played.frequency - requested.frequency, can.frequency_step),
        ("level", played.level - requested.level, can.level_step),
        ("phase", (played.phase - requested.phase + 180) % 360 - 180, can.phase_step),
    ):
        expect(
            abs(error) <= step / 2 + 1e-9,
            f"{what} must be within half a step of {step:g}, got an error of {error:g}",
        )
    status = await bench.amplifier.status()
    expect(status.token == token, f"token must be {token}, got {status.token}")
    await bench.expect_levels(played.level / bench.level, why="achieved level")


async def unnamed_channels(bench: Bench) -> None:
    """It silences the channels that a set does not contain."""
    await bench.arm()
    await bench.amplifier.apply(bench.tones(1.0))
    await bench.expect_levels(1.0, why="applied set")
    await bench.amplifier.apply(bench.tones())
    await bench.expect_levels(why="set without channels")


async def all_or_nothing(bench: Bench) -> None:
    """It accepts a set whole or not at all; the playing and the staged set stay."""
    await bench.arm()
    before = bench.tones(1.0)
    await bench.amplifier.apply(before)
    staged = bench.tones(0.25)
    await bench.amplifier.stage(staged)
    larger = bench.guard_as(replace(bench.can, channels=16))
    if bench.can.channels < 16:
        beyond = bench.tones(0.5, guard=larger, first=bench.can.channels)
        await bench.refused(bench.amplifier.apply(beyond), what="a channel that does not exist")
        status = await bench.amplifier.status()
        expect(status.token == before.token, "token must not change by a refused set")
        await bench.expect_levels(1.0, why="after a refused set")
    await bench.amplifier.commit(staged.token)
    await bench.expect_levels(0.25, why="commit of a set staged before a refused one")


async def stage_and_commit(bench: Bench) -> None:
    """It changes nothing on Stage, and plays the staged set on Commit of its token only."""
    await bench.arm()
    staged = bench.tones(1.0)
    await bench.amplifier.stage(staged)
    await bench.expect_levels(why="after Stage")
    other = bench.amplifier.next_token()
    await bench.refused(bench.amplifier.commit(other), what="a token that is not staged")
    await bench.expect_levels(why="after a refused Commit")
    await bench.amplifier.commit(staged.token)
    await bench.expect_levels(1.0, why="after Commit")


async def tokens(bench: Bench) -> None:
    """It plays a token once: the same set is confirmed; another, or a late copy, is refused."""
    await bench.arm()
    skipped, first = bench.tones(0.5), bench.tones(1.0)
    achieved = await bench.amplifier.apply(first)
    expect(
        (await bench.amplifier.apply(first)).commands == achieved.commands,
        "reply to a repeated set must equal the first one",
    )
    await bench.amplifier.commit(first.token)
    other = bench.tones(0.5, token=first.token)
    await bench.refused(bench.amplifier.apply(other), what="another set with the active token")
    await bench.expect_levels(1.0, why="after a repeated token")
    await bench.amplifier.apply(bench.tones(0.25))
    staged = bench.tones(0.5)
    await bench.amplifier.stage(staged)
    await bench.refused(bench.amplifier.apply(first), what="a late copy of an earlier set")
    await bench.refused(bench.amplifier.stage(skipped), what="a token older than the active one")
    await bench.expect_levels(0.25, why="after a late copy")
    await bench.amplifier.commit(staged.token)
    await bench.expect_levels(0.5, why="commit of a set staged before a late copy")


async def staged_sets_expire(bench: Bench) -> None:
    """It forgets a staged set that is not committed within a second."""
    await bench.arm()
    staged = bench.tones(1.0)
    await bench.amplifier.stage(staged)
    await bench.wait(1.25 * PROTOCOL.staged_life)
    await bench.refused(bench.amplifier.commit(staged.token), what="the commit of an old set")
    await bench.expect_levels(why="after a refused Commit")


async def ramps(bench: Bench) -> None:
    """It follows the ramp of a set."""
    await bench.arm()
    ramp = min(0.5, bench.can.ramp_max)
    await bench.amplifier.apply(bench.tones(1.0, ramp=ramp))
    level = (await bench.levels())[0]
    expect(level < bench.level * 0.9, f"level must rise along the ramp, got {level:g} at its start")
    await bench.until(
        lambda status: abs(status.levels[0] - bench.level) <= LEVEL_TOLERANCE,
        what="end of a ramp",
        feed=True,
    )


async def cancelled_requests(bench: Bench) -> None:
    """It gives a request its own reply after one that was cancelled."""
    for _ in range(3):
        requesting = asyncio.create_task(bench.amplifier.faults())
        await asyncio.sleep(0)
        requesting.cancel()
        await asyncio.gather(requesting, return_exceptions=True)
        status = await bench.arm()
        bench.expect_state(status, AmplifierState.OPERATION_ENABLED, after="Arm")
        await bench.amplifier.disarm(0.0)
