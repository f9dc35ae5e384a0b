"""A CAN bus, frame by frame, and the check of frames and their numbers.

A Modbus line, RTU or TCP, PDU by PDU: writes of messages, reads of their replies; its checks.

A serial line, frame by frame; checks of frames on any wire, and of those on a serial line.
"""

import asyncio
import math
import struct
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from functools import partial
from typing import Any, cast

from cobs import cobs

from drivers.errors import WireCounters
from drivers.protocol.definition import (
    BY_NUMBER,
    EVENT,
    EVENT_RECORD,
    HELLO,
    IDENTITY,
    MAX_WORDS,
    MESSAGES,
    NO_CHANNEL,
    REFUSALS,
    VERSION,
)
from drivers.protocol.records import Refusal, Values
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
from drivers.wires.modbus_frames import (
    AREA,
    BOX,
    EXCEPTION,
    EXCEPTIONS,
    HEAD,
    IDENTITY_COUNT,
    IDENTITY_REGISTER,
    PRESENT,
    READ,
    REPLY_OFFSET,
    WRITE,
    Adu,
    AduReader,
    framed,
    parse_request,
    read_pdu,
    response_to,
    unpack_identity,
    write_pdu,
)
from drivers.wires.serial_frames import (
    NEUTRAL,
    REPLY_BIT,
    Frame,
    FrameReader,
    encode_frame,
    pack_words,
    words_of,
)
from era_haptics.lab.conformance.check import driving, reading
from era_haptics.lab.conformance.judge_client import (
    GATEWAY_TIMEOUT,
    QUIET_TIME,
    HeardMessage,
    JudgeClient,
    RequestOutcome,
    When,
    altered,
    expect_equal,
    layer,
    message_name,
    read_as,
    require,
    require_in_time,
    send,
    stage,
    verify,
)
from era_haptics.lab.conformance.subject import Subject
from registry import threads

_NMT: Mapping[str, int] = CANOPEN["nmt"]
_OF_NODES = {*map(cob_id, ("emergency", "heartbeat", "sdo_answer")), REPLY}
UPLOAD = 0x40
"""Begins a read of an object."""
_DEVICE_TYPE = 0x1000
_SETTLING = 0.005  # s; after a command of network management


class CanClient(JudgeClient):
    """A bus; frames: all of the node."""

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
                self.take(HeardMessage(now, *message), is_event=is_event)
            elif self._counters.unexpected_frames > before:  # again, or an older one
                self.take(HeardMessage(now, frame.data[0], frame.data[2], ()))
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
        """Send frames with a single identifier."""
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
        yield "a first frame of seven bytes", self.packed([first[:7], *rest])
        yield "another node", self.packed(frames(), to=self.free)
        first, *rest = frames()
        yield "121 words", self.packed([first[:3] + b"\x79" + first[4:], *rest])
        first, *rest = frames()
        yield "the number of a broadcast", self.packed([b"\0" + first[1:], *rest])
        if rest:
            yield "its last frame missing", self.packed(frames()[:-1])
            yield "its first frame missing", self.packed(frames()[1:])
            first, *rest = frames()
            yield (
                "two different frames with one index",
                self.packed([altered(rest[-1], 2), *rest, first]),
            )

    def data_of(self, name: str) -> list[bytes]:
        """Return the data of the frames heard of a kind, by the name of its identifier."""
        can_id = cob_id(name, self.address)
        return [frame.data for frame in self.frames if frame.id == can_id]


_PING, _SET, _STATUS, _COMMIT, _CAPS, _ACHIEVED, _STOP = (
    MESSAGES[name].number
    for name in ("Ping", "Set", "GetStatus", "Commit", "GetCaps", "GetAchieved", "Stop")
)
_LIFE, _FORGOTTEN = 0.09, 0.12  # s; for which a number is kept, after which any begins
_FAST = 0.015  # s; exchanges that are quick enough to see for how long a number is kept


