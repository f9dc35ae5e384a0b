"""Checks of a CAN node: network management, heartbeats, emergencies, and objects by SDO."""

import asyncio
import struct
import zlib
from functools import partial

from drivers.judge.asking.can_frames import UPLOAD, CanClient, can_client
from drivers.protocol.definition import (
    FAULTS,
    MESSAGES,
    NO_CHANNEL,
    STATES,
    STATUS,
    TEXTS,
    name_of,
)
from drivers.wires.can_frames import CANOPEN, cob_id
from era_haptics.lab.conformance.check import driving, reading
from era_haptics.lab.conformance.judge_client import (
    Violation,
    expect,
    expect_equal,
    expect_one_of,
    expect_within,
    require,
    require_in_time,
)
from era_haptics.lab.conformance.subject import Subject
from era_haptics.lab.expected_amplifier import FAULT, OFF, REACTING
from registry import threads

_OPERATIONAL, _PRE_OPERATIONAL = 5, 127
_EMERGENCY = struct.Struct("<HBBB3x")
_HEARTBEAT, _DEFAULT, _OTHER = 0x1017, CANOPEN["heartbeat_ms"], 20  # ms
_NO_OBJECT, _NO_SUBINDEX, _READ_ONLY = 0x0602_0000, 0x0609_0011, 0x0601_0002
_WRONG_LENGTH = 0x0607_0010
_STILL = "state", "fault", "latch", "token", "channels"
"""Words of a status that stay while nothing is asked of it."""
_ABORT, _WRITTEN = 0x80, 0x60
_TRIES, _POLL = 500, 0.001  # s
_QUICK, _BEYOND = 0.003, 0.05  # s; for an exchange amid a fade; behind what is awaited


async def _exchange(client: CanClient, data: bytes) -> bytes:
    client.frames.clear()
    client.put(cob_id("sdo_request", client.address), data)
    for _ in range(_TRIES):
        await asyncio.sleep(_POLL)
        if replies := client.data_of("sdo_answer"):
            return replies[0]
    raise Violation("reply to an SDO", expected="one within 0.5 s", seen="none")


async def _object(
    client: CanClient, command: int, index: int, subindex: int, data: bytes = b"", *, code: int = 0
) -> bytes:
    """Read or write an object; returns the answer, an abort with the code if there is one."""
    request = struct.pack("<BHB4s", command, index, subindex, data)
    answer = await _exchange(client, request)
    kind = _ABORT if code else UPLOAD if command == UPLOAD else _WRITTEN
    seen = answer[0] & 0xE0, answer[1:4], f"{int.from_bytes(answer[4:], 'little') * bool(code):08x}"
    what = f"reply to SDO {command:02x} of object {index:04x}/{subindex}"
    expect_equal(seen, (kind, request[1:4], f"{code:08x}"), what)
    return answer


async def write_object(
    client: CanClient, index: int, data: bytes, subindex: int = 0, *, code: int = 0
) -> None:
    """Write an object of up to four bytes, which must be taken, or refused with a code."""
    await _object(client, 0x23 | 4 - len(data) << 2, index, subindex, data, code=code)


async def read_object(client: CanClient, index: int, subindex: int = 0, *, code: int = 0) -> bytes:
    """Read an object, expedited or in segments, or be refused with a code; returns its bytes."""
    answer = await _object(client, UPLOAD, index, subindex, code=code)
    if answer[0] & 2 or code:
        return answer[4 : 8 - (answer[0] >> 2 & 3)]
    (size,) = struct.unpack_from("<L", answer, 4)
    data, toggle = b"", 0
    while len(data) < size:
        answer = await _exchange(client, bytes([0x60 | toggle]) + bytes(7))
        is_next = answer[0] & 0xF0 == toggle
        what = f"segment of object {index:04x}/{subindex}"
        expect(is_next, what, expected="the next", seen=answer.hex())
        data += answer[1 : 8 - (answer[0] >> 1 & 7)]
        toggle ^= 0x10
    return data


