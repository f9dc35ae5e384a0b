"""Checks of Stop, Disarm, Silence and Clear."""

import asyncio

from drivers.conformance.check import driving
from drivers.conformance.client import When
from drivers.conformance.expected import alone, cosine
from drivers.conformance.findings import expect, expect_equal
from drivers.conformance.subject import NAMES, SLACK, Subject, flag, is_silent, layer

_PLACE = "protocol.md#states"
_SETTLING = 0.01  # s; state and high voltage, once silent
_STOPPED, _OFF, _ENABLED = "QUICK_STOP_ACTIVE", "SWITCH_ON_DISABLED", "OPERATION_ENABLED"


async def _armed(subject: Subject, *fractions: float) -> None:
    await subject.arm()
    tones = [subject.tone(*each) for each in enumerate(fractions or [1.0])]
    await subject.play(layer(0, *tones))


async def _expect_off(subject: Subject, state: str, silent_by: float, why: str) -> None:
    """Require a state without high voltage, soon after a time of silence [s]."""
    when, status = await subject.until(
        lambda each: NAMES[each["state"]] == state and not flag(each, "high_voltage"),
        f"{state} without high voltage ({why})",
    )
    is_soon = when.earliest <= silent_by + _SETTLING + SLACK
    seen = f"{1e3 * (when.earliest - silent_by):.1f} ms later"
    expect(is_soon, f"{state} after {why}", expected="10 ms after silence", seen=seen)
    expect(not any(status["levels"]), f"levels after {why}", expected="0", seen=status["levels"])


@driving(_PLACE)
async def stop(subject: Subject) -> None:
    """It stops at once, latched and numbered, plays no more, and arms only once it is cleared."""
    await _armed(subject, *[1.0] * len(subject.channels))
    staged = await subject.stage(layer(0, subject.tone(0, 0.5)))
    latch, session = subject.latch, subject.session
    status = (await subject.request("Stop", ramp=0)).values
    shown = NAMES[status["state"]], status["latch"], status["levels"], any(status["tokens"])
    expected = _STOPPED, latch % 0xFFFF + 1, [0] * len(subject.channels), False
    expect_equal(shown, expected, "state, latch, levels, tokens in the reply to Stop")
    await asyncio.sleep(0.02)
    status = (await subject.request("GetStatus")).values
    left = flag(status, "high_voltage"), status["watchdog_left"], any(status["levels"])
    expect_equal(left, (False, 0, False), "high voltage, watchdog_left, levels after Stop")
    maximum = subject.can["watchdog_max"]
    await subject.refused("WRONG_STATE", "Arm", session=session + 1, watchdog=maximum)
    await subject.refused("WRONG_STATE", "Commit", session=session, token=staged)
    (part,) = subject.parts(layer(0, subject.tone()))
    await subject.refused("WRONG_STATE", "Set", **part)
    await subject.refused("WRONG_STATE", "Silence", session=session, ramp=0)
    status = (await subject.request("Disarm", ramp=0)).values
    expect_equal(NAMES[status["state"]], _STOPPED, "state after a Disarm")
    await asyncio.sleep(0.1)
    await subject.expect_levels(why="0.1 s after Stop")


@driving(_PLACE)
async def stop_ramps(subject: Subject) -> None:
    """It falls silent along the ramp of a Stop, a raised cosine, then switches high voltage off."""
    count = len(subject.channels)
    for ramp in (subject.ramp, min(500, subject.can["ramp_max"])):
        await _armed(subject, *[1.0] * count)
        stopped = (await subject.request("Stop", ramp=ramp)).when
        curve = alone(cosine(ramp / 1000, 1, 0))
        bounds = dict.fromkeys(subject.channels, curve)
        await subject.follow(bounds, stopped, ramp / 1000, f"Stop along {ramp} ms")
        await _expect_off(subject, _STOPPED, stopped.latest + ramp / 1000, "Stop")
        await subject.request("Clear", latch=subject.latch)
    maximum = subject.can["ramp_max"] / 1000
    for name in ("Stop", "Disarm"):
        await _armed(subject)
        stopped = (await subject.request(name, ramp=0xFFFF)).when
        curve = alone(cosine(maximum, 1, 0))
        await subject.follow({0: curve}, stopped, maximum, f"{name} with a ramp above its longest")
        await subject.until(is_silent, f"silence after a {name} with a ramp above its longest")
        await subject.rest()


