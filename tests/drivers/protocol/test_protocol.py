"""Messages of protocol 4 as words, and sets of layers as streams of words.

Against rows and a stream that were written by hand from their definition.
"""

import random
from itertools import permutations

import pytest

from drivers.protocol.definition import (
    BY_NUMBER,
    IDENTITY,
    MAX_WORDS,
    MESSAGES,
    QUANTITIES,
    STAGED_LIFE,
    reading,
    sensor_reading,
)
from drivers.protocol.definition import STATUS as STATUS_RECORD
from drivers.protocol.records import Number, Refusal, Values, WireQuantity
from drivers.protocol.sets import Assembly, is_last, pack_layers, parts, unpack_layers

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


STATUS: Values = {
    **{"state": 4, "fault": 0, "flags": 1, "latch": 0, "watchdog_left": 250},
    **{
        "temperature": -53,
        "high_voltage": 1800,
        "clock": 65538,
        "token": 513,
        "channels": 4,
        "layers": 2,
    },
    **{"levels": [2000, 0, 0, 10000], "tokens": [513, 0]},
}
NOT_STATED = dict.fromkeys(each.name for each in STATUS_RECORD.added)
"""What later editions add."""
STATUS_WORDS = [
    *(4, 0, 1, 0, 250, 0xFFCB, 1800, 1, 2, 513, 0x0402),
    *(2000, 0, 0, 10000, 513, 0),
]


def test_status_has_the_words_written_by_hand() -> None:
    """State to token, both counts in one word, levels, tokens; -5.3 °C in two's complement."""
    record = MESSAGES["GetStatus"].reply
    assert record.pack(STATUS) == STATUS_WORDS
    assert record.unpack(STATUS_WORDS, is_strict=True) == {**NOT_STATED, **STATUS}


def test_long_numbers_and_texts_have_the_high_part_first() -> None:
    """65.536 s is 0001 0000; 1.5 as binary32 is 3FC0 0000; "A-1" is 3, 412D, 3100."""
    fault = {"count": 1, "faults": [{"fault": 4, "channel": 2, "age": 65536}]}
    assert MESSAGES["GetFaults"].reply.pack(fault) == [1, 4, 2, 1, 0]
    reading = {"flags": 1, "tones": [{"amplitude": 1.5, "phase": -1}]}
    assert sensor_reading(1).pack(reading) == [1, 0x3FC0, 0, 0xFFFF]
    texts = {"versions": 8, "vendor": "A-1", "product": "", "serial_number": "é", "firmware": ""}
    words = [8, 3, 0x412D, 0x3100, 0, 2, 0xC3A9, 0]
    assert IDENTITY.pack(texts) == words
    assert IDENTITY.unpack(words, is_strict=True) == texts


def test_reading_has_its_unit_in_its_names_and_the_decimals_of_its_step() -> None:
    """Of 0.05 rpm two; a unit without a name for keys and metrics is refused."""
    speed = Number("fan_speed", WireQuantity("fan_speed", "u16", 20, "rpm", 1, 65535))
    assert (speed.key, speed.metric, speed.label) == (*("fan_speed_rpm",) * 2, "fan speed")
    assert (speed.decimals, Number("count", QUANTITIES["count"]).decimals) == (2, 0)
    with pytest.raises(ValueError, match=r"unit of fan_speed .* rpm, got /min"):
        WireQuantity("fan_speed", "u16", 20, "/min", 1, 65535)


@pytest.mark.parametrize(("low", "high"), [(0, 65535), (-1, 65534), (-32768, 32767)])
def test_added_reading_that_fills_a_word_is_refused(low: int, high: int) -> None:
    """With 0 for not stated it needs two words; one value less, or a start at 1, needs one."""
    with pytest.raises(ValueError, match=f"later must be from {low} to {high - 1}, "):
        reading("later", "of it", low, high, 10, "V", is_added=True)
    for first, last in ((low, high - 1), (1, 65535)):
        assert reading("later", "of it", first, last, 10, "V", is_added=True).words == 1


@pytest.mark.parametrize(
    ("name", "words", "code"),
    [
        ("Arm", [9, 250], "BAD_LENGTH"),
        ("Arm", [9, 250, 0, 0], "BAD_LENGTH"),
        ("Arm", [9, 99, 0], "BAD_VALUE"),
        ("Arm", [0, 250, 0], "BAD_VALUE"),
        ("Commit", [9, 0, 0], "BAD_TOKEN"),
        ("Set", [9, 1], "BAD_LENGTH"),
        ("SetAddress", [5, 33, *[0x4141] * 17], "BAD_LENGTH"),
        ("SetAddress", [5, 2, 0x0A41], "BAD_VALUE"),
        ("SetAddress", [5, 1, 0xFF00], "BAD_VALUE"),
        ("Measure", [1, 100, 2, 2200], "BAD_LENGTH"),
        ("Measure", [1, 100, 0], "BAD_VALUE"),
    ],
)
def test_request_that_no_host_may_send_is_refused(name: str, words: list[int], code: str) -> None:
    """Too short, too long and out of range, each by its own code."""
    with pytest.raises(Refusal) as caught:
        MESSAGES[name].request.unpack(words, is_strict=True)
    assert caught.value.code == code


def test_longest_messages_fit_every_wire() -> None:
    """Sixteen channels and sixteen layers, the widest that an amplifier can have."""
    limits = {"frequency_min": 0, "frequency_max": 1, "level_max": 1}
    zeros = dict.fromkeys(MESSAGES["GetCaps"].reply.names, 1)
    widest = zeros | {
        "layers": 4,
        "voices": 8,
        "set_words": 512,
        "watchdog_min": 100,
        "watchdog_max": 100,
    }
    caps = widest | {"channels": 16, "limits": [limits] * 16}
    assert len(MESSAGES["GetCaps"].reply.pack(caps)) <= MAX_WORDS
    status = STATUS | {"channels": 16, "layers": 16, "levels": [0] * 16, "tokens": [0] * 16}
    assert len(MESSAGES["GetStatus"].reply.pack(status)) <= MAX_WORDS


def test_random_words_are_read_or_refused() -> None:
    """Whatever arrives, nothing else than a refusal is raised, and what is read packs to itself."""
    random_words = random.Random(5)
    read = 0
    for _ in range(5_000):
        message = BY_NUMBER[random_words.choice(list(BY_NUMBER))]
        values = [
            random_words.choice((0, 1, 2, 9, 300, 65535)) for _ in range(random_words.randrange(24))
        ]
        for record in (message.request, message.reply):
            try:
                found = record.unpack(values, is_strict=True)
            except Refusal:
                continue
            read += 1
            packed = record.pack(found)
            assert [*packed, *[0] * (len(values) - len(packed))] == values
    assert read > 300