@driving("can.md#messages-as-frames", "can")
async def numbers(subject: Subject) -> None:
    """Frames in any order: one reply to each newer number, none to an older one.

    Collect frames by message number and index, compare numbers modulo 255, and forget the last
    number after 0.1 s of silence.
    """
    client = cast(CanClient, subject.client)
    require(
        subject.exchange_time <= _FAST, "the line is too slow to observe how long a number is kept"
    )
    await subject.arm()
    client.quiet = _FAST

    async def expect_replies(count: int, what: str, *data: bytes, since: float = math.inf) -> None:
        heard = await client.send(client.packed(data), count=count)
        require_in_time(threads.now() - since <= _LIFE, "frames were too far apart")
        expect_equal(len(heard), count, f"replies to {what}")

    async def follow(number: int, *others: tuple[int, int]) -> None:
        """Require a reply to a number, then to the following numbers."""
        accepted = math.inf
        for each, count in ((number, 1), *others):
            sent = threads.now()
            ping = segments(each, _PING, [subject.session, 0])
            await expect_replies(
                count, f"number {each} after {number}", *ping, since=min(accepted, sent)
            )
            accepted = sent if count else accepted

    for number, order in ((200, -1), (220, 1)):
        part, words = subject.words_of(layer(0, subject.tone(0, 0.5)))
        await asyncio.sleep(_FORGOTTEN)
        sent = threads.now()
        frames = segments(number, _SET, words)[::order]
        await expect_replies(1, "reordered frames", *frames)
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
        await expect_replies(0, "an incomplete message", *others)
        await (follow(3) if number == 2 else asyncio.sleep(_FORGOTTEN))
        await expect_replies(0, "the last frame of an abandoned message", last)
    again = MESSAGES["Commit"].request.pack(subject.filled({"token": subject.token}))
    for number, kind, sent_words in ((9, _STATUS, []), (10, _COMMIT, again)):
        *others, last = segments(number, kind, sent_words)
        await expect_replies(
            1, f"message {kind} with bytes after its words", *others, last[:4] + b"\xff" * 4
        )
    client.number = 10
    shown = (await client.exchange(HELLO, [0xFFFF])).words
    named = read_as("identity", IDENTITY.unpack, shown, is_strict=False)
    expect_equal(named, subject.identity, "identity returned to a Hello with words")
    await subject.ping()


READ_HOLDING = 3
"""The other function that reads."""
_PRESENT = tuple(MESSAGES[name].number for name in PRESENT)


