"""Checks of the parts of a set: in any order, as long as can be, and for a second at most."""

import asyncio

from drivers.conformance.check import driving
from drivers.conformance.findings import Late, expect, expect_equal
from drivers.conformance.subject import SLACK, Subject, layer
from drivers.protocol.records import Values
from drivers.protocol.sets import LayerSet, pack_layers
from drivers.protocol.table import MAX_WORDS

_PLACE = "protocol.md#sets"
_LIFE = 1.0  # s; from the first part of a set to its commit
_HEAD = 3  # words of a Set before its stream
_LAYER_HEAD, _SHAPED = 3, 8  # words of a layer, of a command with two empty envelopes
_MAX_TRIED = 2000  # words of a set: more take a slow wire longer than a set lives


def long_set(subject: Subject) -> list[LayerSet]:
    """Make a set of several parts, as far as the amplifier takes it."""
    count = min(subject.can["knots"], 32)
    layers: list[LayerSet] = []
    for number in subject.layers:
        for share in range(count, 0, -1):
            shape = subject.envelope(0.001, *[0.1 + 0j] * share)
            tones = [
                subject.tone(each, 0.1, onset=shape, ending=shape) for each in subject.channels
            ]
            longer = [*layers, layer(number, *tones)]
            if len(pack_layers(longer)) <= min(subject.can["set_words"], 600):
                layers = longer
                break
    return layers


@driving(_PLACE)
async def parts_of_sets(subject: Subject) -> None:
    """It takes parts in any order and again, says which is missing, and plays a whole set alone."""
    await subject.arm()
    await subject.play(layer(0, subject.tone()))
    made = long_set(subject)
    levels = [0.1 * len(made)] * len(subject.channels)
    for now in (False, True):
        parts = subject.parts(*made, now=now)
        count = len(parts)
        expect(count > 1, "parts of a long set", expected="two or more", seen=count)
        order = [*range(count - 1, 0, -1), count - 1, 0]
        for index in order:
            taken = await subject.request("Set", **parts[index])
            is_whole = index == 0
            shown = taken["token"], taken["staged"], taken["played"], taken["missing"]
            expected = subject.token, is_whole and not now, is_whole and now, 0
            expect_equal(shown, expected, f"token, staged, played, missing after part {index}")
            if not is_whole:
                commit: Values = {"session": subject.session, "token": subject.token}
                await subject.refused("INCOMPLETE", "Commit", **commit)
        if not now:
            await subject.expect_levels(1.0, why="set that is staged")
            again = await subject.request("Set", **parts[-1])
            expect_equal((again["staged"], again["missing"]), (1, 0), "staged after a part again")
            await subject.commit(subject.token)
        await asyncio.sleep(0.05)
        await subject.expect_levels(*levels, why=f"set of {count} parts")
        await subject.play(layer(0, subject.tone()), *(layer(n) for n in subject.layers[1:]))
        await asyncio.sleep(0.05)
    parts = subject.parts(*made, now=False)
    taken = await subject.request("Set", **parts[0])
    expect_equal((taken["staged"], taken["missing"]), (0, 1), "staged, missing after part 0")
    await _wrong_parts(subject, parts)


async def _wrong_parts(subject: Subject, parts: list[Values]) -> None:
    """Send what fits no set under way, which changes nothing, then complete it."""
    count = len(parts)
    await subject.refused("BAD_VALUE", "Set", **{**parts[1], "index": count})
    await subject.refused("BAD_VALUE", "Set", **{**parts[1], "parts": count + 1})
    await subject.refused("BAD_TOKEN", "Set", **{**parts[1], "token": subject.token - 2})
    for part in parts[1:]:
        taken = await subject.request("Set", **part)
    expect_equal(taken["staged"], 1, "staged after the other parts")
    newer = subject.parts(*long_set(subject), now=False)
    taken = await subject.request("Set", **newer[0])
    expect_equal((taken["staged"], taken["missing"]), (0, 1), "staged, missing of a newer set")
    older: Values = {"session": subject.session, "token": subject.token - 1}
    await subject.refused("BAD_TOKEN", "Commit", **older)
    await subject.refused("BAD_TOKEN", "Set", **parts[0])
    for part in newer[1:]:
        await subject.request("Set", **part)
    await subject.commit(subject.token)


