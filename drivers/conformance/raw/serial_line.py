"""Raw access to a serial line."""

import asyncio
import struct
from collections.abc import Sequence

from drivers.amplifier import WATCHDOG
from drivers.backends.serial_line.line import SerialLine, serial_line
from drivers.codec.serial_line.exchanges import encode_request, is_event
from drivers.codec.serial_line.frame import NEUTRAL, Frame, FrameReader, encode_frame
from drivers.codec.serial_line.frame import REPLY as REPLY_BIT
from drivers.codec.serial_line.timing import SerialTimes
from drivers.conformance.raw.line import NO_REPLY, REPLY, RawLine, RawRequest
from drivers.protocol.definition import PROTOCOL
from drivers.protocol.messages import (
    Apply,
    Arm,
    Broadcast,
    GetStatus,
    Hello,
    NakCode,
    Ping,
    Request,
    SetAddress,
    Stop,
)
from drivers.urls.serial_line import SerialUrl

_NAK = REPLY_BIT | PROTOCOL.types["nak"]
_OTHER_ADDRESS = PROTOCOL.serial.address_max - 1
_UNKNOWN_TYPE = PROTOCOL.vendor_numbers - 1
_TIMEOUT = 0.03  # s, beyond the time on the line; three times the longest reaction
_SEQUENCE = 0xA55A
_Q = PROTOCOL.quantities
_SESSION, _TOKEN, _RAMP, _VALID, _COUNT, _COMMANDS = 0, 2, 4, 6, 8, 9  # offsets of an Apply
_FLAGS, _LEVEL, _PHASE = _COMMANDS + 1, _COMMANDS + 4, _COMMANDS + 6  # of its first command


