"""A Modbus line, RTU or TCP, PDU by PDU: writes of messages, reads of their replies; its checks."""

import asyncio
import struct
from collections.abc import Iterator, Sequence
from functools import partial
from typing import cast

from drivers.protocol.definition import BY_NUMBER, MAX_WORDS, MESSAGES, NO_CHANNEL, REFUSALS
from drivers.protocol.records import Values
from drivers.wires.modbus_frames import (
    AREA,
    BOX,
    EXCEPTION,
    EXCEPTIONS,
    HEAD,
    IDENTITY,
    IDENTITY_COUNT,
    PRESENT,
    READ,
    REPLY,
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
from era_haptics.lab.conformance.check import driving, reading
from era_haptics.lab.conformance.judge_client import (
    GATEWAY_TIMEOUT,
    QUIET,
    Answer,
    Client,
    Heard,
    When,
    altered,
    expect,
    expect_equal,
    message_name,
    read_as,
    require_in_time,
    send,
    stage,
)
from era_haptics.lab.conformance.subject import Subject
from registry import threads

READ_HOLDING = 3
"""The other function that reads."""
_PRESENT = tuple(MESSAGES[name].number for name in PRESENT)


class ModbusClient(Client):
    """A line or a connection; number: of the last transaction and tag."""

    has_events = False
    transactions = 2
    has_gateway = False
    """Whether a gateway replies for units that are not there."""

    def __init__(self, address: int, *, is_rtu: bool) -> None:
        super().__init__(address)
        self.kind = "rtu" if is_rtu else "tcp"  # type: ignore[misc]
        self.has_broadcasts = is_rtu  # type: ignore[misc]
        self.is_rtu = is_rtu
        self.number = 0
        self._reader = AduReader(is_rtu=is_rtu, of_requests=False)

    def hear(self, data: bytes) -> bytes:
        """Take responses from bytes, also other bytes; those of a gateway are left out."""
        for adu in self._reader.feed(data):
            is_own = adu.unit == self.address or not adu.pdu
            if not is_own and adu.pdu[0] & EXCEPTION and adu.pdu[1:] in _GATEWAY:
                self.has_gateway, self.timeout = True, GATEWAY_TIMEOUT
                continue
            kind, frame = (adu.pdu or b"\0")[0], (adu.unit, adu.pdu or adu.raw)
            self.take(Heard(threads.now(), adu.transaction, kind, (), frame))
            self._others |= set() if is_own else {adu.unit}
        return data

    def question(self, address: int) -> bytes:
        """Return the frame that reads the identity of a unit."""
        return self.adu(read_pdu(IDENTITY, IDENTITY_COUNT), unit=address)

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
        expect(bool(heard.type), "response", expected="a valid frame", seen=response.hex(" "))
        seen = unit, response[0] & ~EXCEPTION
        expect_equal(seen, (self.address, pdu[0]), "unit, function of a response")
        request = parse_request(Adu(unit, pdu))
        if request is not None:
            fits = response_to(request, Adu(unit, response)) is not None
            expected = "its registers, or address and count"
            expect(
                fits, f"response to {pdu[:5].hex(' ')}", expected=expected, seen=response.hex(" ")
            )
        return response, When(sent, heard.at)

    async def read(self, first: int, count: int, *, function: int = READ) -> tuple[int, ...]:
        """Read registers; Violation for an exception."""
        pdu = read_pdu(first, count, function=function)
        response, _ = await self.transact(pdu)
        what = f"function of the response to a read of {count} registers from {first}"
        expect_equal(response[0], function, what)
        return struct.unpack(f">{count}H", response[2:])

    async def hello(self) -> Values:
        """Read the identity."""
        registers = await self.read(IDENTITY, IDENTITY_COUNT)
        expect_equal(registers[0], 0, "tag of the identity")
        return read_as("identity", unpack_identity, registers)

    async def exchange(self, number: int, words: Sequence[int]) -> Answer:
        """Write a message, then read its reply; one that shows the present is read alone."""
        tag, when = None, None
        if number not in _PRESENT or words:
            tag = self.number % 0xFFFF + 1  # that of the frame, see `write_of`
            response, when = await self.transact(self.write_of(number, words))
            if response[0] & EXCEPTION:
                code = EXCEPTIONS.get(response[1], f"exception {response[1]}")
                return Answer(code, None, (), when)
        sent = threads.now()
        count = HEAD + min(self.reply_words.get(number, MAX_WORDS), MAX_WORDS)
        shown, result, *reply = await self.read(BOX * number + REPLY, count)
        when = when or When(sent, threads.now())
        if tag is not None:
            expect_equal(shown, tag, f"tag of the reply to {message_name(number)}")
        if result:
            return self.refusal(*when, number, (number, *divmod(result, 256)))
        return Answer("", None, tuple(reply), when)

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

    async def send(self, data: bytes, *before: bytes) -> list[Heard]:
        """Send frames, data the last; return what is heard until a reply must have come."""
        self._reader.end()
        heard = await super().send(data, *before)
        if self.is_rtu:
            await asyncio.sleep(QUIET)  # ends a frame that is not whole
        return heard


_PLACE = "modbus.md#registers"
_GATEWAY = b"\x0a", b"\x0b"  # exceptions: no path to a unit, or no response of it
_PING, _STATUS, _CAPS, _ACHIEVED, _STOP, _SET, _COMMIT = (
    MESSAGES[name].number
    for name in ("Ping", "GetStatus", "GetCaps", "GetAchieved", "Stop", "Set", "Commit")
)
_TOO_LONG, _BEYOND = (REFUSALS[name] << 8 | NO_CHANNEL for name in ("BAD_LENGTH", "BAD_VALUE"))
_NO_WORDS = (0,) * (AREA - HEAD)


def _client(subject: Subject) -> ModbusClient:
    return cast(ModbusClient, subject.client)


@reading(_PLACE, "rtu", "tcp")
async def areas(subject: Subject) -> None:
    """It keeps each reply under its tag, zeros behind it, and shows the present without a write."""
    client = _client(subject)

    async def write(number: int, tag: int, *words: int) -> None:
        await client.transact(client.write_of(number, words, tag=tag))

    async def area(number: int, count: int = AREA, at: int = 0, function: int = READ) -> list[int]:
        return [*await client.read(BOX * number + REPLY + at, count, function=function)]

    for number in set(BY_NUMBER) - {_STATUS}:
        shown = await area(number)
        again = await area(number, function=READ_HOLDING)
        expect_equal(again, shown, f"reply area {number} by function 3")
    for tag in (1, 0xFFFF, 77):
        await write(_PING, tag, 1, 0)
        shown = await area(_PING)
        expect_equal(shown[:HEAD], [tag, 0], "tag, result")
        expect_equal(await area(_PING, 3, HEAD + 3), shown[HEAD + 3 : HEAD + 6], "part of an area")
    await write(_ACHIEVED, 5, 1)  # the number of the layer is a word that must not stay
    expect_equal((await area(_ACHIEVED, 1)), [5], "tag of GetAchieved")
    expect_equal((await area(_PING, 1)), [77], "tag of a Ping before it")
    await write(_ACHIEVED, 6, 15, 0)
    tag, result, *behind = await area(_ACHIEVED)
    seen = tag, result, any(behind)
    expect_equal(seen, (6, _TOO_LONG, False), "tag, result of a word too many, registers behind")
    for tag, count, result in ((7, 1, _BEYOND), (8, 3, 0)):  # parts; of session 0
        await write(_SET, tag, 0, 1, count << 1)
        what = f"reply area after the first of {count} parts that is wrong"
        expect_equal(await area(_SET), [tag, result, *_NO_WORDS], what)
    for number in (_CAPS, _STATUS):
        await write(number, 9, 0)
        expect_equal(await area(number, 2), [9, _TOO_LONG], "tag, result of a refusal")
        tag, result, first = await area(number, 3)
        shown_once = tag, result, first > 0
        expect_equal(shown_once, (9, 0, True), "tag, result, words once a refusal was read")
    texts = await client.read(IDENTITY, IDENTITY_COUNT, function=READ_HOLDING)
    part = await client.read(IDENTITY + 2, 16)
    expect_equal(part, texts[2:18], "part of the identity")


@driving(_PLACE, "rtu", "tcp")
async def present_areas(subject: Subject) -> None:
    """It shows the status of the moment at every read, and other replies as they were."""
    client = _client(subject)
    await client.look_around()
    await subject.run([subject.arm, subject.one(), subject.ping])
    kept = await client.read(BOX * _PING + REPLY, AREA)
    await subject.run([subject.one(level=0.5), partial(subject.request, "GetStatus")])
    again = await client.read(BOX * _PING + REPLY, AREA)
    expect_equal(again, kept, "reply to a Ping, read again after a set")
    first, *_ = subject.parts(subject.one(), now=0, count=3)
    await subject.send(send("Set", **first))
    tag = client.number
    shown = await client.read(BOX * _SET + REPLY, AREA)
    expect_equal(shown, (tag, 0, *_NO_WORDS), "reply area after a part that is kept")
    if not (client.is_rtu or client.has_gateway):
        await subject.run([stage(subject.one())])
        words = MESSAGES["Commit"].request.pack(subject.filled({"token": subject.token}))
        await client.expect_silence(client.request(_COMMIT, words, to=0), "a Commit to unit 0")
        await subject.request("GetStatus")
    if client.is_rtu:
        subject.require_alone()
        data = client.adu(client.write_of(_PING, [subject.session, 0], tag=4242), unit=0)
        await client.expect_silence(data, "a Ping for all")
        await subject.starve()
        await client.send(client.adu(client.write_of(_STOP, [0], tag=4242), unit=0))
        (tag,) = await client.read(BOX * _STOP + REPLY, 1)
        expect(tag != 4242, "tag after a Stop for all", expected="as before", seen=tag)


def _bad_pdus(client: ModbusClient, ping: bytes) -> Iterator[tuple[str, bytes, int]]:
    """Yield PDUs with the exceptions that they must raise."""
    area = BOX * _PING + REPLY
    last = area + AREA
    functions = (1, 2, 5, 6, 22, 43, 100)
    for function in functions:
        yield f"function {function}", bytes([function]) + b"\0\0\0\1", 1
    yield "function 23", struct.pack(">BHHHHBH", 23, 0, 1, BOX * _PING, 1, 2, 1), 1
    for what, first, registers, code in (
        ("a write within a message", BOX * _PING + 1, [1, 1], 2),
        ("a write of no message", BOX * 63, [1, 1], 2),
        ("a write of message 1", BOX, [1], 2),
        ("a write to a reply area", area, [1, 1], 2),
        ("a write of 122 registers", BOX * _PING, [1] * 122, 2),
        ("a write of 0 registers", BOX * _PING, [], 3),
        ("a write of 0 registers of no message", BOX * 63, [], 3),
    ):
        yield what, write_pdu(first, registers), code
    wrong_size = ping[:5] + bytes([ping[5] + 2]) + ping[6:] + b"\0\0"
    yield "a write of another number of bytes", wrong_size, 3
    for what, first, count, code in (
        ("a read beyond an area", last - 1, 2, 2),
        ("a read behind an area", last, 1, 2),
        ("a read of no message", BOX * 63 + REPLY, 1, 2),
        ("a read of what is written", BOX * _PING, 1, 2),
        ("a read beyond the identity", IDENTITY, IDENTITY_COUNT + 1, 2),
        ("a read of 0 registers", area, 0, 3),
        ("a read of 126 registers", area, 126, 3),
        ("a read of 126 registers where there are none", 0, 126, 3),
    ):
        of_one = read_pdu(first, 1)  # pymodbus makes none of 0 or 126
        yield what, of_one[:3] + count.to_bytes(2), code


@driving("modbus.md#functions-and-exceptions", "rtu", "tcp")
async def exceptions(subject: Subject) -> None:
    """It raises exceptions for what Modbus defines, which change and feed nothing."""
    client = _client(subject)
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
    """It takes a frame in pieces, gives half a frame up after a pause, and loses none behind it."""
    client = _client(subject)
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
            not wait < limit < threads.now() - began, "the rest of a frame came too late"
        )
        heard = await client.send(second)
        what = f"responses after {len(first)} bytes and a pause of {1e3 * wait:g} ms"
        numbers = [0 if client.is_rtu else int.from_bytes(each[:2]) for each in frames]
        expect_equal([each.number for each in heard], numbers, f"transactions of the {what}")