class ModbusClient(JudgeClient):
    """A line or a connection; numbers are of transactions and tags."""

    has_events = False
    transactions = 2
    has_gateway = False
    """Whether a gateway replies for units that are not there."""

    def __init__(self, address: int, *, is_rtu: bool) -> None:
        super().__init__(address)
        self.kind = "rtu" if is_rtu else "tcp"  # type: ignore[misc]
        self.has_broadcasts = is_rtu  # type: ignore[misc]
        self.is_rtu = is_rtu
        self._reader = AduReader(is_rtu=is_rtu, of_requests=False)

    def hear(self, data: bytes) -> bytes:
        """Extract responses and other bytes; skip the responses of a gateway."""
        for adu in self._reader.feed(data):
            is_own = adu.unit == self.address or not adu.pdu
            if not is_own and adu.pdu[0] & EXCEPTION and adu.pdu[1:] in _GATEWAY:
                self.has_gateway, self.timeout = True, GATEWAY_TIMEOUT
                continue
            kind, frame = (adu.pdu or b"\0")[0], (adu.unit, adu.pdu or adu.raw)
            self.take(HeardMessage(threads.now(), adu.transaction, kind, (), frame))
            self._others |= set() if is_own else {adu.unit}
        return data

    def question(self, address: int) -> bytes:
        """Return the frame that reads the identity of a unit."""
        return self.adu(read_pdu(IDENTITY_REGISTER, IDENTITY_COUNT), unit=address)

    def adu(self, pdu: bytes, *, unit: int | None = None) -> bytes:
        """Return a PDU in a frame under the next transaction number."""
        self.number = self.number % 0xFFFF + 1
        unit = self.address if unit is None else unit
        transaction = 0 if self.is_rtu else self.number
        return framed(unit, pdu, transaction, is_rtu=self.is_rtu)

    async def transact(self, pdu: bytes) -> tuple[bytes, When]:
        """Send a PDU and await its response; returns that and when it was carried out."""
        data, sent = self.adu(pdu), threads.now()
        self._reader.end()
        number = 0 if self.is_rtu else self.number
        self.write(data)
        what = f"function {pdu[0]} from register {int.from_bytes(pdu[1:3])}"
        heard = await self.replied(lambda each: each.number == number or not each.type, what)
        unit, response = heard.frame
        verify(bool(heard.type), "response", expected="a valid frame", seen=response.hex(" "))
        seen = unit, response[0] & ~EXCEPTION
        expect_equal(seen, (self.address, pdu[0]), "unit, function of a response")
        request = parse_request(Adu(unit, pdu))
        if request is not None:
            fits = response_to(request, Adu(unit, response)) is not None
            expected = "its registers, or address and count"
            verify(
                fits, f"response to {pdu[:5].hex(' ')}", expected=expected, seen=response.hex(" ")
            )
        return response, When(sent, heard.at)

    async def read(self, first: int, count: int, *, function: int = READ) -> tuple[int, ...]:
        """Read registers; ContractViolation for an exception."""
        pdu = read_pdu(first, count, function=function)
        response, _ = await self.transact(pdu)
        expect_equal(
            response[0],
            function,
            f"function of the response to a read of {count} registers from {first}",
        )
        return struct.unpack(f">{count}H", response[2:])

    async def hello(self) -> Values:
        """Read the identity."""
        registers = await self.read(IDENTITY_REGISTER, IDENTITY_COUNT)
        expect_equal(registers[0], 0, "tag of the identity")
        return read_as("identity", unpack_identity, registers)

    async def exchange(self, number: int, words: Sequence[int], **more: Any) -> RequestOutcome:
        """Write a message, then read its reply; a request for present values is only read."""
        tag, when = None, None
        if number not in _PRESENT or words:
            tag = self.number % 0xFFFF + 1  # the tag of the frame, see `write_of`
            response, when = await self.transact(self.write_of(number, words))
            if response[0] & EXCEPTION:
                code = EXCEPTIONS.get(response[1], f"exception {response[1]}")
                return RequestOutcome(code, None, (), when)
        sent = threads.now()
        count = HEAD + min(self.reply_words.get(number, MAX_WORDS), MAX_WORDS)
        shown, result, *reply = await self.read(BOX * number + REPLY_OFFSET, count)
        when = when or When(sent, threads.now())
        if tag is not None:
            expect_equal(shown, tag, f"tag of the reply to {message_name(number)}")
        if result:
            return self.refusal(*when, number, (number, *divmod(result, 256)))
        return RequestOutcome("", None, tuple(reply), when)

    async def part(self, number: int, words: Sequence[int]) -> None:
        """Write a message, whose reply area is not read."""
        response, _ = await self.transact(self.write_of(number, words))
        expect_equal(response[0], WRITE, f"function of the response to {message_name(number)}")

    def write_of(self, number: int, words: Sequence[int], *, tag: int | None = None) -> bytes:
        """Return the PDU that writes a message, tagged with the number of its frame."""
        tag = self.number % 0xFFFF + 1 if tag is None else tag
        return write_pdu(BOX * number % 0x10000, (tag, *words))

    def request(self, number: int, words: Sequence[int], *, to: int | None = None) -> bytes:
        """Return the frame that writes a message."""
        return self.adu(self.write_of(number, words), unit=to)

    def damaged(self, number: int, words: Sequence[int]) -> Iterator[tuple[str, bytes]]:
        """Yield frames with damage of all kinds; a gateway keeps those to other units."""
        pdu = self.write_of(number, words)
        if not self.has_gateway:
            yield "another unit", self.adu(pdu, unit=self.free)
        if self.is_rtu:
            frame = self.adu(pdu)
            for at in (-2, -1, -4):
                yield f"a wrong byte {at}", altered(frame, at)

    async def send(self, data: bytes, *before: bytes, count: int = 0) -> list[HeardMessage]:
        """Send frames, data last; return the frames received until a reply is due."""
        self._reader.end()
        heard = await super().send(data, *before, count=count)
        if self.is_rtu:
            await asyncio.sleep(QUIET_TIME)  # ends a frame that is not whole
        return heard


_GATEWAY = b"\x0a", b"\x0b"  # exceptions: no path to a unit, or no response from it
_TOO_LONG, _BEYOND = (REFUSALS[name] << 8 | NO_CHANNEL for name in ("BAD_LENGTH", "BAD_VALUE"))
_NO_WORDS = (0,) * (AREA - HEAD)


