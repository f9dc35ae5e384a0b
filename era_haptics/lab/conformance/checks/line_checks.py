"""Checks of what an amplifier shares with others on its line: Events, broadcasts, addresses."""

import asyncio
from contextlib import suppress
from functools import partial
from itertools import pairwise

from drivers.protocol.definition import (
    EVENT,
    EVENT_RECORD,
    MESSAGES,
    NO_CHANNEL,
    STATES,
    name_of,
)
from drivers.protocol.records import Values
from drivers.wires.modbus_frames import BOX, HEAD, REPLY_OFFSET
from era_haptics.lab.conformance.check import driving
from era_haptics.lab.conformance.checks.request_checks import UNKNOWN_NUMBERS, valid_words
from era_haptics.lab.conformance.judge_client import HeardMessage, JudgeClient
from era_haptics.lab.conformance.modbus_client import ModbusClient
from era_haptics.lab.conformance.outcomes import (
    ContractViolation,
    TooLate,
    expect_equal,
    require,
    require_in_time,
    verify,
)
from era_haptics.lab.conformance.request_rows import DISARM_NOW, STOP_NOW, Wait, send, stage
from era_haptics.lab.conformance.subject import Subject
from registry import threads

_MOMENTARY = ("READY_TO_SWITCH_ON", "SWITCHED_ON", "FAULT_REACTION_ACTIVE")  # can last no time
_TYPE = 0x7F  # of a frame, without the bit of a reply
_UNFED, _TRIPPED = 0.05, 0.05  # s; before what must not feed; until a trip shows
_MOVED = 0.1  # s; until an amplifier has taken its address
_TRIES = 3  # of a Hello, so that one late reply does not count


# Events


@driving("protocol.md#events")
async def events(subject: Subject) -> None:
    """Change of state: one Event, before the reply to its cause.

    Send one Event for each change of state and for nothing else, with state, fault and latch; none
    if the feature is not stated.
    """
    client = subject.client
    require(client.has_events, "this wire carries no Events")
    await client.look_around()
    has_neighbors = client.kind == "serial" and client.neighbors
    has_events = subject.has("events") and not has_neighbors
    client.history.clear()
    await subject.arm(0.0)
    types = [message.type & _TYPE for message in client.history]
    arm = MESSAGES["Arm"].number
    expected_types = [EVENT, arm] if has_events else [arm]
    expect_equal(types, expected_types, "message types after Arm (Event, then reply)")
    await subject.run([subject.layer_0(), subject.feeding.starve])
    await _expect_unrequested_event(subject, has_events=has_events)
    await subject.run(
        [
            subject.settle,
            subject.clear,
            subject.arm,
            subject.layer_0(),
            send("Disarm", ramp=50),
            subject.settle,
            STOP_NOW,
            STOP_NOW,
            subject.clear,
            Wait(0.02),
        ]
    )
    messages = [message for message in client.history if message.type & _TYPE == EVENT]
    _expect_states(messages, subject.latch, has_events=has_events)
    if client.kind == "serial":
        _expect_consecutive(messages)


async def _expect_unrequested_event(subject: Subject, *, has_events: bool) -> None:
    """Let the watchdog expire without a request, and require an Event."""
    client = subject.client
    count = len(client.history)
    await asyncio.sleep(subject.judge.watchdog.time + _TRIPPED)
    if not has_events:
        return
    if len(client.history) == count:
        await asyncio.sleep(client.timeout)
    has_event = len(client.history) > count
    quantity = "Events after a watchdog expired without a request"
    verify(has_event, quantity, expected="at least one", actual="none")


def _expect_states(messages: list[HeardMessage], latch: int, *, has_events: bool) -> None:
    """Require an Event for each state of the check; latch: of the second Stop at its end."""
    second, first = latch - 1, latch - 2
    changes = [
        ("OPERATION_ENABLED", 0, first - 1),
        ("FAULT_REACTION_ACTIVE", 1, first),
        ("FAULT", 1, first),
        ("SWITCH_ON_DISABLED", 0, first),
        ("OPERATION_ENABLED", 0, first),
        ("SWITCHED_ON", 0, first),
        ("SWITCH_ON_DISABLED", 0, first),
        ("QUICK_STOP_ACTIVE", 0, second),
        ("SWITCH_ON_DISABLED", 0, latch),
    ]
    records = [EVENT_RECORD.unpack(message.words, is_strict=False) for message in messages]
    reported = []
    for record in records:
        state = name_of(STATES, record["state"])
        reported.append((state, record["fault"], record["latch"]))
    # An Event for a state that lasts no time is optional.
    required = [row for row in changes if row[0] not in _MOMENTARY or row in reported]
    actual = [row for row in reported if row[0] not in _MOMENTARY or row in changes]
    expected = required if has_events else []
    expect_equal(actual, expected, "states, faults and latches of Events")
    channels = {record["channel"] for record in records}
    expect_equal(channels - {NO_CHANNEL}, set(), "channels of Events other than 255")


