import math
import re
from collections.abc import Callable
from dataclasses import replace
from operator import attrgetter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.codec.payload import Cursor, Malformed
from drivers.codec.serial_line.exchanges import (
    decode_reply,
    decode_request,
    encode_reply,
    encode_request,
)
from drivers.codec.serial_line.frame import REPLY, Frame, encode_frame
from drivers.codec.serial_line.sets import pack_set, unpack_achieved
from drivers.command import CommandSet, DriveCommand, Envelope, Knot
from drivers.errors import CommandError
from drivers.guard import Guard, GuardLimits
from drivers.protocol.definition import PROTOCOL, WireQuantity
from drivers.protocol.messages import (
    Achieved,
    AmplifierState,
    Apply,
    Arm,
    Capabilities,
    Clear,
    Commit,
    Fault,
    FaultList,
    FaultRecord,
    Feature,
    GetFaults,
    GetStatus,
    Hello,
    LoadEnvelope,
    Nak,
    NakCode,
    Ping,
    Reply,
    Request,
    Stage,
    Status,
    Stop,
)
from vendor_pages import plain

Q = PROTOCOL.quantities
FREQUENCIES = WireQuantity("frequency", "u16", 20, "Hz", 400, 12000)  # within the limits


WIDE = Capabilities(
    *(16, 20.0, 600.0, 0.05, 1.0, 0.0001, 0.01, 1.0, 0.1, 2.0, 32, 63, 0.001, 0.1),
    features=Feature.WHOLE,
)
GUARD = Guard(GuardLimits(20.0, 600.0, 1.0), WIDE)
SET = CommandSet(
    token=513,
    commands=(
        DriveCommand(channel=0, frequency=110.0, level=0.2, phase=0.0),
        DriveCommand(channel=3, frequency=250.5, level=1.0, phase=-90.0, keep_phase=True),
    ),
    ramp=0.02,
    valid_for=0.5,
)
# session 9 = 09 00, token 513 = 01 02, ramp 20 ms = 14 00, valid 500 ms = f4 01, two channels;
# channel 0: 2200 = 98 08, 2000 = d0 07, 0; channel 3 keeping phase: 5010 = 92 13, 10000 = 10 27,
# -9000 = d8 dc
SET_BYTES = "09 00  01 02 14 00 f4 01 02  00 00 98 08 d0 07 00 00  03 01 92 13 10 27 d8 dc"


@pytest.mark.parametrize(("wrap", "code"), [(Stage, 5), (Apply, 7)])
def test_set_is_these_bytes(wrap: Callable[[CommandSet, int], Request], code: int) -> None:
    """Counted out by hand; decoding yields a plain CommandSet."""
    frame = Frame(kind=code, address=1, sequence=2, payload=bytes.fromhex(SET_BYTES))
    assert encode_request(wrap(GUARD.check(SET), 9), address=1, sequence=2) == frame
    decoded = decode_request(frame)
    assert decoded == wrap(SET, 9)
    assert type(decoded.command_set) is CommandSet


@pytest.mark.parametrize("level", [0.2, 0.123456789])
def test_reply_that_repeats_a_set_says_what_arrived(level: float) -> None:
    """Whatever was sent: levels of the wire are whole ten-thousandths."""
    sent = CommandSet(7, (DriveCommand(2, 110.0, level),), ramp=0.02, valid_for=0.0)
    packed = pack_set(sent)
    head = len(packed) - 9  # a count and one command of eight bytes
    achieved = unpack_achieved(Cursor(b"\x07\x00" + packed[head:]))
    assert achieved == Achieved(7, (DriveCommand(2, 110.0, round(level, 4)),))


def largest(pick: Callable[[WireQuantity], float]) -> tuple[list[Request], dict[int, Reply]]:
    """Requests, and replies by request type, of full length with an end of every range."""
    value = {name: pick(quantity) for name, quantity in vars(Q).items()}
    whole = {name: int(number) for name, number in value.items()}
    slots = {"onset": whole["envelope_slot"], "ending": whole["envelope_slot"]}
    flags = {"keep_phase": pick(Q.level) > 0, "skip_ending": True}
    commands = tuple(
        DriveCommand(n, value["frequency"], value["level"], value["phase"], **slots, **flags)
        for n in range(16)
    )
    playable = tuple(replace(one, frequency=pick(FREQUENCIES)) for one in commands)
    times = {"ramp": value["ramp"], "valid_for": value["valid_for"]}
    step = max(value["envelope_step"], 0.001)
    shape = Envelope(
        max(whole["envelope_slot"], 1), step, (Knot(value["level"], value["phase"]),) * 32
    )
    guard = Guard(GuardLimits(20.0, 600.0, 1.0), WIDE)
    load = LoadEnvelope(guard.check_envelope(shape))
    safe = guard.check(CommandSet(whole["token"], playable, **times))
    status = Status(
        AmplifierState.FAULT,
        Fault.INTERNAL,
        whole["active_token"],
        True,
        value["temperature"],
        value["watchdog_left"],
        (value["level"],) * 16,
        value["voltage"],
        whole["latch"],
    )
    held = whole["held_session"]
    requests = [
        *(Stage(safe, held), Apply(safe, held), Commit(whole["token"], held), Ping(held)),
        *(load, Arm(value["watchdog"], whole["session"]), Stop(value["ramp"])),
        Clear(whole["latch"]),
    ]
    replies: dict[int, Reply] = {
        7: Achieved(whole["token"], commands),
        9: status,
        10: FaultList((FaultRecord(Fault.INTERNAL, 15, value["age"]),) * 32),
    }
    return requests, replies


