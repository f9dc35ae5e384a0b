"""Checks of a CAN bus: numbers of requests, network management, heartbeats, objects."""

import asyncio
import struct
from functools import partial
from typing import cast

from drivers import clock
from drivers.codec.can_bus.canopen import CANOPEN, cob_id
from drivers.codec.can_bus.segments import segments
from drivers.conformance.can_frames import CanClient, read_object, write_object
from drivers.conformance.check import driving, reading
from drivers.conformance.client import (
    Late,
    When,
    expect,
    expect_equal,
    expect_one_of,
    expect_within,
)
from drivers.conformance.expected import NAMES, OFF
from drivers.conformance.material import layer
from drivers.conformance.subject import Subject
from drivers.protocol.table import MESSAGES

_PLACE = "can.md#messages-as-frames"
_PING, _SET, _STATUS = (MESSAGES[name].number for name in ("Ping", "Set", "GetStatus"))
_LIFE, _FORGOTTEN = 0.09, 0.12  # s; for which a number is kept, after which any begins
_QUIET = 0.015  # s; in which a reply comes
_TEXTS = ("vendor", "product", "serial_number", "firmware")
_OPERATIONAL, _PRE_OPERATIONAL = 5, 127


def _client(subject: Subject) -> CanClient:
    return cast(CanClient, subject.client)


@driving(_PLACE, "can")
async def numbers(subject: Subject) -> None:
    """It takes newer numbers only, each message once, its frames in any order."""
    client = _client(subject)
    await subject.arm()

    async def expect_replies(count: int, what: str, *data: bytes) -> None:
        heard = await client.send(client.packed(data), _QUIET)
        expect_equal(len(heard), count, f"replies to {what}")

    async def follow(number: int, *others: tuple[int, int]) -> None:
        """Require a reply to a number, then to those that follow it."""
        for each, count in ((number, 1), *others):
            sent = clock.now()
            ping = segments(each, _PING, [subject.session])
            await expect_replies(count, f"number {each} after {number}", *ping)
            if count:
                accepted = sent
            if clock.now() - accepted > _LIFE:
                raise Late("frames were too far apart")

    for number, order in ((200, -1), (220, 1)):
        token, words = subject.words_of(layer(0, subject.tone(0, 0.5)))
        await asyncio.sleep(_FORGOTTEN)
        sent = clock.now()
        frames = segments(number, _SET, words)[::order]
        await expect_replies(1, "frames in another order", *frames)
        subject.shown.commit(token, When(sent, clock.now()))
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
    (ping,) = segments(9, _PING, [subject.session])
    await expect_replies(1, "words that are not used", ping[:6] + b"\xff\xff")
    client.number = 10
    await subject.ping()


@driving("can.md#network-management", "can")
async def network_management(subject: Subject) -> None:
    """It replies while operational only, and stops what plays when it is taken out of operation."""
    client = _client(subject)

    async def stopped_by(command: str) -> None:
        sent = clock.now()
        await client.command(command)
        subject.shown.carried_out("Stop", {"ramp": 0}, When(sent, clock.now()))
        data = client.packed(segments(client.next_number(), _STATUS, []))
        await client.expect_silence(data, f"GetStatus after {command}")
        await client.command("start")

    for command in ("pre_operational", "stop", "reset_communication"):
        stopped = partial(stopped_by, command)
        await subject.run([subject.arm, subject.one(), subject.starve, stopped, subject.clear])
    start, other = partial(client.command, "start"), client.address % client.addresses + 1
    ended = partial(client.command, "pre_operational", to=other)
    await subject.run([subject.arm, subject.one(), start, partial(start, to=0), ended])
    client.frames.clear()
    await client.command("reset_node")
    await asyncio.sleep(0.1)
    beats = b"".join(client.data_of("heartbeat"))
    shown = beats[:1], beats[-1:]
    expect_equal(shown, (b"\0", bytes([_PRE_OPERATIONAL])), "heartbeats after reset_node")
    await client.command("start")
    reply = await client.exchange(_STATUS, ())
    status = MESSAGES["GetStatus"].reply.unpack(reply.words, is_strict=False)
    seen = NAMES.get(status["state"]), any(status["levels"]), status["token"]
    expect_equal(seen, (OFF, False, 0), "state, levels, token after reset_node")


@driving("can.md#network-management", "can")
async def heartbeats(subject: Subject) -> None:
    """It sends its state in the interval of object 1017, and emergencies of faults."""
    client = _client(subject)
    stated = int.from_bytes(await read_object(client, 0x1017), "little")
    for interval in (stated, 20, 0, stated):
        await write_object(client, 0x1017, struct.pack("<H", interval))
        await asyncio.sleep(0.06)
        client.frames.clear()
        await asyncio.sleep(0.5)
        beats = b"".join(client.data_of("heartbeat"))
        count = 500 / interval if interval else 0
        slack, what = 0.15 * count + (interval > 0), f"heartbeats of {interval} ms in 0.5 s"
        expect_within(len(beats), count - slack, count + slack, what)
        expect({*beats} <= {_OPERATIONAL}, "state in a heartbeat", expected="5", seen=beats)
    client.frames.clear()
    await subject.run([partial(subject.arm, 0.0), subject.starve, subject.settle, subject.clear])
    known = CANOPEN["emergencies"]["WATCHDOG"]
    codes = [struct.unpack_from("<HB", each) for each in client.data_of("emergency")]
    expect_one_of((known["code"], known["error_register"]), codes, "emergency of the watchdog")
    expect_equal(codes[-1], (0, 0), "emergency after Clear")


@reading("can.md#objects", "can")
async def objects(subject: Subject) -> None:
    """It shows identity, capabilities and status as objects, of which 1017 alone can be written."""
    client, caps = _client(subject), MESSAGES["GetCaps"].reply.pack(subject.can)
    status = (await subject.request("GetStatus")).values
    words = 9 + len(subject.channels) + len(subject.layers)
    for index, subindex, size, value in (
        (0x1000, 0, 4, None),
        (0x1001, 0, 1, None),
        (0x1014, 0, 4, cob_id("emergency", client.address)),
        (0x1018, 0, 1, 4),
        (0x2000, 5, 2, subject.identity["versions"]),
        (0x2001, 0, 1, len(caps)),
        *((0x2001, number, 2, word) for number, word in enumerate(caps, 1)),
        (0x2002, 0, 1, words),
        (0x2002, 1, 2, status["state"]),
    ):
        data = await read_object(client, index, subindex)
        seen = len(data), value and int.from_bytes(data, "little")
        expect_equal(seen, (size, value), f"bytes and value of object {index:04x}/{subindex}")
    for number, name in enumerate(_TEXTS, 1):
        text = (await read_object(client, 0x2000, number)).decode("utf-8", errors="replace")
        expect_equal(text, subject.identity[name], f"{name} in object 2000")
    missing = [(0x1003, 0), (0x1016, 1), (0x2000, 6), (0x2001, len(caps) + 1)]
    for index, subindex in missing:
        await read_object(client, index, subindex, is_there=False)
    for index, subindex in ((0x1000, 0), (0x2000, 1), (0x2002, 1)):
        await write_object(client, index, b"\1\0", subindex, is_taken=False)