@driving(_PLACE)
async def silence_never_later(subject: Subject) -> None:
    """It is silent by the sooner of two Stops; a later one prolongs nothing, nor does a fault."""
    long, short = min(400, subject.can["ramp_max"]), 50
    for first, second, silent in ((long, short, short), (short, long, short)):
        await _armed(subject)
        started = (await subject.request("Stop", ramp=first)).when
        stopped = (await subject.request("Stop", ramp=second)).when
        since = stopped if second == silent else started
        await _expect_silence(subject, since, silent / 1000, f"Stops of {first} and {second} ms")
        await subject.rest()  # its fade may last, though its level is below a step
    await _armed(subject)
    started = await subject.play(layer(0, ramp=short))
    await subject.request("Stop", ramp=long)
    await _expect_silence(subject, started, short / 1000, "a Stop amid a shorter fade")


async def _expect_silence(subject: Subject, since: When, time: float, why: str) -> None:
    when, _ = await subject.until(lambda each: not any(each["levels"]), f"silence ({why})")
    # The last thousandth of a raised cosine is below a step of levels.
    earliest, latest = since.earliest + 0.9 * time - SLACK, since.latest + time + SLACK
    seen = f"{1e3 * (when.latest - since.earliest):.1f} ms"
    is_met = earliest <= when.latest and when.earliest <= latest
    expect(is_met, f"silence ({why})", expected=f"{1e3 * time:.0f} ms after it began", seen=seen)


@driving(_PLACE)
async def stop_ends_all(subject: Subject) -> None:
    """It ends fades, onsets, endings, waiting sets and all layers by Stop, skipping endings."""
    slow = subject.envelope(0.1, 1, 1, 1)
    long = subject.can["ramp_max"]
    other = subject.tone(frequency=subject.other)
    cases = {
        "amid a fade": [layer(0, subject.tone()), layer(0, ramp=long)],
        "amid a cross-fade": [layer(0, subject.tone()), layer(0, other, ramp=long)],
        "with an ending": [layer(0, subject.tone(ending=slow))],
        "amid an ending": [layer(0, subject.tone(ending=slow)), layer(0)],
        "amid an onset": [layer(0, subject.tone(onset=slow))],
        "with a set that waits": [layer(0, subject.tone(onset=slow)), layer(0, other, after=True)],
        "of all layers": [layer(number, subject.tone(0, 0.2)) for number in subject.layers],
    }
    for why, sets in cases.items():
        await subject.arm()
        for each in sets:
            await subject.play(each)
        stopped = (await subject.request("Stop", ramp=10)).when
        await _expect_silence_by(subject, stopped, 0.01, f"Stop {why}")
        await asyncio.sleep(0.05)
        await subject.expect_levels(why=f"50 ms after a Stop {why}")
        await subject.request("Clear", latch=subject.latch)


async def _expect_silence_by(subject: Subject, since: When, time: float, why: str) -> None:
    when, _ = await subject.until(lambda each: not any(each["levels"]), f"silence ({why})")
    seen = f"{1e3 * (when.earliest - since.latest):.1f} ms later"
    is_met = when.earliest <= since.latest + time + SLACK
    expect(is_met, f"silence ({why})", expected=f"within {1e3 * time:.0f} ms", seen=seen)


@driving(_PLACE)
async def stops_are_numbered(subject: Subject) -> None:
    """It numbers every Stop, also of one disarmed; Clear names the last, else changes nothing."""
    latch = subject.latch
    for count in (1, 2, 3):
        status = (await subject.request("Stop", ramp=0)).values
        shown = NAMES[status["state"]], status["latch"]
        expected = _STOPPED, (latch + count - 1) % 0xFFFF + 1
        expect_equal(shown, expected, f"state, latch after Stop {count}")
    for wrong in (subject.latch - 1, subject.latch + 1, subject.latch ^ 0x100):
        await subject.refused("WRONG_LATCH", "Clear", latch=wrong % 0x10000)
    status = (await subject.request("GetStatus")).values
    expect_equal(NAMES[status["state"]], _STOPPED, "state after Clears of other latches")
    status = (await subject.request("Clear", latch=subject.latch)).values
    expect_equal(NAMES[status["state"]], _OFF, "state after Clear")
    status = (await subject.request("Clear", latch=subject.latch)).values
    expect_equal(NAMES[status["state"]], _OFF, "state after Clear again")
    await _armed(subject)
    await subject.request("Clear", latch=subject.latch)
    await subject.expect_levels(1.0, why="after a Clear while armed")


