"""Checks of a CAN bus: numbers of requests, network management, heartbeats, objects."""

import asyncio
import struct
from typing import cast

from drivers import clock
from drivers.codec.can_bus.canopen import CANOPEN, cob_id
from drivers.codec.can_bus.segments import segments
from drivers.conformance.can_client import CanClient
from drivers.conformance.check import driving, reading
from drivers.conformance.findings import Late, Violation, expect, expect_equal
from drivers.conformance.subject import NAMES, Subject, layer
from drivers.protocol.sets import pack_layers
from drivers.protocol.table import MESSAGES

_PLACE = "can.md#messages-as-frames"
_PING, _SET = MESSAGES["Ping"].number, MESSAGES["Set"].number
_LIFE, _FORGOTTEN = 0.09, 0.12  # s; for which a number is kept, after which any begins
_QUIET = 0.015  # s; in which a reply comes
_TEXTS = ("vendor", "product", "serial_number", "firmware")
_ABORT, _UPLOAD = 0x80, 0x40
_OPERATIONAL, _PRE_OPERATIONAL = 5, 127


def _client(subject: Subject) -> CanClient:
    return cast(CanClient, subject.client)


@driving(_PLACE, "can")
async def numbers(subject: Subject) -> None:
    """It takes newer numbers only, each message once, its frames in any order."""
    client = _client(subject)
    await subject.arm()
    await subject.play(layer(0, subject.tone()))

    async def replies(*data: bytes) -> int:
        return len(await client.send(client.packed(data), _QUIET))

    async def follow(number: int, *others: tuple[int, int]) -> None:
        """Require a reply to a number, then to those that follow it."""
        for each, count in ((number, 1), *others):
            sent = clock.now()
            data = segments(each, _PING, [subject.session])
            expect_equal(await replies(*data), count, f"replies to number {each} after {number}")
            if count:
                accepted = sent
            if clock.now() - accepted > _LIFE:
                raise Late("frames were too far apart")

    stream = pack_layers([layer(0, subject.tone(0, 0.5))])
    for number, token, order in ((200, 2, -1), (220, 3, 1)):
        words = [subject.session, token, 1 << 1 | 1, *stream]
        await asyncio.sleep(_FORGOTTEN)
        frames = segments(number, _SET, words)
        expect_equal(await replies(*frames[::order]), 1, "replies to frames in another order")
        client.number = number
        shown = (await subject.request("GetStatus"))["token"]
        expect_equal(shown, token, "token of a set")
    subject.token = 3
    await asyncio.sleep(_FORGOTTEN)
    await follow(100, (100, 0), (99, 0), (228, 0), (227, 1), (226, 0), (100, 0))
    await asyncio.sleep(_FORGOTTEN)
    await follow(3, (255, 0), (4, 1), (130, 1), (255, 1), (1, 1))
    long = segments(2, _SET, [subject.session, 9, 1 << 1 | 1, *stream])
    expect_equal(await replies(*long[:-1]), 0, "replies to a part of a message")
    await follow(3)
    expect_equal(await replies(long[-1]), 0, "replies to the last frame of an older one")
    long = segments(4, _SET, [subject.session, 9, 1 << 1 | 1, *stream])
    expect_equal(await replies(*long[:-1]), 0, "replies to a part of a message")
    await asyncio.sleep(_FORGOTTEN)
    expect_equal(await replies(long[-1]), 0, "replies to the last frame after 0.12 s")
    padded = bytearray(segments(9, _PING, [subject.session])[0])
    padded[6:] = b"\xff\xff"
    expect_equal(await replies(bytes(padded)), 1, "replies to words that are not used")
    client.number = 10
    await subject.expect_levels(0.5, why="after frames that make no message")


@driving("can.md#network-management", "can")
async def network_management(subject: Subject) -> None:
    """It replies while operational only, and stops what plays when it is taken out of operation."""
    client = _client(subject)
    for command in ("pre_operational", "stop", "reset_communication"):
        await subject.arm()
        await subject.play(layer(0, subject.tone()))
        latch = subject.latch
        subject.starve()
        await client.command(command)
        await asyncio.sleep(0.02)
        data = client.packed(segments(client.next_number(), MESSAGES["GetStatus"].number, []))
        expect_equal(len(await client.send(data)), 0, f"replies after {command}")
        await client.command("start")
        status = (await subject.request("GetStatus")).values
        shown = NAMES[status["state"]], status["latch"], any(status["levels"])
        expect_equal(shown, ("QUICK_STOP_ACTIVE", latch + 1, False), f"state after {command}")
        await subject.request("Clear", latch=subject.latch)
    await subject.arm()
    await subject.play(layer(0, subject.tone()))
    await client.command("start")
    await client.command("start", to=0)
    await client.command("pre_operational", to=client.address % client.addresses + 1)
    await subject.expect_levels(1.0, why="commands that change nothing, or for another node")
    client.frames.clear()
    await client.command("reset_node")
    await asyncio.sleep(0.1)
    subject.starve()
    beats = _heartbeats(client)
    expect_equal(beats[:1], [0], "first heartbeat after reset_node")
    expect_equal(beats[-1], _PRE_OPERATIONAL, "state in the heartbeat after reset_node")
    await client.command("start")
    status = (await subject.request("GetStatus")).values
    shown = NAMES[status["state"]], any(status["levels"]), status["token"]
    expect_equal(shown, ("SWITCH_ON_DISABLED", False, 0), "state, levels, token after reset_node")


def _heartbeats(client: CanClient) -> list[int]:
    sent = cob_id("heartbeat", client.address)
    return [frame.data[0] for _, frame in client.frames if frame.id == sent]


