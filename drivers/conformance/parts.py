"""Checks of the parts of a set: in any order, as long as can be, and for a second at most."""

from drivers import clock
from drivers.conformance.check import driving
from drivers.conformance.findings import Late, expect, expect_equal
from drivers.conformance.material import Material, layer
from drivers.conformance.subject import Subject
from drivers.protocol.records import Values
from drivers.protocol.sets import LayerSet, pack_layers
from drivers.protocol.table import STAGED_LIFE

_PLACE = "protocol.md#sets"
_LAYER_HEAD, _SHAPED = 3, 8  # words of a layer, of a command with two empty envelopes
_MAX_TRIED = 2000  # words of a set: more take a slow wire longer than a set lives
_LONG = 600  # words of a set of several parts


def set_of(material: Material, room: int) -> list[LayerSet]:
    """Make a set of this many words, or of as many as there can be."""
    channels, max_knots = len(material.channels), material.can["knots"]
    # All but the heads of layers has an even number of words.
    counts = [each for each in range(1, len(material.layers) + 1) if each % 2 == room % 2]
    bare = _LAYER_HEAD + _SHAPED * channels
    full = bare + 4 * channels * max_knots
    count = next((each for each in counts if each * full >= room), counts[-1])
    left = max(room - count * bare, 0) // 2  # knots
    layers = []
    for number in range(count):
        tones = []
        for channel in material.channels:
            knots = [min(left, max_knots), min(max(left - max_knots, 0), max_knots)]
            left -= sum(knots)
            onset, ending = (material.envelope(0.001, *[0.1 + 0j] * each) for each in knots)
            tones.append(material.tone(channel, 0.1, onset=onset, ending=ending))
        layers.append(layer(number, *tones))
    return layers


def long_set(subject: Subject) -> list[LayerSet]:
    """Make a set of several parts."""
    return set_of(subject, min(subject.can["set_words"], _LONG))


@driving(_PLACE)
async def parts_of_sets(subject: Subject) -> None:
    """It takes parts in any order and again, says which is missing, and plays a whole set alone."""
    await subject.arm()
    await subject.play(subject.one())
    made = long_set(subject)
    for now in (False, True):
        first, *others = subject.parts(*made, now=now)
        expect(bool(others), "parts of a long set", expected="two or more", seen=1)
        commit: Values = {"session": subject.session, "token": subject.token}
        for part in (*reversed(others), others[-1]):
            await subject.request("Set", **part)
            await subject.refused("INCOMPLETE", "Commit", **commit)
        await subject.request("Set", **first)
        await subject.status()
        if not now:
            await subject.request("Set", **others[-1])
            await subject.request("Commit", **commit)
        await subject.pause(0.05)
        await subject.status()
        await subject.play(subject.one(), *(layer(each) for each in subject.layers[1:]))
        await subject.pause(0.05)
    first, *others = subject.parts(*made, now=False)
    await subject.request("Set", **first)
    count = len(others) + 1
    await subject.refused("BAD_VALUE", "Set", **{**others[0], "index": count})
    await subject.refused("BAD_VALUE", "Set", **{**others[0], "parts": count + 1})
    await subject.refused("BAD_TOKEN", "Set", **{**others[0], "token": subject.token - 2})
    for part in others:
        await subject.request("Set", **part)
    newer, *rest = subject.parts(*made, now=False)
    await subject.request("Set", **newer)
    older: Values = {"session": subject.session, "token": subject.token - 1}
    await subject.refused("BAD_TOKEN", "Commit", **older)
    await subject.refused("BAD_TOKEN", "Set", **first)
    for part in rest:
        await subject.request("Set", **part)
    await subject.commit(subject.token)


@driving(_PLACE)
async def max_set(subject: Subject) -> None:
    """It takes a set of as many words as it states, and refuses a longer one."""
    await subject.arm()
    room = min(subject.can["set_words"], _MAX_TRIED)
    await subject.commit(await subject.stage(*set_of(subject, room)))
    await subject.status()
    longer = set_of(subject, room + 2)
    if len(pack_layers(longer)) > subject.can["set_words"]:
        answers = [
            await subject.answer("Set", **each) for each in subject.parts(*longer, now=False)
        ]
        codes = [each.code for each in answers if each.code]
        expect_equal(codes[:1], ["BAD_LENGTH"], f"refusal of a set of {room + 2} words")


@driving(_PLACE)
async def sets_expire(subject: Subject) -> None:
    """It discards a set that is not committed, or not complete, 1 s after its first part."""
    await subject.arm()
    for at in (0.9, 1.1):
        began = (await subject.ping()).when.latest
        token = await subject.stage(subject.one())
        await subject.pause(at * STAGED_LIFE)
        if at > 1:
            await subject.refused("BAD_TOKEN", "Commit", session=subject.session, token=token)
        elif clock.now() - began > 0.95 * STAGED_LIFE:
            raise Late("a set was committed too late")
        else:
            await subject.commit(token)
    first, *others = subject.parts(*long_set(subject), now=False)
    await subject.request("Set", **others[-1])
    await subject.pause(0.6)
    for part in others[:-1]:
        await subject.request("Set", **part)
    await subject.pause(0.5)
    subject.shown.forget_parts()
    await subject.request("Set", **first)
