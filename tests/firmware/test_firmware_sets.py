"""Sets in one exchange with the firmware, against docs/decisions/0088, by hand-written frames."""

import struct
from collections.abc import Sequence
from pathlib import Path

import pytest
from cobs import cobs

import hand_written as hand
from drivers.wires.can_bus.frames import segments
from moved_firmware import CAN, SERIAL, SESSION, TCP, MovedFirmware, arm, request, values_of

BAD_LENGTH, BAD_VALUE, BAD_CHANNEL, BAD_TOKEN, INCOMPLETE = 2, 3, 4, 6, 12
UNKNOWN_TYPE, WRONG_SESSION = 1, 10
STAGED, PLAYED = 6, 5  # exact 4, staged 2, played 1
NO_CHANNEL = 255
TONE = hand.tone(0, 100, 0.5)
LAYER = hand.layer(0, TONE)


def said(firmware: MovedFirmware, frame: bytes) -> list[int] | None:
    """Type and words of the only reply to a frame on the serial line; None without one."""
    firmware.sent(SERIAL)
    firmware.receive(SERIAL, frame)
    frames = [cobs.decode(each) for each in firmware.sent(SERIAL).split(b"\0") if each]
    replies = [each for each in frames if each[0] & hand.REPLY]
    assert len(replies) <= 1
    for each in replies:
        return [each[0] & ~hand.REPLY, *struct.unpack(f"<{len(each[5:-4]) // 2}H", each[5:-4])]
    return None


def part(
    token: int, index: int, parts: int, *words: Sequence[int], session: int = SESSION,
    now: bool = False,
) -> bytes:  # fmt: skip
    """A part of a set, with words of its stream."""
    set_words = hand.part(token, *words, session=session, index=index, parts=parts, now=now)
    return request(hand.SET, *set_words)


def taken(token: int, bits: int, missing: int = 0) -> list[int]:
    """What Taken says."""
    return [hand.SET, token, bits, missing]


def refused(code: int, channel: int = NO_CHANNEL) -> list[int]:
    """What the Nak of a Set says."""
    return [hand.NAK, hand.SET, code, channel]


COMMIT = hand.COMMIT
OTHER = hand.layer(1, hand.tone(1, 200, 0.25), ramp=0)
LOUDER, LONGER = hand.layer(0, hand.tone(0, 100, 0.5), ramp=0), hand.layer(2)
BAD = hand.layer(0, hand.tone(9, 100, 0.5))


