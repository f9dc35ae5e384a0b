"""Sets of layers as streams of words, against a stream written by hand from the decision."""

import random
from itertools import permutations

import pytest

from drivers.protocol.definition import MESSAGES, STAGED_LIFE
from drivers.protocol.records import Refusal
from drivers.protocol.sets import (
    Assembly,
    is_last,
    pack_layers,
    parts,
    unpack_layers,
)

STREAM = [
    *(0x0002, 20, 500),  # layer 0, two commands
    *(0x0000, 2200, 2000, 0),
    *(0x003B, 5010, 10000, 0xDCD8),  # channel 3, keep phase, onset and ending
    *(2, 50, 1000, 9000, 10000, 0xFFFF),
    *(1, 20, 500, 0),
    *(0x0100, 10, 0),  # layer 2, silenced
    *(0x01A0, 0, 800),  # layer 3, renewed
]


@pytest.mark.parametrize(
    ("stream", "code", "channel"),
    [
        ([0x0002, 20, 500, 0x0000, 2200, 2000, 0], "BAD_LENGTH", None),
        ([0x0002, 20, 500, *(0x0030, 2200, 0, 0) * 2], "BAD_CHANNEL", 3),
        ([0x0000, 20, 500, 0x0000, 20, 500], "BAD_VALUE", None),
        ([0x0021, 20, 500, 0x0000, 2200, 2000, 0], "BAD_VALUE", None),
        ([0x0040, 20, 500], "BAD_VALUE", None),
        ([0x0060, 20, 500], "BAD_VALUE", None),
        ([0x1000, 20, 500], "BAD_VALUE", None),
        ([0x0001, 20, 500, 0x0000, 2200, 10001, 0], "BAD_VALUE", 0),
        ([0x0001, 20, 500, 0x0052, 2200, 1, 0, 33, 50, *(0, 0) * 33], "BAD_VALUE", 5),
        # Of two flaws that which comes first: length, layer, channel, then the channel's words.
        ([0x0001, 1001, 500, 0x0010, 2200, 0, 0, 9], "BAD_VALUE", None),
        ([0x0001, 1001, 500, 0x0012, 2200, 0, 0, 1, 50, 0], "BAD_LENGTH", None),
        ([0x0001, 20, 500, 0x0010, 2200, 0, 18000, 0x0000, 1001, 0], "BAD_VALUE", 1),
        ([0x0002, 20, 500, 0x0030, 2200, 10001, 0, 0x0030, 2200, 0, 0], "BAD_VALUE", 3),
        ([0x0002, 1001, 500, *(0x0030, 2200, 0, 0) * 2], "BAD_VALUE", None),
        ([0x0002, 20, 500, 0x0030, 2200, 0, 0, 0x0030, 2200, 10001, 0], "BAD_CHANNEL", 3),
    ],
)
def test_stream_that_no_host_may_send_is_refused(
    stream: list[int], code: str, channel: int | None
) -> None:
    """Cut short, a channel or layer twice, renew or after in vain, a level or knots too many."""
    with pytest.raises(Refusal) as caught:
        unpack_layers(stream)
    assert (caught.value.code, caught.value.channel) == (code, channel)


def test_set_is_whole_whatever_the_order_of_its_parts() -> None:
    """The parts but the last, in both orders and one again, give the stream that was cut."""
    stream = list(range(300))
    *others, last = parts(stream, session=9, token=7, now=False)
    assert [len(MESSAGES["Set"].request.pack(part)) for part in (*others, last)] == [120, 120, 69]
    assert [is_last(part) for part in (*others, last)] == [False, False, True]
    for order in permutations(others):
        assembly = Assembly()
        assert [assembly.keep(part, 0.1) for part in (*order, order[0])] == [True] * 3
        assert assembly.whole(last) == stream


def test_parts_of_another_set_or_too_late_are_not_mixed() -> None:
    """Another token drops what was collected, and so does the time that a set may take."""
    old, new = (parts([token] * 300, session=9, token=token, now=False) for token in (1, 2))
    assembly = Assembly()
    assert assembly.keep(old[0], 0.0)
    assert assembly.keep(new[1], 0.1)
    assert assembly.whole(new[2]) == 0
    assert assembly.keep(new[0], 0.1 + STAGED_LIFE + 0.01)
    assert assembly.whole(new[2]) == 1
    assert not assembly.keep({**new[1], "parts": 4}, 1.2)
    assert assembly.keep(new[1], 0.2 + STAGED_LIFE)
    assert assembly.whole(new[2]) == [2] * 300
    assert assembly.whole(old[2]) == 0


def test_damaged_streams_are_read_or_refused() -> None:
    """Words exchanged at random raise a refusal at most, and what is read packs to itself."""
    chance = random.Random(3)
    read = 0
    for _ in range(5_000):
        stream = list(STREAM)
        for _ in range(chance.randrange(1, 4)):
            stream[chance.randrange(len(stream))] = chance.choice((0, 1, 2, 500, 0x3B, 0x3F, 65535))
        try:
            layers = unpack_layers(stream)
        except Refusal:
            continue
        read += 1
        assert pack_layers(layers) == stream
    assert read > 300