@driving(_PLACE)
async def max_set(subject: Subject) -> None:
    """It takes a set of as many words as it states, and refuses a longer one."""
    await subject.arm()
    room = min(subject.can["set_words"], _MAX_TRIED)
    layers = _layers_of(subject, room)
    stream = pack_layers(layers)
    await _send(subject, stream, "", f"a set of {len(stream)} words")
    await subject.commit(subject.token)
    if len(stream) == room:
        shown = (await subject.request("GetStatus")).values["tokens"][: len(layers)]
        expect_equal(shown, [subject.token] * len(layers), "tokens of the longest set")
    longer = pack_layers(_layers_of(subject, room + 2))
    if len(longer) > subject.can["set_words"]:
        await _send(subject, longer, "BAD_LENGTH", f"a set of {len(longer)} words")


def _layers_of(subject: Subject, room: int) -> list[LayerSet]:
    """Make a set of this many words, or of as many as there can be."""
    channels, max_knots = len(subject.channels), subject.can["knots"]
    # All but the heads of layers has an even number of words.
    counts = [each for each in range(1, len(subject.layers) + 1) if each % 2 == room % 2]
    bare = _LAYER_HEAD + _SHAPED * channels
    count = next(
        (each for each in counts if each * (bare + 4 * channels * max_knots) >= room), counts[-1]
    )
    left = max(room - count * bare, 0) // 2  # knots
    layers = []
    for number in range(count):
        tones = []
        for channel in subject.channels:
            shapes = []
            for _ in range(2):
                knots = min(left, max_knots)
                left -= knots
                shapes.append(subject.envelope(0.001, *[0.1 + 0j] * knots))
            tones.append(subject.tone(channel, 0.1, onset=shapes[0], ending=shapes[1]))
        layers.append(layer(number, *tones))
    return layers


async def _send(subject: Subject, stream: list[int], code: str, what: str) -> None:
    token, size = subject.next_token(), MAX_WORDS - _HEAD
    pieces = [stream[at : at + size] for at in range(0, len(stream), size)]
    for index, piece in enumerate(pieces):
        head = [subject.session, token, index << 8 | len(pieces) << 1]
        answer = await subject.answer_to("Set", [*head, *piece])
        if answer.code and index < len(pieces) - 1:
            expect_equal(answer.code, code, f"refusal of {what}")
            return
    expect_equal(answer.code, code, f"refusal of {what}")


@driving(_PLACE)
async def sets_expire(subject: Subject) -> None:
    """It discards a set that is not committed, or not complete, 1 s after its first part."""
    await subject.arm()
    for at, is_kept in ((0.9, True), (1.1, False)):
        began = (await subject.request("Ping", session=subject.session)).when.latest
        token = await subject.stage(layer(0, subject.tone()))
        staged = (await subject.request("Ping", session=subject.session)).when.earliest
        await subject.pause_until((began if is_kept else staged) + at)
        answer = await subject.answer("Commit", {"session": subject.session, "token": token})
        late = answer.when.latest - began >= _LIFE - SLACK
        if is_kept and late:
            raise Late("a set was committed too late")
        code = "" if is_kept else "BAD_TOKEN"
        expect_equal(answer.code, code, f"refusal of a Commit {at:g} s after its set was staged")
    parts = subject.parts(*long_set(subject), now=False)
    await subject.request("Set", **parts[-1])
    started = (await subject.request("Ping", session=subject.session)).when.earliest
    await subject.pause_until(started + 0.6)
    for part in parts[1:-1]:
        await subject.request("Set", **part)
    await subject.pause_until(started + 1.1)
    taken = await subject.request("Set", **parts[0])
    shown = taken["staged"], taken["missing"]
    expect_equal(shown, (0, 1), "staged, missing of a set whose first part came 1.1 s before")
