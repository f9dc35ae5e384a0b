"""Checks of identity, capabilities and rejections, which only read; events, broadcasts, addresses.

Checks of a CAN node: network management, heartbeats, emergencies, and objects by SDO.
"""

import asyncio
import math
import struct
import zlib
from collections.abc import Awaitable, Callable
from contextlib import suppress
from functools import partial
from itertools import pairwise
from typing import Any, cast

from drivers.protocol.definition import (
    ENABLED,
    EVENT,
    EVENT_RECORD,
    FAULTS,
    MESSAGES,
    NO_CHANNEL,
    REACTION,
    RESERVED_MESSAGES,
    STATES,
    STATUS,
    STATUS_FLAGS,
    TEXTS,
    has_flag,
    name_of,
)
from drivers.protocol.records import Values
from drivers.wires.can_frames import CANOPEN, cob_id
from era_haptics.lab.conformance.check import driving, greeted, reading
from era_haptics.lab.conformance.checks.frame_checks import (
    UPLOAD,
    CanClient,
    SerialClient,
)
from era_haptics.lab.conformance.judge_client import (
    AlreadyArmed,
    ContractViolation,
    JudgeClient,
    RequestRows,
    TooLate,
    When,
    expect_equal,
    expect_one_of,
    expect_within,
    in_batches,
    require,
    require_in_time,
    send,
    stage,
    verify,
)
from era_haptics.lab.conformance.subject import Subject
from era_haptics.lab.expected_amplifier import FAULT, OFF, REACTING
from registry import threads

_UNKNOWN = (*RESERVED_MESSAGES, 20, 24, 29, 63)  # unassigned numbers, below the vendors' range
_TRIES, _AT_ONCE = 20, 4
_FEATURE_OF = {
    "GetMeasured": "electrical",
    "SetAddress": "address",
    "Mark": "mark",
}


@reading("protocol.md#identity-and-capabilities", greets=True)
async def identity(client: JudgeClient) -> None:
    """Hello, sent twice: the same identity with all four texts, and version 4 supported.

    Return constant texts for vendor, product, serial number and firmware, and set bit 4 of
    versions.
    """
    first = await greeted(client)
    for name in ("vendor", "product", "serial_number", "firmware"):
        verify(bool(first[name]), name, expected="a text", seen="none")
    expect_equal(await client.hello(), first, "identity, read a second time")


@reading("protocol.md#identity-and-capabilities")
async def capabilities(subject: Subject) -> None:
    """GetCaps, sent twice: the same capabilities, each within its range.

    Correct the number named above. Checks that need this capability are not run until it is right.
    """
    must, seen = (
        "; ".join(f"{name} {each[at]}" for name, each in subject.can.wrong.items()) for at in (0, 1)
    )
    expect_equal(seen, must, "capabilities")
    await subject.request("GetCaps")


@reading("protocol.md#states")
async def starts_disarmed(subject: Subject) -> None:
    """GetStatus before Arm: disarmed and silent, flags of stated features only.

    Power up in SWITCH_ON_DISABLED, and set interlock_open only if you state the feature interlock.
    If another host has armed the amplifier, stop that host first.
    """
    status = (await subject.request("GetStatus")).values
    if status["state"] == ENABLED:
        raise AlreadyArmed("state before Arm", expected="disarmed", seen="OPERATION_ENABLED")
    disarmed = [number for number in STATES.values() if number != ENABLED]
    expect_one_of(status["state"], disarmed, "state before Arm")
    is_open = has_flag(status, "interlock_open") and not subject.has("interlock")
    expect_equal(is_open, False, "interlock_open without the feature interlock")
    expect_within(status["flags"], 0, (1 << len(STATUS_FLAGS)) - 1, "flags")


@reading("protocol.md#times")
async def replies_in_time(subject: Subject) -> None:
    """GetStatus, GetCaps and GetFaults: each reply begins within 10 ms.

    Reply from memory, without waiting for a converter, for flash or for the next block of samples.
    """
    for name in ("GetStatus", "GetCaps", "GetFaults"):
        await _expect_prompt(subject, name, partial(subject.request, name))


