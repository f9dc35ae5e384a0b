"""Checks of Stop, Disarm, Silence and Clear."""

import asyncio

from drivers.conformance.check import driving
from drivers.conformance.material import layer
from drivers.conformance.subject import Subject
from drivers.protocol.sets import LayerSet

_PLACE = "protocol.md#states"


async def _armed(subject: Subject, *sets: LayerSet) -> None:
    await subject.arm()
    for one in sets or [layer(0, *map(subject.tone, subject.channels))]:
        await subject.play(one)


@driving(_PLACE)
async def stop(subject: Subject) -> None:
    """It stops at once, latched and numbered, plays no more, and arms only once it is cleared."""
    await _armed(subject)
    staged, session = await subject.stage(layer(0, subject.tone(0, 0.5))), subject.session
    await subject.request("Stop", ramp=0)
    maximum = subject.can["watchdog_max"]
    await asyncio.sleep(0.02)
    await subject.status()
    for name, values in (
        ("Arm", {"session": session + 1, "watchdog": maximum}),
        ("Commit", {"session": session, "token": staged}),
        ("Set", subject.parts(subject.one())[0]),
        ("Silence", {"session": session, "ramp": 0}),
    ):
        await subject.refused("WRONG_STATE", name, **values)
    await subject.request("Disarm", ramp=0)
    await subject.pause(0.1)
    await subject.status()


@driving(_PLACE)
async def stop_ramps(subject: Subject) -> None:
    """It falls silent along the ramp of a Stop or Disarm, a raised cosine, then is off."""
    long = min(500, subject.can["ramp_max"])
    for name, ramps in (("Stop", (subject.ramp, long, 0xFFFF)), ("Disarm", (subject.ramp, 0xFFFF))):
        for ramp in ramps:
            await _armed(subject)
            await subject.request(name, ramp=ramp)
            if name == "Disarm":
                await subject.refused("WRONG_STATE", "Set", **subject.parts(subject.one())[0])
            await subject.follow(subject.shown.silent.latest - subject.shown.began.earliest + 0.02)
            await subject.request("Disarm", ramp=0)
            await subject.clear()


@driving(_PLACE)
async def silence_never_later(subject: Subject) -> None:
    """It is silent by the sooner of two Stops; a later one prolongs nothing, nor does a fault."""
    long, short = min(400, subject.can["ramp_max"]), 50
    for first, second in ((long, short), (short, long)):
        await _armed(subject)
        await subject.request("Stop", ramp=first)
        await subject.request("Stop", ramp=second)
        await subject.follow(0.1)
        await subject.rest()
    await _armed(subject, subject.one(), layer(0, ramp=short))
    await subject.request("Stop", ramp=long)
    await subject.follow(0.1)


@driving(_PLACE)
async def stop_ends_all(subject: Subject) -> None:
    """It ends fades, onsets, endings, waiting sets and all layers by Stop, skipping endings."""
    slow, long = subject.envelope(0.1, 1, 1, 1), subject.can["ramp_max"]
    ended = subject.one(subject.tone(ending=slow))
    onset = subject.one(subject.tone(onset=slow))
    other = subject.tone(frequency=subject.other)
    for sets in (
        [subject.one(), layer(0, ramp=long)],
        [subject.one(), layer(0, other, ramp=long)],
        [ended],
        [ended, layer(0)],
        [onset],
        [onset, layer(0, other, after=True)],
        [layer(number, subject.tone(0, 0.2)) for number in subject.layers],
    ):
        await _armed(subject, *sets)
        await subject.request("Stop", ramp=10)
        await subject.follow(0.06)
        await subject.clear()


@driving(_PLACE)
async def stops_are_numbered(subject: Subject) -> None:
    """It numbers every Stop, also of one disarmed; Clear names the last, else changes nothing."""
    for _ in range(3):
        await subject.request("Stop", ramp=0)
    latch = subject.shown.latch
    for wrong in (latch - 1, latch + 1, latch ^ 0x100):
        await subject.refused("WRONG_LATCH", "Clear", latch=wrong % 0x10000)
    await subject.status()
    await subject.clear()
    await subject.clear()
    await _armed(subject)
    await subject.clear()
    await subject.status()


@driving(_PLACE)
async def clear_too_early(subject: Subject) -> None:
    """It stays stopped by a Clear amid its fade."""
    await _armed(subject)
    ramp = subject.can["ramp_max"]
    await subject.request("Stop", ramp=ramp)
    await subject.clear()
    await subject.status()
    await asyncio.sleep(ramp / 1000 + 0.02)
    await subject.clear()
    await subject.status()


@driving("protocol.md#sets")
async def silence(subject: Subject) -> None:
    """It silences all layers along the ramp of Silence, drops what is staged, and stays armed."""
    ending = subject.envelope(0.1, 1, 1)
    await subject.arm()
    await subject.play(
        layer(0, subject.tone(0, 0.5, ending=ending)),
        layer(1, subject.tone(0, 0.4, frequency=subject.other)),
        layer(2, subject.tone(1 % len(subject.channels), 0.1)),
    )
    session, staged = subject.session, await subject.stage(subject.one())
    await subject.request("Silence", session=session, ramp=subject.ramp)
    await subject.follow(subject.ramp / 1000 + 0.05)
    await subject.refused("BAD_TOKEN", "Commit", session=session, token=staged)
    await subject.play(subject.one())
    await subject.refused("BAD_VALUE", "Silence", session, subject.can["ramp_max"] + 1)
    await subject.status()
