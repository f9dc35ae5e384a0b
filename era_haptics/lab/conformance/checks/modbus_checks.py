"""Checks of a Modbus unit: reply areas, exceptions, frames in pieces."""

import asyncio
import struct
from collections.abc import Iterator
from functools import partial
from typing import NamedTuple, cast

from drivers.protocol.definition import BY_NUMBER, MESSAGES, NO_CHANNEL, REFUSALS
from drivers.wires.modbus_frames import (
    AREA,
    BOX,
    EXCEPTION,
    HEAD,
    IDENTITY_COUNT,
    IDENTITY_REGISTER,
    READ,
    REPLY_OFFSET,
    WRITE,
    read_pdu,
    write_pdu,
)
from era_haptics.lab.conformance.check import driving, reading
from era_haptics.lab.conformance.modbus_client import ModbusClient
from era_haptics.lab.conformance.outcomes import expect_equal, require_in_time, verify
from era_haptics.lab.conformance.request_rows import send, stage
from era_haptics.lab.conformance.subject import Subject
from registry import threads

_PING, _SET, _STATUS = (MESSAGES[name].number for name in ("Ping", "Set", "GetStatus"))
_COMMIT, _CAPS, _STOP = (MESSAGES[name].number for name in ("Commit", "GetCaps", "Stop"))
_ACHIEVED, _FAULTS = (MESSAGES[name].number for name in ("GetAchieved", "GetFaults"))
_FAULT_WORDS = 4  # of a row in GetFaults: fault, channel, and its age in two words
_AGE_POSITION = 2
_READ_HOLDING = 3  # the other function that reads
_BAD_LENGTH = REFUSALS["BAD_LENGTH"] << 8 | NO_CHANNEL  # results
_BAD_VALUE = REFUSALS["BAD_VALUE"] << 8 | NO_CHANNEL
_NO_WORDS = (0,) * (AREA - HEAD)
_TAG = 4242  # of broadcasts


class ReplyAreas:
    """Writes messages to a unit, and reads their reply areas."""

    def __init__(self, client: ModbusClient) -> None:
        self._client = client

    async def write(self, number: int, tag: int, *words: int) -> None:
        """Write a message with a tag."""
        await self._client.transact(self._client.write_of(number, words, tag=tag))

    async def read(
        self, number: int, count: int = AREA, *, start: int = 0, function: int = READ
    ) -> list[int]:
        """Read registers of the reply area of a message."""
        first = BOX * number + REPLY_OFFSET + start
        return list(await self._client.read(first, count, function=function))


@reading("modbus.md#registers", "rtu", "tcp")
async def areas(subject: Subject) -> None:
    """Reading a reply area: tag, result, words, zeros; three areas work without a write.

    Keep an area of 122 registers for each message and fill it with zeros behind the words. Rebuild
    those of GetCaps, GetStatus and GetFaults at every read.
    """
    client = cast(ModbusClient, subject.client)
    reply_areas = ReplyAreas(client)
    for number in set(BY_NUMBER) - {_STATUS}:
        area = await reply_areas.read(number)
        same_area = await reply_areas.read(number, function=_READ_HOLDING)
        if number == _FAULTS:
            area = _without_ages(area)
            same_area = _without_ages(same_area)
        expect_equal(same_area, area, f"reply area {number} by function 3")
    await _expect_tags(reply_areas)
    await _expect_results(reply_areas)
    await _expect_present_values(reply_areas)
    texts = await client.read(IDENTITY_REGISTER, IDENTITY_COUNT, function=_READ_HOLDING)
    part = await client.read(IDENTITY_REGISTER + 2, 16)
    expect_equal(part, texts[2:18], "part of the identity")


def _without_ages(area: list[int]) -> list[int]:
    """Return the reply area of GetFaults without ages, which change between two reads."""
    rows = area[HEAD + 1 :]
    is_age = [position % _FAULT_WORDS >= _AGE_POSITION for position in range(len(rows))]
    ageless_rows = [0 if age else word for word, age in zip(rows, is_age, strict=True)]
    return [*area[: HEAD + 1], *ageless_rows]


async def _expect_tags(reply_areas: ReplyAreas) -> None:
    """Require the tag of each write in the area of its message, which is read in parts too."""
    for tag in (1, 0xFFFF, 77):
        await reply_areas.write(_PING, tag, 1, 0)
        area = await reply_areas.read(_PING)
        expect_equal(area[:HEAD], [tag, 0], "tag, result")
        part = await reply_areas.read(_PING, 3, start=HEAD + 3)
        expect_equal(part, area[HEAD + 3 : HEAD + 6], "part of an area")
    await reply_areas.write(_ACHIEVED, 5, 1)  # the number of the layer is a word that must not stay
    expect_equal(await reply_areas.read(_ACHIEVED, 1), [5], "tag of GetAchieved")
    expect_equal(await reply_areas.read(_PING, 1), [77], "tag of a Ping before it")


