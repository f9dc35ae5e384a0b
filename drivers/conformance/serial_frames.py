"""Checks of frames on any wire, and of those on a serial line."""

import asyncio
from functools import partial
from typing import cast

from drivers import clock
from drivers.codec.serial_line.frame import pack_words
from drivers.conformance.check import driving
from drivers.conformance.client import When, expect_equal
from drivers.conformance.material import layer
from drivers.conformance.serial_frames import SerialClient
from drivers.conformance.subject import Subject
from drivers.protocol.table import MESSAGES, VERSION

_PLACE = "protocol.md#checks-in-this-order"
_PING, _SET = MESSAGES["Ping"].number, MESSAGES["Set"].number


@driving(_PLACE)
async def damaged_frames(subject: Subject) -> None:
    """It takes no damaged frame, nor one for others: it neither plays, replies nor is fed."""
    await subject.arm()
    await subject.play(subject.one())
    _, words = subject.words_of(layer(0, subject.tone(0, 0.5)))
    for number, sent in ((_PING, [subject.session]), (_SET, words)):
        for what, data in subject.client.damaged(number, sent):
            await subject.client.expect_silence(data, f"message {number} with {what}")
            await subject.run([partial(subject.request, "GetStatus"), subject.ping])


@driving(_PLACE)
async def doubled_frames(subject: Subject) -> None:
    """It carries a frame that comes twice, or late, out as one of its token, or not at all."""
    await subject.arm()
    sets = [layer(0, subject.tone(0, each), valid_for=500) for each in (0.5, 1.0)]
    made = [subject.words_of(each) for each in sets]
    frames = [subject.client.request(_SET, words) for _, words in made]
    for (token, _), data in zip(made, frames, strict=True):
        began = clock.now()
        await subject.client.send(data)
        subject.shown.commit(token, When(began, clock.now()))
    for at, pause in ((0, 0.0), (1, 0.5), (1, 0.0)):
        await subject.client.send(frames[at])
        await subject.run([subject.ping, pause])


@driving("serial.md#receiving", "serial")
async def tolerated_frames(subject: Subject) -> None:
    """It finds frames in noise, in pieces, and back to back, and replies to each."""
    client = cast(SerialClient, subject.client)

    def ping() -> bytes:
        return client.request(_PING, [1])

    whole = ping()
    for what, pieces, count in (
        ("a pause within", [whole[:5], whole[5:]], 1),
        ("noise before it", [b"\x55\xaa\x01" + ping()], 1),
        ("zeros before it", [b"\0\0\0" + ping()], 1),
        ("half a frame before it", [ping()[:7] + ping()], 1),
        ("another back to back", [ping() + ping()], 2),
        ("300 bytes of noise before it", [b"\x77" * 300 + ping()], 1),
        ("the longest payload before it", [client.frame(_SET, bytes(240)) + ping()], 2),
        ("its delimiter shared", [ping()[:-1] + ping()], 2),
    ):
        for piece in pieces[:-1]:
            client.port.write(piece)
            await asyncio.sleep(0.05)
        heard = [each for each in await client.send(pieces[-1]) if each.type & 0x80]
        expect_equal(len(heard), count, f"replies to a frame with {what}")
    for sequence in (0, 0xFFFF):
        client.sequence = (sequence - 1) % 0x10000
        await subject.request("Ping", session=1)
    before = client.invalid
    for _ in range(3):
        await client.exchange_payload(_PING, pack_words([1]), VERSION)
    expect_equal(client.invalid, before, "damaged replies")