def _expect_consecutive(messages: list[HeardMessage]) -> None:
    """Require consecutive sequence numbers of Events."""
    steps = set()
    for previous, following in pairwise(messages):
        step = (following.frame.sequence - previous.frame.sequence) % 0x10000
        steps.add(step)
    expect_equal(steps - {1}, set(), "steps between Event numbers other than 1")


# Broadcasts


@driving("protocol.md#broadcasts", "serial", "rtu", "can")
async def broadcasts(subject: Subject) -> None:
    """Broadcast Commit or Stop: carried out without a reply; other broadcasts: ignored.

    Accept Commit, Stop, SetAddress and Mark at the broadcast address, check them as usual, and send
    no reply, not even a Nak.
    """
    client = subject.client
    await client.look_around()
    subject.require_alone()
    next_session = subject.next_session
    serial_number = str(subject.identity["serial_number"])
    await _expect_ignored(subject, session=next_session, serial_number=serial_number[:-1])
    half_level = stage(subject.layer_0(level=0.5))
    await subject.run([subject.arm, subject.layer_0(), half_level, Wait(_UNFED)])
    await _expect_ignored(subject)
    moment = subject.moment(0.1 * subject.timing.slowness)
    commit = partial(_expect_obeyed, subject, "Commit", token=subject.sets.token, at=moment)
    await subject.run([commit, subject.follow, commit, subject.feeding.starve])
    half_frames = []
    if client.kind != "rtu":
        # Half of a message, on CAN one frame of two, must not disturb the next one.
        frame = client.request(MESSAGES["Commit"].number, valid_words("Commit"), to=0)
        half_frames = [frame[: len(frame) // 2]]
    await _expect_obeyed(subject, "Stop", *half_frames, ramp=subject.ramp)
    await subject.run([subject.settle, Wait(0.02)])
    await _expect_ignored(subject, session=subject.next_session)


async def _expect_ignored(subject: Subject, **values: object) -> None:
    """Broadcast unicast messages and flawed messages: the amplifier must ignore them."""
    client = subject.client
    (part,) = subject.sets.parts(subject.layer_0(level=0.75), token=subject.sets.token + 2)
    values = {
        "session": subject.session,
        "latch": subject.latch,
        "address": client.free_address,
        "watchdog": subject.can["watchdog_max"],
        "serial_number": str(subject.identity["serial_number"]),
        **part,
        **values,
    }
    stop, commit = MESSAGES["Stop"].number, MESSAGES["Commit"].number
    requests: list[tuple[int, list[int]]] = [
        (commit, valid_words("Commit", session=77, token=subject.sets.token or 1)),
        (stop, []),
        (stop, [0, 0]),
        (UNKNOWN_NUMBERS[0], []),
    ]
    for name, message in reversed(list(MESSAGES.items())):
        if not message.is_broadcast or name == "SetAddress":
            requests.append((message.number, valid_words(name, **values)))
    frames = [client.request(number, words, to=0) for number, words in requests]
    await client.expect_silence(client.question(0), "broadcasts of other messages", *frames)
    await subject.request("GetStatus")


async def _expect_obeyed(subject: Subject, name: str, *earlier: bytes, **values: object) -> None:
    """Broadcast a request after other frames: carried out without a reply."""
    sent_at = threads.now()
    values = subject.filled(values)
    number = MESSAGES[name].number
    data = subject.client.request(number, MESSAGES[name].request.pack(values), to=0)
    await subject.client.expect_silence(data, f"a broadcast {name}", *earlier)
    when = subject.since(sent_at)
    sets = subject.judge.sets
    sets.expire(when)
    require_in_time(not sets.has_expired, "a set expired before its Commit")
    subject.judge.granted(name, values, {}, when)
    await subject.request("GetStatus")


# Addresses


@driving("protocol.md#addresses")
async def addresses(subject: Subject) -> None:
    """SetAddress with the serial number, while disarmed: replies at the new address only.

    Compare the whole serial number, reply from the old address, then move and store the new one.
    Reject another serial number with BAD_VALUE.
    """
    subject.require("address")
    client = subject.client
    own_address = client.address
    serial_number = str(subject.identity["serial_number"])
    await client.look_around()
    move: Values = {"address": client.free_address, "serial_number": serial_number}
    await _expect_not_moved(subject, move)
    try:
        if isinstance(client, ModbusClient):
            await _move_by_reading(subject, client, move)
        else:
            await subject.request("SetAddress", **move)
        await asyncio.sleep(_MOVED)
        await _expect_moved(client, own_address)
        if client.has_broadcasts and not client.neighbors:
            await _expect_moved_by_broadcast(client, own_address, serial_number)
    finally:
        is_back = await _move_back(subject, own_address, serial_number)
    expect_equal(is_back, True, "reply at the first address after the check")


async def _expect_not_moved(subject: Subject, move: Values) -> None:
    """Require that a SetAddress with wrong values, or while armed, is rejected."""
    serial_number = str(move["serial_number"])
    other_end = "y" if serial_number.endswith("x") else "x"
    wrong_numbers = {serial_number + "x", serial_number[:-1], serial_number[:-1] + other_end, ""}
    for wrong_number in wrong_numbers - {serial_number}:
        values = {**move, "serial_number": wrong_number}
        await subject.run([send("SetAddress", **values, code="BAD_VALUE")])
    _, *text = MESSAGES["SetAddress"].request.pack(move)
    for address in (0, subject.client.addresses + 1):
        await subject.run([send("SetAddress", raw=[address, *text], code="BAD_VALUE")])
    while_armed = send("SetAddress", **move, code="WRONG_STATE")
    await subject.run([subject.arm, while_armed, DISARM_NOW, subject.settle])


async def _move_by_reading(subject: Subject, client: ModbusClient, move: Values) -> None:
    """Write a SetAddress, use other areas at the old address, then read the reply."""
    message = MESSAGES["SetAddress"]
    await client.part(message.number, message.request.pack(move))
    await subject.request("GetAchieved", layer=0)
    await subject.request("GetStatus")
    await client.read(BOX * message.number + REPLY_OFFSET, HEAD)


async def _expect_moved(client: JudgeClient, old_address: int) -> None:
    """Require replies at the free address only."""
    timeout = client.timeout
    client.timeout = client.quiet
    has_reply = await _is_at(client, old_address, tries=1)
    client.timeout = timeout
    expect_equal(has_reply, False, "reply at the old address")
    if client.kind == "can":
        client.address = client.free_address  # at which a node does not listen before a start
        data = client.request(MESSAGES["GetStatus"].number, ())
        await client.expect_silence(data, "GetStatus after the boot-up")
    has_reply = await _is_at(client, client.free_address)
    expect_equal(has_reply, True, "reply at the new address")


async def _expect_moved_by_broadcast(client: JudgeClient, address: int, serial_number: str) -> None:
    """Require that a broadcast SetAddress moves the amplifier without a reply."""
    message = MESSAGES["SetAddress"]
    words = message.request.pack({"address": address, "serial_number": serial_number})
    data = client.request(message.number, words, to=0)
    await client.expect_silence(data, "a broadcast SetAddress")
    await asyncio.sleep(_MOVED)
    has_reply = await _is_at(client, address)
    quantity = "reply at the old address after a broadcast SetAddress back"
    expect_equal(has_reply, True, quantity)


async def _move_back(subject: Subject, address: int, serial_number: str) -> bool:
    """Return the amplifier to its address; return whether it replies there."""
    client = subject.client
    is_back = client.address == address and await _is_at(client, address)
    if not is_back:
        if await _is_at(client, client.free_address):
            await subject.request("SetAddress", address=address, serial_number=serial_number)
            await asyncio.sleep(_MOVED)
        is_back = await _is_at(client, address)
    client.address = address
    client.inbox.clear()
    return is_back


async def _is_at(client: JudgeClient, address: int, *, tries: int = _TRIES) -> bool:
    """Whether a Hello to an address has a reply."""
    client.address = address
    for _ in range(tries):
        with suppress(ContractViolation, TooLate):
            await client.hello()
            return True
    return False