@driving("can.md#network-management", "can")
async def network_management(subject: Subject) -> None:
    """It replies while operational only, and stops what plays when it is taken out of operation."""
    client = can_client(subject)
    await client.look_around()
    for_all = None if client.neighbours else 0

    async def stopped_by(command: str, to: int | None, started_as: int | None) -> None:
        await write_object(client, _HEARTBEAT, _OTHER.to_bytes(2, "little"))
        sent = threads.now()
        await client.command(command, to=to)
        subject.shown.carry_out("Stop", {"ramp": 0}, {}, subject.since(sent))
        data = client.request(MESSAGES["GetStatus"].number, [])
        client.frames.clear()
        await client.expect_silence(
            data, f"GetStatus after {command}", client.question(client.address)
        )
        is_read = bool(client.data_of("sdo_answer"))
        expect_equal(is_read, command != "stop", f"whether objects are read after {command}")
        await client.command("start", to=started_as)
        await expect_interval(_DEFAULT if "reset" in command else _OTHER, command)

    async def expect_interval(interval: int, command: str) -> None:
        shown = int.from_bytes(await read_object(client, _HEARTBEAT), "little")
        expect_equal(shown, interval, f"interval of the heartbeat [ms] after {command}")

    for case in (
        *(("pre_operational", None, for_all), ("stop", for_all, None)),
        ("reset_communication", None, None),
    ):
        stopped = partial(stopped_by, *case)
        await subject.run([subject.arm, subject.one(), subject.starve, stopped, subject.clear])
    start = partial(client.command, "start")
    ended = partial(client.command, "pre_operational", to=client.free)
    await subject.run([subject.arm, subject.one(), start, partial(start, to=for_all), ended])
    await write_object(client, _HEARTBEAT, _OTHER.to_bytes(2, "little"))
    client.frames.clear()
    await client.command("reset_node")
    await asyncio.sleep(0.1)
    beats = b"".join(client.data_of("heartbeat"))
    beats = beats.lstrip(bytes([_OPERATIONAL]))  # were still on their way
    shown = beats[:1], beats[-1:]
    expect_equal(shown, (b"\0", bytes([_PRE_OPERATIONAL])), "heartbeats after reset_node")
    await client.command("start")
    reply = await client.exchange(MESSAGES["GetStatus"].number, ())
    status = STATUS.unpack(reply.words, is_strict=False)
    seen = name_of(STATES, status["state"]), any(status["levels"]), status["token"]
    expect_equal(seen, ("SWITCH_ON_DISABLED", False, 0), "state, levels, token after reset_node")
    await expect_interval(_DEFAULT, "reset_node")
    words = MESSAGES["Arm"].request.pack(subject.filled({"watchdog": subject.can["watchdog_max"]}))
    arm = await client.exchange(MESSAGES["Arm"].number, words)
    expect_equal(arm.code, "", "refusal of an Arm with the session from before reset_node")
    subject.require_alone()


@driving("can.md#network-management", "can")
async def heartbeats(subject: Subject) -> None:
    """It sends its state in the interval of object 1017, and emergencies of faults."""
    client = can_client(subject)

    async def expect_objects(error_register: int, state: int) -> None:
        shown = [(await read_object(client, *each))[0] for each in ((0x1001, 0), (0x2002, 1))]
        expect_equal(shown, [error_register, state], "error register and state, as objects")

    stated = int.from_bytes(await read_object(client, _HEARTBEAT), "little")
    for interval in (stated, _OTHER, 0, stated):
        await write_object(client, _HEARTBEAT, struct.pack("<H", interval))
        await asyncio.sleep(0.06)
        client.frames.clear()
        began = threads.now()
        await asyncio.sleep(0.3)
        took, beats = threads.now() - began, b"".join(client.data_of("heartbeat"))
        count = 1000 * took / interval if interval else 0
        slack, what = 0.15 * count + (interval > 0), f"heartbeats of {interval} ms in {took:.3g} s"
        expect_within(len(beats), count - slack, count + slack, what)
        expect({*beats} <= {_OPERATIONAL}, "state in a heartbeat", expected="5", seen=beats)
    client.frames.clear()
    await subject.run([partial(subject.arm, 0.0), subject.starve, subject.settle])
    known, fault = CANOPEN["emergencies"]["WATCHDOG"], FAULTS["WATCHDOG"] << 4
    head = known["code"], known["error_register"]
    tripped = [_EMERGENCY.pack(*head, fault | each, NO_CHANNEL) for each in (REACTING, FAULT)]
    # The state before it is silent may last no time.
    expect_one_of(client.data_of("emergency"), (tripped, tripped[1:]), "emergencies of a fault")
    await expect_objects(head[1], FAULT)
    client.frames.clear()
    await subject.run([subject.clear])
    cleared = [_EMERGENCY.pack(0, 0, OFF, NO_CHANNEL)]
    expect_equal(client.data_of("emergency"), cleared, "emergencies after Clear")
    await expect_objects(0, OFF)