@pytest.mark.parametrize("end", ["low", "high"])
def test_extreme_values_round_trip(end: str) -> None:
    """Both ends of every range, in messages of full length."""
    requests, replies = largest(attrgetter(end))
    for request in requests:
        frame = encode_request(request, address=1, sequence=1)
        assert len(encode_frame(frame)) <= 254
        assert decode_request(frame) == plain(request)
    for code, reply in replies.items():
        asked = Frame(kind=code, address=1, sequence=1, payload=b"")
        assert decode_reply(encode_reply(reply, asked), asked) == reply


def in_range(command_set: CommandSet | Achieved) -> bool:
    """Whether every number of a set is one that the page for vendors allows."""
    channels = [command.channel for command in command_set.commands]
    return (
        1 <= command_set.token <= 65535
        and len(set(channels)) == len(channels)
        and all(
            0 <= command.channel <= 15
            and 0 <= command.frequency <= 3276.75
            and 0 <= command.level <= 1
            and -180 <= command.phase < 180
            for command in command_set.commands
        )
    )


@given(st.integers(0, 127), st.binary(max_size=60))
def test_any_payload_is_a_valid_request_or_malformed(code: int, payload: bytes) -> None:
    """Never another exception or a value out of range."""
    frame = Frame(kind=code, address=1, sequence=1, payload=payload)
    try:
        request = decode_request(frame)
    except Malformed:
        return
    if isinstance(request, Stage | Apply):
        assert in_range(request.command_set)
        assert 0 <= request.command_set.ramp <= 1
        assert 0 <= request.command_set.valid_for <= 60
    if isinstance(request, LoadEnvelope):
        assert all(0 <= knot.level <= 1 for knot in request.envelope.knots)
    if isinstance(request, Arm):
        assert 0.1 <= request.watchdog <= 2


@given(st.integers(1, 13), st.booleans(), st.binary(max_size=60))
def test_any_payload_is_a_valid_reply_or_malformed(
    code: int, refused: bool, payload: bytes
) -> None:
    """Never another exception or a value out of range."""
    request = Frame(kind=code, address=1, sequence=1, payload=b"")
    frame = Frame(REPLY | (31 if refused else code), address=1, sequence=1, payload=payload)
    try:
        reply = decode_reply(frame, request)
    except Malformed:
        return
    if isinstance(reply, Achieved):
        assert in_range(reply)
    if isinstance(reply, Status):
        assert all(0 <= level <= 1 for level in reply.levels)


@pytest.mark.parametrize(
    ("code", "payload", "nak"),
    [
        (29, "", NakCode.UNKNOWN_TYPE),
        (13, "05 32 00 02 e803 0000", NakCode.BAD_LENGTH),
        (13, "40 32 00 00", NakCode.BAD_VALUE),
        (13, "05 32 00 01 1127 0000", NakCode.BAD_VALUE),
        (3, "fa 00", NakCode.BAD_LENGTH),
        (3, "fa 00 09 00 00", NakCode.BAD_LENGTH),
        (3, "63 00 09 00", NakCode.BAD_VALUE),
        (3, "fa 00 00 00", NakCode.BAD_VALUE),
        (6, "09 00 00 00", NakCode.BAD_TOKEN),
        (11, "", NakCode.BAD_LENGTH),
        (12, "", NakCode.BAD_LENGTH),
        (7, "0900 0100 0000 0000 01 10 00 9808 d007 0000", NakCode.BAD_CHANNEL),
        (7, "0900 0100 0000 0000 01 00 08 9808 d007 0000", NakCode.BAD_VALUE),
        (7, "0900 0100 0000 0000 01 00 04 9808 d007 0000 40 00", NakCode.BAD_VALUE),
        (7, "0900 0100 0000 0000 01 00 00 9808 1127 0000", NakCode.BAD_VALUE),
        (7, "0900 0100 0000 0000 01 00 00 9808 d007 5046", NakCode.BAD_VALUE),
        (7, "0900 0100 e903 0000 00", NakCode.BAD_VALUE),
        (7, "0900 0100 0000 0000 11", NakCode.BAD_VALUE),
    ],
)
def test_malformed_request_has_a_nak_code(code: int, payload: str, nak: NakCode) -> None:
    """The code of the vendors' page."""
    frame = Frame(kind=code, address=1, sequence=1, payload=bytes.fromhex(payload))
    with pytest.raises(Malformed) as caught:
        decode_request(frame)
    assert caught.value.code is nak


