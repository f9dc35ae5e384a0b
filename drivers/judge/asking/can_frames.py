"""A CAN bus, frame by frame, and the check of frames and their numbers."""

import asyncio
import math
import struct
from collections.abc import Iterator, Mapping, Sequence
from typing import cast

from drivers.errors import WireCounters
from drivers.protocol.definition import HELLO, IDENTITY, MESSAGES, NAK
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
from era_haptics.lab.conformance.check import driving
from era_haptics.lab.conformance.judge_client import (
    Answer,
    Client,
    Heard,
    When,
    altered,
    expect_equal,
    layer,
    message_name,
    read_as,
    require,
    require_in_time,
)
from era_haptics.lab.conformance.subject import Subject
from registry import threads

_NMT: Mapping[str, int] = CANOPEN["nmt"]
_OF_NODES = {*map(cob_id, ("emergency", "heartbeat", "sdo_answer")), REPLY}
UPLOAD = 0x40
"""Begins a read of an object."""
_DEVICE_TYPE = 0x1000
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

    def hear(self, data: bytes) -> bytes:
        """Take messages from packed frames, and note other nodes."""
        now, own = threads.now(), b""
        for frame in unpack_frames(data):
            node = frame.id & NODE_MAX
            if node != self.address:
                self._others |= {node} if node and frame.id - node in _OF_NODES else set()
                continue
            own += frame.data
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
        return own

    def question(self, address: int) -> bytes:
        """Return the frame that reads what device a node is."""
        data = struct.pack("<BHB4x", UPLOAD, _DEVICE_TYPE, 0)
        return pack_frames([CanFrame(cob_id("sdo_request", address), data)])

    async def command(self, command: str, *, to: int | None = None) -> None:
        """Send a command of network management; to: a node, 0 for all, None for this one."""
        node = self.address if to is None else to
        self.put(cob_id("nmt"), bytes((_NMT[command], node)))
        await asyncio.sleep(_SETTLING)

    def put(self, can_id: int, *data: bytes) -> None:
        """Send frames of one identifier."""
        self.write(pack_frames(CanFrame(can_id, each) for each in data))

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
        sequence, sent = self.next_number(), threads.now()
        self.put(REQUEST + self.address, *segments(sequence, number, words))
        heard = await self.replied(lambda each: each.number == sequence, message_name(number))
        if heard.type == NAK:
            return self.refusal(sent, heard.at, number, heard.words)
        expect_equal(heard.type, number, "type of a reply")
        return Answer("", None, heard.words, When(sent, heard.at))

    def request(self, number: int, words: Sequence[int], *, to: int | None = None) -> bytes:
        """Return the frames of a request."""
        sequence = 0 if to == 0 else self.next_number()
        return self.packed(segments(sequence, number, words), to=to)

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
        yield "another node", self.packed(frames(), to=self.free)
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


_PLACE = "can.md#messages-as-frames"
_PING, _SET, _STATUS = (MESSAGES[name].number for name in ("Ping", "Set", "GetStatus"))
_COMMIT = MESSAGES["Commit"].number
_LIFE, _FORGOTTEN = 0.09, 0.12  # s; for which a number is kept, after which any begins
_FAST = 0.015  # s; exchanges that are quick enough to see for how long a number is kept


def can_client(subject: Subject) -> CanClient:
    """Return the client of an amplifier on a bus."""
    return cast(CanClient, subject.client)


@driving(_PLACE, "can")
async def numbers(subject: Subject) -> None:
    """It takes newer numbers only, each message once, its frames in any order."""
    client = can_client(subject)
    require(
        subject.exchange_time <= _FAST, "the line is too slow to see for how long it keeps a number"
    )
    await subject.arm()
    client.quiet = _FAST

    async def expect_replies(count: int, what: str, *data: bytes, since: float = math.inf) -> None:
        heard = await client.send(client.packed(data))
        require_in_time(threads.now() - since <= _LIFE, "frames were too far apart")
        expect_equal(len(heard), count, f"replies to {what}")

    async def follow(number: int, *others: tuple[int, int]) -> None:
        """Require a reply to a number, then to those that follow it."""
        accepted = math.inf
        for each, count in ((number, 1), *others):
            sent = threads.now()
            ping = segments(each, _PING, [subject.session, 0])
            what = f"number {each} after {number}"
            await expect_replies(count, what, *ping, since=min(accepted, sent))
            accepted = sent if count else accepted

    for number, order in ((200, -1), (220, 1)):
        part, words = subject.words_of(layer(0, subject.tone(0, 0.5)))
        await asyncio.sleep(_FORGOTTEN)
        sent = threads.now()
        frames = segments(number, _SET, words)[::order]
        await expect_replies(1, "frames in another order", *frames)
        subject.played(part, sent)
        client.number = number
        await subject.ping()
    await asyncio.sleep(_FORGOTTEN)
    await follow(100, (100, 0), (99, 0), (228, 0), (227, 1), (226, 0), (100, 0))
    await asyncio.sleep(_FORGOTTEN)
    await follow(3, (255, 0), (4, 1), (130, 1), (255, 1), (1, 1))
    _, words = subject.words_of(subject.one())
    for number in (2, 4):
        *others, last = segments(number, _SET, words)
        await expect_replies(0, "a part of a message", *others)
        await (follow(3) if number == 2 else asyncio.sleep(_FORGOTTEN))
        await expect_replies(0, "the last frame of a message that was given up", last)
    again = MESSAGES["Commit"].request.pack(subject.filled({"token": subject.token}))
    for number, kind, sent_words in ((9, _STATUS, []), (10, _COMMIT, again)):
        *others, last = segments(number, kind, sent_words)
        what = f"message {kind} with bytes behind its words"
        await expect_replies(1, what, *others, last[:4] + b"\xff" * 4)
    client.number = 10
    shown = (await client.exchange(HELLO, [0xFFFF])).words
    named = read_as("identity", IDENTITY.unpack, shown, is_strict=False)
    expect_equal(named, subject.identity, "identity by a Hello with words")
    await subject.ping()
