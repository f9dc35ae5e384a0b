"""Checks of Modbus: areas of replies, exceptions, and frames in pieces."""

import asyncio
import struct
from collections.abc import Iterator
from functools import partial
from typing import cast

from drivers.conformance.check import driving, reading
from drivers.conformance.client import expect, expect_equal
from drivers.conformance.modbus_frames import (
    BOX,
    EXCEPTION,
    HEAD,
    IDENTITY,
    READ,
    READ_HOLDING,
    REPLY,
    TEXT,
    WRITE,
    ModbusClient,
    write_pdu,
)
from drivers.conformance.subject import Subject
from drivers.protocol.table import BY_NUMBER, MAX_WORDS, MESSAGES, NO_CHANNEL, REFUSALS

_PLACE = "modbus.md#registers"
_AREA = HEAD + MAX_WORDS
_PING, _STATUS, _CAPS, _ACHIEVED, _STOP = (
    MESSAGES[name].number for name in ("Ping", "GetStatus", "GetCaps", "GetAchieved", "Stop")
)
_TOO_LONG = REFUSALS["BAD_LENGTH"] << 8 | NO_CHANNEL


def _client(subject: Subject) -> ModbusClient:
    return cast(ModbusClient, subject.client)


@reading(_PLACE, "rtu", "tcp")
async def areas(subject: Subject) -> None:
    """It keeps each reply under its tag, zeros behind it, and shows the present without a write."""
    client = _client(subject)

    async def write(number: int, tag: int, *words: int) -> None:
        await client.transact(client.write_of(number, words, tag=tag))

    async def area(number: int, count: int = _AREA, at: int = 0, function: int = READ) -> list[int]:
        return [*await client.read(BOX * number + REPLY + at, count, function=function)]

    for number in set(BY_NUMBER) - {_STATUS}:
        shown = await area(number)
        again = await area(number, function=READ_HOLDING)
        expect_equal(again, shown, f"reply area {number} by function 3")
    for tag in (1, 0xFFFF, 77):
        await write(_PING, tag, 1)
        shown = await area(_PING)
        behind = shown[HEAD + 9 + len(subject.channels) + len(subject.layers) :]
        expect_equal((*shown[:2], any(behind)), (tag, 0, False), "tag, result, registers behind")
        expect_equal(await area(_PING, 3, HEAD + 3), shown[HEAD + 3 : HEAD + 6], "part of an area")
    await write(_ACHIEVED, 5, 0)
    expect_equal((await area(_ACHIEVED, 1)), [5], "tag of GetAchieved")
    expect_equal((await area(_PING, 1)), [77], "tag of a Ping before it")
    await write(_ACHIEVED, 6, 15, 0)
    expect_equal(await area(_ACHIEVED, 2), [6, _TOO_LONG], "tag, result of a word too many")
    for number in (_CAPS, _STATUS):
        await write(number, 9, 0)
        expect_equal(await area(number, 2), [9, _TOO_LONG], "tag, result of a refusal")
        tag, result, first = await area(number, 3)
        shown_once = tag, result, first > 0
        expect_equal(shown_once, (9, 0, True), "tag, result, words once a refusal was read")
    texts = await client.read(IDENTITY, 2 + 4 * TEXT, function=READ_HOLDING)
    part = await client.read(IDENTITY + 2, TEXT)
    expect_equal(part, texts[2 : 2 + TEXT], "part of the identity")


@driving(_PLACE, "rtu", "tcp")
async def present_areas(subject: Subject) -> None:
    """It shows the status of the moment at every read, and other replies as they were."""
    client = _client(subject)
    await subject.run([subject.arm, subject.one(), subject.ping])
    kept = await client.read(BOX * _PING + REPLY, _AREA)
    await subject.run([subject.one(level=0.5), partial(subject.request, "GetStatus")])
    again = await client.read(BOX * _PING + REPLY, _AREA)
    expect_equal(again, kept, "reply to a Ping, read again after a set")
    if client.is_rtu:
        data = client.adu(client.write_of(_PING, [subject.session], tag=4242), unit=0)
        await client.expect_silence(data, "a Ping for all")
        await subject.starve()
        await client.send(client.adu(client.write_of(_STOP, [0], tag=4242), unit=0))
        (tag,) = await client.read(BOX * _STOP + REPLY, 1)
        expect(tag != 4242, "tag after a Stop for all", expected="as before", seen=tag)


def _bad_pdus(client: ModbusClient, ping: bytes) -> Iterator[tuple[str, bytes, int]]:
    """Yield PDUs with the exceptions that they must raise."""
    area = BOX * _PING + REPLY
    last = area + _AREA
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
    ):
        yield what, write_pdu(first, registers), code
    wrong_size = ping[:5] + bytes([ping[5] + 2]) + ping[6:] + b"\0\0"
    yield "a write of another number of bytes", wrong_size, 3
    for what, first, count, code in (
        ("a read beyond an area", last - 1, 2, 2),
        ("a read behind an area", last, 1, 2),
        ("a read of no message", BOX * 63 + REPLY, 1, 2),
        ("a read of what is written", BOX * _PING, 1, 2),
        ("a read beyond the identity", IDENTITY, 3 + 4 * TEXT, 2),
        ("a read of 0 registers", area, 0, 3),
        ("a read of 126 registers", area, 126, 3),
    ):
        yield what, struct.pack(">BHH", READ, first, count), code


@driving("modbus.md#functions-and-exceptions", "rtu", "tcp")
async def exceptions(subject: Subject) -> None:
    """It raises exceptions for what Modbus defines, which change and feed nothing."""
    client = _client(subject)
    await subject.arm()
    await subject.play(subject.one())
    known = READ, READ_HOLDING, WRITE
    for what, pdu, code in _bad_pdus(client, client.write_of(_PING, [subject.session])):
        # On RTU the length of a frame follows from its function: of others it ends with a pause.
        if client.is_rtu and pdu[0] not in known and len(pdu) != 5:
            continue
        await subject.run([subject.ping, 0.02])
        response, _ = await client.transact(pdu)
        expect_equal(response, bytes([pdu[0] | EXCEPTION, code]), f"response to {what}")
        await subject.request("GetStatus")


@reading("modbus.md#the-line", "rtu", "tcp")
async def pieces(subject: Subject) -> None:
    """It takes a frame in pieces, gives half a frame up after a pause, and loses none behind it."""
    client = _client(subject)
    pause = 0.012 if client.is_rtu else 0.2  # s; within a frame, none on RTU above 20 ms

    def frame() -> bytes:
        return client.request(_PING, [1])

    whole, broken = frame(), bytearray(frame())
    broken[6] = 200  # bytes that would follow
    cases = [(whole[:5], pause, whole[5:], 1)]
    if client.is_rtu:
        for first in (whole[:2], whole[:7], whole[:-1], bytes(broken)):
            cases.append((first, 0.03, frame(), 1))
    else:
        cases.append((b"", 0.0, frame() + frame(), 2))
    for first, wait, second, count in cases:
        client.port.write(first)
        await asyncio.sleep(wait)
        heard = await client.send(second)
        what = f"responses after {len(first)} bytes and a pause of {1e3 * wait:g} ms"
        expect_equal(len(heard), count, what)