async def _expect_results(reply_areas: ReplyAreas) -> None:
    """Require the result of a rejected message, and zeros behind it."""
    await reply_areas.write(_ACHIEVED, 6, 15, 0)
    tag, result, *words = await reply_areas.read(_ACHIEVED)
    quantity = "tag, result, nonzero registers behind, for one extra word"
    expect_equal((tag, result, any(words)), (6, _BAD_LENGTH, False), quantity)
    for tag, count, result in ((7, 1, _BAD_VALUE), (8, 3, 0)):  # parts; of session 0
        await reply_areas.write(_SET, tag, 0, 1, count << 1)
        area = await reply_areas.read(_SET)
        quantity = f"reply area after an invalid first part of {count}"
        expect_equal(area, [tag, result, *_NO_WORDS], quantity)


async def _expect_present_values(reply_areas: ReplyAreas) -> None:
    """Require present values in two areas, except for one read after a rejected request."""
    for number in (_CAPS, _STATUS):
        await reply_areas.write(number, 9, 0)
        head = await reply_areas.read(number, 2)
        expect_equal(head, [9, _BAD_LENGTH], "tag, result of a rejected request")
        tag, result, word = await reply_areas.read(number, 3)
        quantity = "tag, result, presence of words after a rejection was read"
        expect_equal((tag, result, word > 0), (9, 0, True), quantity)


@driving("modbus.md#registers", "rtu", "tcp")
async def present_areas(subject: Subject) -> None:
    """Status area: a current Status at every read; other areas: unchanged since their last write.

    Rebuild only GetCaps, GetStatus and GetFaults at a read. A broadcast changes no reply area.
    """
    client = cast(ModbusClient, subject.client)
    reply_areas = ReplyAreas(client)
    await client.look_around()
    await subject.run([subject.arm, subject.layer_0(), subject.ping])
    area = await reply_areas.read(_PING)
    half_level = subject.layer_0(level=0.5)
    await subject.run([half_level, partial(subject.request, "GetStatus")])
    same_area = await reply_areas.read(_PING)
    expect_equal(same_area, area, "reply area of Ping, read again after a Set")
    part, *_ = subject.sets.parts(subject.layer_0(), now=0, count=3)
    await subject.send(send("Set", **part))
    tag = client.number
    area = await reply_areas.read(_SET)
    expect_equal(area, [tag, 0, *_NO_WORDS], "reply area after a part that was kept")
    if client.is_rtu:
        await _expect_no_area_of_broadcasts(subject, client)
    elif not client.has_gateway:
        await _expect_no_unit_0(subject, client)


async def _expect_no_unit_0(subject: Subject, client: ModbusClient) -> None:
    """Require that Modbus TCP has no broadcasts."""
    await subject.run([stage(subject.layer_0())])
    words = MESSAGES["Commit"].request.pack(subject.filled({"token": subject.sets.token}))
    await client.expect_silence(client.request(_COMMIT, words, to=0), "a Commit to unit 0")
    await subject.request("GetStatus")


async def _expect_no_area_of_broadcasts(subject: Subject, client: ModbusClient) -> None:
    """Require that broadcasts do not change a reply area."""
    subject.require_alone()
    ping = client.adu(client.write_of(_PING, [subject.session, 0], tag=_TAG), unit=0)
    await client.expect_silence(ping, "a broadcast Ping")
    subject.feeding.starve()
    stop = client.adu(client.write_of(_STOP, [0], tag=_TAG), unit=0)
    await client.send(stop)
    (tag,) = await client.read(BOX * _STOP + REPLY_OFFSET, 1)
    verify(tag != _TAG, "tag after a broadcast Stop", expected="unchanged", actual=tag)


