"""Checks of sets in parts and by tokens: staged, committed once, in their order, for a second."""

from drivers.judge.asking.check import driving
from drivers.judge.asking.client import require
from drivers.judge.asking.material import Material, Rows, layer, play, send, stage
from drivers.judge.asking.subject import Subject
from drivers.protocol.records import Values
from drivers.protocol.sets import LayerSet, pack_layers
from drivers.protocol.table import STAGED_LIFE

_PLACE = "protocol.md#sets"
_LAYER_HEAD, _SHAPED = 3, 8  # words of a layer, of a command with two empty envelopes
_MAX_TRIED = 2000  # words of a set: more take a slow wire longer than a set lives
_LONG, _SHORT = 600, 60  # words of a set of several parts
_SLOW = 0.03  # s; of a line, for an exchange of the longest messages
_OLD = "BAD_TOKEN"


def set_of(material: Material, room: int) -> list[LayerSet]:
    """Make a set of this many words, or of as many as there can be."""
    channels, max_knots = len(material.channels), material.can["knots"]
    # All but the heads of layers has an even number of words.
    bare = _LAYER_HEAD + _SHAPED * channels
    max_layers = min(len(material.layers), room // bare)
    counts = [each for each in range(1, max_layers + 1) if each % 2 == room % 2] or [max_layers]
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
    """Make a set of several parts, a short one on a slow line, lest it expires on its way."""
    is_quick = max(subject.client.transit, subject.exchange_time) < _SLOW
    return set_of(subject, min(subject.can["set_words"], _LONG if is_quick else _SHORT))


def _require_quick(subject: Subject) -> None:
    require(
        16 * subject.exchange_time <= STAGED_LIFE,
        "the line is too slow for a set in several parts",
    )


@driving(_PLACE)
def parts_of_sets(subject: Subject) -> Rows:
    """It takes parts in any order and again, says which is missing, and plays a whole set alone."""
    _require_quick(subject)
    made = long_set(subject)

    def cut(token: int, now: int = 0) -> list[Values]:
        return subject.parts(*made, token=token, now=now, count=3)

    def parts(token: int, now: int = 0) -> Rows:
        return [send("Set", **each) for each in cut(token, now)]

    def backwards(token: int, now: int) -> Rows:
        first, *others = parts(token, now)
        incomplete = send("Commit", token=token, code="INCOMPLETE")
        late = [row for each in (*reversed(others), others[-1]) for row in (each, incomplete)]
        again = [] if now else [others[-1], send("Commit", token=token)]
        return [*late, first, *again, 0.05]

    def second(**changed: int) -> Values:
        return {**cut(5)[1], **changed}

    count = len(parts(5))
    others = play(subject.one(), *(layer(each) for each in subject.layers[1:]), token=3)
    return [
        *(subject.arm, subject.one(), *backwards(2, now=0), others, 0.05, *backwards(4, now=1)),
        parts(5)[0],
        send("Set", **second(index=count), code="BAD_VALUE"),
        send("Set", **second(parts=count + 1), code="BAD_VALUE"),
        *(send("Set", **second(token=3), code=_OLD), *parts(5)[1:], parts(6)[0]),
        *(send("Commit", token=5, code=_OLD), send("Set", **second(), code=_OLD)),
        *(*parts(6)[1:], send("Commit", token=6)),
    ]


@driving(_PLACE)
def max_set(subject: Subject) -> Rows:
    """It takes a set of as many words as it states, and refuses a longer one."""
    room = min(subject.can["set_words"], _MAX_TRIED)
    longer = set_of(subject, room + 2)
    is_longer = len(pack_layers(longer)) > subject.can["set_words"]
    refused = [stage(*longer, code="BAD_LENGTH")] if is_longer else []
    return [subject.arm, stage(*set_of(subject, room)), send("Commit", token=1), *refused]


@driving(_PLACE)
def sets_expire(subject: Subject) -> Rows:
    """It discards a set that is not committed, or not complete, 1 s after its first part."""
    _require_quick(subject)
    parts = subject.parts(*long_set(subject), token=3, now=0, count=3)
    first, *others, last = (send("Set", **each) for each in parts)
    shorter = 0.9 * STAGED_LIFE - 4 * min(subject.exchange_time, 0.1)
    return [
        *(subject.arm, stage(subject.one()), shorter, send("Commit", token=1)),
        *(stage(subject.one()), 1.1 * STAGED_LIFE, send("Commit", token=2, code=_OLD)),
        last,
        0.6 * STAGED_LIFE,
        *others,
        0.5 * STAGED_LIFE,
        first,
    ]


@driving(_PLACE)
def stage_and_commit(subject: Subject) -> Rows:
    """It plays a staged set by the commit of its token only, once, and confirms it again."""
    both = layer(0, subject.tone(0, 0.5), ramp=50), layer(1, subject.beside(1, 0.25))
    again = send("Commit", token=2), stage(*both, token=2), play(*both, token=2)
    others = (send("Commit", token=other, code=_OLD) for other in (3, 302, 2 ^ 0x100, 0))
    return [
        subject.arm,
        subject.one(),
        stage(*both),
        *others,
        send("Commit", token=2),
        subject.follow,
        *again,
        *again,
        play(subject.one(), token=2, code=("", _OLD)),
    ]


@driving(_PLACE)
def repeats_change_nothing(subject: Subject) -> Rows:
    """It starts nothing anew by a commit or set that comes again, even if its vibration ended."""
    one, commit = subject.one(valid_for=300), send("Commit", token=1)
    again = commit, play(one, token=1)
    return [subject.arm, stage(one), commit, 0.2, *again, 0.13, *again]


@driving(_PLACE)
def tokens_wrap(subject: Subject) -> Rows:
    """It takes tokens that are newer by 1 to 32767 modulo 65536, and no others (RFC 1982)."""
    rows: list[Rows] = [
        [
            play(subject.one(level=0.5), token=newer),
            *(
                play(layer(0), token=(newer + ahead) % 0x10000, code=_OLD)
                for ahead in (32_768, 32_769, 65_534)
                if newer + ahead != 0x10000
            ),
        ]
        for newer in (65_535, 1, 32_768, 65_535)
    ]
    return [subject.arm, play(subject.one(), token=65_530), *(row for each in rows for row in each)]


@driving(_PLACE)
def newer_sets_replace(subject: Subject) -> Rows:
    """It keeps the newest staged set alone, and plays what comes with *now* at once."""
    half, quarter = subject.one(level=0.5), subject.one(level=0.25)

    def dropped(token: int) -> Rows:
        return [send("Commit", token=token, code=_OLD)]

    return [
        *(subject.arm, stage(quarter), stage(half), *dropped(1)),
        *(stage(subject.one(), token=1, code=_OLD), send("Commit", token=2)),
        *(stage(subject.one()), half, *dropped(3)),
        *(stage(subject.one()), send("Silence", ramp=0), *dropped(5)),
        *(stage(subject.one()), send("Disarm", ramp=0), subject.settle, subject.arm, *dropped(6)),
    ]


@driving(_PLACE)
def committed_together(subject: Subject) -> Rows:
    """It starts all layers and channels of a set at one moment."""
    tones = [subject.tone(each, 1 / len(subject.layers)) for each in subject.channels]
    room = subject.can["set_words"] // (_LAYER_HEAD + 4 * len(tones))
    layers = [layer(each, *tones, ramp=subject.ramp) for each in subject.layers[:room]]
    return [[stage(*layers), send("Commit", token=1)]]