@driving("can.md#network-management", "can")
async def emergencies(subject: Subject) -> None:
    """It sends the emergency of a fault while it is PRE-OPERATIONAL, too."""
    require(
        subject.exchange_time <= _QUICK,
        "the line is too slow to take it out of operation in the 5 ms of a fault",
    )
    await subject.in_time(partial(_fails_unheard, subject))


async def _fails_unheard(subject: Subject) -> None:
    """Take it out of operation amid the fade of a fault, between two emergencies."""
    client = can_client(subject)
    await subject.run([partial(subject.arm, 0.0), subject.one(), subject.starve])
    client.frames.clear()
    due = threads.now() + subject.shown.watchdog + _BEYOND
    while threads.now() < due:
        await asyncio.sleep(_POLL)
        if client.data_of("emergency"):
            break
    client.put(cob_id("nmt"), bytes((CANOPEN["nmt"]["pre_operational"], client.address)))
    heard = client.data_of("emergency")
    state = (await read_object(client, 0x2002, 1))[0]
    await asyncio.sleep(_BEYOND)
    heard += client.data_of("emergency")
    await client.command("start")
    expect(bool(heard), "emergencies of a fault", expected="two", seen="none")
    require_in_time(state == REACTING, "it was taken out of operation behind the fade of a fault")
    states = [each[3] & 0xF for each in heard]
    expect_equal(states, [REACTING, FAULT], "states in emergencies amid and behind that fade")
    await subject.run([subject.settle, subject.clear])


@reading("can.md#objects", "can")
async def objects(subject: Subject) -> None:
    """It shows identity, capabilities and status as objects, of which 1017 alone can be written."""
    client, caps = can_client(subject), (await subject.request("GetCaps")).words
    reply = await subject.request("GetStatus")
    status, still = reply.words, {STATUS.places[name] for name in _STILL}
    serial_number = zlib.crc32(str(subject.identity["serial_number"]).encode())
    for index, subindex, size, value in (
        (0x1000, 0, 4, 0),
        (0x1001, 0, 1, None if reply["fault"] else 0),
        (0x1014, 0, 4, cob_id("emergency", client.address)),
        (_HEARTBEAT, 0, 2, None),
        (0x1018, 0, 1, 4),
        *((0x1018, number, 4, None) for number in (1, 2, 3)),
        (0x1018, 4, 4, serial_number),
        *((0x2000, 0, 1, len(TEXTS) + 1), (0x2000, 5, 2, subject.identity["versions"])),
        (0x2001, 0, 1, len(caps)),
        *((0x2001, number, 2, word) for number, word in enumerate(caps, 1)),
        (0x2002, 0, 1, len(status)),
        *((0x2002, at + 1, 2, word if at in still else None) for at, word in enumerate(status)),
    ):
        data = await read_object(client, index, subindex)
        seen = len(data), None if value is None else int.from_bytes(data, "little")
        expect_equal(seen, (size, value), f"bytes and value of object {index:04x}/{subindex}")
    for number, field in enumerate(TEXTS, 1):
        text = (await read_object(client, 0x2000, number)).decode("utf-8", errors="replace")
        expect_equal(text, subject.identity[field.name], f"{field.name} in object 2000")
    last = {0x1018: 4, 0x2000: len(TEXTS) + 1, 0x2001: len(caps), 0x2002: len(status)}
    known = {**dict.fromkeys((0x1000, 0x1001, 0x1014, _HEARTBEAT), 0), **last}
    missing = [(each, 0, _NO_OBJECT) for each in (0x1003, 0x1016, 0x2003)]
    missing += [(index, subindex + 1, _NO_SUBINDEX) for index, subindex in known.items()]
    for index, subindex, code in missing:
        await read_object(client, index, subindex, code=code)
    for index, subindex, size, code in (
        *((0x1000, 0, 4, _READ_ONLY), (0x2000, 5, 2, _READ_ONLY), (0x2002, 1, 2, _READ_ONLY)),
        *((0x1003, 0, 2, _NO_OBJECT), (_HEARTBEAT, 1, 2, _NO_SUBINDEX)),
        *((_HEARTBEAT, 0, 1, _WRONG_LENGTH), (_HEARTBEAT, 0, 4, _WRONG_LENGTH)),
    ):
        await write_object(client, index, b"\1\0\0\0"[:size], subindex, code=code)
