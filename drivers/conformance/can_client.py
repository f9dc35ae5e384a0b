"""A CAN bus, frame by frame."""

import asyncio
from collections.abc import Iterator, Mapping, Sequence

from drivers import clock
from drivers.codec.can_bus.canopen import CANOPEN, CanFrame, cob_id
from drivers.codec.can_bus.segments import (
    NODE_MAX,
    NUMBER_MAX,
    REPLY,
    REQUEST,
    Assembler,
    pack_frames,
    segments,
    unpack_frames,
)
from drivers.conformance.client import (
    Answer,
    Client,
    Heard,
    When,
    altered,
    expect_equal,
    expect_reply,
    read_as,
)
from drivers.protocol.records import Values
from drivers.protocol.table import HELLO, IDENTITY, NAK
from drivers.statistics import WireCounters

NMT: Mapping[str, int] = CANOPEN["nmt"]
_SETTLING = 0.005  # s; after a command of network management


class CanClient(Client):
    """A bus; number: of the last request. frames: all of the node."""

    kind = "can"
    addresses = NODE_MAX

    def __init__(self, address: int) -> None:
        super().__init__(address)
        self.number = 0
        self.frames: list[CanFrame] = []
        self._counters = WireCounters()
        self._replies = Assembler(self._counters)
        self._events = Assembler(self._counters, is_numbered=False)

    def received(self, data: bytes) -> None:
        """Take packed frames from the port."""
        now = clock.now()
        for frame in unpack_frames(data):
            if frame.id & NODE_MAX != self.address:
                continue
            self.frames.append(frame)
            if frame.id != REPLY + self.address:
                continue
            is_event = frame.data[:1] == b"\0"
            before = self._counters.unexpected_frames
            message = (self._events if is_event else self._replies).add(frame.data, now)
            if message is not None:
                self.take(Heard(now, *message), is_event=is_event)
            elif self._counters.unexpected_frames > before:  # again, or an older one
                self.take(Heard(now, frame.data[0], frame.data[2], ()))

    async def command(self, command: str, *, to: int | None = None) -> None:
        """Send a command of network management; to: a node, 0 for all, None for this one."""
        node = self.address if to is None else to
        self.put(cob_id("nmt"), bytes((NMT[command], node)))
        await asyncio.sleep(_SETTLING)

    def put(self, can_id: int, *data: bytes) -> None:
        """Send frames of one identifier."""
        self.port.write(pack_frames(CanFrame(can_id, each) for each in data))

    def next_number(self) -> int:
        """Return the number of a new request."""
        self.number = self.number % NUMBER_MAX + 1
        return self.number

    async def hello(self) -> Values:
        """Set the node operational and read the identity."""
        await self.command("start")
        answer = await self.exchange(HELLO, ())
        return read_as("identity", IDENTITY.unpack, answer.words, is_strict=False)

    async def exchange(self, number: int, words: Sequence[int]) -> Answer:
        """Send a message and await its reply."""
        sequence, sent = self.next_number(), clock.now()
        self.put(REQUEST + self.address, *segments(sequence, number, words))
        heard = expect_reply(await self.next(lambda each: each.number == sequence), number)
        if heard.type == NAK:
            return self.refusal(sent, heard.at, number, heard.words)
        expect_equal(heard.type, number, "type of a reply")
        return Answer("", None, heard.words, When(sent, heard.at))

    def request(self, number: int, words: Sequence[int], *, to: int | None = None) -> bytes:
        """Return the frames of a request."""
        node = self.address if to is None else to
        sequence = self.next_number() if node else 0
        return self.packed(segments(sequence, number, words), to=node)

    def packed(self, data: Sequence[bytes], *, to: int | None = None) -> bytes:
        """Return frames with these data to a node."""
        node = self.address if to is None else to
        return pack_frames(CanFrame(REQUEST + node, each) for each in data)

    def damaged(self, number: int, words: Sequence[int]) -> Iterator[tuple[str, bytes]]:
        """Yield frames with damage of all kinds, each under the next number."""

        def frames() -> list[bytes]:
            return segments(self.next_number(), number, words)

        first, *rest = frames()
        yield "seven bytes in its first frame", self.packed([first[:7], *rest])
        yield "another node", self.packed(frames(), to=self.address % NODE_MAX + 1)
        first, *rest = frames()
        yield "121 words", self.packed([first[:3] + b"\x79" + first[4:], *rest])
        first, *rest = frames()
        yield "the number of a broadcast", self.packed([b"\0" + first[1:], *rest])
        if rest:
            yield "its last frame missing", self.packed(frames()[:-1])
            yield "its first frame missing", self.packed(frames()[1:])
            first, *rest = frames()
            yield "two frames of one place", self.packed([altered(rest[-1], 2), *rest, first])

    def data_of(self, name: str) -> list[bytes]:
        """Return the data of the frames heard of a kind, by the name of its identifier."""
        can_id = cob_id(name, self.address)
        return [frame.data for frame in self.frames if frame.id == can_id]
