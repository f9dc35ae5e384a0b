"""What is played, and what is not: sets, tokens, ramps."""

import asyncio
from dataclasses import replace

from drivers.command import CommandSet, DriveCommand
from drivers.conformance.bench import LEVEL_ERROR, Bench, expect
from drivers.protocol.messages import AmplifierState


async def plays_nothing_disarmed(bench: Bench) -> None:
    """It plays nothing before it is armed, and nothing of it afterwards."""
    await bench.refused(bench.amplifier.apply(bench.tones(1.0)), what="an apply while disarmed")
    status = await bench.arm()
    expect(status.state is AmplifierState.OPERATION_ENABLED, f"armed it is in {status.state.name}")
    expect(status.high_voltage, "armed its high voltage is off")
    expect(status.token == 0, f"armed it plays token {status.token}")
    expect(not any(status.levels), f"armed its levels are {status.levels}")


async def achieved(bench: Bench) -> None:
    """It says what it really plays: the nearest steps; token and levels read back."""
    await bench.arm()
    asked = DriveCommand(0, bench.frequency + 0.0049, bench.level * 0.987654, 12.3456)
    token = bench.amplifier.next_token()
    achieved = await bench.amplifier.apply(
        bench.guard.check(CommandSet(token, (asked,), ramp=0.0, valid_for=0.0))
    )
    expect([one.channel for one in achieved.commands] == [0], "not the channels that were asked")
    (played,) = achieved.commands
    can = bench.can
    for what, error, step in (
        ("frequency", played.frequency - asked.frequency, can.frequency_step),
        ("level", played.level - asked.level, can.level_step),
        ("phase", (played.phase - asked.phase + 180) % 360 - 180, can.phase_step),
    ):
        expect(abs(error) <= step / 2 + 1e-9, f"{what} is off by {error:g}, its step is {step:g}")
    status = await bench.amplifier.status()
    expect(status.token == token, f"token {status.token} is read back instead of {token}")
    await bench.expect_levels(played.level / bench.level, why="what is achieved is read back")


async def unnamed_channels(bench: Bench) -> None:
    """It silences the channels that a set does not name."""
    await bench.arm()
    await bench.amplifier.apply(bench.tones(1.0))
    await bench.expect_levels(1.0, why="a set plays")
    await bench.amplifier.apply(bench.tones())
    await bench.expect_levels(why="a set without channels silences all")


async def all_or_nothing(bench: Bench) -> None:
    """It takes a set whole or not at all; what plays and what is staged stays."""
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
        expect(status.token == before.token, "a refused set changed the token")
        await bench.expect_levels(1.0, why="after a refused set the one before plays on")
    await bench.amplifier.commit(staged.token)
    await bench.expect_levels(0.25, why="what was staged before a refused set is committed")


async def stage_and_commit(bench: Bench) -> None:
    """It moves nothing on Stage, and plays what is staged on Commit of its token only."""
    await bench.arm()
    staged = bench.tones(1.0)
    await bench.amplifier.stage(staged)
    await bench.expect_levels(why="Stage changes nothing")
    other = bench.amplifier.next_token()
    await bench.refused(bench.amplifier.commit(other), what="a token that is not staged")
    await bench.expect_levels(why="a refused Commit changes nothing")
    await bench.amplifier.commit(staged.token)
    await bench.expect_levels(1.0, why="Commit plays what is staged")


async def tokens(bench: Bench) -> None:
    """It applies a token once: repeated it is confirmed, late it is refused."""
    await bench.arm()
    first = bench.tones(1.0)
    achieved = await bench.amplifier.apply(first)
    again = bench.tones(0.5, token=first.token)
    expect(
        (await bench.amplifier.apply(again)).commands == achieved.commands,
        "a repeated token is not answered as the first time",
    )
    await bench.amplifier.commit(first.token)
    await bench.expect_levels(1.0, why="a repeated token changes nothing")
    await bench.amplifier.apply(bench.tones(0.25))
    staged = bench.tones(0.5)
    await bench.amplifier.stage(staged)
    await bench.refused(bench.amplifier.apply(first), what="a late copy of an earlier set")
    await bench.expect_levels(0.25, why="a late copy changes nothing")
    await bench.amplifier.commit(staged.token)
    await bench.expect_levels(0.5, why="a late copy does not oust what is staged")


async def ramps(bench: Bench) -> None:
    """It fades along the ramp of the set."""
    await bench.arm()
    ramp = min(0.5, bench.can.ramp_max)
    await bench.amplifier.apply(bench.tones(1.0, ramp=ramp))
    level = (await bench.levels())[0]
    expect(level < bench.level * 0.9, "after a moment of a long ramp the level is there already")
    await bench.until(
        lambda status: abs(status.levels[0] - bench.level) <= LEVEL_ERROR,
        what="the end of a ramp",
        feed=True,
    )


async def patience(bench: Bench) -> None:
    """It gives the next request its own reply after one that was cancelled."""
    for _ in range(3):
        asking = asyncio.create_task(bench.amplifier.faults())
        await asyncio.sleep(0)
        asking.cancel()
        await asyncio.gather(asking, return_exceptions=True)
        status = await bench.arm()
        expect(
            status.state is AmplifierState.OPERATION_ENABLED, f"armed it is in {status.state.name}"
        )
