"""A serial line, frame by frame; checks of frames on any wire, and of those on a serial line."""

import asyncio
import zlib
from collections.abc import Iterator, Sequence
from contextlib import suppress
from typing import cast

from cobs import cobs

from drivers.protocol.definition import (
    EVENT,
    EVENT_RECORD,
    HELLO,
    MAX_WORDS,
    MESSAGES,
    NAK,
    VERSION,
)
from drivers.protocol.records import Values
from drivers.wires.serial_frames import (
    NEUTRAL,
    REPLY,
    Frame,
    FrameReader,
    encode_frame,
    pack_words,
    unpack_identity,
    unpack_words,
)
from era_haptics.lab.conformance.check import driving
from era_haptics.lab.conformance.judge_client import (
    Answer,
    Client,
    Heard,
    When,
    altered,
    expect,
    expect_equal,
    layer,
    message_name,
    read_as,
    stage,
)
from era_haptics.lab.conformance.subject import Subject
from registry import threads

_SEQUENCES = 1 << 16
_SEQUENCE_AT, _CRC_SIZE = 3, 4


class SerialClient(Client):
    """A serial line; sequence: number of the last request."""

    kind = "serial"

    def __init__(self, address: int) -> None:
        super().__init__(address)
        self.sequence = 0
        self.invalid: list[bytes] = []
        self._reader = FrameReader(on_invalid=self.invalid.append)

    def hear(self, data: bytes) -> bytes:
        """Take messages from bytes."""
        for frame in self._reader.feed(data):
            is_text = frame.kind == HELLO | REPLY
            if len(frame.payload) % 2 and not is_text:
                self.invalid.append(frame.payload)
                continue
            words = () if is_text else unpack_words(frame.payload)
            heard = Heard(threads.now(), frame.sequence, frame.kind, words, frame)
            self.take(heard, is_event=frame.kind == EVENT)
            self._others |= {frame.address} - {self.address}
        return data

    def remark(self) -> str:
        """Return whether a reply has its CRC in the wrong byte order."""
        for piece in filter(None, self.came.split(b"\0")):
            with suppress(cobs.DecodeError):
                content = cobs.decode(piece)
                body, crc = content[:-_CRC_SIZE], content[-_CRC_SIZE:]
                if crc == zlib.crc32(body).to_bytes(_CRC_SIZE, "big"):
                    return ", whose CRC fits with its four bytes reversed: it goes low byte first"
        return ""

    def question(self, address: int) -> bytes:
        """Return the frame of a Hello to an address."""
        return self.frame(HELLO, b"", to=address, version=NEUTRAL)

    async def hello(self, payload: bytes = b"", version: int = NEUTRAL) -> Values:
        """Read the identity, by a Hello of any length and version."""
        frame = (await self._replied(HELLO, payload, version)).frame
        seen = frame.kind, frame.version
        expect_equal(seen, (HELLO | REPLY, NEUTRAL), "type, version of the reply to Hello")
        return read_as("identity", unpack_identity, frame.payload)

    async def exchange(
        self, number: int, words: Sequence[int], *, behind: bytes = b"", version: int = VERSION
    ) -> Answer:
        """Send a message, with bytes behind its words, under a version; await its reply."""
        sent = threads.now()
        heard = await self._replied(number, pack_words(words) + behind, version)
        answer = Answer("", None, heard.words, When(sent, heard.at))
        if heard.type == NAK | REPLY:
            answer = self.refusal(sent, heard.at, number, heard.words)
        is_refused, is_neutral = bool(answer.code), answer.code == "UNSUPPORTED_VERSION"
        required = (NAK if is_refused else number) | REPLY, NEUTRAL if is_neutral else VERSION
        seen = heard.type, heard.frame.version
        expect_equal(seen, required, f"type, version of the reply to {message_name(number)}")
        return answer

    async def _replied(self, number: int, payload: bytes, version: int) -> Heard:
        self.write(self.frame(number, payload, version=version))
        sequence = self.sequence
        heard = await self.replied(
            lambda each: each.number == sequence and each.type != EVENT, message_name(number)
        )
        expect_equal(heard.frame.address, self.address, "address of a reply")
        return heard

    def request(self, number: int, words: Sequence[int], *, to: int | None = None) -> bytes:
        """Return the frame of a request."""
        return self.frame(number, pack_words(words), to=to)

    def frame(
        self, number: int, payload: bytes, *, to: int | None = None, version: int = VERSION
    ) -> bytes:
        """Return the frame of a payload under the next sequence number."""
        self.sequence = (self.sequence + 1) % _SEQUENCES
        address = self.address if to is None else to
        return encode_frame(Frame(number, address, self.sequence, payload, version))

    def damaged(self, number: int, words: Sequence[int]) -> Iterator[tuple[str, bytes]]:
        """Yield frames with damage of all kinds."""
        good = self.request(number, words)
        content = cobs.decode(good[1:-1])
        long = content[:-_CRC_SIZE] + bytes(2 * MAX_WORDS + 2 - 2 * len(words))
        reply = bytes([content[0] | REPLY]) + content[1:-_CRC_SIZE]
        bits = (
            (f"a wrong byte {at}", altered(content, at)) for at in (-4, -3, -2, -1, _SEQUENCE_AT)
        )
        yield from ((what, _framed(each)) for what, each in bits)
        # Without zeros, so that it is one block, whose length is wrong.
        statuses = (self.request(_STATUS, []) for _ in range(_SEQUENCES))
        plain = next(each for each in statuses if each[1] == len(each) - 2)
        yield from {
            "a block that goes on behind its end": b"\0\xff" + plain[2:],
            "eight bytes": _framed(_checked(content[:4])),
            "its last byte missing": good[:-2] + b"\0",
            "its first byte missing": b"\0" + good[2:],
            "a broken stuffing": b"\0\xff" + good[2:],
            "no CRC": _framed(content[:-_CRC_SIZE]),
            "more than 240 bytes of payload": _framed(_checked(long)),
            "the bit of a reply": _framed(_checked(reply)),
            "another address": self.request(number, words, to=self.free),
        }.items()