@driving("can.md#network-management", "can")
async def heartbeats(subject: Subject) -> None:
    """It sends its state in the interval of object 1017, and emergencies of faults."""
    client = _client(subject)
    stated = int.from_bytes(await _read(client, 0x1017, 0), "little")
    for interval in (stated, 20, 0, stated):
        await _write(client, 0x1017, 0, struct.pack("<H", interval))
        await asyncio.sleep(0.06)
        client.frames.clear()
        await asyncio.sleep(0.5)
        beats = _heartbeats(client)
        required = 500 / interval if interval else 0
        is_met = abs(len(beats) - required) <= 0.15 * required + (interval > 0)
        expect(is_met, f"heartbeats of {interval} ms in 0.5 s", expected=required, seen=len(beats))
        expect(set(beats) <= {_OPERATIONAL}, "state in a heartbeat", expected="5", seen=beats)
    await subject.arm(subject.can["watchdog_min"] / 1000)
    client.frames.clear()
    subject.starve()
    await subject.until(lambda each: NAMES[each["state"]] == "FAULT", "FAULT")
    await subject.request("Clear", latch=subject.latch)
    known = CANOPEN["emergencies"]
    codes = [struct.unpack_from("<HB", each) for each in client.emergencies]
    pair = known["WATCHDOG"]["code"], known["WATCHDOG"]["error_register"]
    reported = pair in codes and codes[-1:] == [(0, 0)]
    expect(reported, "emergencies of a fault that was cleared", expected=(pair, (0, 0)), seen=codes)


@reading("can.md#objects", "can")
async def objects(subject: Subject) -> None:
    """It shows identity, capabilities and status as objects, of which 1017 alone can be written."""
    client = _client(subject)
    expect_equal(len(await _read(client, 0x1000, 0)), 4, "bytes of object 1000")
    expect_equal(len(await _read(client, 0x1001, 0)), 1, "bytes of object 1001")
    emergency = int.from_bytes(await _read(client, 0x1014, 0), "little")
    expect_equal(emergency, cob_id("emergency", client.address), "object 1014")
    count = (await _read(client, 0x1018, 0))[0]
    expect_equal(count, 4, "subindices of object 1018")
    for number, name in enumerate(_TEXTS, 1):
        text = (await _read(client, 0x2000, number)).decode("utf-8", errors="replace")
        expect_equal(text, subject.identity[name], f"{name} in object 2000")
    versions = int.from_bytes(await _read(client, 0x2000, 5), "little")
    expect_equal(versions, subject.identity["versions"], "versions in object 2000")
    caps = MESSAGES["GetCaps"].reply.pack(subject.can)
    expect_equal((await _read(client, 0x2001, 0))[0], len(caps), "words of object 2001")
    for number, word in enumerate(caps, 1):
        seen = int.from_bytes(await _read(client, 0x2001, number), "little")
        expect_equal(seen, word, f"word {number} of object 2001")
    words = 9 + len(subject.channels) + len(subject.layers)
    expect_equal((await _read(client, 0x2002, 0))[0], words, "words of object 2002")
    state = int.from_bytes(await _read(client, 0x2002, 1), "little")
    status = (await subject.request("GetStatus")).values
    expect_equal(state, status["state"], "state in object 2002")
    for index, subindex in ((0x1003, 0), (0x1016, 1), (0x2000, 6), (0x2001, len(caps) + 1)):
        answer = await _sdo(client, struct.pack("<BHB4x", _UPLOAD, index, subindex))
        expect_equal(answer[0], _ABORT, f"reply to a read of {index:04x}/{subindex}")
    for index, subindex in ((0x1000, 0), (0x2000, 1), (0x2002, 1)):
        answer = await _sdo(client, struct.pack("<BHBL", 0x2B, index, subindex, 1))
        expect_equal(answer[0], _ABORT, f"reply to a write of {index:04x}/{subindex}")


async def _sdo(client: CanClient, data: bytes) -> bytes:
    """Exchange a frame with the objects; Violation where no reply comes."""
    client.frames.clear()
    client.put(cob_id("sdo_request", client.address), data)
    for _ in range(500):
        await asyncio.sleep(0.001)
        for _, frame in client.frames:
            if frame.id == cob_id("sdo_answer", client.address):
                return frame.data
    raise Violation("reply to an SDO", expected="one within 0.5 s", seen="none")


async def _write(client: CanClient, index: int, subindex: int, data: bytes) -> None:
    command = 0x23 | 4 - len(data) << 2
    answer = await _sdo(client, struct.pack("<BHB4s", command, index, subindex, data))
    expect_equal(answer[0], 0x60, f"reply to a write of object {index:04x}")


async def _read(client: CanClient, index: int, subindex: int) -> bytes:
    """Read an object: expedited, or in segments."""
    answer = await _sdo(client, struct.pack("<BHB4x", _UPLOAD, index, subindex))
    what = f"reply to a read of {index:04x}/{subindex}"
    expect(answer[0] & 0xE0 == _UPLOAD, what, expected="the object", seen=answer.hex())
    if answer[0] & 2:
        return answer[4 : 8 - (answer[0] >> 2 & 3)]
    (size,) = struct.unpack_from("<L", answer, 4)
    data, toggle = b"", 0
    while len(data) < size:
        answer = await _sdo(client, bytes([0x60 | toggle]) + bytes(7))
        is_next = answer[0] & 0xF0 == toggle
        expect(
            is_next, f"segment of {index:04x}/{subindex}", expected="the next", seen=answer.hex()
        )
        data += answer[1 : 8 - (answer[0] >> 1 & 7)]
        toggle ^= 0x10
    return data