@driving("protocol.md#times")
async def obeys_in_time(subject: Subject) -> None:
    """Requests that arm, feed, play or silence: each reply begins within 10 ms.

    Reply before slow work: do not wait for the high voltage, for a block of samples or for a ramp
    to end.
    """
    refused = send("Ping", session=77, code="WRONG_SESSION")
    requests: dict[str, Callable[[], Awaitable[object]]] = {
        "refusals": partial(subject.send, refused),
        "Arm": partial(subject.request, "Arm", watchdog=subject.can["watchdog_max"]),
        "Ping": subject.ping,
        "Set": partial(subject.send, stage(subject.one())),
        "Commit": lambda: subject.request("Commit", token=subject.token),
        "GetAchieved": partial(subject.request, "GetAchieved", layer=0),
        "Silence": partial(subject.request, "Silence", ramp=0),
        "Disarm": partial(subject.request, "Disarm", ramp=0),
        "Stop": partial(subject.request, "Stop", ramp=0),
    }
    await subject.arm(subject.can["watchdog_max"] / 1000)
    for name, request in requests.items():
        await _expect_prompt(subject, name, request)


async def _expect_prompt(
    subject: Subject, name: str, request: Callable[[], Awaitable[object]]
) -> None:
    """Make a request until its reply begins in time, which it must once."""
    subject.client.reactions[name].clear()  # lest a longer one of before hides its time
    fastest = math.inf
    for _ in range(_TRIES):
        await request()
        fastest = min(subject.client.reactions[name])
        if fastest <= REACTION:
            break
    expect_within(
        1e3 * fastest,
        0,
        1e3 * REACTION,
        f"shortest time until the reply to {name} begins [ms], of {_TRIES}",
    )


@reading("protocol.md#order-of-checks")
async def unknown_types(subject: Subject) -> None:
    """Unknown message, or message of a feature that is not stated: UNKNOWN_TYPE.

    Check the type before the length. Reject every number that is not in the table, including 16 to
    18.
    """
    for number in _UNKNOWN:
        answer = await subject.client.exchange(number, ())
        expect_equal(answer.code, "UNKNOWN_TYPE", f"code for message {number}")
    missing = [name for name, feature in _FEATURE_OF.items() if not subject.has(feature)]
    await subject.run([send(each, raw=_shortest(each), code="UNKNOWN_TYPE") for each in missing])


@driving("protocol.md#order-of-checks")
def lengths(subject: Subject) -> RequestRows:
    """Request one word short or one word long: BAD_LENGTH.

    Read the words in order and reject at the first error: a missing word, a token of 0, a number
    out of range. Reject extra words only after that.
    """
    known = [name for name in MESSAGES if subject.has(_FEATURE_OF.get(name, ""))]
    shorter = [(name, words[:-1]) for name in known if (words := _shortest(name))]
    longer = [(name, [*_shortest(name), 0]) for name in known if name != "Set"]
    first_wrong = [send("Ping", raw=[0, 0, 0][:count], code="BAD_VALUE") for count in (1, 3)]
    lengths = (*shorter, *longer)
    rows = [send(name, raw=words, code="BAD_LENGTH") for name, words in lengths] + first_wrong
    return [partial(subject.send_all, each) for each in in_batches(rows, _AT_ONCE)]


@reading("protocol.md#readings")
async def reading_changes_nothing(subject: Subject) -> None:
    """GetAchieved while disarmed: no command in any layer, BAD_VALUE beyond the last layer.

    For a layer that plays nothing, return its number and 0 in every other field. In GetFaults, name
    a channel that exists, or 255.
    """
    beyond = range(len(subject.layers), 16)
    await subject.run([send("GetAchieved", layer=each, code="BAD_VALUE") for each in beyond])
    await subject.run([send("GetAchieved", layer=number) for number in subject.layers])
    known = *subject.channels, NO_CHANNEL
    for each in (await subject.request("GetFaults"))["faults"]:
        expect_one_of(each["channel"], known, "channel of a listed fault")
    await subject.status()


@reading("serial.md#hello", "serial")
async def hello_for_ever(subject: Subject) -> None:
    """Hello of any version and length: Identity; other messages: UNSUPPORTED_VERSION.

    Handle Hello before the version check, ignore its payload and reply in version 0.
    """
    client = cast(SerialClient, subject.client)
    for payload, version in ((b"", 3), (b"\1\2\3", 0), (b"\1", 77), (b"", 2)):
        shown = await client.hello(payload, version)
        expect_equal(shown, subject.identity, f"identity returned to a Hello of version {version}")
    for version in (0, 2, 3, 255):
        answer = await client.exchange(MESSAGES["GetStatus"].number, (), version=version)
        expect_equal(answer.code, "UNSUPPORTED_VERSION", f"code for a frame of version {version}")