@reading("modbus.md#registers", "rtu", "tcp")
async def areas(subject: Subject) -> None:
    """Reading a reply area: tag, result, words, zeros; three areas work without a write.

    Keep an area of 122 registers for each message and fill it with zeros behind the words. Rebuild
    those of GetCaps, GetStatus and GetFaults at every read.
    """
    client = cast(ModbusClient, subject.client)

    async def write(number: int, tag: int, *words: int) -> None:
        await client.transact(client.write_of(number, words, tag=tag))

    async def area(number: int, count: int = AREA, at: int = 0, function: int = READ) -> list[int]:
        return [*await client.read(BOX * number + REPLY_OFFSET + at, count, function=function)]

    for number in set(BY_NUMBER) - {_STATUS}:
        shown = await area(number)
        again = await area(number, function=READ_HOLDING)
        expect_equal(again, shown, f"reply area {number} by function 3")
    for tag in (1, 0xFFFF, 77):
        await write(_PING, tag, 1, 0)
        shown = await area(_PING)
        expect_equal(shown[:HEAD], [tag, 0], "tag, result")
        expect_equal(
            await area(_PING, 3, HEAD + 3),
            shown[HEAD + 3 : HEAD + 6],
            "part of an area",
        )
    await write(_ACHIEVED, 5, 1)  # the number of the layer is a word that must not stay
    expect_equal((await area(_ACHIEVED, 1)), [5], "tag of GetAchieved")
    expect_equal((await area(_PING, 1)), [77], "tag of a Ping before it")
    await write(_ACHIEVED, 6, 15, 0)
    tag, result, *behind = await area(_ACHIEVED)
    seen = tag, result, any(behind)
    expect_equal(
        seen, (6, _TOO_LONG, False), "tag, result, nonzero registers behind, for one extra word"
    )
    for tag, count, result in ((7, 1, _BEYOND), (8, 3, 0)):  # parts; of session 0
        await write(_SET, tag, 0, 1, count << 1)
        expect_equal(
            await area(_SET),
            [tag, result, *_NO_WORDS],
            f"reply area after an invalid first part of {count}",
        )
    for number in (_CAPS, _STATUS):
        await write(number, 9, 0)
        expect_equal(await area(number, 2), [9, _TOO_LONG], "tag, result of a rejected request")
        tag, result, first = await area(number, 3)
        shown_once = tag, result, first > 0
        expect_equal(
            shown_once, (9, 0, True), "tag, result, presence of words after a rejection was read"
        )
    texts = await client.read(IDENTITY_REGISTER, IDENTITY_COUNT, function=READ_HOLDING)
    part = await client.read(IDENTITY_REGISTER + 2, 16)
    expect_equal(part, texts[2:18], "part of the identity")


@driving("modbus.md#registers", "rtu", "tcp")
async def present_areas(subject: Subject) -> None:
    """Status area: a current Status at every read; other areas: unchanged since their last write.

    Rebuild only GetCaps, GetStatus and GetFaults at a read. A broadcast changes no reply area.
    """
    client = cast(ModbusClient, subject.client)
    await client.look_around()
    await subject.run([subject.arm, subject.one(), subject.ping])
    kept = await client.read(BOX * _PING + REPLY_OFFSET, AREA)
    await subject.run([subject.one(level=0.5), partial(subject.request, "GetStatus")])
    again = await client.read(BOX * _PING + REPLY_OFFSET, AREA)
    expect_equal(again, kept, "reply area of Ping, read again after a Set")
    first, *_ = subject.parts(subject.one(), now=0, count=3)
    await subject.send(send("Set", **first))
    tag = client.number
    shown = await client.read(BOX * _SET + REPLY_OFFSET, AREA)
    expect_equal(shown, (tag, 0, *_NO_WORDS), "reply area after a part that was kept")
    if not (client.is_rtu or client.has_gateway):
        await subject.run([stage(subject.one())])
        words = MESSAGES["Commit"].request.pack(subject.filled({"token": subject.token}))
        await client.expect_silence(client.request(_COMMIT, words, to=0), "a Commit to unit 0")
        await subject.request("GetStatus")
    if client.is_rtu:
        subject.require_alone()
        data = client.adu(client.write_of(_PING, [subject.session, 0], tag=4242), unit=0)
        await client.expect_silence(data, "a broadcast Ping")
        await subject.starve()
        await client.send(client.adu(client.write_of(_STOP, [0], tag=4242), unit=0))
        (tag,) = await client.read(BOX * _STOP + REPLY_OFFSET, 1)
        verify(tag != 4242, "tag after a broadcast Stop", expected="unchanged", seen=tag)


