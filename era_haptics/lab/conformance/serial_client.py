"""Client of an amplifier on a serial line, frame by frame."""

import zlib
from collections.abc import Iterator, Sequence
from contextlib import suppress

from cobs import cobs

from drivers.protocol.definition import EVENT, HELLO, IDENTITY, MAX_WORDS, MESSAGES, VERSION
from drivers.protocol.records import Refusal, Values
from drivers.wires.serial_frames import (
    NEUTRAL,
    REPLY_BIT,
    Frame,
    FrameReader,
    encode_frame,
    pack_words,
    words_of,
)
from era_haptics.lab.conformance.judge_client import HeardMessage, JudgeClient, with_flipped_bit
from era_haptics.lab.conformance.outcomes import expect_equal, read_as
from registry import threads

_SEQUENCES = 1 << 16
_SEQUENCE_AT = 3  # byte of a frame's content
_CRC_SIZE = 4


class SerialClient(JudgeClient):
    """An amplifier on a serial line; invalid: pieces that are no frame."""

    kind = "serial"

    def __init__(self, address: int) -> None:
        super().__init__(address)
        self.invalid: list[bytes] = []
        self._reader = FrameReader(on_invalid=self.invalid.append)

    def hear(self, data: bytes) -> bytes:
        """Take messages from bytes."""
        for frame in self._reader.feed(data):
            try:
                words = tuple(words_of(frame))
            except Refusal:
                self.invalid.append(frame.payload)
                continue
            message_type = frame.kind ^ REPLY_BIT  # which is set unless it is a reply
            message = HeardMessage(threads.now(), frame.sequence, message_type, words, frame)
            self.take(message, is_event=frame.kind == EVENT)
            if frame.address != self.address:
                self._heard_addresses.add(frame.address)
        return data

    def remark(self) -> str:
        """Return whether a reply has its CRC in the wrong byte order."""
        for piece in filter(None, self.last_bytes.split(b"\0")):
            with suppress(cobs.DecodeError):
                content = cobs.decode(piece)
                body, crc = content[:-_CRC_SIZE], content[-_CRC_SIZE:]
                if crc == zlib.crc32(body).to_bytes(_CRC_SIZE, "big"):
                    return ", whose CRC fits with its four bytes reversed: it goes low byte first"
        return ""

    def question(self, address: int) -> bytes:
        """Return the frame of a Hello to an address."""
        return self.request(HELLO, (), to=address, version=NEUTRAL)

    async def hello(self, payload: bytes = b"", version: int = NEUTRAL) -> Values:
        """Read the identity, by a Hello of any length and version."""
        reply = await self.exchange(HELLO, (), extra=payload, version=version)
        return read_as("identity", IDENTITY.unpack, reply.words, is_strict=False)

    def check_reply(self, message: HeardMessage, number: int, code: str) -> None:
        """Require its address, too, and its version."""
        is_neutral = number == HELLO or code == "UNSUPPORTED_VERSION"
        version = NEUTRAL if is_neutral else VERSION
        head = message.type, message.frame.version, message.frame.address
        expect_equal(head, (number, version, self.address), "type, version, address of a reply")

    def request(
        self,
        number: int,
        words: Sequence[int],
        *,
        to: int | None = None,
        extra: bytes = b"",
        version: int = VERSION,
    ) -> bytes:
        """Return the frame of a request under the next number; extra: bytes after its words."""
        self.number = (self.number + 1) % _SEQUENCES
        address = self.address if to is None else to
        payload = pack_words(words) + extra
        return encode_frame(Frame(number, address, self.number, payload, version))

    def damaged(self, number: int, words: Sequence[int]) -> Iterator[tuple[str, bytes]]:
        """Yield frames with damage of all kinds."""
        frame = self.request(number, words)
        content = cobs.decode(frame[1:-1])
        body = content[:-_CRC_SIZE]
        for position in (-4, -3, -2, -1, _SEQUENCE_AT):
            changed = with_flipped_bit(content, position)
            yield f"a wrong byte {position}", _framed(changed)
        block = self._frame_of_one_block()
        yield "a COBS block longer than the frame", b"\0\xff" + block[2:]
        yield "eight bytes", _framed(_checked(content[:4]))
        yield "its last byte missing", frame[:-2] + b"\0"
        yield "its first byte missing", b"\0" + frame[2:]
        yield "invalid COBS", b"\0\xff" + frame[2:]
        yield "no CRC", _framed(body)
        filling = bytes(2 * MAX_WORDS + 2 - 2 * len(words))
        yield "more than 240 bytes of payload", _framed(_checked(body + filling))
        reply = bytes([content[0] | REPLY_BIT]) + body[1:]
        yield "bit 7 of a reply", _framed(_checked(reply))
        yield "another address", self.request(number, words, to=self.free_address)

    def _frame_of_one_block(self) -> bytes:
        """Return the frame of a GetStatus without zeros, so that it is one COBS block."""
        for _ in range(_SEQUENCES):
            frame = self.request(MESSAGES["GetStatus"].number, [])
            if frame[1] == len(frame) - 2:
                return frame
        raise AssertionError("every sequence number has a zero")


def _checked(body: bytes) -> bytes:
    """Return a body with its CRC."""
    return body + zlib.crc32(body).to_bytes(_CRC_SIZE, "little")


def _framed(content: bytes) -> bytes:
    """Return content as a frame."""
    stuffed: bytes = cobs.encode(content)
    return b"\0" + stuffed + b"\0"