@reading("protocol.md#order-of-checks", "serial")
async def half_words(subject: Subject) -> None:
    """Request with an odd number of bytes: BAD_LENGTH; of an unknown type: UNKNOWN_TYPE.

    Check the type first. If a byte is left over after the last whole word, reject the request with
    BAD_LENGTH before you read its words.
    """
    client = cast(SerialClient, subject.client)
    ping = MESSAGES["Ping"].number
    for number, words, code in (
        (ping, [1, 0], "BAD_LENGTH"),
        (ping, [1], "BAD_LENGTH"),
        (_UNKNOWN[0], [1, 0], "UNKNOWN_TYPE"),
    ):
        answer = await client.exchange(number, words, behind=b"\0")
        expect_equal(answer.code, code, f"code for message {number} with half a word")


def _shortest(name: str, **others: Any) -> list[int]:
    """Return the words of a request that is right but for the state, or has other values."""
    values = {
        "session": 1,
        "watchdog": 250,
        "ramp": 5,
        "token": 1,
        "index": 0,
        "parts": 1,
        "now": 0,
        "stream": [],
        "latch": 0,
        "layer": 0,
        "address": 9,
        "serial_number": "?",
        "shift": 0,
        "rate": 0,
        "at": 0,
        **others,
    }
    return MESSAGES[name].request.pack(values)


_MOMENTARY = ("READY_TO_SWITCH_ON", "SWITCHED_ON", "FAULT_REACTION_ACTIVE")  # may last no time
_TYPE = 0x7F  # of a frame, without the bit of a reply
_MARKED = 0.1  # s; from a Mark until it is read
_UNFED, _TRIPPED = 0.05, 0.05  # s; before what must not feed; until a trip shows
_MOVED = 0.1  # s; until an amplifier has taken its address
_SURE = 3  # tries


@driving("protocol.md#events")
async def events(subject: Subject) -> None:
    """Change of state: one Event, before the reply to its cause.

    Send one Event for each change of state and for nothing else, with state, fault and latch; none
    if the feature is not stated.
    """
    client = subject.client
    require(client.has_events, "this wire carries no Events")
    await client.look_around()
    is_stated = subject.has("events") and not (client.kind == "serial" and client.neighbours)
    client.order.clear()
    await subject.arm(0.0)
    types = [EVENT, MESSAGES["Arm"].number][not is_stated :]
    seen = [each.type & _TYPE for each in client.order]
    expect_equal(seen, types, "message types after Arm (Event, then reply)")

    async def unasked() -> None:
        count = len(client.order)
        await asyncio.sleep(subject.shown.watchdog + _TRIPPED)
        if is_stated and len(client.order) == count:
            await asyncio.sleep(client.timeout)
        if is_stated:
            verify(
                len(client.order) > count,
                "Events after a watchdog expired without a request",
                expected="at least one",
                seen="none",
            )

    await subject.run([subject.one(), subject.starve])
    await unasked()
    await subject.run(
        [
            subject.settle,
            subject.clear,
            subject.arm,
            subject.one(),
            send("Disarm", ramp=50),
            subject.settle,
            send("Stop", ramp=0),
            send("Stop", ramp=0),
            subject.clear,
            0.02,
        ]
    )
    last = subject.latch  # of the second Stop, which changes no state
    second, first = last - 1, last - 2
    required = [
        ("OPERATION_ENABLED", 0, first - 1),
        ("FAULT_REACTION_ACTIVE", 1, first),
        ("FAULT", 1, first),
        ("SWITCH_ON_DISABLED", 0, first),
        ("OPERATION_ENABLED", 0, first),
        ("SWITCHED_ON", 0, first),
        ("SWITCH_ON_DISABLED", 0, first),
        ("QUICK_STOP_ACTIVE", 0, second),
        ("SWITCH_ON_DISABLED", 0, last),
    ]
    found = [each for each in client.order if each.type & _TYPE == EVENT]
    reports = [EVENT_RECORD.unpack(each.words, is_strict=False) for each in found]
    reported = [(name_of(STATES, each["state"]), each["fault"], each["latch"]) for each in reports]
    # A state that lasts no time may be left out or told.
    needed = [each for each in required if each[0] not in _MOMENTARY or each in reported]
    shown = [each for each in reported if each[0] not in _MOMENTARY or each in required]
    expect_equal(shown, needed if is_stated else [], "states, faults and latches of Events")
    if client.kind == "serial":
        steps = {(b.frame.sequence - a.frame.sequence) % 0x10000 for a, b in pairwise(found)}
        expect_equal(steps - {1}, set(), "steps between Event numbers other than 1")
    channels = {each["channel"] for each in reports}
    expect_equal(channels - {NO_CHANNEL}, set(), "channels of Events other than 255")


