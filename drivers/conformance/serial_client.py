"""A serial line, frame by frame."""

import zlib
from collections.abc import Iterator, Sequence

from cobs import cobs

from drivers import clock
from drivers.codec.serial_line.frame import NEUTRAL, REPLY, Frame, FrameReader, encode_frame
from drivers.conformance.client import Answer, Client, Heard, When, altered, expect_reply
from drivers.conformance.findings import Violation, expect_equal
from drivers.protocol.records import Refusal, Values
from drivers.protocol.serial_payload import HELLO, pack_words, unpack_identity, unpack_words
from drivers.protocol.table import EVENT, MAX_WORDS, NAK, VERSION

_SEQUENCES = 1 << 16
_SEQUENCE_AT, _CRC_SIZE = 3, 4


class SerialClient(Client):
    """A serial line; sequence: number of the last request."""

    kind = "serial"

    def __init__(self, address: int) -> None:
        super().__init__(address)
        self.sequence = 0
        self.invalid = 0
        self._reader = FrameReader(on_invalid=self._count)
        self._frames: dict[tuple[int, int], Frame] = {}

    def received(self, data: bytes) -> None:
        """Take bytes from the port."""
        for frame in self._reader.feed(data):
            try:
                is_identity = frame.kind == HELLO | REPLY
                words = () if is_identity else unpack_words(frame.payload)
            except Refusal:
                self.invalid += 1
                continue
            self._frames[frame.kind, frame.sequence] = frame
            is_event = frame.kind == EVENT
            self.take(Heard(clock.now(), frame.sequence, frame.kind, words), is_event=is_event)

    async def hello(self) -> Values:
        """Read the identity."""
        return await self.identity(b"", NEUTRAL)

    async def identity(self, payload: bytes, version: int) -> Values:
        """Read the identity by a Hello of any length and version."""
        self.sequence = (self.sequence + 1) % _SEQUENCES
        request = Frame(HELLO, self.address, self.sequence, payload, version)
        _, frame = await self._replied(request)
        expect_equal(frame.kind, HELLO | REPLY, "type of the reply to Hello")
        expect_equal(frame.version, NEUTRAL, "version of the reply to Hello")
        try:
            return unpack_identity(frame.payload)
        except Refusal as error:
            raise Violation("identity", expected="versions and four texts", seen=error) from None

    async def exchange(self, number: int, words: Sequence[int]) -> Answer:
        """Send a message and await its reply."""
        return await self.exchange_payload(number, pack_words(words), VERSION)

    async def exchange_payload(self, number: int, payload: bytes, version: int) -> Answer:
        """Send a payload under a version and await its reply."""
        self.sequence = (self.sequence + 1) % _SEQUENCES
        sent = clock.now()
        heard, frame = await self._replied(
            Frame(number, self.address, self.sequence, payload, version)
        )
        if frame.kind == NAK | REPLY:
            answer = self.refusal(sent, heard.at, number, heard.words)
            neutral = answer.code == "UNSUPPORTED_VERSION"
            expect_equal(frame.version, NEUTRAL if neutral else VERSION, "version of a Nak")
            return answer
        expect_equal(frame.kind, number | REPLY, f"type of the reply to message {number}")
        expect_equal(frame.version, VERSION, f"version of the reply to message {number}")
        return Answer("", None, heard.words, When(sent, heard.at))

    async def _replied(self, request: Frame) -> tuple[Heard, Frame]:
        self.port.write(encode_frame(request))
        heard = expect_reply(
            await self.next(lambda each: each.number == request.sequence and each.type != EVENT),
            request.type,
        )
        frame = self._frames[heard.type, heard.number]
        self._frames.clear()
        expect_equal(frame.address, self.address, "address of a reply")
        return heard, frame

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
        for at in (-4, -3, -2, -1, _SEQUENCE_AT):
            yield f"a wrong byte {at}", _framed(altered(content, at))
        yield "its last byte missing", good[:-2] + b"\0"
        yield "its first byte missing", b"\0" + good[2:]
        yield "a broken stuffing", b"\0\xff" + good[2:]
        yield "no CRC", _framed(content[:-_CRC_SIZE])
        yield "more than 240 bytes of payload", _framed(_checked(long))
        yield "the bit of a reply", _framed(_checked(reply))
        other = self.address % self.addresses + 1
        yield "another address", self.request(number, words, to=other)

    def _count(self, piece: bytes) -> None:
        self.invalid += 1


def _checked(body: bytes) -> bytes:
    return body + zlib.crc32(body).to_bytes(_CRC_SIZE, "little")


def _framed(content: bytes) -> bytes:
    stuffed: bytes = cobs.encode(content)
    return b"\0" + stuffed + b"\0"