def _bad_pdus(client: ModbusClient, ping: bytes) -> Iterator[tuple[str, bytes, int]]:
    """Yield PDUs with the exceptions that they must raise."""
    area = BOX * _PING + REPLY_OFFSET
    last = area + AREA
    functions = (1, 2, 5, 6, 22, 43, 100)
    for function in functions:
        yield f"function {function}", bytes([function]) + b"\0\0\0\1", 1
    yield "function 23", struct.pack(">BHHHHBH", 23, 0, 1, BOX * _PING, 1, 2, 1), 1
    for what, first, registers, code in (
        ("a write within a message", BOX * _PING + 1, [1, 1], 2),
        ("a write to an unknown message", BOX * 63, [1, 1], 2),
        ("a write of message 1", BOX, [1], 2),
        ("a write to a reply area", area, [1, 1], 2),
        ("a write of 122 registers", BOX * _PING, [1] * 122, 2),
        ("a write of 0 registers", BOX * _PING, [], 3),
        ("a write of 0 registers to an unknown message", BOX * 63, [], 3),
    ):
        yield what, write_pdu(first, registers), code
    wrong_size = ping[:5] + bytes([ping[5] + 2]) + ping[6:] + b"\0\0"
    yield "a write with a wrong number of bytes", wrong_size, 3
    for what, first, count, code in (
        ("a read across the end of an area", last - 1, 2, 2),
        ("a read after the end of an area", last, 1, 2),
        ("a read of an unknown message", BOX * 63 + REPLY_OFFSET, 1, 2),
        ("a read of a request register", BOX * _PING, 1, 2),
        ("a read beyond the identity", IDENTITY_REGISTER, IDENTITY_COUNT + 1, 2),
        ("a read of 0 registers", area, 0, 3),
        ("a read of 126 registers", area, 126, 3),
        ("a read of 126 unknown registers", 0, 126, 3),
    ):
        of_one = read_pdu(first, 1)  # pymodbus makes none of 0 or 126
        yield what, of_one[:3] + count.to_bytes(2), code


@driving("modbus.md#functions-and-exceptions", "rtu", "tcp")
async def exceptions(subject: Subject) -> None:
    """Invalid function, register or count: the listed exception, no effect, does not feed.

    Check the count first, then the registers, and do nothing else for a request that gets an
    exception.
    """
    client = cast(ModbusClient, subject.client)
    await subject.arm()
    await subject.play(subject.one())
    known = READ, READ_HOLDING, WRITE
    for what, pdu, code in _bad_pdus(client, client.write_of(_PING, [subject.session, 0])):
        # On RTU the length of a frame follows from its function: of others it ends with a pause.
        if client.is_rtu and pdu[0] not in known and len(pdu) != 5:
            continue
        await subject.unfed()
        response, _ = await client.transact(pdu)
        expect_equal(response, bytes([pdu[0] | EXCEPTION, code]), f"response to {what}")
        await subject.request("GetStatus")


@reading("modbus.md#the-line", "rtu", "tcp")
async def pieces(subject: Subject) -> None:
    """Frame in pieces: reply; frame interrupted by a pause: discarded, reply to the next one.

    Collect bytes until the frame is complete. Drop an incomplete frame after 20 ms (RTU) or 1 s
    (TCP), and keep the bytes that follow a complete one.
    """
    client = cast(ModbusClient, subject.client)
    pause, limit = (0.012, 0.02) if client.is_rtu else (0.2, 1.0)  # s; within a frame

    def frame() -> bytes:
        return client.request(_PING, [1, 0])

    whole, broken = frame(), bytearray(frame())
    broken[6] = 200  # bytes that would follow
    cases = [(whole[:5], pause, whole[5:], [whole])]
    halves = (whole[:2], whole[:7], whole[:-1], bytes(broken)) if client.is_rtu else (whole[:7],)
    cases += [(each, 1.2 * limit, last, [last]) for each in halves for last in [frame()]]
    both = [frame(), frame()]
    cases += [(b"", 0.0, b"".join(both), both)] * (not client.is_rtu)
    for first, wait, second, frames in cases:
        began = threads.now()
        client.write(first)
        await asyncio.sleep(wait)
        require_in_time(
            not wait < limit < threads.now() - began, "the rest of a frame arrived too late"
        )
        heard = await client.send(second, count=len(frames))
        what = f"responses after {len(first)} bytes and a pause of {1e3 * wait:g} ms"
        numbers = [0 if client.is_rtu else int.from_bytes(each[:2]) for each in frames]
        expect_equal([each.number for each in heard], numbers, f"transactions of the {what}")


