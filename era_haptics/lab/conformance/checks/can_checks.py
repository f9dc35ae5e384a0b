"""Checks of a CAN node: objects, message numbers, network management, heartbeats, emergencies."""

import asyncio
import math
import struct
import zlib
from collections.abc import Iterator
from functools import partial
from typing import NamedTuple, cast

from drivers.protocol.definition import (
    FAULTS,
    HELLO,
    IDENTITY,
    MESSAGES,
    NO_CHANNEL,
    STATES,
    STATUS,
    TEXTS,
    name_of,
)
from drivers.wires.can_frames import CANOPEN, cob_id, segments
from era_haptics.lab.conformance.can_client import UPLOAD, CanClient
from era_haptics.lab.conformance.check import driving, reading
from era_haptics.lab.conformance.judge_client import RequestOutcome
from era_haptics.lab.conformance.outcomes import (
    ContractViolation,
    expect_equal,
    expect_one_of,
    expect_within,
    read_as,
    require,
    require_in_time,
    verify,
)
from era_haptics.lab.conformance.request_rows import layer
from era_haptics.lab.conformance.subject import Subject
from era_haptics.lab.expectations.expected_amplifier import FAULT, OFF, REACTING
from registry import threads

_OPERATIONAL, _PRE_OPERATIONAL = 5, 127
_EMERGENCY = struct.Struct("<HBBB3x")
_HEARTBEAT = 0x1017  # the object with the interval [ms]
_DEFAULT_INTERVAL, _INTERVAL = CANOPEN["heartbeat_ms"], 20  # ms
_ERROR_REGISTER, _STATE = (0x1001, 0), (0x2002, 1)  # objects
_NO_OBJECT, _NO_SUBINDEX, _READ_ONLY = 0x0602_0000, 0x0609_0011, 0x0601_0002
_WRONG_LENGTH = 0x0607_0010
_STEADY_FIELDS = "state", "fault", "latch", "token", "channels"
"""Fields of a Status that do not change without a request."""
_ABORT, _WRITTEN = 0x80, 0x60
_SDO_TIMEOUT, _POLL = 0.5, 0.001  # s
_QUICK = 0.003  # s; for an exchange during a fade
_SETTLING = 0.05  # s; after an expected event
_BOOT_TIME = 0.1  # s; until heartbeats after a reset
_PING, _SET, _STATUS = (MESSAGES[name].number for name in ("Ping", "Set", "GetStatus"))
_COMMIT = MESSAGES["Commit"].number
_NUMBER_LIFE = 0.09  # s; a number is kept at least this long
_FORGOTTEN = 0.12  # s; after this silence any number is accepted
_FAST = 0.015  # s; exchanges fast enough to observe how long a number is kept


@driving("can.md#messages-as-frames", "can")
async def numbers(subject: Subject) -> None:
    """Frames in any order: one reply to each newer number, none to an older one.

    Collect frames by message number and index, compare numbers modulo 255, and forget the last
    number after 0.1 s of silence.
    """
    client = cast(CanClient, subject.client)
    is_fast = subject.timing.exchange_time <= _FAST
    require(is_fast, "the line is too slow to observe how long a number is kept")
    await subject.arm()
    client.quiet = _FAST
    await _expect_any_order(subject, client)
    await asyncio.sleep(_FORGOTTEN)
    older = (100, 0), (99, 0), (228, 0), (227, 1), (226, 0), (100, 0)
    await _follow(subject, client, 100, *older)
    await asyncio.sleep(_FORGOTTEN)
    await _follow(subject, client, 3, (255, 0), (4, 1), (130, 1), (255, 1), (1, 1))
    await _expect_abandoned(subject, client)
    await _expect_padding_ignored(subject, client)
    client.number = 10
    reply = await client.exchange(HELLO, [0xFFFF])
    identity = read_as("identity", IDENTITY.unpack, reply.words, is_strict=False)
    expect_equal(identity, subject.identity, "identity returned to a Hello with words")
    await subject.ping()


async def _expect_replies(
    client: CanClient, count: int, description: str, *frames: bytes, since: float = math.inf
) -> None:
    """Send frames and require a number of replies, in time after `since` [s]."""
    replies = await client.send(client.packed(frames), count=count)
    require_in_time(threads.now() - since <= _NUMBER_LIFE, "frames were too far apart")
    expect_equal(len(replies), count, f"replies to {description}")