def _checked(body: bytes) -> bytes:
    return body + zlib.crc32(body).to_bytes(_CRC_SIZE, "little")


def _framed(content: bytes) -> bytes:
    stuffed: bytes = cobs.encode(content)
    return b"\0" + stuffed + b"\0"


_PLACE = "protocol.md#checks-in-this-order"
_PING, _SET, _STATUS = (MESSAGES[name].number for name in ("Ping", "Set", "GetStatus"))


@driving(_PLACE)
async def damaged_frames(subject: Subject) -> None:
    """It takes no damaged frame, nor one for others: it neither plays, replies nor is fed."""
    client = subject.client
    await client.look_around()
    own = client.address
    for other in client.neighbours if client.kind == "serial" else ():
        client.address = other
        named = await client.hello()
        expect(named != subject.identity, "addresses that reply", expected=own, seen=other)
    client.address = own
    await subject.arm()
    await subject.play(subject.one())
    _, words = subject.words_of(layer(0, subject.tone(0, 0.5)))
    for number, sent in ((_PING, [subject.session, 0]), (_SET, words)):
        for what, data in client.damaged(number, sent):
            await subject.unfed()
            await client.expect_silence(data, f"message {number} with {what}")
            await subject.request("GetStatus")


@driving(_PLACE)
async def doubled_frames(subject: Subject) -> None:
    """It carries a frame that comes twice, or late, out as one of its token, or not at all."""
    await subject.arm()
    sets = [layer(0, subject.tone(0, each), valid_for=250) for each in (0.5, 1.0)]
    made = [subject.words_of(each) for each in sets]
    frames = [subject.client.request(_SET, words) for _, words in made]
    for (part, _), data in zip(made, frames, strict=True):
        began = threads.now()
        await subject.client.reply_to(data)
        subject.played(part, began)
    for at, pause in ((0, 0.0), (1, 0.25), (1, 0.0)):
        await subject.client.reply_to(frames[at])
        await subject.run([subject.ping, pause])


@driving("serial.md#receiving", "serial")
async def discarded_frames(subject: Subject) -> None:
    """It discards Events, and what is for all in another version, without a reply."""
    client = cast(SerialClient, subject.client)
    await client.look_around()
    subject.require_alone()
    event = pack_words(EVENT_RECORD.pack({"state": 1, "fault": 0, "channel": 255, "latch": 1}))
    await client.expect_silence(client.frame(EVENT, event), "an Event")
    await subject.run([subject.arm, subject.one()])
    answer = await client.exchange(_SET, subject.words_of(subject.one())[1], behind=b"\0")
    expect_equal(answer.code, "BAD_LENGTH", "refusal of a set with half a word")
    head = pack_words([subject.session, subject.token + 1, 2 << 1])
    await client.expect_silence(client.frame(_SET, head + b"\0"), "a part with half a word")
    await subject.run([stage(subject.one(level=0.5))])
    for name, values in (("Commit", {"token": subject.token}), ("Stop", {"ramp": 0})):
        message = MESSAGES[name]
        words = pack_words(message.request.pack(subject.filled(values)))
        for version in (VERSION - 1, 0):
            data = client.frame(message.number, words, to=0, version=version)
            await client.expect_silence(data, f"a {name} of version {version} for all")
            await subject.run([subject.ping])


@driving("serial.md#receiving", "serial")
async def tolerated_frames(subject: Subject) -> None:
    """It finds frames in noise, in pieces, and back to back, and replies to each."""
    client = cast(SerialClient, subject.client)

    def ping() -> bytes:
        return client.request(_PING, [1, 0])

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
            client.write(piece)
            await asyncio.sleep(0.05)
        heard = [each for each in await client.send(pieces[-1]) if each.type & 0x80]
        expect_equal(len(heard), count, f"replies to a frame with {what}")
    for sequence in (0, 0xFFFF):
        client.sequence = (sequence - 1) % 0x10000
        await subject.request("Ping", session=1)
    client.invalid.clear()
    for _ in range(3):
        await client.exchange(_PING, [1, 0])
    expect_equal(client.invalid, [], "damaged replies")
