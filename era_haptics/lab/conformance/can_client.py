"""Client of a node on a CAN bus, frame by frame."""

import asyncio
import struct
from collections.abc import Iterator, Mapping, Sequence

from drivers.errors import WireCounters
from drivers.protocol.definition import HELLO, IDENTITY
from drivers.protocol.records import Values
from drivers.wires.can_frames import (
    CANOPEN,
    NODE_MAX,
    NUMBER_MAX,
    REPLY,
    REQUEST,
    Assembler,
    CanFrame,
    cob_id,
    pack_frames,
    segments,
    unpack_frames,
)
from era_haptics.lab.conformance.judge_client import HeardMessage, JudgeClient, with_flipped_bit
from era_haptics.lab.conformance.outcomes import read_as
from registry import threads

UPLOAD = 0x40
"""Command of an SDO that begins to read an object."""
_NMT: Mapping[str, int] = CANOPEN["nmt"]
_NODE_IDS = {*map(cob_id, ("emergency", "heartbeat", "sdo_answer")), REPLY}
"""Identifiers, less the node, of what nodes send."""
_DEVICE_TYPE = 0x1000
_SETTLING = 0.005  # s; after a command of network management


class CanClient(JudgeClient):
    """A node on a bus; frames: all frames of the node."""

    kind = "can"
    addresses = NODE_MAX

    def __init__(self, address: int) -> None:
        super().__init__(address)
        self.frames: list[CanFrame] = []
        self._counters = WireCounters()
        self._replies = Assembler(self._counters)
        self._events = Assembler(self._counters, is_numbered=False)

    def hear(self, data: bytes) -> bytes:
        """Take messages from packed frames, and note other nodes."""
        own_bytes = b""
        for frame in unpack_frames(data):
            node = frame.id & NODE_MAX
            if node == self.address:
                own_bytes += frame.data
                self._take_frame(frame)
            elif node and frame.id - node in _NODE_IDS:
                self._heard_addresses.add(node)
        return own_bytes

    def _take_frame(self, frame: CanFrame) -> None:
        """Keep a frame of the node, and the message that it completes."""
        self.frames.append(frame)
        if frame.id != REPLY + self.address:
            return
        now = threads.now()
        is_event = frame.data[:1] == b"\0"
        unexpected_frames = self._counters.unexpected_frames
        assembler = self._events if is_event else self._replies
        message = assembler.add(frame.data, now)
        if message is not None:
            self.take(HeardMessage(now, *message), is_event=is_event)
        elif self._counters.unexpected_frames > unexpected_frames:  # again, or an older one
            self.take(HeardMessage(now, frame.data[0], frame.data[2], ()))

    def question(self, address: int) -> bytes:
        """Return the frame that reads what device a node is."""
        data = struct.pack("<BHB4x", UPLOAD, _DEVICE_TYPE, 0)
        return pack_frames([CanFrame(cob_id("sdo_request", address), data)])

    async def hello(self) -> Values:
        """Set the node operational and read the identity."""
        await self.command("start")
        reply = await self.exchange(HELLO, ())
        return read_as("identity", IDENTITY.unpack, reply.words, is_strict=False)

    async def command(self, command: str, *, to: int | None = None) -> None:
        """Send a command of network management; to: a node, 0 for all, None for this one."""
        node = self.address if to is None else to
        self.put(cob_id("nmt"), bytes((_NMT[command], node)))
        await asyncio.sleep(_SETTLING)

    def put(self, can_id: int, *data: bytes) -> None:
        """Send frames with a single identifier."""
        self.write(pack_frames(CanFrame(can_id, content) for content in data))

    def data_of(self, name: str) -> list[bytes]:
        """Return the data of the frames heard of a kind, by the name of its identifier."""
        can_id = cob_id(name, self.address)
        return [frame.data for frame in self.frames if frame.id == can_id]

    def request(self, number: int, words: Sequence[int], *, to: int | None = None) -> bytes:
        """Return the frames of a request."""
        sequence = 0 if to == 0 else self.next_number()
        return self.packed(segments(sequence, number, words), to=to)

    def next_number(self) -> int:
        """Return the number of a new request."""
        self.number = self.number % NUMBER_MAX + 1
        return self.number

    def packed(self, data: Sequence[bytes], *, to: int | None = None) -> bytes:
        """Return frames with these data to a node."""
        node = self.address if to is None else to
        return pack_frames(CanFrame(REQUEST + node, content) for content in data)

    def damaged(self, number: int, words: Sequence[int]) -> Iterator[tuple[str, bytes]]:
        """Yield frames with damage of all kinds, each under the next number."""

        def frames() -> list[bytes]:
            return segments(self.next_number(), number, words)

        head, *tail = frames()
        yield "a first frame of seven bytes", self.packed([head[:7], *tail])
        yield "another node", self.packed(frames(), to=self.free_address)
        head, *tail = frames()
        yield "121 words", self.packed([head[:3] + b"\x79" + head[4:], *tail])
        head, *tail = frames()
        yield "the number of a broadcast", self.packed([b"\0" + head[1:], *tail])
        if tail:
            yield "its last frame missing", self.packed(frames()[:-1])
            yield "its first frame missing", self.packed(frames()[1:])
            head, *tail = frames()
            changed = with_flipped_bit(tail[-1], 2)
            yield "two different frames with one index", self.packed([changed, *tail, head])