async def _follow(
    subject: Subject, client: CanClient, number: int, *others: tuple[int, int]
) -> None:
    """Require a reply to a number, then as many as stated to the following numbers."""
    accepted_at = math.inf
    for sent_number, count in ((number, 1), *others):
        sent_at = threads.now()
        ping = segments(sent_number, _PING, [subject.session, 0])
        description = f"number {sent_number} after {number}"
        since = min(accepted_at, sent_at)
        await _expect_replies(client, count, description, *ping, since=since)
        if count:
            accepted_at = sent_at


async def _expect_any_order(subject: Subject, client: CanClient) -> None:
    """Require that a set plays if its frames arrive in any order."""
    for number, order in ((200, -1), (220, 1)):
        part, words = subject.words_of(layer(0, subject.tone(0, 0.5)))
        await asyncio.sleep(_FORGOTTEN)
        sent_at = threads.now()
        frames = segments(number, _SET, words)[::order]
        await _expect_replies(client, 1, "reordered frames", *frames)
        subject.played(part, sent_at)
        client.number = number
        await subject.ping()


async def _expect_abandoned(subject: Subject, client: CanClient) -> None:
    """Require that a newer number or a silence ends an incomplete message."""
    _, words = subject.words_of(subject.layer_0())
    for number in (2, 4):
        *frames, last = segments(number, _SET, words)
        await _expect_replies(client, 0, "an incomplete message", *frames)
        if number == 2:
            await _follow(subject, client, 3)
        else:
            await asyncio.sleep(_FORGOTTEN)
        await _expect_replies(client, 0, "the last frame of an abandoned message", last)


async def _expect_padding_ignored(subject: Subject, client: CanClient) -> None:
    """Require that bytes after the words of a message are ignored."""
    commit = MESSAGES["Commit"].request.pack(subject.filled({"token": subject.sets.token}))
    for number, message, words in ((9, _STATUS, []), (10, _COMMIT, commit)):
        *frames, last = segments(number, message, words)
        padded = last[:4] + b"\xff" * 4
        description = f"message {message} with bytes after its words"
        await _expect_replies(client, 1, description, *frames, padded)


# Objects


async def _exchange(client: CanClient, data: bytes) -> bytes:
    """Send an SDO and return its reply."""
    client.frames.clear()
    client.put(cob_id("sdo_request", client.address), data)
    for _ in range(round(_SDO_TIMEOUT / _POLL)):
        await asyncio.sleep(_POLL)
        if replies := client.data_of("sdo_answer"):
            return replies[0]
    raise ContractViolation("reply to an SDO", expected="one within 0.5 s", actual="none")


async def _object(
    client: CanClient, command: int, index: int, subindex: int, data: bytes = b"", *, code: int = 0
) -> bytes:
    """Read or write an object and return the reply; code: of the abort that is required."""
    request = struct.pack("<BHB4s", command, index, subindex, data)
    reply = await _exchange(client, request)
    expected_command = UPLOAD if command == UPLOAD else _WRITTEN
    if code:
        expected_command = _ABORT
    shown_code = int.from_bytes(reply[4:], "little") if code else 0
    actual = reply[0] & 0xE0, reply[1:4], f"{shown_code:08x}"
    expected = expected_command, request[1:4], f"{code:08x}"
    expect_equal(actual, expected, f"reply to SDO {command:02x} of object {index:04x}/{subindex}")
    return reply


async def _write_object(
    client: CanClient, index: int, data: bytes, subindex: int = 0, *, code: int = 0
) -> None:
    """Write an object of up to four bytes; code: of the abort that is required."""
    command = 0x23 | 4 - len(data) << 2
    await _object(client, command, index, subindex, data, code=code)


