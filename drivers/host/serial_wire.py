"""The host's side of a serial line: frames of words, matched by address and sequence number."""

from drivers.codec.serial_line.frame import (
    NEUTRAL,
    REPLY,
    Frame,
    FrameReader,
    encode_frame,
    frame_length,
    pack_words,
    unpack_identity,
    unpack_words,
)
from drivers.host.wire import (
    NETWORK_DELAY,
    Arrival,
    Broken,
    Reply,
    Several,
    Wire,
    read_event,
    read_nak,
)
from drivers.protocol.records import Refusal, Values
from drivers.protocol.table import (
    BROADCAST,
    BY_NUMBER,
    EVENT,
    HELLO,
    MESSAGES,
    NAK,
    VERSION,
)
from drivers.statistics import WireCounters

_BITS = 10  # of a byte, with start and stop


class SerialWire(Wire):
    """A line at a speed [baud], 0 for a network; sequence: number of the last request."""

    def __init__(self, baud: int, *, sequence: int) -> None:
        self.counters = WireCounters()
        self.delay = 0.0 if baud else NETWORK_DELAY
        self._byte_time = _BITS / baud if baud else 0.0
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
            payload = pack_words(message.request.append([], values))
            frame = Frame(message.number, address, self._sequence, payload, VERSION)
        self._pending = None if address == BROADCAST else frame
        self.counters.frames_out += 1
        data = encode_frame(frame)
        self.takes = self._byte_time * len(data)
        return data

    def received(self, data: bytes) -> list[Arrival]:
        """Return what these bytes complete."""
        arrivals: list[Arrival] = []
        for frame in self._reader.feed(data):
            self.counters.frames_in += 1
            pending = self._pending
            if frame.kind == EVENT:
                words = () if len(frame.payload) % 2 else unpack_words(frame.payload)
                arrivals += read_event(frame.address, EVENT, words, self.counters)
            elif (
                pending is None
                or not frame.kind & REPLY
                or (frame.address, frame.sequence) != (pending.address, pending.sequence)
            ):
                self.counters.unexpected_frames += 1
                last = self._replied
                if (
                    last is not None
                    and frame != last
                    and (frame.address, frame.sequence) == (last.address, last.sequence)
                ):
                    arrivals.append(Several(frame.address))
            else:
                self._pending, self._replied = None, frame
                arrivals.append(self._reply(frame, pending))
        return arrivals

    def withdraw(self) -> None:
        """Take the request off the wire: its reply will be unexpected."""
        self._pending = None

    def transit(self, words: int) -> float:
        """Return how long a request of so many words takes to arrive [s]."""
        return self._byte_time * frame_length(2 * words)

    def _reply(self, frame: Frame, request: Frame) -> Arrival:
        """Read the reply to a request."""
        kind, version = frame.kind ^ REPLY, frame.version
        try:
            if kind == NAK:
                return read_nak(unpack_words(frame.payload))
            if (kind, version) != (request.kind, request.version):
                expected = f"{request.kind} in version {request.version}"
                return Broken(f"type of the reply must be {expected}, got {kind} in {version}")
            if kind == HELLO:
                return Reply(unpack_identity(frame.payload))
            # What follows is ignored.
            return Reply(BY_NUMBER[kind].reply.read(unpack_words(frame.payload))[0])
        except Refusal as refusal:
            return Broken(str(refusal))

    def _count_invalid(self, piece: bytes) -> None:
        self.counters.invalid_frames += 1