_SEQUENCES = 1 << 16
_SEQUENCE_AT, _CRC_SIZE = 3, 4


class SerialClient(JudgeClient):
    """A serial line; invalid: pieces that are no frame."""

    kind = "serial"

    def __init__(self, address: int) -> None:
        super().__init__(address)
        self.invalid: list[bytes] = []
        self._reader = FrameReader(on_invalid=self.invalid.append)

    def hear(self, data: bytes) -> bytes:
        """Take messages from bytes."""
        for frame in self._reader.feed(data):
            try:
                words = (*words_of(frame),)
            except Refusal:
                self.invalid.append(frame.payload)
                continue
            kind = frame.kind ^ REPLY_BIT  # which is set where it is no reply
            heard = HeardMessage(threads.now(), frame.sequence, kind, words, frame)
            self.take(heard, is_event=frame.kind == EVENT)
            self._others |= {frame.address} - {self.address}
        return data

    def remark(self) -> str:
        """Return whether a reply has its CRC in the wrong byte order."""
        for piece in filter(None, self.came.split(b"\0")):
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
        answer = await self.exchange(HELLO, (), behind=payload, version=version)
        return read_as("identity", IDENTITY.unpack, answer.words, is_strict=False)

    def check_reply(self, heard: HeardMessage, number: int, code: str) -> None:
        """Require its address, too, and its version."""
        is_neutral = number == HELLO or code == "UNSUPPORTED_VERSION"
        seen = heard.type, heard.frame.version, heard.frame.address
        required = number, NEUTRAL if is_neutral else VERSION, self.address
        expect_equal(seen, required, "type, version, address of a reply")

    def request(
        self,
        number: int,
        words: Sequence[int],
        *,
        to: int | None = None,
        behind: bytes = b"",
        version: int = VERSION,
    ) -> bytes:
        """Return the frame of a request, with bytes behind its words, under the next number."""
        self.number = (self.number + 1) % _SEQUENCES
        address = self.address if to is None else to
        payload = pack_words(words) + behind
        return encode_frame(Frame(number, address, self.number, payload, version))

    def damaged(self, number: int, words: Sequence[int]) -> Iterator[tuple[str, bytes]]:
        """Yield frames with damage of all kinds."""
        good = self.request(number, words)
        content = cobs.decode(good[1:-1])
        long = content[:-_CRC_SIZE] + bytes(2 * MAX_WORDS + 2 - 2 * len(words))
        reply = bytes([content[0] | REPLY_BIT]) + content[1:-_CRC_SIZE]
        bits = (
            (f"a wrong byte {at}", altered(content, at)) for at in (-4, -3, -2, -1, _SEQUENCE_AT)
        )
        yield from ((what, _framed(each)) for what, each in bits)
        # Without zeros, so that it is one block, whose length is wrong.
        statuses = (self.request(_STATUS, []) for _ in range(_SEQUENCES))
        plain = next(each for each in statuses if each[1] == len(each) - 2)
        yield from {
            "a COBS block longer than the frame": b"\0\xff" + plain[2:],
            "eight bytes": _framed(_checked(content[:4])),
            "its last byte missing": good[:-2] + b"\0",
            "its first byte missing": b"\0" + good[2:],
            "invalid COBS": b"\0\xff" + good[2:],
            "no CRC": _framed(content[:-_CRC_SIZE]),
            "more than 240 bytes of payload": _framed(_checked(long)),
            "bit 7 of a reply": _framed(_checked(reply)),
            "another address": self.request(number, words, to=self.free),
        }.items()


def _checked(body: bytes) -> bytes:
    return body + zlib.crc32(body).to_bytes(_CRC_SIZE, "little")


def _framed(content: bytes) -> bytes:
    stuffed: bytes = cobs.encode(content)
    return b"\0" + stuffed + b"\0"


