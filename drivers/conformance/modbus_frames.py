"""Checks of Modbus: areas of replies, exceptions, and frames in pieces."""

import asyncio
import struct
from typing import cast

from drivers.conformance.check import driving, reading
from drivers.conformance.findings import expect, expect_equal
from drivers.conformance.modbus_client import (
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
)
from drivers.conformance.subject import Subject, layer
from drivers.protocol.table import BY_NUMBER, MAX_WORDS, MESSAGES

_PLACE = "modbus.md#registers"
_AREA = HEAD + MAX_WORDS
_PING, _STATUS, _CAPS = (MESSAGES[name].number for name in ("Ping", "GetStatus", "GetCaps"))


def _client(subject: Subject) -> ModbusClient:
    return cast(ModbusClient, subject.client)


@reading(_PLACE, "rtu", "tcp")
async def areas(subject: Subject) -> None:
    """It keeps each reply under its tag, zeros behind it, and shows the present without a write."""
    client = _client(subject)
    for number in BY_NUMBER:
        area = await client.read(BOX * number + REPLY, _AREA)
        again = await client.read(BOX * number + REPLY, _AREA, function=READ_HOLDING)
        if number != _STATUS:
            expect_equal(again, area, f"reply area {number} by function 3")
    latch_at = HEAD + 3
    for tag in (1, 0xFFFF, 77):
        await client.transact(client.write_of(_PING, [1], tag=tag))
        area = await client.read(BOX * _PING + REPLY, _AREA)
        expect_equal(area[:2], (tag, 0), "tag, result of a Ping")
        words = 9 + len(subject.channels) + len(subject.layers)
        rest = area[HEAD + words :]
        expect(not any(rest), "registers behind a Status", expected="zeros", seen=rest)
        part = await client.read(BOX * _PING + REPLY + latch_at, 3)
        expect_equal(part, area[latch_at : latch_at + 3], "part of an area")
    other = await client.read(BOX * 13 + REPLY, 2)
    await client.transact(client.write_of(13, [0], tag=5))
    expect_equal((await client.read(BOX * 13 + REPLY, 2))[0], 5, "tag of GetAchieved")
    expect_equal((await client.read(BOX * _PING + REPLY, 1))[0], 77, "tag of a Ping before it")
    await client.transact(client.write_of(13, [15, 0], tag=6))
    refused = await client.read(BOX * 13 + REPLY, 2)
    expect_equal(refused, (6, 2 << 8 | 255), "tag, result of a message that is too long")
    expect(other[1] in (0, refused[1]) or other[0] != 0, "result before", expected="0", seen=other)
    for number in (_CAPS, _STATUS):
        await client.transact(client.write_of(number, [0], tag=9))
        refused = await client.read(BOX * number + REPLY, 2)
        expect_equal(refused, (9, 2 << 8 | 255), "tag, result of a refusal")
        good = await client.read(BOX * number + REPLY, 3)
        expect_equal(good[:2], (9, 0), "tag, result once a refusal was read")
        expect(good[2] > 0, "first word once a refusal was read", expected="above 0", seen=good[2])
    texts = await client.read(IDENTITY, 2 + 4 * TEXT, function=READ_HOLDING)
    part = await client.read(IDENTITY + 2, TEXT)
    expect_equal(part, texts[2 : 2 + TEXT], "part of the identity")


@driving(_PLACE, "rtu", "tcp")
async def present_areas(subject: Subject) -> None:
    """It shows the status of the moment at every read, and other replies as they were."""
    client = _client(subject)
    await subject.arm()
    await subject.play(layer(0, subject.tone()))
    await subject.request("Ping", session=subject.session)
    kept = await client.read(BOX * _PING + REPLY, _AREA)
    await subject.play(layer(0, subject.tone(0, 0.5)))
    await subject.expect_levels(0.5, why="status without a write")
    again = await client.read(BOX * _PING + REPLY, _AREA)
    expect_equal(again, kept, "reply to a Ping, read again after a set")
    if client.is_rtu:
        data = client.adu(client.write_of(_PING, [subject.session], tag=4242), unit=0)
        expect(not await client.send(data), "responses to unit 0", expected="none", seen="some")
        stop = client.adu(client.write_of(MESSAGES["Stop"].number, [0], tag=4242), unit=0)
        subject.starve()
        await client.send(stop)
        area = await client.read(BOX * MESSAGES["Stop"].number + REPLY, 1)
        expect(area[0] != 4242, "tag after a Stop for all", expected="as before", seen=area[0])
        await subject.expect_levels(why="Stop for all")


