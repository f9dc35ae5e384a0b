"""Checks of frames on a serial line."""

import asyncio
from typing import cast

from drivers.protocol.definition import EVENT, EVENT_RECORD, MESSAGES, VERSION
from drivers.wires.serial_frames import REPLY_BIT
from era_haptics.lab.conformance.check import driving, reading
from era_haptics.lab.conformance.checks.request_checks import UNKNOWN_NUMBERS
from era_haptics.lab.conformance.outcomes import expect_equal
from era_haptics.lab.conformance.request_rows import stage
from era_haptics.lab.conformance.serial_client import SerialClient
from era_haptics.lab.conformance.subject import Subject

_PING, _SET = MESSAGES["Ping"].number, MESSAGES["Set"].number
_PAUSE = 0.05  # s; within a frame
_HALF_WORD = b"\0"


@reading("serial.md#hello", "serial")
async def hello_for_ever(subject: Subject) -> None:
    """Hello of any version and length: Identity; other messages: UNSUPPORTED_VERSION.

    Handle Hello before the version check, ignore its payload and reply in version 0.
    """
    client = cast(SerialClient, subject.client)
    for payload, version in ((b"", 3), (b"\1\2\3", 0), (b"\1", 77), (b"", 2)):
        identity = await client.hello(payload, version)
        quantity = f"identity returned to a Hello of version {version}"
        expect_equal(identity, subject.identity, quantity)
    for version in (0, 2, 3, 255):
        reply = await client.exchange(MESSAGES["GetStatus"].number, (), version=version)
        expect_equal(reply.code, "UNSUPPORTED_VERSION", f"code for a frame of version {version}")


@reading("protocol.md#order-of-checks", "serial")
async def half_words(subject: Subject) -> None:
    """Request with an odd number of bytes: BAD_LENGTH; of an unknown type: UNKNOWN_TYPE.

    Check the type first. If a byte is left over after the last whole word, reject the request with
    BAD_LENGTH before you read its words.
    """
    client = cast(SerialClient, subject.client)
    unknown_number = UNKNOWN_NUMBERS[0]
    for number, words, code in (
        (_PING, [1, 0], "BAD_LENGTH"),
        (_PING, [1], "BAD_LENGTH"),
        (unknown_number, [1, 0], "UNKNOWN_TYPE"),
    ):
        reply = await client.exchange(number, words, extra=_HALF_WORD)
        expect_equal(reply.code, code, f"code for message {number} with half a word")


@driving("serial.md#receiving", "serial")
async def discarded_frames(subject: Subject) -> None:
    """Event, or broadcast of another version: discarded without a reply.

    Ignore frames with bit 7 set and Events, and check the version of a broadcast.
    """
    client = cast(SerialClient, subject.client)
    await client.look_around()
    subject.require_alone()
    event = EVENT_RECORD.pack({"state": 1, "fault": 0, "channel": 255, "latch": 1})
    await client.expect_silence(client.request(EVENT, event), "an Event")
    await subject.run([subject.arm, subject.layer_0()])
    _, words = subject.words_of(subject.layer_0())
    reply = await client.exchange(_SET, words, extra=_HALF_WORD)
    expect_equal(reply.code, "BAD_LENGTH", "code for a Set with half a word")
    part = [subject.session, subject.sets.token + 1, 2 << 1]
    data = client.request(_SET, part, extra=_HALF_WORD)
    await client.expect_silence(data, "a part with half a word")
    await subject.run([stage(subject.layer_0(level=0.5))])
    for name, values in (("Commit", {"token": subject.sets.token}), ("Stop", {"ramp": 0})):
        message = MESSAGES[name]
        words = message.request.pack(subject.filled(values))
        for version in (VERSION - 1, 0):
            data = client.request(message.number, words, to=0, version=version)
            await client.expect_silence(data, f"a broadcast {name} of version {version}")
            await subject.run([subject.ping])


@driving("serial.md#receiving", "serial")
async def tolerated_frames(subject: Subject) -> None:
    """Frame in noise, in pieces or back to back: one reply to each.

    Resynchronize at every zero byte, accept a zero shared by two frames, and buffer the next frame
    while you reply.
    """
    client = cast(SerialClient, subject.client)

    def ping() -> bytes:
        return client.request(_PING, [1, 0])

    frame = ping()
    full_frame = client.request(_SET, (), extra=bytes(240))
    for description, pieces, count in (
        ("a pause within", [frame[:5], frame[5:]], 1),
        ("noise before it", [b"\x55\xaa\x01" + ping()], 1),
        ("zeros before it", [b"\0\0\0" + ping()], 1),
        ("half a frame before it", [ping()[:7] + ping()], 1),
        ("another frame back to back", [ping() + ping()], 2),
        ("300 bytes of noise before it", [b"\x77" * 300 + ping()], 1),
        ("the longest payload before it", [full_frame + ping()], 2),
        ("a shared delimiter", [ping()[:-1] + ping()], 2),
    ):
        for piece in pieces[:-1]:
            client.write(piece)
            await asyncio.sleep(_PAUSE)
        messages = await client.send(pieces[-1], count=count)
        replies = [message for message in messages if not message.type & REPLY_BIT]
        expect_equal(len(replies), count, f"replies to a frame with {description}")
    for sequence in (0, 0xFFFF):
        client.number = (sequence - 1) % 0x10000
        await subject.request("Ping", session=1)
    client.invalid.clear()
    for _ in range(3):
        await client.exchange(_PING, [1, 0])
    expect_equal(client.invalid, [], "damaged replies")