def _bad_pdus(ping: bytes) -> Iterator[tuple[str, bytes, int]]:
    """Yield PDUs with the exceptions that they must raise; ping: a valid one."""
    for function in (1, 2, 5, 6, 22, 43, 100):
        yield f"function {function}", bytes([function]) + b"\0\0\0\1", 1
    yield "function 23", struct.pack(">BHHHHBH", 23, 0, 1, BOX * _PING, 1, 2, 1), 1
    area = BOX * _PING + REPLY_OFFSET
    for description, first, registers, code in (
        ("a write within a message", BOX * _PING + 1, [1, 1], 2),
        ("a write to an unknown message", BOX * 63, [1, 1], 2),
        ("a write of message 1", BOX, [1], 2),
        ("a write to a reply area", area, [1, 1], 2),
        ("a write of 122 registers", BOX * _PING, [1] * 122, 2),
        ("a write of 0 registers", BOX * _PING, [], 3),
        ("a write of 0 registers to an unknown message", BOX * 63, [], 3),
    ):
        yield description, write_pdu(first, registers), code
    wrong_size = ping[:5] + bytes([ping[5] + 2]) + ping[6:] + b"\0\0"
    yield "a write with a wrong number of bytes", wrong_size, 3
    end = area + AREA
    for description, first, count, code in (
        ("a read across the end of an area", end - 1, 2, 2),
        ("a read after the end of an area", end, 1, 2),
        ("a read of an unknown message", BOX * 63 + REPLY_OFFSET, 1, 2),
        ("a read of a request register", BOX * _PING, 1, 2),
        ("a read beyond the identity", IDENTITY_REGISTER, IDENTITY_COUNT + 1, 2),
        ("a read of 0 registers", area, 0, 3),
        ("a read of 126 registers", area, 126, 3),
        ("a read of 126 unknown registers", 0, 126, 3),
    ):
        head = read_pdu(first, 1)[:3]  # pymodbus builds no PDU that reads 0 or 126 registers
        yield description, head + count.to_bytes(2), code


@driving("modbus.md#functions-and-exceptions", "rtu", "tcp")
async def exceptions(subject: Subject) -> None:
    """Invalid function, register or count: the listed exception, no effect, does not feed.

    Check the count first, then the registers, and do nothing else for a request that gets an
    exception.
    """
    client = cast(ModbusClient, subject.client)
    await subject.arm()
    await subject.play(subject.layer_0())
    ping = client.write_of(_PING, [subject.session, 0])
    for description, pdu, code in _bad_pdus(ping):
        function = pdu[0]
        # On RTU the function determines the length of a frame; a frame of another function ends
        # with a pause.
        is_known = function in (READ, _READ_HOLDING, WRITE)
        if client.is_rtu and not is_known and len(pdu) != 5:
            continue
        await subject.unfed()
        response, _ = await client.transact(pdu)
        expect_equal(response, bytes([function | EXCEPTION, code]), f"response to {description}")
        await subject.request("GetStatus")


class BrokenFrame(NamedTuple):
    """Frames in two pieces with a pause [s] between them, and the frames that get a response."""

    first: bytes
    pause: float
    second: bytes
    frames: list[bytes]


@reading("modbus.md#the-line", "rtu", "tcp")
async def pieces(subject: Subject) -> None:
    """Frame in pieces: reply; frame interrupted by a pause: discarded, reply to the next one.

    Collect bytes until the frame is complete. Drop an incomplete frame after 20 ms (RTU) or 1 s
    (TCP), and keep the bytes that follow a complete one.
    """
    client = cast(ModbusClient, subject.client)
    pause, limit = (0.012, 0.02) if client.is_rtu else (0.2, 1.0)  # s; within a frame
    for case in _broken_frames(client, pause, limit):
        started_at = threads.now()
        client.write(case.first)
        await asyncio.sleep(case.pause)
        duration = threads.now() - started_at
        is_late = case.pause < limit < duration
        require_in_time(not is_late, "the rest of a frame arrived too late")
        messages = await client.send(case.second, count=len(case.frames))
        numbers = [0 if client.is_rtu else int.from_bytes(frame[:2]) for frame in case.frames]
        description = f"{len(case.first)} bytes and a pause of {1e3 * case.pause:g} ms"
        quantity = f"transactions of the responses after {description}"
        expect_equal([message.number for message in messages], numbers, quantity)


def _broken_frames(client: ModbusClient, pause: float, limit: float) -> Iterator[BrokenFrame]:
    """Yield frames in two pieces: completed within a pause, or dropped after the limit [s]."""

    def frame() -> bytes:
        return client.request(_PING, [1, 0])

    whole = frame()
    wrong_count = bytearray(frame())
    wrong_count[6] = 200  # bytes that would follow
    yield BrokenFrame(whole[:5], pause, whole[5:], [whole])
    halves = [whole[:7]]
    if client.is_rtu:
        halves = [whole[:2], whole[:7], whole[:-1], bytes(wrong_count)]
    for half in halves:
        following = frame()
        yield BrokenFrame(half, 1.2 * limit, following, [following])
    if not client.is_rtu:
        both = [frame(), frame()]
        yield BrokenFrame(b"", 0.0, b"".join(both), both)