@driving("modbus.md#functions-and-exceptions", "rtu", "tcp")
async def exceptions(subject: Subject) -> None:
    """It raises exceptions for what Modbus defines, which change and feed nothing."""
    client = _client(subject)
    await subject.arm()
    await subject.play(layer(0, subject.tone()))
    session = subject.session
    await subject.request("Ping", session=session)
    ping = client.write_of(_PING, [session])
    last = BOX * _PING + REPLY + _AREA
    cases = [
        *(
            (f"function {each}", bytes([each]) + b"\0\0\0\1", 1)
            for each in (1, 2, 5, 6, 22, 43, 100)
        ),
        ("function 23", struct.pack(">BHHHHBH", 23, 0, 1, BOX * _PING, 1, 2, 1), 1),
        ("a write within a message", _write(BOX * _PING + 1, [1, session]), 2),
        ("a write of no message", _write(BOX * 63, [1, session]), 2),
        ("a write of message 1", _write(BOX, [1]), 2),
        ("a write to a reply area", _write(BOX * _PING + REPLY, [1, session]), 2),
        ("a write of 122 registers", _write(BOX * _PING, [1] * 122), 2),
        ("a read beyond an area", struct.pack(">BHH", READ, last - 1, 2), 2),
        ("a read behind an area", struct.pack(">BHH", READ, last, 1), 2),
        ("a read of no message", struct.pack(">BHH", READ, BOX * 63 + REPLY, 1), 2),
        ("a read of what is written", struct.pack(">BHH", READ, BOX * _PING, 1), 2),
        ("a read beyond the identity", struct.pack(">BHH", READ, IDENTITY, 3 + 4 * TEXT), 2),
        ("a read of 0 registers", struct.pack(">BHH", READ, BOX * _PING + REPLY, 0), 3),
        ("a read of 126 registers", struct.pack(">BHH", READ, BOX * _PING + REPLY, 126), 3),
        ("a write of 0 registers", _write(BOX * _PING, []), 3),
        ("another number of bytes", ping[:5] + bytes([ping[5] + 2]) + ping[6:] + b"\0\0", 3),
    ]
    if client.is_rtu:
        # The length of a frame follows from its function: of others it ends with a pause.
        is_known = (READ, READ_HOLDING, WRITE)
        cases = [each for each in cases if each[1][0] in is_known or len(each[1]) == 5]
    for what, pdu, code in cases:
        response, _ = await client.transact(pdu)
        shown = response.pdu[0], response.pdu[1:]
        expect_equal(shown, (pdu[0] | EXCEPTION, bytes([code])), f"response to {what}")
        await subject.expect_not_fed(what)
        await subject.status()
    await subject.expect_levels(1.0, why="after exceptions")


def _write(first: int, registers: list[int]) -> bytes:
    head = struct.pack(">BHHB", WRITE, first, len(registers), 2 * len(registers))
    return head + struct.pack(f">{len(registers)}H", *registers)


@reading("modbus.md#the-line", "rtu", "tcp")
async def pieces(subject: Subject) -> None:
    """It takes a frame in pieces, gives half a frame up after a pause, and loses none behind it."""
    client = _client(subject)
    pause = 0.012 if client.is_rtu else 0.2  # s; within a frame, none on RTU above 20 ms

    def frame() -> bytes:
        return client.request(_PING, [1])

    whole = frame()
    client.port.write(whole[:5])
    await asyncio.sleep(pause)
    heard = await client.send(whole[5:])
    expect_equal(len(heard), 1, f"responses to a frame with a pause of {1e3 * pause:g} ms")
    if client.is_rtu:
        for cut in (2, 7, -1):
            client.port.write(frame()[:cut])
            await asyncio.sleep(0.03)
            heard = await client.send(frame())
            expect_equal(len(heard), 1, f"responses after {cut} bytes of a frame and 30 ms")
        broken = bytearray(client.request(_PING, [1]))
        broken[6] = 200  # bytes that would follow
        client.port.write(bytes(broken))
        await asyncio.sleep(0.03)
        heard = await client.send(frame())
        expect_equal(len(heard), 1, "responses after a damaged length and 30 ms")
    else:
        heard = await client.send(frame() + frame())
        expect_equal(len(heard), 2, "responses to two frames at once")