@pytest.mark.parametrize(
    "exchange",
    [
        [  # the first that is missing; then staged, confirmed, and played by its last part alone
            (part(1, 0, 3, LAYER[:2]), None),
            (part(1, 2, 3, LAYER[4:]), taken(1, 0, 1)),
            (part(1, 1, 3, LAYER[2:4]), None),
            (part(1, 2, 3, LAYER[4:]), taken(1, STAGED)),
            (part(1, 2, 3, [1, 2, 3]), taken(1, STAGED)),
            (part(1, 2, 3, now=True), taken(1, PLAYED)),
            (part(1, 4, 3), taken(1, PLAYED)),
            (part(1, 0, 3, LAYER[:2]), None),
        ],
        [  # dropped without a word: another session, an older token, other parts than before
            (part(1, 0, 2, LAYER, session=7), None),
            (part(1, 1, 2), taken(1, 0)),
            (part(1, 1, 2, session=7), refused(WRONG_SESSION)),
            (part(1, 0, 1, now=True), taken(1, PLAYED)),
            (part(0x9000, 0, 2), None),
            (part(0x9000, 1, 2), refused(BAD_TOKEN)),
            (part(3, 0, 3, LAYER), None),
            (part(3, 0, 2), None),
            (part(2, 0, 2), None),
            (part(2, 1, 2), refused(BAD_TOKEN)),
            (part(3, 1, 2), refused(BAD_VALUE)),
            (part(3, 2, 3), taken(3, 0, 1)),
        ],
        [  # an index that no set has, also of none
            (part(1, 0, 1, LAYER), taken(1, STAGED)),
            (part(2, 2, 2), refused(BAD_VALUE)),
            (part(2, 0, 0), refused(BAD_VALUE)),
            (part(1, 0, 1, LAYER), taken(1, STAGED)),
        ],
        [  # the staged set stays where a newer one is refused, and goes where a part of it is kept
            (part(1, 0, 1, LAYER), taken(1, STAGED)),
            (part(2, 0, 1, BAD), refused(BAD_CHANNEL, 9)),
            (part(2, 1, 2), taken(2, 0)),
            (part(1, 0, 1, LAYER), taken(1, STAGED)),
            (part(2, 0, 2, LAYER), None),
            (request(COMMIT, SESSION, 1, 0), [hand.NAK, COMMIT, BAD_TOKEN, NO_CHANNEL]),
            (request(COMMIT, SESSION, 2, 0), [hand.NAK, COMMIT, INCOMPLETE, NO_CHANNEL]),
        ],
        [  # and where a newer one of one part is staged
            (part(1, 0, 1, LAYER), taken(1, STAGED)),
            (part(2, 0, 1), taken(2, STAGED)),
            (request(COMMIT, SESSION, 1, 0), [hand.NAK, COMMIT, BAD_TOKEN, NO_CHANNEL]),
        ],
        [  # other content replaces what was kept, also in the middle and of another length
            (part(1, 0, 3, LONGER), None),
            (part(1, 1, 3, OTHER), None),
            (part(1, 0, 3, LOUDER), None),
            (part(1, 1, 3), None),
            (part(1, 2, 3, hand.layer(3), now=True), taken(1, PLAYED)),
        ],
        [  # a set that is refused loses its parts
            (part(1, 0, 2, BAD), None),
            (part(1, 1, 2), refused(BAD_CHANNEL, 9)),
            (part(1, 1, 2), taken(1, 0)),
        ],
        [  # 1053 words, where 1024 are the most
            *((part(1, index, 9, [0] * 117), None) for index in range(8)),
            (part(1, 8, 9, [0] * 117), refused(BAD_LENGTH)),
            (part(1, 8, 9, [0] * 117), taken(1, 0)),
        ],
    ],
    ids=["order", "dropped", "index", "newer", "single", "other", "refused", "long"],
)
def test_only_the_last_part_is_replied_to(
    replaying: Path, exchange: list[tuple[bytes, list[int] | None]]
) -> None:
    """And in the order of the decision's steps."""
    firmware = MovedFirmware(replaying)
    firmware.receive(SERIAL, arm())
    for frame, expected in exchange:
        assert said(firmware, frame) == expected


def test_replaced_part_plays(replaying: Path) -> None:
    """Its last content, without the layers of the others."""
    firmware = MovedFirmware(replaying)
    firmware.receive(SERIAL, arm())
    for words in (OTHER, LOUDER):
        firmware.receive(SERIAL, part(1, 0, 2, words))
    firmware.receive(SERIAL, part(1, 1, 2, now=True))
    assert values_of(firmware, hand.GET_STATUS)["levels"][:2] == [5000, 0]


def test_set_is_gone_a_second_after_its_first_part(replaying: Path) -> None:
    """Whenever the others came."""
    firmware = MovedFirmware(replaying)
    firmware.receive(SERIAL, arm())
    firmware.receive(SERIAL, part(1, 0, 3))
    firmware.move(0.9)
    firmware.receive(SERIAL, part(1, 1, 3))
    firmware.move(0.99)
    assert said(firmware, part(1, 1, 2)) == refused(BAD_VALUE)
    firmware.move(1.0001)
    assert said(firmware, part(1, 2, 3)) == taken(1, 0)


def test_part_that_is_kept_feeds(replaying: Path) -> None:
    """And one that is dropped does not."""
    firmware = MovedFirmware(replaying)
    firmware.receive(SERIAL, arm())
    for time, token, left in ((0.5, 1, 2000), (0.9, 1, 2000), (1.2, 0xFFFF, 1700)):
        firmware.move(time)
        firmware.receive(SERIAL, part(token, 0, 2))
        assert values_of(firmware, hand.GET_STATUS)["watchdog_left"] == left


def shape(knots: int, step: int, *numbers: int) -> list[int]:
    """The words of an envelope."""
    return [knots, step, *numbers]


ONSET, ENDING = 2, 1