async def _read_object(client: CanClient, index: int, subindex: int = 0, *, code: int = 0) -> bytes:
    """Read an object, expedited or in segments; code: of the abort that is required."""
    reply = await _object(client, UPLOAD, index, subindex, code=code)
    is_expedited = bool(reply[0] & 2)
    if is_expedited or code:
        unused = reply[0] >> 2 & 3
        return reply[4 : 8 - unused]
    (size,) = struct.unpack_from("<L", reply, 4)
    data, toggle = b"", 0
    while len(data) < size:
        reply = await _exchange(client, bytes([0x60 | toggle]) + bytes(7))
        is_next = reply[0] & 0xF0 == toggle
        quantity = f"segment of object {index:04x}/{subindex}"
        verify(is_next, quantity, expected="the next segment", actual=reply.hex())
        unused = reply[0] >> 1 & 7
        data += reply[1 : 8 - unused]
        toggle ^= 0x10
    return data


class ObjectEntry(NamedTuple):
    """An object of the dictionary: its size in bytes, and its value, None if it can change."""

    main_index: int
    subindex: int
    size: int
    value: int | None


@reading("can.md#objects", "can")
async def objects(subject: Subject) -> None:
    """SDO of every object: its value and size; of any other object or size: the listed abort.

    Serve every object of the table in its size, allow writes to object 1017 only, and check for
    aborts in the order of the page.
    """
    client = cast(CanClient, subject.client)
    caps = await subject.request("GetCaps")
    status = await subject.request("GetStatus")
    for entry in _object_entries(subject, client, caps, status):
        data = await _read_object(client, entry.main_index, entry.subindex)
        value = None if entry.value is None else int.from_bytes(data, "little")
        quantity = f"bytes and value of object {entry.main_index:04x}/{entry.subindex}"
        expect_equal((len(data), value), (entry.size, entry.value), quantity)
    for number, field in enumerate(TEXTS, 1):
        text = (await _read_object(client, 0x2000, number)).decode("utf-8", errors="replace")
        expect_equal(text, subject.identity[field.name], f"{field.name} in object 2000")
    await _expect_missing_objects(client, caps, status)
    for index, subindex, size, code in (
        (0x1000, 0, 4, _READ_ONLY),
        (0x2000, 5, 2, _READ_ONLY),
        (0x2002, 1, 2, _READ_ONLY),
        (0x1003, 0, 2, _NO_OBJECT),
        (_HEARTBEAT, 1, 2, _NO_SUBINDEX),
        (_HEARTBEAT, 0, 1, _WRONG_LENGTH),
        (_HEARTBEAT, 0, 4, _WRONG_LENGTH),
    ):
        await _write_object(client, index, b"\1\0\0\0"[:size], subindex, code=code)


def _object_entries(
    subject: Subject, client: CanClient, caps: RequestOutcome, status: RequestOutcome
) -> Iterator[ObjectEntry]:
    """Yield the numeric objects; those with capabilities and status must match the replies."""
    serial_number = zlib.crc32(str(subject.identity["serial_number"]).encode())
    yield ObjectEntry(0x1000, 0, 4, 0)
    yield ObjectEntry(0x1001, 0, 1, None if status["fault"] else 0)
    yield ObjectEntry(0x1014, 0, 4, cob_id("emergency", client.address))
    yield ObjectEntry(_HEARTBEAT, 0, 2, None)
    yield ObjectEntry(0x1018, 0, 1, 4)
    for number in (1, 2, 3):
        yield ObjectEntry(0x1018, number, 4, None)
    yield ObjectEntry(0x1018, 4, 4, serial_number)
    yield ObjectEntry(0x2000, 0, 1, len(TEXTS) + 1)
    yield ObjectEntry(0x2000, 5, 2, subject.identity["versions"])
    yield ObjectEntry(0x2001, 0, 1, len(caps.words))
    for number, word in enumerate(caps.words, 1):
        yield ObjectEntry(0x2001, number, 2, word)
    yield ObjectEntry(0x2002, 0, 1, len(status.words))
    steady_positions = {STATUS.places[name] for name in _STEADY_FIELDS}
    for place, word in enumerate(status.words):
        yield ObjectEntry(0x2002, place + 1, 2, word if place in steady_positions else None)


async def _expect_missing_objects(
    client: CanClient, caps: RequestOutcome, status: RequestOutcome
) -> None:
    """Require an abort for objects that do not exist, and beyond the last subindex of others."""
    for index in (0x1003, 0x1016, 0x2003):
        await _read_object(client, index, code=_NO_OBJECT)
    for index in (0x1000, 0x1001, 0x1014, _HEARTBEAT):
        await _read_object(client, index, 1, code=_NO_SUBINDEX)
    last_subindexes = {
        0x1018: 4,
        0x2000: len(TEXTS) + 1,
        0x2001: len(caps.words),
        0x2002: len(status.words),
    }
    for index, last in last_subindexes.items():
        await _read_object(client, index, last + 1, code=_NO_SUBINDEX)