def test_repeated_channel_is_malformed() -> None:
    """The refusal names the channel."""
    one = "02 00 9808 d007 0000"
    payload = bytes.fromhex(f"0900 0100 0000 0000 02 {one} {one}")
    with pytest.raises(Malformed) as caught:
        decode_request(Frame(kind=7, address=1, sequence=1, payload=payload))
    assert (caught.value.code, caught.value.channel) == (NakCode.BAD_CHANNEL, 2)


@pytest.mark.parametrize(
    ("raw", "problem"),
    [(b"a\x1b[31m", "control"), (b"tab\there", "control"), (b"\xff\xfe", "UTF-8")],
)
def test_unprintable_text_is_malformed(raw: bytes, problem: str) -> None:
    """Escape sequences and invalid UTF-8 do not reach the terminal."""
    payload = b"\x04\0" + bytes([len(raw)]) + raw + b"\0\0\0"
    request = Frame(kind=1, address=1, sequence=1, payload=b"")
    with pytest.raises(Malformed, match=problem):
        decode_reply(Frame(kind=0x81, address=1, sequence=1, payload=payload), request)


@pytest.mark.parametrize(
    ("asked", "payload", "problem"),
    [
        (Hello(), "0400 21", "got 33"),
        (GetStatus(), f"08{11 * '00'}010000", "unknown AmplifierState 8"),
        (GetFaults(), "01 04 10 00000000", "channel 16 does not exist"),
        (GetFaults(), "ff", "fault_count must be 0 to 32, got 255"),
    ],
)
def test_malformed_reply_names_the_field(asked: Request, payload: str, problem: str) -> None:
    """Bytes by hand."""
    request = encode_request(asked, address=1, sequence=1)
    frame = Frame(kind=request.kind | 0x80, address=1, sequence=1, payload=bytes.fromhex(payload))
    with pytest.raises(Malformed, match=re.escape(problem)):
        decode_reply(frame, request)


def test_reply_may_have_more_than_is_known() -> None:
    """Further bytes; and unknown flags, faults and reasons of a refusal, shown by number."""
    request = encode_request(GetStatus(), address=1, sequence=1)

    def reply(kind: int, payload: str) -> Reply:
        frame = Frame(kind=kind, address=1, sequence=1, payload=bytes.fromhex(payload))
        return decode_reply(frame, request)

    status = reply(REPLY | 9, "07 42 0100 85 FA00 0000 0807 03 01 0000 07 07")
    assert status == Status(
        AmplifierState.FAULT, Fault(66), 1, True, 25.0, 0.0, (0.0,), 1800.0, 3, other_flags=0x84
    )
    assert reply(REPLY | 31, "09 0D FF 00") == Nak(NakCode(13))
    assert [Fault(66).name, NakCode(13).name] == ["VENDOR_66", "NUMBER_13"]


def test_reply_to_another_type_is_malformed() -> None:
    """A Status or a refusal of a Ping in reply to a Commit."""
    request = Frame(kind=6, address=1, sequence=1, payload=b"\1\0")
    status = Status(AmplifierState.FAULT, Fault.ARC, 0, False, 25.0, 0.0, ())
    ping = Frame(kind=12, address=1, sequence=1, payload=b"")
    for reply in (status, Nak(NakCode.BUSY)):
        with pytest.raises(Malformed, match=r"type (0x8c|12)"):
            decode_reply(encode_reply(reply, ping), request)
    with pytest.raises(TypeError, match="not a reply"):
        encode_reply(status, request)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, -0.01, 3276.8, 1e300])
def test_quantity_refuses_values_out_of_range(value: float) -> None:
    """NaN, infinities and values out of range are not clipped."""
    with pytest.raises(CommandError, match="frequency"):
        Q.frequency.to_wire(value)
    if not math.isfinite(value):
        with pytest.raises(CommandError, match="phase"):
            Q.phase.to_wire(value)


def test_quantity_rounds_and_angles_wrap() -> None:
    """Values go to the nearest step, u16 in 0.05 Hz ends at 3276.75, angles are modulo a turn."""
    assert Q.frequency.to_wire(3276.75) == 65535
    assert Q.frequency.quantise(110.02) == 110.0
    assert Q.level.to_wire(1.0) == 10000
    assert Q.ramp.to_wire(0.0204) == 20
    assert [Q.phase.to_wire(angle) for angle in (180, -180, 270, 360, 539.99)] == [
        -18000,
        -18000,
        -9000,
        0,
        17999,
    ]


@pytest.mark.parametrize(
    ("enum", "listed"),
    [(AmplifierState, PROTOCOL.states), (Fault, PROTOCOL.faults), (NakCode, PROTOCOL.naks)],
)
def test_enumerations_equal_the_definition(
    enum: type[AmplifierState] | type[Fault] | type[NakCode], listed: dict[str, int]
) -> None:
    """States, faults and refusals, by name and number."""
    assert {member.name: member.value for member in enum} == listed
