"""The host's side of a serial line: frames of words, matched by address and sequence number."""

from drivers.codec.serial_line.frame import (
    NEUTRAL,
    REPLY,
    Frame,
    FrameReader,
    encode_frame,
    frame_length,
)
from drivers.host.wire import NETWORK_DELAY, Arrival, Broken, Event, Reply, Several, read_nak
from drivers.protocol.records import Refusal, Values
from drivers.protocol.serial_payload import (
    BROADCAST,
    HELLO,
    pack_words,
    unpack_identity,
    unpack_words,
)
from drivers.protocol.table import (
    BY_NUMBER,
    EVENT,
    EVENT_RECORD,
    MAX_WORDS,
    MESSAGES,
    NAK,
    VERSION,
)
from drivers.statistics import WireCounters

_BITS = 10  # of a byte, with start and stop


class SerialWire:
    """A line at a speed [baud], 0 for a network; sequence: number of the last request."""

    def __init__(self, baud: int, *, sequence: int) -> None:
        self.counters = WireCounters()
        self.delay = 0.0 if baud else NETWORK_DELAY
        self._baud = baud
        self._sequence = sequence
        self._pending: Frame | None = None
        self._replied: Frame | None = None  # the last reply
        self._reader = FrameReader(on_invalid=self._count_invalid)

    def request(self, address: int, name: str, values: Values) -> bytes:
        """Return the frame of a request, which is on the wire from now on; address 0: of all."""
        self._sequence = (self._sequence + 1) & 0xFFFF
        if name == "Hello":
            frame = Frame(HELLO, address, self._sequence, b"", NEUTRAL)
        else:
            message = MESSAGES[name]
            payload = pack_words(message.request.pack(values))
            frame = Frame(message.number, address, self._sequence, payload, VERSION)
        self._pending = None if address == BROADCAST else frame
        self.counters.frames_out += 1
        return encode_frame(frame)

    def received(self, data: bytes) -> list[Arrival]:
        """Return what these bytes complete."""
        arrivals = [self._arrival(frame) for frame in self._reader.feed(data)]
        return [arrival for arrival in arrivals if arrival is not None]

    def withdraw(self) -> None:
        """Take the request off the wire: its reply will be unexpected."""
        self._pending = None

    def transit(self, words: int) -> float:
        """Return how long a request of so many words takes to arrive [s]."""
        return _BITS * frame_length(2 * words) / self._baud if self._baud else 0.0

    def round_trip(self, name: str, length: int) -> float:
        """Return how long a request of this many bytes and its longest reply take [s]."""
        if not self._baud:
            return 0.0
        reply_bytes = 2 * MAX_WORDS if name != "Hello" else 140
        return _BITS * (length + frame_length(reply_bytes)) / self._baud

    def _arrival(self, frame: Frame) -> Arrival | None:
        self.counters.frames_in += 1
        if frame.kind == EVENT:
            return self._event(frame)
        pending = self._pending
        if (
            pending is None
            or not frame.kind & REPLY
            or (frame.address, frame.sequence) != (pending.address, pending.sequence)
        ):
            self.counters.unexpected_frames += 1
            return Several(frame.address) if self._is_second(frame) else None
        self._pending, self._replied = None, frame
        try:
            return _reply(frame, pending)
        except Refusal as refusal:
            return Broken(str(refusal))

    def _is_second(self, frame: Frame) -> bool:
        """Whether a frame is another reply to the request that was replied to last."""
        last = self._replied
        if last is None or frame == last:
            return False
        return (frame.address, frame.sequence) == (last.address, last.sequence)

    def _event(self, frame: Frame) -> Event | None:
        try:
            values = EVENT_RECORD.unpack(unpack_words(frame.payload), is_strict=False)
        except Refusal:
            self.counters.invalid_frames += 1
            return None
        self.counters.events += 1
        return Event(frame.address, values)

    def _count_invalid(self, piece: bytes) -> None:
        self.counters.invalid_frames += 1


def _reply(frame: Frame, request: Frame) -> Arrival:
    """Read the reply to a request; raises Refusal."""
    if frame.kind == NAK | REPLY:
        return read_nak(unpack_words(frame.payload))
    if frame.kind != request.kind | REPLY:
        return Broken(f"type of the reply must be {request.type}, got {frame.type}")
    if frame.version != request.version:
        return Broken(f"version of the reply must be {request.version}, got {frame.version}")
    if request.version == NEUTRAL:
        return Reply(unpack_identity(frame.payload))
    record = BY_NUMBER[request.kind].reply
    return Reply(record.unpack(unpack_words(frame.payload), is_strict=False))
