"""Checks of frames on any wire, and of those on a serial line."""

import asyncio

from drivers.conformance.check import driving
from drivers.conformance.findings import expect, expect_equal
from drivers.conformance.serial_client import SerialClient
from drivers.conformance.subject import Subject, layer
from drivers.protocol.serial_payload import pack_words
from drivers.protocol.sets import pack_layers
from drivers.protocol.table import MESSAGES, VERSION

_PLACE = "protocol.md#checks-in-this-order"
_PING, _SET = MESSAGES["Ping"].number, MESSAGES["Set"].number


@driving(_PLACE)
async def damaged_frames(subject: Subject) -> None:
    """It takes no damaged frame, nor one for others: it neither plays, replies nor is fed."""
    await subject.arm()
    await subject.play(layer(0, subject.tone()))
    client = subject.client
    await subject.request("Ping", session=subject.session)
    stream = pack_layers([layer(0, subject.tone(0, 0.5))])
    words = [subject.session, subject.token + 1, 1 << 1 | 1, *stream]
    for number, content in ((_PING, [subject.session]), (_SET, words)):
        for what, data in client.damaged(number, content):
            text = f"message {number} with {what}"
            heard = await client.send(data)
            expect(not heard, f"replies to {text}", expected="none", seen=len(heard))
            await subject.expect_not_fed(text)
            shown = await subject.status()
            expect_equal(shown["token"], subject.token, f"token after {text}")
    await subject.expect_levels(1.0, why="after damaged frames")


@driving(_PLACE)
async def doubled_frames(subject: Subject) -> None:
    """It carries a frame that comes twice, or late, out as one of its token, or not at all."""
    await subject.arm()
    client = subject.client

    def frame(token: int, fraction: float) -> bytes:
        stream = pack_layers([layer(0, subject.tone(0, fraction), valid_for=500)])
        return client.request(_SET, [subject.session, token, 1 << 1 | 1, *stream])

    first, second = frame(1, 0.5), frame(2, 1.0)
    await client.send(first)
    await client.send(second)
    await subject.expect_levels(1.0, why="the second of two sets")
    await client.send(first)  # late
    await subject.expect_levels(1.0, why="after the first of two sets came late")
    await client.send(second)
    status = await subject.expect_levels(1.0, why="after the sets came again")
    expect_equal(status["token"], 2, "token after the sets came again")
    subject.token = 2
    await asyncio.sleep(0.5)
    await client.send(second)
    await subject.expect_levels(why="after a set came again that has ended")


@driving("serial.md#receiving", "serial")
async def tolerated_frames(subject: Subject) -> None:
    """It finds frames in noise, in pieces, and back to back, and replies to each."""
    client = subject.client
    assert isinstance(client, SerialClient)  # noqa: S101

    def ping() -> bytes:
        return client.request(_PING, [1])

    for what, pieces, count in (
        ("noise before it", [b"\x55\xaa\x01" + ping()], 1),
        ("zeros before it", [b"\0\0\0" + ping()], 1),
        ("half a frame before it", [ping()[:7] + ping()], 1),
        ("another back to back", [ping() + ping()], 2),
        ("a pause within", [(data := ping())[:5], data[5:]], 1),
        ("300 bytes of noise before it", [b"\x77" * 300 + ping()], 1),
        ("the longest payload before it", [client.frame(_SET, bytes(240)) + ping()], 2),
        ("its delimiter shared", [ping()[:-1] + ping()], 2),
    ):
        client.heard.clear()
        for piece in pieces[:-1]:
            client.port.write(piece)
            await asyncio.sleep(0.05)
        heard = await client.send(pieces[-1])
        heard = [each for each in heard if each.type & 0x80]
        expect_equal(len(heard), count, f"replies to a frame with {what}")
    for sequence in (0, 0xFFFF):
        client.sequence = (sequence - 1) % 0x10000
        await subject.request("Ping", session=1)
    before = client.invalid
    for _ in range(3):
        await client.exchange_payload(_PING, pack_words([1]), VERSION)
    expect_equal(client.invalid, before, "damaged replies")