# Network management


@driving("can.md#network-management", "can")
async def network_management(subject: Subject) -> None:
    """NMT command: replies only while OPERATIONAL; leaving it while armed is a Stop.

    Run a Stop with a ramp of 5 ms whenever NMT takes the node out of OPERATIONAL, and reset object
    1017 and the numbers after a reset.
    """
    client = cast(CanClient, subject.client)
    await client.look_around()
    for_all = None if client.neighbors else 0
    for command, to, started_as in (
        ("pre_operational", None, for_all),
        ("stop", for_all, None),
        ("reset_communication", None, None),
    ):
        stopped = partial(_expect_stop, subject, client, command, to, started_as)
        starve = subject.feeding.starve
        await subject.run([subject.arm, subject.layer_0(), starve, stopped, subject.clear])
    start = partial(client.command, "start")
    start_all = partial(client.command, "start", to=for_all)
    end_another = partial(client.command, "pre_operational", to=client.free_address)
    await subject.run([subject.arm, subject.layer_0(), start, start_all, end_another])
    await _expect_reset(subject, client)
    subject.require_alone()


async def _expect_stop(
    subject: Subject, client: CanClient, command: str, to: int | None, started_as: int | None
) -> None:
    """Require that a command stops the amplifier and ends replies; then start the node again."""
    await _write_object(client, _HEARTBEAT, _INTERVAL.to_bytes(2, "little"))
    sent_at = threads.now()
    await client.command(command, to=to)
    subject.judge.carry_out("Stop", {"ramp": 0}, {}, subject.since(sent_at))
    data = client.request(_STATUS, [])
    client.frames.clear()
    question = client.question(client.address)
    await client.expect_silence(data, f"GetStatus after {command}", question)
    is_readable = len(client.data_of("sdo_answer")) > 0
    expect_equal(is_readable, command != "stop", f"object readable after {command}")
    await client.command("start", to=started_as)
    interval = _DEFAULT_INTERVAL if "reset" in command else _INTERVAL
    await _expect_interval(client, interval, command)


async def _expect_interval(client: CanClient, interval: int, command: str) -> None:
    data = await _read_object(client, _HEARTBEAT)
    actual = int.from_bytes(data, "little")
    expect_equal(actual, interval, f"interval of the heartbeat [ms] after {command}")


async def _expect_reset(subject: Subject, client: CanClient) -> None:
    """Require that reset_node restores defaults, and forgets the session and the latch."""
    await _write_object(client, _HEARTBEAT, _INTERVAL.to_bytes(2, "little"))
    client.frames.clear()
    await client.command("reset_node")
    await asyncio.sleep(_BOOT_TIME)
    heartbeats = b"".join(client.data_of("heartbeat"))
    heartbeats = heartbeats.lstrip(bytes([_OPERATIONAL]))  # were still on their way
    expected = b"\0", bytes([_PRE_OPERATIONAL])
    expect_equal((heartbeats[:1], heartbeats[-1:]), expected, "heartbeats after reset_node")
    await client.command("start")
    reply = await client.exchange(_STATUS, ())
    status = STATUS.unpack(reply.words, is_strict=False)
    state = name_of(STATES, status["state"])
    actual = state, any(status["levels"]), status["token"], status["latch"]
    expected_status = "SWITCH_ON_DISABLED", False, 0, 0
    expect_equal(actual, expected_status, "state, levels, token, latch after reset_node")
    await _expect_interval(client, _DEFAULT_INTERVAL, "reset_node")
    values = subject.filled({"watchdog": subject.can["watchdog_max"]})
    arm = await client.exchange(MESSAGES["Arm"].number, MESSAGES["Arm"].request.pack(values))
    expect_equal(arm.code, "", "code for an Arm with the session held before reset_node")


