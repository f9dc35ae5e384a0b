"""Checks of tokens: staged and committed once, in their order, together or not at all."""

from drivers.conformance.check import driving
from drivers.conformance.findings import expect
from drivers.conformance.material import layer
from drivers.conformance.subject import Subject
from drivers.protocol.sets import pack_layers

_PLACE = "protocol.md#sets"


@driving(_PLACE)
async def stage_and_commit(subject: Subject) -> None:
    """It plays a staged set by the commit of its token only, once, and confirms it again."""
    await subject.arm()
    await subject.play(subject.one())
    session = subject.session
    beside = layer(1, subject.tone(0, 0.25, frequency=subject.apart(1)))
    both = layer(0, subject.tone(0, 0.5), ramp=50), beside
    token = await subject.stage(*both)
    await subject.status()
    for other in (token + 1, token + 300, token ^ 0x100, 0):
        await subject.refused("BAD_TOKEN", "Commit", session, other)
    await subject.status()
    await subject.commit(token)
    await subject.follow()
    for is_now in (False, True):
        await subject.commit(token)
        (part,) = subject.parts(*both, token=token, now=is_now)
        await subject.request("Set", **part)
        await subject.status()
    (part,) = subject.parts(subject.one(), token=token)
    code = (await subject.answer("Set", **part)).code
    what, right = "set again with other contents", "confirmed, or refused with BAD_TOKEN"
    expect(code in ("", "BAD_TOKEN"), what, expected=right, seen=code)
    await subject.ping()


@driving(_PLACE)
async def repeats_change_nothing(subject: Subject) -> None:
    """It starts nothing anew by a commit or set that comes again, even if its vibration ended."""
    await subject.arm()
    one = subject.one(valid_for=300)
    token = await subject.stage(one)
    await subject.commit(token)
    (part,) = subject.parts(one, token=token)
    for pause in (0.2, 0.13):
        await subject.pause(pause)
        await subject.status()
        await subject.commit(token)
        await subject.request("Set", **part)
    await subject.status()


@driving(_PLACE)
async def tokens_wrap(subject: Subject) -> None:
    """It takes tokens that are newer by 1 to 32767 modulo 65536, and no others (RFC 1982)."""
    await subject.arm()
    await subject.play(subject.one(), token=65_530)
    for newer in (65_535, 1, 32_768, 65_535):
        subject.shown.sets.clear()
        await subject.play(layer(0, subject.tone(0, 0.5)), token=newer)
        for ahead in (32_768, 32_769, 65_535):
            older = (newer + ahead) % 0x10000
            words = [subject.session, older, 1 << 1 | 1, *pack_layers([layer(0)])]
            await subject.refused("BAD_TOKEN", "Set", *words)
        await subject.status()


@driving(_PLACE)
async def newer_sets_replace(subject: Subject) -> None:
    """It keeps the newest staged set alone, and plays what comes with *now* at once."""
    await subject.arm()
    session, half = subject.session, layer(0, subject.tone(0, 0.5))
    first = await subject.stage(layer(0, subject.tone(0, 0.25)))
    second = await subject.stage(half)
    await subject.refused("BAD_TOKEN", "Commit", session=session, token=first)
    (late,) = subject.parts(subject.one(), token=first, now=False)
    await subject.refused("BAD_TOKEN", "Set", **late)
    await subject.commit(second)
    subject.token = second
    for name in ("Set", "Silence", "Disarm"):
        staged = await subject.stage(subject.one())
        if name == "Set":
            await subject.play(half)
        elif name == "Silence":
            await subject.request(name, session=session, ramp=0)
        else:
            await subject.request(name, ramp=0)
            await subject.settle()
            await subject.arm()
        await subject.refused("BAD_TOKEN", "Commit", session=subject.session, token=staged)
        await subject.status()


@driving(_PLACE)
async def committed_together(subject: Subject) -> None:
    """It starts all layers and channels of a set at one moment."""
    await subject.arm()
    tones = [subject.tone(each, 1 / len(subject.layers)) for each in subject.channels]
    await subject.commit(
        await subject.stage(*(layer(each, *tones, ramp=subject.ramp) for each in subject.layers))
    )
    await subject.follow()