@pytest.mark.parametrize(
    ("stream", "code", "channel"),
    [
        ([1, 10, 0, *TONE[:3]], BAD_LENGTH, 255),
        ([*LAYER, 9 << 7, 10], BAD_LENGTH, 255),
        ([*LAYER, *LAYER, 1], BAD_VALUE, 255),
        ([31 << 5, 2000, 0], BAD_VALUE, 255),
        (hand.layer(1, TONE, renew=True), BAD_VALUE, 255),
        (hand.layer(1, after=True), BAD_VALUE, 255),
        (hand.layer(8), BAD_VALUE, 255),
        (hand.layer(0, renew=True, ramp=1001), BAD_VALUE, 255),
        (hand.layer(0, renew=True, valid_for=60_001), BAD_VALUE, 255),
        (hand.layer(8, hand.tone(9, 100, 0.5)), BAD_VALUE, 255),
        (hand.layer(0, TONE, [0, 0, 20_000, 0], ramp=0), BAD_CHANNEL, 0),
        (hand.layer(0, [4 << 4, 0, 20_000, 0]), BAD_CHANNEL, 4),
        (hand.layer(0, hand.tone(2, 100, 0.5), hand.tone(3, 10, 0.1)), BAD_VALUE, 3),
        (hand.layer(0, [1 << 4, 2000, 10_001, 0]), BAD_VALUE, 1),
        (hand.layer(0, [1 << 4, 2000, 100, 18_000]), BAD_VALUE, 1),
        (hand.layer(0, [1 << 8, 2000, 100, 0]), BAD_VALUE, 0),
        (hand.layer(0, [1 << 4 | ONSET, 10, 0, 0, *shape(0, 100)]), BAD_VALUE, 1),
        (hand.layer(0, [1 << 4 | ONSET, 2000, 0, 0, *shape(33, 100, *[0] * 66)]), BAD_VALUE, 1),
        (hand.layer(0, [1 << 4 | ENDING, 2000, 0, 0, *shape(0, 9)]), BAD_VALUE, 1),
        (hand.layer(0, [1 << 4 | ENDING, 2000, 0, 0, *shape(1, 10, 0, 18_000)]), BAD_VALUE, 1),
        (hand.layer(0, [2 << 4 | ONSET, 2000, 0, 0, *shape(1, 10, 10_001, 0)]), BAD_VALUE, 2),
        (hand.layer(0, [2 << 4 | ONSET, 2000, 0, 0, *shape(65_535, 10)]), BAD_LENGTH, 255),
    ],
)
def test_what_is_wrong_first_is_refused(
    replaying: Path, stream: list[int], code: int, channel: int
) -> None:
    """Layer by layer: its length, its head, then its commands, whose channel is named."""
    firmware = MovedFirmware(replaying)
    firmware.receive(SERIAL, arm())
    assert said(firmware, part(1, 0, 1, stream)) == refused(code, channel)
    driven = hand.layer(0, [1 << 4, 10, 0, 0])  # any frequency where nothing is driven
    assert said(firmware, part(1, 0, 1, driven)) == taken(1, STAGED)


def test_half_a_word_is_looked_at_behind_the_type(replaying: Path) -> None:
    """Of a type that is not there it is unknown."""
    firmware = MovedFirmware(replaying)
    for kind, code in ((hand.PING, BAD_LENGTH), (hand.SET, BAD_LENGTH), (40, UNKNOWN_TYPE)):
        frame = hand.raw_frame(kind, b"\1\0\1", sequence=1)
        assert said(firmware, frame) == [hand.NAK, kind, code, NO_CHANNEL]


def test_parts_on_can_and_modbus(replaying: Path) -> None:
    """On CAN nothing is sent to an earlier part, be it kept or not; on Modbus each write is."""
    firmware = MovedFirmware(replaying)
    firmware.receive(CAN, b"O\rt00020100\r")
    firmware.receive(SERIAL, arm())
    firmware.sent(CAN)
    sent = []
    for number, session in enumerate((SESSION, SESSION + 1), 1):
        words = hand.part(1, [0], session=session, parts=2)
        for data in segments(number, hand.SET, words):
            firmware.receive(CAN, b"t2018" + data.hex().upper().encode() + b"\r")
        sent.append(firmware.sent(CAN).strip(b"\r"))
    assert sent == [b"", b""]
    words = [77, *hand.part(1, [0], session=SESSION + 1, parts=2)]
    head = struct.pack(">BHHB", 16, 256 * hand.SET, len(words), 2 * len(words))
    write = head + struct.pack(f">{len(words)}H", *words)
    firmware.receive(TCP, struct.pack(">HHHB", 7, 0, len(write) + 1, 1) + write)
    assert firmware.sent(TCP)[7:] == head[:5]
    firmware.receive(TCP, struct.pack(">HHHBBHH", 8, 0, 6, 1, 4, 256 * hand.SET + 128, 5))
    assert struct.unpack(">5H", firmware.sent(TCP)[9:]) == (77, 0, 0, 0, 0)