@driving(_PLACE)
async def clear_too_early(subject: Subject) -> None:
    """It stays stopped by a Clear amid its fade."""
    await _armed(subject)
    ramp = subject.can["ramp_max"]
    await subject.request("Stop", ramp=ramp)
    early = await subject.request("Clear", latch=subject.latch)
    expect_equal(NAMES[early.values["state"]], _STOPPED, "state after a Clear amid the fade")
    status = (await subject.request("GetStatus")).values
    expect_equal(NAMES[status["state"]], _STOPPED, "state after a Clear amid the fade")
    await asyncio.sleep(ramp / 1000 + 0.02)
    await subject.request("Clear", latch=subject.latch)
    status = (await subject.request("GetStatus")).values
    expect_equal(NAMES[status["state"]], _OFF, "state after a Clear once silent")


@driving(_PLACE)
async def disarm(subject: Subject) -> None:
    """It falls silent along the ramp of a Disarm, takes no set meanwhile, and is off then."""
    await _armed(subject, *[1.0] * len(subject.channels))
    latch, ramp = subject.latch, subject.ramp
    started = await subject.request("Disarm", ramp=ramp)
    expect_equal(NAMES[started.values["state"]], "SWITCHED_ON", "state amid the fade of a Disarm")
    (part,) = subject.parts(layer(0, subject.tone()))
    await subject.refused("WRONG_STATE", "Set", **part)
    curve = alone(cosine(ramp / 1000, 1, 0))
    bounds = dict.fromkeys(subject.channels, curve)
    await subject.follow(bounds, started.when, ramp / 1000, f"Disarm along {ramp} ms")
    await _expect_off(subject, _OFF, started.when.latest + ramp / 1000, "Disarm")
    status = (await subject.request("GetStatus")).values
    shown = status["watchdog_left"], status["latch"], any(status["tokens"])
    expect_equal(shown, (0, latch, False), "watchdog_left, latch, tokens after Disarm")
    await subject.request("Disarm", ramp=0)
    status = (await subject.request("GetStatus")).values
    expect_equal(NAMES[status["state"]], _OFF, "state after Disarm again")


@driving("protocol.md#sets")
async def silence(subject: Subject) -> None:
    """It silences all layers along the ramp of Silence, drops what is staged, and stays armed."""
    slow = subject.envelope(0.1, 1, 1)
    await subject.arm()
    latch, ramp = subject.latch, subject.ramp
    await subject.play(
        layer(0, subject.tone(0, 0.5, ending=slow)),
        layer(1, subject.tone(0, 0.4, frequency=subject.other)),
        layer(2, subject.tone(1 % len(subject.channels), 0.1)),
    )
    staged = await subject.stage(layer(0, subject.tone()))
    silenced = await subject.request("Silence", session=subject.session, ramp=ramp)
    shown = NAMES[silenced.values["state"]], silenced.values["latch"]
    expect_equal(shown, (_ENABLED, latch), "state, latch after Silence")
    expect(
        not any(silenced.values["tokens"]),
        "tokens after Silence",
        expected="0",
        seen=silenced.values["tokens"],
    )
    shares = (0.9, 0.1) if len(subject.channels) > 1 else (1.0,)
    bounds = {channel: alone(cosine(ramp / 1000, share, 0)) for channel, share in enumerate(shares)}
    await subject.follow(bounds, silenced.when, ramp / 1000 + 0.05, f"Silence along {ramp} ms")
    await subject.refused("BAD_TOKEN", "Commit", session=subject.session, token=staged)
    await subject.play(layer(0, subject.tone()))
    await subject.expect_levels(1.0, why="set after Silence")
    beyond = subject.can["ramp_max"] + 1
    words = [subject.session, beyond]
    await subject.refused_words("BAD_VALUE", "Silence", words, what=f"Silence along {beyond} ms")
    await subject.expect_levels(1.0, why="after a Silence that was refused")
