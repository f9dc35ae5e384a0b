"""Checks of frames that no host should send: damaged, malformed, for others."""

import asyncio
from collections.abc import Sequence

from drivers import clock
from drivers.amplifier import WATCHDOG
from drivers.conformance.bench import Bench
from drivers.conformance.check import driving
from drivers.conformance.findings import NotApplicable, expect
from drivers.conformance.raw.line import RawRequest
from drivers.conformance.watchdog import expect_trip
from drivers.protocol.messages import AmplifierState, Apply, Commit, Feature, Ping, Stage, Stop

_FRAME = (
    "wire-protocol.md#the-frame",
    "wire-modbus.md#exceptions",
    "wire-can.md#orders-and-answers",
)
_BROADCAST = (
    "wire-protocol.md#the-frame",
    "wire-modbus.md#messages",
    "wire-can.md#orders-and-answers",
)


async def _armed(bench: Bench, watchdog: float) -> tuple[Ping, Apply]:
    """Arm and play; returns valid requests, of which only the second would change what plays."""
    await bench.arm(watchdog)
    await bench.play(1.0)
    session = bench.amplifier.session
    return Ping(session), Apply(bench.tones(0.5), session)


async def _expect_ignored(bench: Bench, requests: Sequence[RawRequest]) -> None:
    """Require the outcome of each request, and that it neither plays nor feeds the watchdog."""
    for request in requests:
        await bench.beat()
        await asyncio.sleep(0.01)
        outcome = await bench.raw.send(request)
        sample = await bench.sample()
        allowed = " or ".join(sorted(request.allowed))
        expect(outcome in request.allowed, request.name, expected=allowed, seen=outcome)
        await bench.expect_levels(1.0, why=f"after {request.name}")
        bench.expect_not_fed(sample, by=request.name)


@driving(*_FRAME)
async def invalid_frames(bench: Bench) -> None:
    """It discards damaged frames and those for others, and refuses malformed requests."""
    raw = bench.raw
    ping, apply = await _armed(bench, bench.can.watchdog_max)
    await _expect_ignored(bench, raw.invalid(ping, apply))


@driving("wire-protocol.md#watchdog", "wire-modbus.md#exceptions")
async def invalid_frames_do_not_feed(bench: Bench) -> None:
    """It trips its watchdog in time amid frames that it discards or refuses."""
    bench.require(Feature.WATCHDOG)
    raw = bench.raw
    ping, apply = await _armed(bench, WATCHDOG)
    for request in [*raw.invalid(ping, apply), *raw.broadcasts(ping, apply)]:
        if bench.has_passed(0.75 * bench.watchdog):
            await bench.rest()
            ping, apply = await _armed(bench, WATCHDOG)
        await raw.send_only(request)
        last = request
    await expect_trip(
        bench, why=f"amid frames that do not feed it, the last of which was {last.name}"
    )


@driving(*_FRAME)
async def tolerated_frames(bench: Bench) -> None:
    """It understands a valid request behind noise or half a frame."""
    raw = bench.raw
    ping, _ = await _armed(bench, bench.can.watchdog_max)
    for request in raw.tolerated(ping):
        outcome = await raw.send(request)
        expected = " or ".join(sorted(request.allowed))
        expect(outcome in request.allowed, request.name, expected=expected, seen=outcome)
    await bench.expect_levels(1.0, why="after unusual frames")


@driving("wire-can.md#orders-and-answers")
async def frames_in_any_order(bench: Bench) -> None:
    """It takes the frames of a set in any order, and nothing of it applies before the last."""
    bench.require(Feature.STAGING)
    staged = bench.tones(*(0.5,) * bench.can.channels)
    requests = bench.raw.in_any_order(Stage(staged))
    if not requests:
        raise NotApplicable("a set is one frame on this wire")
    await bench.arm()
    for request in requests:
        outcome = await bench.raw.send(request)
        expect(outcome in request.allowed, request.name, expected="a reply", seen=outcome)
        await bench.expect_levels(why=f"after {request.name}, staged")
    await bench.amplifier.commit(staged.token)
    await bench.expect_levels(*(0.5,) * bench.can.channels, why="after its Commit")


@driving(*_BROADCAST)
async def broadcasts(bench: Bench) -> None:
    """It carries out a broadcast Commit or Stop without a reply, and discards all others."""
    raw = bench.raw
    bench.require(Feature.BROADCAST)
    ping, apply = await _armed(bench, bench.can.watchdog_max)
    await _expect_ignored(bench, raw.broadcasts(ping, apply))
    await _expect_commit(bench)
    latch = (await bench.sample()).status.latch
    stop = raw.carried_out(Stop(0.0))
    outcome = await raw.send(stop)
    expect(outcome in stop.allowed, stop.name, expected="no reply", seen=outcome)
    status = (await bench.sample()).status
    bench.expect_state(status, AmplifierState.QUICK_STOP_ACTIVE, after=stop.name)
    expect(not any(status.levels), f"levels after {stop.name}", expected="0", seen=status.levels)
    following = latch % 255 + 1
    seen = status.latch
    expect(seen == following, f"latch after {stop.name}", expected=following, seen=seen)


async def _expect_commit(bench: Bench) -> None:
    """Require that a broadcast Commit plays the staged set of its token, and feeds the watchdog."""
    if not bench.has(Feature.STAGING):
        return
    raw = bench.raw
    staged = bench.tones(0.75)
    await bench.amplifier.stage(staged)
    session = bench.amplifier.session
    if bench.amplifier.carries_sessions:
        await raw.send(raw.carried_out(Commit(staged.token, session % 65535 + 1)))
        await bench.expect_levels(1.0, why="after a broadcast Commit of another session")
    await asyncio.sleep(0.05)
    commit = raw.carried_out(Commit(staged.token, session))
    sent_at = clock.now()
    outcome = await raw.send(commit)
    expect(outcome in commit.allowed, commit.name, expected="no reply", seen=outcome)
    sample = await bench.sample()
    token = sample.status.token
    expect(
        token == staged.token,
        f"active_token after {commit.name}",
        expected=staged.token,
        seen=token,
    )
    await bench.expect_levels(0.75, why=f"after {commit.name}")
    lowest = bench.watchdog - (sample.when.latest - sent_at) - 0.002
    left = sample.status.watchdog_left
    expect(
        left >= lowest, f"watchdog_left after {commit.name}", expected=f"{lowest:.3f} s", seen=left
    )
    await bench.beat()
    await bench.amplifier.stage(bench.tones(0.5))
    other = raw.carried_out(Commit(bench.amplifier.next_token(), session))
    await raw.send(other)
    await bench.expect_levels(0.75, why="after a broadcast Commit of another token")
