"""Serial lines: frames of words, matched by address and sequence number, and their URLs.

serial:///dev/ttyUSB0?baud=921600&address=1
serial+tcp://HOST:PORT?baud=921600&address=1     a serial server with raw TCP
"""

import random
import re
from collections.abc import Mapping
from typing import ClassVar

from drivers.errors import WireCounters
from drivers.ports import NETWORK_DELAY
from drivers.protocol.definition import BOOT_TIME, EVENT, HELLO, NAK, REQUESTS, VERSION, Message
from drivers.protocol.records import Refusal, Values
from drivers.urls import ADDRESS, ADDRESS_MAX, BAUD, AmplifierUrl
from drivers.wires.serial_frames import (
    NEUTRAL,
    REPLY_BIT,
    Frame,
    FrameReader,
    encode_frame,
    frame_length,
    words_of,
)
from drivers.wires.wire import (
    Arrival,
    BrokenReply,
    DuplicateAddress,
    Scheme,
    Wire,
    WireAddress,
    read_event,
    read_reply,
)

_BITS = 10  # of a byte, with start and stop


class SerialWire(Wire):
    """A line at a speed [baud], 0 if unknown; sequence: number of the last request.

    delay [s]: of a network on the way to it, as there is where the speed is unknown.
    """

    def __init__(self, baud: int, *, sequence: int, delay: float = 0.0) -> None:
        self.counters = WireCounters()
        self.delay = delay if baud else NETWORK_DELAY
        self._byte_time = _BITS / baud if baud else 0.0
        self._sequence = sequence
        self._pending: tuple[Frame, Message] | None = None
        self._replied: Frame | None = None  # the last reply
        self._reader = FrameReader(on_invalid=self._count_invalid)

    def request(self, address: int, name: str, values: Values, *, has_reply: bool = True) -> bytes:
        """Return the frame of a request, which counts as sent; address 0: a broadcast."""
        self._sequence = (self._sequence + 1) & 0xFFFF
        message, version = REQUESTS[name], NEUTRAL if name == "Hello" else VERSION
        frame = Frame(message.number, address, self._sequence, b"", version)
        data = encode_frame(frame, message.request.append([], values))
        self._pending = (frame, message) if has_reply else None
        self.counters.frames_out += 1
        self.takes = self._byte_time * len(data)
        return data

    def received(self, data: bytes) -> list[Arrival]:
        """Return the arrivals that these bytes complete."""
        arrivals: list[Arrival] = []
        for frame in self._reader.feed(data):
            self.counters.frames_in += 1
            sent, message = self._pending or (None, None)
            if (
                sent is None
                or message is None
                or not frame.is_reply
                or (frame.address, frame.sequence) != (sent.address, sent.sequence)
            ):
                arrivals += self._unexpected(frame)
                continue
            self._pending, self._replied = None, frame
            try:
                if frame.type != NAK and frame.version != sent.version:
                    raise Refusal(
                        f"version of the reply must be {sent.version}, got {frame.version}"
                    )
                arrivals.append(read_reply(message, frame.type, words_of(frame)))
            except Refusal as refusal:
                arrivals.append(BrokenReply(str(refusal)))
        return arrivals

    def _unexpected(self, frame: Frame) -> list[Arrival]:
        """Read a frame that is no reply to the request on the wire."""
        if frame.kind == EVENT:
            words = () if len(frame.payload) % 2 else words_of(frame)
            return read_event(frame.address, EVENT, words, self.counters)
        self.counters.unexpected_frames += 1
        self.counters.remark = (
            f"a reply of address {frame.address} to another request came: check the address, and "
            "that nothing delays the line"
            if frame.is_reply
            else "the request itself came back: check the wire from the amplifier to this machine"
        )
        last = self._replied
        # Of another request that comes twice, late, each reply is of its own moment.
        if last is None or frame == last or last.kind != HELLO | REPLY_BIT:
            return []
        is_same = (frame.address, frame.sequence) == (last.address, last.sequence)
        return [DuplicateAddress(frame.address)] if is_same else []

    def withdraw(self) -> None:
        """Give up the request on the wire, so that its reply will count as unexpected."""
        self._pending = None
        if self._reader.rest:
            self._remark_invalid(self._reader.rest)

    def transit(self, words: int) -> float:
        """Return how long a request with this number of words takes to arrive [s]."""
        return self._byte_time * frame_length(2 * words)

    def _count_invalid(self, piece: bytes) -> None:
        self.counters.invalid_frames += 1
        self._remark_invalid(piece)

    def _remark_invalid(self, piece: bytes) -> None:
        self.counters.remark = (
            f"{len(piece)} bytes that are no valid frame came ({piece[:8].hex(' ')}): check baud "
            "rate, cable and protocol; modbus+rtu:// is another one"
        )


_FORM = (
    "serial:///dev/ttyUSB0?baud=921600&address=1, or serial+tcp://HOST:PORT?baud=921600&address=1 "
    "for a serial server"
)


class SerialAddress(WireAddress):
    """An amplifier on a serial port of this machine, or behind a serial server."""

    SCHEMES: ClassVar[Mapping[str, Scheme]] = {
        "serial": Scheme(
            line_kind="",
            example="serial:///dev/ttyUSB0?baud=921600&address=1",
            help="a serial port",
            number="`?address=` 1 to 247",
            forms={"serial:///PATH": "`baud` 921600"},
        ),
        "serial+tcp": Scheme(
            line_kind="ethernet",
            example="serial+tcp://HOST:PORT?baud=921600",
            help="a serial server with raw TCP",
            number="`?address=` 1 to 247",
            forms={
                "serial+tcp://HOST:PORT": "`baud`: speed of the line behind the server (unknown)"
            },
        ),
    }
    boot_time = BOOT_TIME

    def __init__(self, url: str) -> None:
        parsed = AmplifierUrl(url, _FORM, known=("baud", "address"))
        number = "address must be given as ?address={}"
        parsed.require(not parsed.number, number.format(parsed.number))
        is_server = parsed.scheme == "serial+tcp"
        self.place = parsed.server(number=number) if is_server else parsed.device(BAUD)
        self.number = parsed.whole_option("address", ADDRESS, ADDRESS_MAX)
        self.line = self.place.name
        self.settings = {"protocol": "serial", "baud": self.place.baud}

    @staticmethod
    def with_address(url: str, address: int) -> str:
        """Return a URL with another address."""
        without_address = re.sub(r"(?<=[?&])address=\d+&?", "", url).rstrip("?&")
        separator = "&" if "?" in without_address else "?"
        return f"{without_address}{separator}address={address}"

    def make_wire(self) -> SerialWire:
        """Make the wire with a random number, so that a reply to an earlier host does not match."""
        delay = 0.0 if self.place.device else NETWORK_DELAY
        return SerialWire(self.place.baud, sequence=random.getrandbits(16), delay=delay)