class SerialRaw(RawLine):
    """Raw access to the line of an open amplifier at a URL."""

    page = "wire-protocol.md"

    def __init__(self, url: str) -> None:
        self.url = url
        self._url = SerialUrl.parse(url)
        self._replies: list[Frame] = []
        self._reader = FrameReader()
        self._came = asyncio.Event()

    async def send(self, request: RawRequest) -> str:
        """See `RawLine`."""
        self._replies.clear()
        self._came.clear()
        self._reader = FrameReader()
        self._line.tap = self._heard
        try:
            await self._write(request)
            size = sum(len(piece) for piece in request.pieces if isinstance(piece, bytes))
            timeout = SerialTimes(self._url.baud).exchange(size) + _TIMEOUT
            try:
                async with asyncio.timeout(timeout):
                    await self._came.wait()
            except TimeoutError:
                return NO_REPLY
        finally:
            self._line.tap = None
        return self._outcome(self._replies[0])

    async def send_only(self, request: RawRequest) -> None:
        """See `RawLine`."""
        await self._write(request)
        size = sum(len(piece) for piece in request.pieces if isinstance(piece, bytes))
        await asyncio.sleep(SerialTimes(self._url.baud).exchange(size) + 0.002)

    def invalid(self, ping: Ping, apply: Apply) -> Sequence[RawRequest]:
        """See `RawLine`."""
        beat, played = self._frame(ping), self._frame(apply)
        found = [
            self._made("a Ping with a wrong CRC", _damaged(encode_frame(beat)), NO_REPLY),
            self._made(
                "a Ping with a wrong last byte of the CRC",
                _damaged(encode_frame(beat), -2),
                NO_REPLY,
            ),
            self._made("an Apply with a damaged bit", _damaged(encode_frame(played), 12), NO_REPLY),
            self._made(
                "a Ping to another address", beat._replace(address=_OTHER_ADDRESS), NO_REPLY
            ),
            self._made(
                "an Apply to another address", played._replace(address=_OTHER_ADDRESS), NO_REPLY
            ),
            self._made(
                "a Ping with the reply bit", beat._replace(kind=beat.kind | REPLY_BIT), NO_REPLY
            ),
            self._made("a frame of six bytes", b"\0\x07abcdef\0", NO_REPLY),
            self._made("data that cannot be unstuffed", b"\0\x20\x01\x01\x01\0", NO_REPLY),
            self._made(
                "a message of an unknown type", beat._replace(kind=_UNKNOWN_TYPE), "UNKNOWN_TYPE"
            ),
        ]
        for version in (1, PROTOCOL.version + 1):
            found.append(
                self._made(
                    f"a Ping of version {version}",
                    beat._replace(version=version),
                    "UNSUPPORTED_VERSION",
                )
            )
        for frame, what in ((beat, "a Ping"), (played, "an Apply")):
            longer = frame._replace(payload=frame.payload + b"\0")
            shorter = frame._replace(payload=frame.payload[:-1])
            found.append(self._made(f"{what} with a byte too many", longer, "BAD_LENGTH"))
            found.append(self._made(f"{what} with a byte too few", shorter, "BAD_LENGTH"))
        return [*found, *self._bad_sets(played)]

    def _bad_sets(self, played: Frame) -> list[RawRequest]:
        """Make sets with one value or flag out of range."""
        body = played.payload
        command = body[_COMMANDS:]
        twice = body[:_COUNT] + b"\x02" + command * 2
        none = body[:_COMMANDS] + b"\x10" + command[1:]
        changed = [
            ("a flag that is not defined", _put(body, "<B", _FLAGS, body[_FLAGS] | 8), "BAD_VALUE"),
            ("another flag", _put(body, "<B", _FLAGS, body[_FLAGS] | 0x80), "BAD_VALUE"),
            ("a level out of range", _put(body, "<H", _LEVEL, _Q.level.maximum + 1), "BAD_VALUE"),
            ("a phase out of range", _put(body, "<h", _PHASE, _Q.phase.maximum + 1), "BAD_VALUE"),
            ("a ramp out of range", _put(body, "<H", _RAMP, _Q.ramp.maximum + 1), "BAD_VALUE"),
            (
                "a valid_for out of range",
                _put(body, "<H", _VALID, _Q.valid_for.maximum + 1),
                "BAD_VALUE",
            ),
            ("token 0", _put(body, "<H", _TOKEN, 0), "BAD_TOKEN"),
            ("a channel twice", twice, "BAD_CHANNEL"),
            ("channel 16", none, "BAD_CHANNEL"),
            ("a command too few", _put(body, "<B", _COUNT, 2), "BAD_LENGTH"),
            ("session 0", _put(body, "<H", _SESSION, 0), "WRONG_SESSION"),
        ]
        return [
            self._made(f"an Apply with {name}", played._replace(payload=payload), outcome)
            for name, payload, outcome in changed
        ]

    def tolerated(self, ping: Ping) -> Sequence[RawRequest]:
        """See `RawLine`."""
        whole = self._next(ping)
        half = len(whole) // 2
        hello = self._frame(Hello())._replace(version=PROTOCOL.version + 7, payload=b"abc")
        return [
            self._made("half a frame, then a Ping", whole[:half] + self._next(ping), REPLY),
            self._made("noise, then a Ping", b"\xff\x55\xaa" * 9 + self._next(ping), REPLY),
            self._made("300 bytes of noise, then a Ping", b"\x55" * 300 + self._next(ping), REPLY),
            self._made("zeros, then a Ping", b"\0\0\0" + self._next(ping), REPLY),
            self._made("a Hello of another version and length", hello, REPLY),
            RawRequest(
                "a Ping in two pieces", _halves(self._next(ping)), frozenset({REPLY}), 0.005
            ),
        ]

    def broadcasts(self, ping: Ping, apply: Apply) -> Sequence[RawRequest]:
        """See `RawLine`."""
        arm = Arm(WATCHDOG, session=ping.session)
        return [
            self._made(f"a broadcast {type(one).__name__}", self._to_all(one), NO_REPLY)
            for one in (ping, apply, arm, GetStatus())
        ]

    @property
    def address(self) -> int:
        """See `RawLine`."""
        return self._url.address

    def address_requests(self, own: SetAddress, other: SetAddress) -> Sequence[RawRequest]:
        """See `RawLine`."""
        return [
            self._made("SetAddress of its own serial number", self._frame(own), REPLY),
            self._made("SetAddress of another serial number", self._frame(other), NO_REPLY),
        ]

    def stop_out_of_range(self) -> RawRequest:
        """See `RawLine`."""
        stop = self._frame(Stop(0.0))._replace(payload=b"\xff\xff")
        return self._made("a Stop with a ramp out of range", stop, REPLY)

    def carried_out(self, request: Broadcast) -> RawRequest:
        """See `RawLine`."""
        return self._made(f"a broadcast {type(request).__name__}", self._to_all(request), NO_REPLY)

    @property
    def _line(self) -> SerialLine:
        return serial_line(self._url.port, baud=self._url.baud)

    async def _write(self, request: RawRequest) -> None:
        for number, piece in enumerate(request.pieces):
            assert isinstance(piece, bytes)  # noqa: S101  made here
            if number:
                await asyncio.sleep(request.pause)
            self._line.send(piece)

    def _heard(self, data: bytes) -> None:
        for frame in self._reader.feed(data):
            if not is_event(frame):
                self._replies.append(frame)
                self._came.set()

    def _outcome(self, reply: Frame) -> str:
        if (reply.address, reply.sequence) != (self._url.address, _SEQUENCE):
            return f"a reply from address {reply.address} with sequence number {reply.sequence}"
        if reply.kind != _NAK:
            return REPLY
        if reply.payload[1:2] == bytes([NakCode.UNSUPPORTED_VERSION]) and reply.version != NEUTRAL:
            return f"UNSUPPORTED_VERSION of version {reply.version}"
        return NakCode(reply.payload[1]).name if len(reply.payload) > 1 else "an incomplete Nak"

    def _frame(self, request: Request) -> Frame:
        return encode_request(request, address=self._url.address, sequence=_SEQUENCE)

    def _to_all(self, request: Request) -> Frame:
        return self._frame(request)._replace(address=PROTOCOL.serial.broadcast)

    def _next(self, request: Request) -> bytes:
        return encode_frame(self._frame(request))

    def _made(self, name: str, data: Frame | bytes, outcome: str) -> RawRequest:
        whole = encode_frame(data) if isinstance(data, Frame) else data
        return RawRequest(name, (whole,), frozenset({outcome}))


def _damaged(whole: bytes, at: int = -3) -> bytes:
    """Flip a bit of a frame, without making a zero."""
    changed = bytearray(whole)
    changed[at] ^= 0x40 if changed[at] != 0x40 else 0x20
    return bytes(changed)


def _put(payload: bytes, layout: str, at: int, value: int) -> bytes:
    """Replace an integer in a payload."""
    changed = bytearray(payload)
    struct.pack_into(layout, changed, at, value)
    return bytes(changed)


def _halves(whole: bytes) -> tuple[bytes, bytes]:
    return whole[: len(whole) // 2], whole[len(whole) // 2 :]
