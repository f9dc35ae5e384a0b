"""A CAN bus, frame by frame, objects by SDO, and the checks of them."""

import asyncio
import math
import struct
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import cast

from drivers.counters import WireCounters
from drivers.judge.asking.check import driving, reading
from drivers.judge.asking.client import (
    Answer,
    Client,
    Heard,
    Violation,
    When,
    altered,
    expect,
    expect_equal,
    expect_within,
    message_name,
    read_as,
    require,
    require_in_time,
)
from drivers.judge.asking.material import layer
from drivers.judge.asking.subject import Subject
from drivers.judge.states import FAULT, OFF, REACTING
from drivers.protocol.records import Values
from drivers.protocol.table import (
    FAULTS,
    HELLO,
    IDENTITY,
    MESSAGES,
    NAK,
    NO_CHANNEL,
    STATES,
    STATUS,
    TEXTS,
    name_of,
)
from drivers.wires.can_bus.canopen import CANOPEN, CanFrame, cob_id
from drivers.wires.can_bus.frames import (
    NODE_MAX,
    NUMBER_MAX,
    REPLY,
    REQUEST,
    Assembler,
    pack_frames,
    segments,
    unpack_frames,
)
from registry import clock

_NMT: Mapping[str, int] = CANOPEN["nmt"]
_OF_NODES = {*map(cob_id, ("emergency", "heartbeat", "sdo_answer")), REPLY}
_UPLOAD, _DEVICE_TYPE = 0x40, 0x1000
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
        now, own = clock.now(), b""
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
        data = struct.pack("<BHB4x", _UPLOAD, _DEVICE_TYPE, 0)
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
        sequence, sent = self.next_number(), clock.now()
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


_ABORT, _WRITTEN = 0x80, 0x60
_TRIES, _POLL = 500, 0.001  # s


async def _exchange(client: CanClient, data: bytes) -> bytes:
    client.frames.clear()
    client.put(cob_id("sdo_request", client.address), data)
    for _ in range(_TRIES):
        await asyncio.sleep(_POLL)
        if replies := client.data_of("sdo_answer"):
            return replies[0]
    raise Violation("reply to an SDO", expected="one within 0.5 s", seen="none")


async def write_object(
    client: CanClient, index: int, data: bytes, subindex: int = 0, *, is_taken: bool = True
) -> None:
    """Write an object of up to four bytes, which must be taken or refused."""
    command = 0x23 | 4 - len(data) << 2
    answer = await _exchange(client, struct.pack("<BHB4s", command, index, subindex, data))
    required = _WRITTEN if is_taken else _ABORT
    expect_equal(answer[0], required, f"reply to a write of object {index:04x}")


async def read_object(
    client: CanClient, index: int, subindex: int = 0, *, is_there: bool = True
) -> bytes:
    """Read an object, expedited or in segments, which must be there or not; returns its bytes."""
    answer = await _exchange(client, struct.pack("<BHB4x", _UPLOAD, index, subindex))
    what = f"reply to a read of {index:04x}/{subindex}"
    expect_equal(answer[0] & 0xE0, _UPLOAD if is_there else _ABORT, what)
    if answer[0] & 2 or not is_there:
        return answer[4 : 8 - (answer[0] >> 2 & 3)]
    (size,) = struct.unpack_from("<L", answer, 4)
    data, toggle = b"", 0
    while len(data) < size:
        answer = await _exchange(client, bytes([0x60 | toggle]) + bytes(7))
        is_next = answer[0] & 0xF0 == toggle
        expect(is_next, f"segment of the {what}", expected="the next", seen=answer.hex())
        data += answer[1 : 8 - (answer[0] >> 1 & 7)]
        toggle ^= 0x10
    return data


_PLACE = "can.md#messages-as-frames"
_PING, _SET, _STATUS = (MESSAGES[name].number for name in ("Ping", "Set", "GetStatus"))
_LIFE, _FORGOTTEN = 0.09, 0.12  # s; for which a number is kept, after which any begins
_FAST = 0.015  # s; exchanges that are quick enough to see for how long a number is kept
_OPERATIONAL, _PRE_OPERATIONAL = 5, 127
_EMERGENCY = struct.Struct("<HBBB3x")


def _client(subject: Subject) -> CanClient:
    return cast(CanClient, subject.client)


@driving(_PLACE, "can")
async def numbers(subject: Subject) -> None:
    """It takes newer numbers only, each message once, its frames in any order."""
    client = _client(subject)
    require(
        subject.exchange_time <= _FAST, "the line is too slow to see for how long it keeps a number"
    )
    await subject.arm()
    client.quiet = _FAST

    async def expect_replies(count: int, what: str, *data: bytes, since: float = math.inf) -> None:
        heard = await client.send(client.packed(data))
        require_in_time(clock.now() - since <= _LIFE, "frames were too far apart")
        expect_equal(len(heard), count, f"replies to {what}")

    async def follow(number: int, *others: tuple[int, int]) -> None:
        """Require a reply to a number, then to those that follow it."""
        accepted = math.inf
        for each, count in ((number, 1), *others):
            sent = clock.now()
            ping = segments(each, _PING, [subject.session, 0])
            what = f"number {each} after {number}"
            await expect_replies(count, what, *ping, since=min(accepted, sent))
            accepted = sent if count else accepted

    for number, order in ((200, -1), (220, 1)):
        part, words = subject.words_of(layer(0, subject.tone(0, 0.5)))
        await asyncio.sleep(_FORGOTTEN)
        sent = clock.now()
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
    (ping,) = segments(9, _PING, [subject.session, 0])
    await expect_replies(1, "words that are not used", ping[:6] + b"\xff\xff")
    client.number = 10
    await subject.ping()


