"""Checks of tokens: staged and committed once, in their order, together or not at all."""

import asyncio

from drivers.conformance.check import driving
from drivers.conformance.expected import alone, cosine
from drivers.conformance.findings import expect, expect_equal
from drivers.conformance.subject import Subject, layer
from drivers.protocol.records import Values
from drivers.protocol.sets import pack_layers

_PLACE = "protocol.md#sets"


@driving(_PLACE)
async def stage_and_commit(subject: Subject) -> None:
    """It plays a staged set by the commit of its token only, once, and confirms it again."""
    await subject.arm()
    await subject.play(layer(0, subject.tone()))
    session = subject.session
    beside = subject.tone(0, 0.25, frequency=subject.apart(1))
    token = await subject.stage(layer(0, subject.tone(0, 0.5), ramp=50), layer(1, beside))
    await subject.expect_levels(1.0, why="after a set was staged")
    for other in (token + 1, token + 300, token ^ 0x100):
        await subject.refused("BAD_TOKEN", "Commit", session=session, token=other)
    await subject.refused_words("BAD_TOKEN", "Commit", [session, 0], what="Commit of token 0")
    await subject.expect_levels(1.0, why="after commits of other tokens")
    committed = await subject.commit(token)
    shown = committed["token"], committed.values["tokens"][:2]
    expect_equal(shown, (token, [token, token]), "token, tokens of layers after Commit")
    await asyncio.sleep(0.1)
    await subject.expect_levels(0.75, why="after the commit")
    for _ in range(2):
        await subject.commit(token)
        await subject.expect_levels(0.75, why="after the commit came again")
    again = layer(0, subject.tone(0, 0.5), ramp=50), layer(1, beside)
    for now in (False, True):
        (part,) = subject.parts(*again, token=token, now=now)
        taken = await subject.request("Set", **part)
        expect_equal((taken["token"], taken["played"]), (token, 1), "token, played of a set again")
    await subject.expect_levels(0.75, why="after the set came again")
    (part,) = subject.parts(layer(0, subject.tone()), token=token)
    answer = await subject.answer("Set", part)
    is_right = answer.code in ("", "BAD_TOKEN")
    what, right = "set again with other contents", "confirmed, or refused with BAD_TOKEN"
    expect(is_right, what, expected=right, seen=answer.code)
    await subject.expect_levels(0.75, why="after its token came again with other contents")


@driving(_PLACE)
async def repeats_change_nothing(subject: Subject) -> None:
    """It starts nothing anew by a commit or set that comes again, even if its vibration ended."""
    await subject.arm()
    lasting = 300
    token = await subject.stage(layer(0, subject.tone(), valid_for=lasting))
    started = (await subject.commit(token)).when
    await subject.pause_until(started.latest + 0.2)
    await subject.commit(token)
    (part,) = subject.parts(layer(0, subject.tone(), valid_for=lasting), token=token)
    await subject.request("Set", **part)
    await subject.pause_until(started.latest + 0.33)
    status = await subject.expect_levels(why="after valid_for, its commit came again meanwhile")
    expect_equal(status["tokens"][0], 0, "token of a layer that has ended")
    await subject.commit(token)
    await subject.request("Set", **part)
    status = await subject.expect_levels(why="commit again of what has ended")
    expect_equal((status["token"], status["tokens"][0]), (token, 0), "token, that of the layer")


@driving(_PLACE)
async def tokens_wrap(subject: Subject) -> None:
    """It takes tokens that are newer by 1 to 32767 modulo 65536, and no others (RFC 1982)."""
    await subject.arm()
    await subject.play(layer(0, subject.tone()), token=65_530)
    for newer in (65_535, 1, 32_768, 65_535):
        await subject.play(layer(0, subject.tone(0, 0.5)), token=newer)
        for ahead in (32_768, 32_769, 65_535):
            older = (newer + ahead) % 0x10000
            words = [subject.session, older, 1 << 1 | 1, *pack_layers([layer(0)])]
            await subject.refused_words(
                "BAD_TOKEN", "Set", words, what=f"set {older} after {newer}"
            )
        status = await subject.expect_levels(0.5, why=f"set {newer}")
        expect_equal(status["token"], newer, "token")


@driving(_PLACE)
async def newer_sets_replace(subject: Subject) -> None:
    """It keeps the newest staged set alone, and plays what comes with *now* at once."""
    await subject.arm()
    session = subject.session
    first = await subject.stage(layer(0, subject.tone(0, 0.25)))
    second = await subject.stage(layer(0, subject.tone(0, 0.5)))
    await subject.refused("BAD_TOKEN", "Commit", session=session, token=first)
    (late,) = subject.parts(layer(0, subject.tone()), token=first, now=False)
    await subject.refused("BAD_TOKEN", "Set", **late)
    await subject.commit(second)
    await subject.expect_levels(0.5, why="the newer of two staged sets")
    staged = await subject.stage(layer(0, subject.tone(0, 0.25)))
    await subject.play(layer(0, subject.tone(0, 0.75)))
    await subject.expect_levels(0.75, why="set that plays at once")
    await subject.refused("BAD_TOKEN", "Commit", session=session, token=staged)
    for name in ("Silence", "Arm"):
        staged = await subject.stage(layer(0, subject.tone()))
        if name == "Arm":
            await subject.request("Disarm", ramp=0)
            await asyncio.sleep(0.02)
            await subject.arm()
        else:
            await subject.request(name, session=session, ramp=0)
        commit: Values = {"session": subject.session, "token": staged}
        await subject.refused("BAD_TOKEN", "Commit", **commit)
    await subject.expect_levels(why="sets that were dropped")


@driving(_PLACE)
async def committed_together(subject: Subject) -> None:
    """It starts all layers and channels of a set at one moment."""
    await subject.arm()
    share, ramp = 1 / len(subject.layers), subject.ramp
    token = await subject.stage(
        *(
            layer(number, *(subject.tone(each, share) for each in subject.channels), ramp=ramp)
            for number in subject.layers
        )
    )
    started = await subject.commit(token)
    expect_equal(started.values["tokens"], [token] * len(subject.layers), "tokens after Commit")
    bounds = dict.fromkeys(subject.channels, alone(cosine(ramp / 1000, 0, 1)))
    await subject.follow(bounds, started.when, ramp / 1000 + 0.02, "set of all layers")