@driving("can.md#network-management", "can")
async def heartbeats(subject: Subject) -> None:
    """Object 1017: heartbeats at its interval; fault and Clear: an emergency for each.

    Send the NMT state at the interval of object 1017, none for 0, and an emergency on entering 6,
    on entering 7 and on leaving 7.
    """
    client = cast(CanClient, subject.client)
    stated_interval = int.from_bytes(await _read_object(client, _HEARTBEAT), "little")
    for interval in (stated_interval, _INTERVAL, 0, stated_interval):
        await _expect_heartbeats(client, interval)
    client.frames.clear()
    await subject.run([partial(subject.arm, 0.0), subject.feeding.starve, subject.settle])
    watchdog = CANOPEN["emergencies"]["WATCHDOG"]
    fault = FAULTS["WATCHDOG"] << 4
    tripped = []
    for state in (REACTING, FAULT):
        head = watchdog["code"], watchdog["error_register"]
        tripped.append(_EMERGENCY.pack(*head, fault | state, NO_CHANNEL))
    # The state before it is silent may last no time.
    emergencies = client.data_of("emergency")
    expect_one_of(emergencies, (tripped, tripped[1:]), "emergencies of a fault")
    await _expect_objects(client, watchdog["error_register"], FAULT)
    client.frames.clear()
    await subject.run([subject.clear])
    cleared = [_EMERGENCY.pack(0, 0, OFF, NO_CHANNEL)]
    expect_equal(client.data_of("emergency"), cleared, "emergencies after Clear")
    await _expect_objects(client, 0, OFF)


async def _expect_heartbeats(client: CanClient, interval: int) -> None:
    """Set the interval [ms] of the heartbeat, 0 for none, and count heartbeats."""
    await _write_object(client, _HEARTBEAT, struct.pack("<H", interval))
    await asyncio.sleep(0.06)
    client.frames.clear()
    started_at = threads.now()
    await asyncio.sleep(0.3)
    duration = threads.now() - started_at
    heartbeats = b"".join(client.data_of("heartbeat"))
    count = 1000 * duration / interval if interval else 0
    slack = 0.15 * count + (interval > 0)
    quantity = f"heartbeats of {interval} ms in {duration:.3g} s"
    expect_within(len(heartbeats), count - slack, count + slack, quantity)
    is_operational = set(heartbeats) <= {_OPERATIONAL}
    verify(is_operational, "state in a heartbeat", expected="5", actual=heartbeats)


async def _expect_objects(client: CanClient, error_register: int, state: int) -> None:
    """Require the error register and the state in their objects."""
    actual = []
    for index, subindex in (_ERROR_REGISTER, _STATE):
        data = await _read_object(client, index, subindex)
        actual.append(data[0])
    quantity = "error register and state in objects 1001 and 2002"
    expect_equal(actual, [error_register, state], quantity)


@driving("can.md#network-management", "can")
async def emergencies(subject: Subject) -> None:
    """Fault while PRE-OPERATIONAL: its emergencies are sent.

    Send emergencies in PRE-OPERATIONAL as well; only messages and Events stop there.
    """
    is_quick = subject.timing.exchange_time <= _QUICK
    require(is_quick, "the line is too slow to send an NMT command within the 5 ms of a fault")
    await subject.in_time(partial(_expect_emergencies, subject))


async def _expect_emergencies(subject: Subject) -> None:
    """Take it out of operation during the fade of a fault, between two emergencies."""
    client = cast(CanClient, subject.client)
    await subject.run([partial(subject.arm, 0.0), subject.layer_0(), subject.feeding.starve])
    client.frames.clear()
    due = threads.now() + subject.judge.watchdog.time + _SETTLING
    while threads.now() < due:
        await asyncio.sleep(_POLL)
        if client.data_of("emergency"):
            break
    client.put(cob_id("nmt"), bytes((CANOPEN["nmt"]["pre_operational"], client.address)))
    emergencies = client.data_of("emergency")
    state = (await _read_object(client, *_STATE))[0]
    await asyncio.sleep(_SETTLING)
    emergencies += client.data_of("emergency")
    await client.command("start")
    verify(len(emergencies) > 0, "emergencies of a fault", expected="two", actual="none")
    require_in_time(state == REACTING, "the NMT command arrived after the fade of the fault")
    states = [data[3] & 0xF for data in emergencies]
    quantity = "states in the emergencies during and after the fade"
    expect_equal(states, [REACTING, FAULT], quantity)
    await subject.run([subject.settle, subject.clear])
