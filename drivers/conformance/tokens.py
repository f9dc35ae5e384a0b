"""Checks of staging and tokens."""

import asyncio

from drivers.conformance.bench import Bench
from drivers.conformance.check import driving
from drivers.conformance.findings import expect
from drivers.protocol.definition import PROTOCOL
from drivers.protocol.messages import AmplifierState, Feature

_SETS = "wire-protocol.md#sets-tokens-and-ramps"
_HALF, _ALL = 1 << 15, (1 << 16) - 1


@driving(_SETS)
async def stage_and_commit(bench: Bench) -> None:
    """It changes nothing on Stage, and plays the staged set on Commit of its token only."""
    bench.require(Feature.STAGING)
    await bench.arm()
    staged = bench.tones(1.0)
    await bench.amplifier.stage(staged)
    await bench.expect_levels(why="after Stage")
    other = bench.amplifier.next_token()
    await bench.refused(bench.amplifier.commit(other), what="a token that is not staged")
    await bench.expect_levels(why="after a refused Commit")
    await bench.amplifier.commit(staged.token)
    await bench.expect_levels(1.0, why="after Commit")


@driving(_SETS)
async def second_stage(bench: Bench) -> None:
    """It replaces the staged set by a second Stage, and discards it with an Apply."""
    bench.require(Feature.STAGING)
    await bench.arm()
    first, second = bench.tones(1.0), bench.tones(0.5)
    await bench.amplifier.stage(first)
    await bench.amplifier.stage(second)
    await bench.refused(bench.amplifier.commit(first.token), what="a Commit of a replaced set")
    await bench.expect_levels(why="after a refused Commit")
    await bench.amplifier.commit(second.token)
    await bench.expect_levels(0.5, why="after Commit of the second")
    applied, staged = bench.tones(0.75), bench.tones(1.0)
    await bench.amplifier.stage(staged)
    await bench.apply(applied)
    commit = bench.amplifier.commit(staged.token)
    await bench.refused(commit, what="a Commit of a set staged before an Apply")
    await bench.expect_levels(0.75, why="after an Apply")


@driving(_SETS)
async def tokens(bench: Bench) -> None:
    """It plays a token once: the same set is confirmed; another, or a late copy, is refused."""
    amplifier = bench.amplifier
    await bench.arm()
    skipped, first = bench.tones(0.5), bench.tones(1.0)
    achieved = await amplifier.apply(first)
    again = await amplifier.apply(first)
    expect(
        again.commands == achieved.commands,
        "reply to a repeated set",
        expected=achieved.commands,
        seen=again.commands,
    )
    await amplifier.commit(first.token)
    other = bench.tones(0.5, token=first.token)
    await bench.refused(amplifier.apply(other), what="another set with the active token")
    slower = bench.tones(1.0, token=first.token, ramp=bench.can.ramp_max)
    await bench.refused(amplifier.apply(slower), what="the active token with another ramp")
    await bench.expect_levels(1.0, why="after a repeated token")
    await bench.play(0.25)
    await bench.refused(amplifier.apply(skipped), what="a token older than the active one")
    await bench.refused(amplifier.apply(first), what="a late copy of an earlier set")
    await bench.refused(amplifier.commit(first.token), what="a late copy of an earlier Commit")
    await bench.expect_levels(0.25, why="after a late copy")
    if not bench.has(Feature.STAGING):
        return
    staged = bench.tones(0.5)
    await amplifier.stage(staged)
    await bench.refused(amplifier.apply(first), what="a late copy of an earlier set")
    await bench.refused(amplifier.stage(skipped), what="a token older than the active one")
    await amplifier.commit(staged.token)
    await bench.expect_levels(0.5, why="commit of a set staged before a late copy")


@driving(_SETS)
async def tokens_wrap(bench: Bench) -> None:
    """It takes tokens up to half their range ahead as newer, also beyond 65535."""
    bench.require(Feature.STAGING)
    amplifier = bench.amplifier
    for active in (_ALL, _HALF, 5):
        await bench.arm()
        await bench.apply(bench.tones(1.0, token=active))
        for ahead in (_HALF, _HALF + 1, _ALL - 1):
            token = (active + ahead) % (1 << 16) or 1
            stage = amplifier.stage(bench.tones(0.5, token=token))
            await bench.refused(stage, what=f"token {token} after {active}")
        for ahead in (1, 2, _HALF - 1):
            token = (active + ahead) % (1 << 16)
            if token:
                await amplifier.stage(bench.tones(0.5, token=token))
        await bench.expect_levels(1.0, why="after Stage")
        await amplifier.disarm(0.0)
        await bench.until(
            lambda status: status.state is AmplifierState.SWITCH_ON_DISABLED,
            what="disarming",
            feed=False,
        )


@driving(_SETS)
async def staged_sets_expire(bench: Bench) -> None:
    """It forgets a staged set that is not committed within a second, and not before."""
    bench.require(Feature.STAGING)
    await bench.arm()
    life = PROTOCOL.staged_life
    for share, is_kept in ((0.9, True), (1.1, False)):
        staged = bench.tones(1.0 if is_kept else 0.5)
        _, when = await bench.timed(bench.amplifier.stage(staged))
        bench.fed = when
        await bench.wait(share * life)
        if is_kept:
            await bench.amplifier.commit(staged.token)
        else:
            await bench.refused(
                bench.amplifier.commit(staged.token),
                what="Commit of an old set",
                is_certain=bench.delayed_since(when.earliest) < (share - 1) * life / 2,
            )
        await bench.expect_levels(1.0, why="after Commit of a kept set, or of an old one")


@driving("wire-protocol.md#the-frame", "wire-modbus.md#written", "wire-can.md#orders-and-answers")
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