@driving("protocol.md#order-of-checks")
async def damaged_frames(subject: Subject) -> None:
    """Damaged frame, or frame for another address: no reply, no effect, does not feed.

    Check length, checksum and address before anything else, and discard the frame silently.
    """
    client = subject.client
    await client.look_around()
    own = client.address
    for other in client.neighbours if client.kind == "serial" else ():
        client.address = other
        named = await client.hello()
        verify(named != subject.identity, "address of this amplifier", expected=own, seen=other)
    client.address = own
    await subject.arm()
    await subject.play(subject.one())
    _, words = subject.words_of(layer(0, subject.tone(0, 0.5)))
    for number, sent in ((_PING, [subject.session, 0]), (_SET, words)):
        for what, data in client.damaged(number, sent):
            await subject.unfed()
            await client.expect_silence(data, f"message {number} with {what}")
            await subject.request("GetStatus")


@driving("protocol.md#sets")
async def doubled_frames(subject: Subject) -> None:
    """Frame that arrives twice or late: treated as a repetition of its token.

    Decide by the token whether a set is new, not by the sequence number of the frame.
    """
    await subject.arm()
    sets = [layer(0, subject.tone(0, each), valid_for=250) for each in (0.5, 1.0)]
    made = [subject.words_of(each) for each in sets]
    frames = [subject.client.request(_SET, words) for _, words in made]
    for (part, _), data in zip(made, frames, strict=True):
        began = threads.now()
        await subject.client.reply_to(data)
        subject.played(part, began)
    for at, pause in ((0, 0.0), (1, 0.25), (1, 0.0)):
        await subject.client.reply_to(frames[at])
        await subject.run([subject.ping, pause])


@driving("serial.md#receiving", "serial")
async def discarded_frames(subject: Subject) -> None:
    """Event, or broadcast of another version: discarded without a reply.

    Ignore frames with bit 7 set and Events, and check the version of a broadcast.
    """
    client = cast(SerialClient, subject.client)
    await client.look_around()
    subject.require_alone()
    event = EVENT_RECORD.pack({"state": 1, "fault": 0, "channel": 255, "latch": 1})
    await client.expect_silence(client.request(EVENT, event), "an Event")
    await subject.run([subject.arm, subject.one()])
    answer = await client.exchange(_SET, subject.words_of(subject.one())[1], behind=b"\0")
    expect_equal(answer.code, "BAD_LENGTH", "code for a Set with half a word")
    head = [subject.session, subject.token + 1, 2 << 1]
    part = client.request(_SET, head, behind=b"\0")
    await client.expect_silence(part, "a part with half a word")
    await subject.run([stage(subject.one(level=0.5))])
    for name, values in (("Commit", {"token": subject.token}), ("Stop", {"ramp": 0})):
        message = MESSAGES[name]
        words = message.request.pack(subject.filled(values))
        for version in (VERSION - 1, 0):
            data = client.request(message.number, words, to=0, version=version)
            await client.expect_silence(data, f"a broadcast {name} of version {version}")
            await subject.run([subject.ping])


@driving("serial.md#receiving", "serial")
async def tolerated_frames(subject: Subject) -> None:
    """Frame in noise, in pieces or back to back: one reply to each.

    Resynchronise at every zero byte, accept a zero shared by two frames, and buffer the next frame
    while you reply.
    """
    client = cast(SerialClient, subject.client)

    def ping() -> bytes:
        return client.request(_PING, [1, 0])

    whole = ping()
    for what, pieces, count in (
        ("a pause within", [whole[:5], whole[5:]], 1),
        ("noise before it", [b"\x55\xaa\x01" + ping()], 1),
        ("zeros before it", [b"\0\0\0" + ping()], 1),
        ("half a frame before it", [ping()[:7] + ping()], 1),
        ("another frame back to back", [ping() + ping()], 2),
        ("300 bytes of noise before it", [b"\x77" * 300 + ping()], 1),
        (
            "the longest payload before it",
            [client.request(_SET, (), behind=bytes(240)) + ping()],
            2,
        ),
        ("a shared delimiter", [ping()[:-1] + ping()], 2),
    ):
        for piece in pieces[:-1]:
            client.write(piece)
            await asyncio.sleep(0.05)
        heard = await client.send(pieces[-1], count=count)
        heard = [each for each in heard if not each.type & REPLY_BIT]
        expect_equal(len(heard), count, f"replies to a frame with {what}")
    for sequence in (0, 0xFFFF):
        client.number = (sequence - 1) % 0x10000
        await subject.request("Ping", session=1)
    client.invalid.clear()
    for _ in range(3):
        await client.exchange(_PING, [1, 0])
    expect_equal(client.invalid, [], "damaged replies")