@driving("can.md#network-management", "can")
async def network_management(subject: Subject) -> None:
    """It replies while operational only, and stops what plays when it is taken out of operation."""
    client = _client(subject)
    await client.look_around()

    async def stopped_by(command: str) -> None:
        sent = clock.now()
        await client.command(command)
        subject.shown.carry_out("Stop", {"ramp": 0}, {}, subject.since(sent))
        data = client.packed(segments(client.next_number(), _STATUS, []))
        await client.expect_silence(data, f"GetStatus after {command}")
        await client.command("start")

    for command in ("pre_operational", "stop", "reset_communication"):
        stopped = partial(stopped_by, command)
        await subject.run([subject.arm, subject.one(), subject.starve, stopped, subject.clear])
    start = partial(client.command, "start")
    for_all = [partial(start, to=0)] * (not client.neighbours)
    ended = partial(client.command, "pre_operational", to=client.free)
    await subject.run([subject.arm, subject.one(), start, *for_all, ended])
    client.frames.clear()
    await client.command("reset_node")
    await asyncio.sleep(0.1)
    beats = b"".join(client.data_of("heartbeat"))
    beats = beats.lstrip(bytes([_OPERATIONAL]))  # were still on their way
    shown = beats[:1], beats[-1:]
    expect_equal(shown, (b"\0", bytes([_PRE_OPERATIONAL])), "heartbeats after reset_node")
    await client.command("start")
    reply = await client.exchange(_STATUS, ())
    status = STATUS.unpack(reply.words, is_strict=False)
    seen = name_of(STATES, status["state"]), any(status["levels"]), status["token"]
    expect_equal(seen, ("SWITCH_ON_DISABLED", False, 0), "state, levels, token after reset_node")
    subject.require_alone()


@driving("can.md#network-management", "can")
async def heartbeats(subject: Subject) -> None:
    """It sends its state in the interval of object 1017, and emergencies of faults."""
    client = _client(subject)
    stated = int.from_bytes(await read_object(client, 0x1017), "little")
    for interval in (stated, 20, 0, stated):
        await write_object(client, 0x1017, struct.pack("<H", interval))
        await asyncio.sleep(0.06)
        client.frames.clear()
        began = clock.now()
        await asyncio.sleep(0.3)
        took, beats = clock.now() - began, b"".join(client.data_of("heartbeat"))
        count = 1000 * took / interval if interval else 0
        slack, what = 0.15 * count + (interval > 0), f"heartbeats of {interval} ms in {took:.3g} s"
        expect_within(len(beats), count - slack, count + slack, what)
        expect({*beats} <= {_OPERATIONAL}, "state in a heartbeat", expected="5", seen=beats)
    client.frames.clear()
    await subject.run([partial(subject.arm, 0.0), subject.starve, subject.settle, subject.clear])
    known, fault = CANOPEN["emergencies"]["WATCHDOG"], FAULTS["WATCHDOG"] << 4
    head = known["code"], known["error_register"]
    tripped = [_EMERGENCY.pack(*head, fault | each, NO_CHANNEL) for each in (REACTING, FAULT)]
    *first, last = client.data_of("emergency") or [b""]
    is_reported = bool(first) and {*first} <= {*tripped}
    expect(is_reported, "emergencies of the watchdog", expected=tripped, seen=first)
    expect_equal(last, _EMERGENCY.pack(0, 0, OFF, NO_CHANNEL), "emergency after Clear")


@reading("can.md#objects", "can")
async def objects(subject: Subject) -> None:
    """It shows identity, capabilities and status as objects, of which 1017 alone can be written."""
    client, caps = _client(subject), (await subject.request("GetCaps")).words
    status = (await subject.request("GetStatus")).words
    for index, subindex, size, value in (
        (0x1000, 0, 4, None),
        (0x1001, 0, 1, None),
        (0x1014, 0, 4, cob_id("emergency", client.address)),
        (0x1018, 0, 1, 4),
        (0x2000, 5, 2, subject.identity["versions"]),
        (0x2001, 0, 1, len(caps)),
        *((0x2001, number, 2, word) for number, word in enumerate(caps, 1)),
        (0x2002, 0, 1, len(status)),
        (0x2002, STATUS.places["state"] + 1, 2, status[STATUS.places["state"]]),
        (0x2002, len(status), 2, None),
    ):
        data = await read_object(client, index, subindex)
        seen = len(data), value and int.from_bytes(data, "little")
        expect_equal(seen, (size, value), f"bytes and value of object {index:04x}/{subindex}")
    for number, field in enumerate(TEXTS, 1):
        text = (await read_object(client, 0x2000, number)).decode("utf-8", errors="replace")
        expect_equal(text, subject.identity[field.name], f"{field.name} in object 2000")
    missing = [(0x1003, 0), (0x1016, 1), (0x2000, 6)]
    missing += [(0x2001, len(caps) + 1), (0x2002, len(status) + 1)]
    for index, subindex in missing:
        await read_object(client, index, subindex, is_there=False)
    for index, subindex in ((0x1000, 0), (0x2000, 1), (0x2002, 1)):
        await write_object(client, index, b"\1\0", subindex, is_taken=False)