@driving("protocol.md#broadcasts", "serial", "rtu", "can")
async def broadcasts(subject: Subject) -> None:
    """Broadcast Commit or Stop: carried out without a reply; other broadcasts: ignored.

    Accept Commit, Stop, SetAddress and Mark at the broadcast address, check them as usual, and send
    no reply, not even a Nak.
    """
    client = subject.client
    await client.look_around()
    subject.require_alone()
    serial = str(subject.identity["serial_number"])

    async def ignore_all(**others: object) -> None:
        """Broadcast unicast messages and flawed messages: the amplifier must ignore them."""
        values = {
            "session": subject.session,
            "latch": subject.latch,
            "address": client.free,
            "watchdog": subject.can["watchdog_max"],
            "serial_number": serial,
            **subject.parts(subject.one(level=0.75), token=subject.token + 2)[0],
            **others,
        }
        requests = [
            (each.number, _shortest(name, **values))
            for name, each in reversed([*MESSAGES.items()])
            if not each.is_broadcast or name == "SetAddress"
        ]
        stop, commit = MESSAGES["Stop"].number, MESSAGES["Commit"].number
        flawed: list[tuple[int, list[int]]] = [(stop, []), (stop, [0, 0]), (_UNKNOWN[0], [])]
        unheld = commit, _shortest("Commit", session=77, token=subject.token or 1)
        frames = [client.request(*each, to=0) for each in (unheld, *flawed, *requests)]
        await client.expect_silence(client.question(0), "broadcasts of other messages", *frames)
        await subject.request("GetStatus")

    async def obey(name: str, *before: bytes, **values: object) -> None:
        message, sent = MESSAGES[name], threads.now()
        values = subject.filled(values)
        words = message.request.pack(values)
        data = client.request(message.number, words, to=0)
        await client.expect_silence(data, f"a broadcast {name}", *before)
        when = subject.since(sent)
        subject.shown.sets.expire(when)
        require_in_time(not subject.shown.sets.has_expired, "a set expired before its Commit")
        subject.shown.granted(name, values, {}, when)
        await subject.request("GetStatus")

    await ignore_all(session=subject.next_session, serial_number=serial[:-1])
    await subject.run([subject.arm, subject.one(), stage(subject.one(level=0.5)), _UNFED])
    await ignore_all()
    at = subject.moment(0.1 * subject.slowness)
    commit = partial(obey, "Commit", token=subject.token, at=at)
    await subject.run([commit, subject.follow, commit, subject.starve])
    commit_all = client.request(MESSAGES["Commit"].number, _shortest("Commit"), to=0)
    # Of a message half, on CAN a frame of two.
    half = () if client.kind == "rtu" else (commit_all[: len(commit_all) // 2],)
    await obey("Stop", *half, ramp=subject.ramp)
    await subject.run([subject.settle, 0.02])
    await ignore_all(session=subject.next_session)


@driving("protocol.md#the-clock")
async def mark(subject: Subject) -> None:
    """Mark: the next Status shows the clock of the Mark, the following one the current clock.

    Store the clock in the interrupt of the last byte of the Mark, show it in one Status, then
    discard it.
    """
    subject.require("mark")
    client = subject.client
    if client.has_broadcasts:
        await client.look_around()
    await subject.run([subject.arm, send("Mark"), send("Mark"), 0.1])
    if client.has_broadcasts and not client.neighbours:
        sent = threads.now()
        client.write(client.request(MESSAGES["Mark"].number, (), to=0))
        written = threads.now()
        await asyncio.sleep(_MARKED)
        when = subject.dating.interval(When(sent, written + REACTION + client.transit))
        subject.shown.carry_out("Mark", {}, {}, when)
        await subject.run([subject.ping, subject.status])
        expect_equal(len(client.heard), 0, "number of replies to a broadcast Mark")


@driving("protocol.md#addresses")
async def addresses(subject: Subject) -> None:
    """SetAddress with the serial number, while disarmed: replies at the new address only.

    Compare the whole serial number, reply from the old address, then move and store the new one.
    Reject another serial number with BAD_VALUE.
    """
    subject.require("address")
    client, own = subject.client, subject.client.address
    serial = str(subject.identity["serial_number"])
    await client.look_around()
    free = client.free
    right: Values = {"address": free, "serial_number": serial}
    _, *text = MESSAGES["SetAddress"].request.pack(right)
    others = {serial + "x", serial[:-1], ""} - {serial}
    named: list[Values] = [{**right, "serial_number": other} for other in others]
    beyond = [[address, *text] for address in (0, client.addresses + 1)]
    await subject.run(
        [
            *(send("SetAddress", **each, code="BAD_VALUE") for each in named),
            *(send("SetAddress", raw=each, code="BAD_VALUE") for each in beyond),
            subject.arm,
            send("SetAddress", **right, code="WRONG_STATE"),
            send("Disarm", ramp=0),
            subject.settle,
        ]
    )
    try:
        await subject.request("SetAddress", **right)
        await asyncio.sleep(_MOVED)
        client.timeout, timeout = client.quiet, client.timeout
        is_there = await _is_at(client, own, tries=1)
        client.timeout = timeout
        expect_equal(is_there, False, "reply at the old address")
        if client.kind == "can":
            client.address = free  # at which a node does not listen before a start
            data = client.request(MESSAGES["GetStatus"].number, ())
            await client.expect_silence(data, "GetStatus after the boot-up")
        expect_equal(await _is_at(client, free), True, "reply at the new address")
        if client.has_broadcasts and not client.neighbours:
            back = MESSAGES["SetAddress"].request.pack({**right, "address": own})
            data = client.request(MESSAGES["SetAddress"].number, back, to=0)
            await client.expect_silence(data, "a broadcast SetAddress")
            await asyncio.sleep(_MOVED)
            expect_equal(
                await _is_at(client, own),
                True,
                "reply at the old address after a broadcast SetAddress back",
            )
    finally:
        if not (is_back := client.address == own and await _is_at(client, own)):
            if await _is_at(client, free):
                await subject.request("SetAddress", address=own, serial_number=serial)
                await asyncio.sleep(_MOVED)
            is_back = await _is_at(client, own)
        client.address = own
        client.heard.clear()
    expect_equal(is_back, True, "reply at the first address after the check")


async def _is_at(client: JudgeClient, address: int, *, tries: int = _SURE) -> bool:
    """Whether a Hello to an address has a reply, in a few tries lest this machine is late."""
    client.address = address
    for _ in range(tries):
        with suppress(ContractViolation, TooLate):
            await client.hello()
            return True
    return False


_OPERATIONAL, _PRE_OPERATIONAL = 5, 127
_EMERGENCY = struct.Struct("<HBBB3x")
_HEARTBEAT, _DEFAULT, _OTHER = 0x1017, CANOPEN["heartbeat_ms"], 20  # ms
_NO_OBJECT, _NO_SUBINDEX, _READ_ONLY = 0x0602_0000, 0x0609_0011, 0x0601_0002
_WRONG_LENGTH = 0x0607_0010
_STILL = "state", "fault", "latch", "token", "channels"
"""Words of a status that do not change without a request."""
_ABORT, _WRITTEN = 0x80, 0x60
_CAN_NODE_TRIES, _POLL = 500, 0.001  # s
_QUICK, _BEYOND = 0.003, 0.05  # s; for an exchange during a fade; after an expected event


async def _exchange(client: CanClient, data: bytes) -> bytes:
    client.frames.clear()
    client.put(cob_id("sdo_request", client.address), data)
    for _ in range(_CAN_NODE_TRIES):
        await asyncio.sleep(_POLL)
        if replies := client.data_of("sdo_answer"):
            return replies[0]
    raise ContractViolation("reply to an SDO", expected="one within 0.5 s", seen="none")


async def _object(
    client: CanClient, command: int, index: int, subindex: int, data: bytes = b"", *, code: int = 0
) -> bytes:
    """Read or write an object; returns the answer, an abort with the code if there is one."""
    request = struct.pack("<BHB4s", command, index, subindex, data)
    answer = await _exchange(client, request)
    kind = _ABORT if code else UPLOAD if command == UPLOAD else _WRITTEN
    seen = answer[0] & 0xE0, answer[1:4], f"{int.from_bytes(answer[4:], 'little') * bool(code):08x}"
    expect_equal(
        seen,
        (kind, request[1:4], f"{code:08x}"),
        f"reply to SDO {command:02x} of object {index:04x}/{subindex}",
    )
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
        verify(
            is_next,
            f"segment of object {index:04x}/{subindex}",
            expected="the next segment",
            seen=answer.hex(),
        )
        data += answer[1 : 8 - (answer[0] >> 1 & 7)]
        toggle ^= 0x10
    return data


@driving("can.md#network-management", "can")
async def network_management(subject: Subject) -> None:
    """NMT command: replies only while OPERATIONAL; leaving it while armed is a Stop.

    Run a Stop with a ramp of 5 ms whenever NMT takes the node out of OPERATIONAL, and reset object
    1017 and the numbers after a reset.
    """
    client = cast(CanClient, subject.client)
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
        expect_equal(is_read, command != "stop", f"object readable after {command}")
        await client.command("start", to=started_as)
        await expect_interval(_DEFAULT if "reset" in command else _OTHER, command)

    async def expect_interval(interval: int, command: str) -> None:
        shown = int.from_bytes(await read_object(client, _HEARTBEAT), "little")
        expect_equal(shown, interval, f"interval of the heartbeat [ms] after {command}")

    for case in (
        ("pre_operational", None, for_all),
        ("stop", for_all, None),
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
    expect_equal(arm.code, "", "code for an Arm with the session held before reset_node")
    subject.require_alone()


@driving("can.md#network-management", "can")
async def heartbeats(subject: Subject) -> None:
    """Object 1017: heartbeats at its interval; fault and Clear: an emergency for each.

    Send the NMT state at the interval of object 1017, none for 0, and an emergency on entering 6,
    on entering 7 and on leaving 7.
    """
    client = cast(CanClient, subject.client)

    async def expect_objects(error_register: int, state: int) -> None:
        shown = [(await read_object(client, *each))[0] for each in ((0x1001, 0), (0x2002, 1))]
        expect_equal(
            shown, [error_register, state], "error register and state in objects 1001 and 2002"
        )

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
        verify({*beats} <= {_OPERATIONAL}, "state in a heartbeat", expected="5", seen=beats)
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
    """Fault while PRE-OPERATIONAL: its emergencies are sent.

    Send emergencies in PRE-OPERATIONAL as well; only messages and Events stop there.
    """
    require(
        subject.exchange_time <= _QUICK,
        "the line is too slow to send an NMT command within the 5 ms of a fault",
    )
    await subject.in_time(partial(_fails_unheard, subject))


async def _fails_unheard(subject: Subject) -> None:
    """Take it out of operation amid the fade of a fault, between two emergencies."""
    client = cast(CanClient, subject.client)
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
    verify(bool(heard), "emergencies of a fault", expected="two", seen="none")
    require_in_time(state == REACTING, "the NMT command arrived after the fade of the fault")
    states = [each[3] & 0xF for each in heard]
    expect_equal(states, [REACTING, FAULT], "states in the emergencies during and after the fade")
    await subject.run([subject.settle, subject.clear])


@reading("can.md#objects", "can")
async def objects(subject: Subject) -> None:
    """SDO of every object: its value and size; of any other object or size: the listed abort.

    Serve every object of the table in its size, allow writes to object 1017 only, and check for
    aborts in the order of the page.
    """
    client, caps = cast(CanClient, subject.client), (await subject.request("GetCaps")).words
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
        (0x2000, 0, 1, len(TEXTS) + 1),
        (0x2000, 5, 2, subject.identity["versions"]),
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
        (0x1000, 0, 4, _READ_ONLY),
        (0x2000, 5, 2, _READ_ONLY),
        (0x2002, 1, 2, _READ_ONLY),
        (0x1003, 0, 2, _NO_OBJECT),
        (_HEARTBEAT, 1, 2, _NO_SUBINDEX),
        (_HEARTBEAT, 0, 1, _WRONG_LENGTH),
        (_HEARTBEAT, 0, 4, _WRONG_LENGTH),
    ):
        await write_object(client, index, b"\1\0\0\0"[:size], subindex, code=code)
