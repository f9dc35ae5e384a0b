"""Requests as CAN frames and answers from them, against bytes worked out by hand."""

from dataclasses import replace

import cantools
import pytest
from hypothesis import given
from hypothesis import strategies as st

from can_dbc import dbc_text
from drivers.codec.can_bus.frame import LAYOUTS, CanFrame
from drivers.codec.can_bus.objects import (
    CAPABILITY_ENTRIES,
    read_integer,
    unpack_achieved,
    unpack_capabilities,
    unpack_faults,
    unpack_identity,
)
from drivers.codec.can_bus.replies import CanReplyReader, decode_emergency
from drivers.codec.can_bus.requests import (
    encode_broadcast,
    encode_request,
    requested_commands,
)
from drivers.command import CommandSet, DriveCommand
from drivers.errors import FrameError
from drivers.guard import Guard, GuardLimits, SafeCommandSet
from drivers.protocol.messages import (
    AmplifierEvent,
    AmplifierState,
    Apply,
    Capabilities,
    ChannelLimits,
    Commit,
    Fault,
    FaultRecord,
    Feature,
    Nak,
    NakCode,
    Stage,
    Status,
    Stop,
)

WIDE = Capabilities(
    *(16, 20.0, 600.0, 0.05, 1.0, 0.0001, 0.01, 1.0, 0.1, 2.0, 32, 63, 0.001, 0.1),
    features=Feature.WHOLE,
)


def make(channels: int) -> SafeCommandSet:
    """A set of so many channels, each at its own frequency."""
    commands = tuple(
        DriveCommand(channel, 100.0 + channel, 0.01 * channel) for channel in range(channels)
    )
    guard = Guard(GuardLimits(20.0, 600.0, 1.0), WIDE)
    return guard.check(CommandSet(token=258, commands=commands, ramp=0.001, valid_for=0.0))


def test_set_is_a_frame_per_channel_and_an_order() -> None:
    """Channels 4 and on have the identifiers of the next node; the count stands in the order."""
    frames = encode_request(Apply(make(6)), node=2, sequence=9)
    assert [frame.id for frame in frames] == [
        *(0x202, 0x302, 0x402, 0x502, 0x203, 0x303),
        0x482,
    ]
    assert frames[5].data == bytes.fromhex("3408 F401 0000 50 09")  # 105 Hz, 0.05, channel 5
    assert frames[6].data == bytes.fromhex("0201 0100 0000 31 09")  # six times eight plus apply


def test_can_fd_set_of_seven_channels_is_one_frame() -> None:
    """Eight bytes of order, seven commands; of sixteen channels the rest goes before it."""
    (one,) = encode_request(Apply(make(7)), node=1, sequence=2, fd=True)
    assert (one.id, len(one.data), one.fd) == (0x481, 64, True)
    frames = encode_request(Apply(make(16)), node=1, sequence=2, fd=True)
    assert [(frame.id, len(frame.data)) for frame in frames] == [
        *((0x201, 64), (0x201, 8)),
        (0x481, 64),
    ]
    five = encode_request(Stage(make(4)), node=1, sequence=2, fd=True)[0]
    assert len(five.data) == 48
    assert five.data[40:] == b"\xff" * 8


def test_broadcast_is_for_node_zero() -> None:
    """One frame each, with sequence number 0."""
    assert encode_broadcast(Commit(7)) == (CanFrame(0x480, bytes.fromhex("0700 0000 0000 03 00")),)
    assert encode_broadcast(Stop(0.01)) == (CanFrame(0x480, bytes.fromhex("0000 0A00 0000 06 00")),)


@given(
    frequency=st.floats(20.0, 600.0),
    level=st.floats(0.0, 1.0),
    phase=st.floats(-180.0, 179.9),
    keep=st.booleans(),
    skip=st.booleans(),
)
def test_cantools_decodes_a_set_by_the_dbc(
    frequency: float, level: float, phase: float, keep: bool, skip: bool
) -> None:
    """An independent decoder finds frequency, level and phase to their steps."""
    wanted = DriveCommand(2, frequency, level, phase, keep_phase=keep, skip_ending=skip)
    guard = Guard(GuardLimits(20.0, 600.0, 1.0), WIDE)
    safe = guard.check(CommandSet(token=77, commands=(wanted,), ramp=0.25, valid_for=1.5))
    frames = encode_request(Apply(safe), node=1, sequence=5)
    command, order = (DATABASE.decode_message(frame.id, frame.data) for frame in frames[:2])
    achieved = requested_commands(safe)[0]
    assert command["frequency"] == pytest.approx(achieved.frequency, abs=1e-9)
    assert command["level"] == pytest.approx(level, abs=0.51e-4)
    assert command["phase"] == pytest.approx(achieved.phase, abs=1e-9)
    assert (command["keep_phase"], command["skip_ending"]) == (keep, skip)
    assert (command["channel"], command["sequence"]) == (2, 5)
    assert order["token"] == 77
    assert order["ramp"] == pytest.approx(0.25)
    assert order["time"] == pytest.approx(1.5)
    assert (order["action"], order["count"]) == ("apply", 1)


DATABASE = cantools.database.load_string(dbc_text(), database_format="dbc")
LEVELS = bytes.fromhex("D007 0000 0040 9C 04")  # 0.2, 0, 0, 1 in 14 bits each
CONDITION = bytes.fromhex("04 01 FA00 0807 04 00")
ANSWER = bytes.fromhex("04 00 04 FF 0102 FA00")
STATUS = Status(
    AmplifierState.OPERATION_ENABLED,
    Fault.NONE,
    513,
    True,
    25.0,
    0.25,
    (0.2, 0.0, 0.0, 1.0),
    1800.0,
)


def feed(*frames: tuple[int, bytes]) -> list[object]:
    """What a reader of node 1 makes of frames."""
    reader = CanReplyReader(1)
    answers = [reader.feed(CanFrame(id, data)) for id, data in frames]
    return [answer for answer in answers if answer is not None]


def test_status_is_complete_with_its_answer() -> None:
    """Three frames of one sequence number; none of them may be missing."""
    whole = [(0x381, LEVELS), (0x281, CONDITION), (0x181, ANSWER)]
    (answer,) = feed(*whole)
    assert answer.status == STATUS
    assert (answer.sequence, answer.refusal) == (4, None)
    assert feed(*whole[1:]) == []
    assert feed(whole[0], whole[2]) == []
    stale = (0x281, bytes([3]) + CONDITION[1:])
    assert feed(whole[0], stale, whole[2]) == []
    assert feed((0x381, LEVELS[:7] + b"\x03"), *whole[1:]) == []


def test_can_fd_status_is_one_frame() -> None:
    """Answer, condition and levels."""
    (answer,) = feed((0x181, ANSWER + CONDITION + LEVELS))
    assert answer.status == STATUS


@pytest.mark.parametrize(
    ("result", "nak"),
    [
        (0x40, Nak(NakCode.BAD_CHANNEL, 9)),
        (0x50, Nak(NakCode.WRONG_STATE, 9)),
        (0xF0, Nak(NakCode.BUSY, 9)),  # incomplete set: repeat
    ],
)
def test_refusal_has_code_and_channel(result: int, nak: Nak) -> None:
    """An incomplete set is BUSY: it can be repeated."""
    (answer,) = feed((0x181, bytes([7, 1 | result, 4, 9, 0, 0, 0, 0])))
    assert answer.refusal == nak


@pytest.mark.parametrize("both", [0x01, 0x05, 0x17])  # disarmed, stopped, the watchdog's fault
def test_incomplete_set_is_a_wrong_state_when_not_armed(both: int) -> None:
    """The complete set would be refused too."""
    (answer,) = feed((0x181, bytes([7, 0xF1, both, 0xFF, 0, 0, 0, 0])))
    assert answer.refusal == Nak(NakCode.WRONG_STATE)


def test_unsolicited_reply_and_emergency_are_events() -> None:
    """Sequence 0, and EMCY."""
    (answer,) = feed((0x181, bytes([0, 0, 5, 0xFF, 0, 0, 0, 0])))
    assert answer.event == AmplifierEvent(AmplifierState.QUICK_STOP_ACTIVE, Fault.NONE)
    event = decode_emergency(bytes.fromhex("4023 03 46 02 000000"))
    assert event == AmplifierEvent(AmplifierState.FAULT_REACTION_ACTIVE, Fault.ARC, 2)


@pytest.mark.parametrize(
    ("id", "data"),
    [
        (0x181, ANSWER[:7]),
        (0x181, bytes([4, 0, 0x0F, 0xFF, 0, 0, 0, 0])),  # no such state
        (0x181, bytes([4, 0, 4, 16, 0, 0, 0, 0])),  # no such channel
        (0x281, CONDITION[:6]),
        (0x381, b""),
    ],
)
def test_invalid_frame_is_a_frame_error(id: int, data: bytes) -> None:
    """Wrong length, unknown state or channel."""
    with pytest.raises(FrameError):
        feed((id, data))


def test_reply_may_have_numbers_and_bits_of_later() -> None:
    """An unknown fault, reason of a refusal, and bit of the condition."""
    (refused,) = feed((0x181, bytes([4, 0xA0, 0xC4, 0xFF, 0, 0, 0, 0])))
    assert (refused.refusal, refused.event.fault) == (Nak(NakCode(10)), Fault(12))
    (told,) = feed(
        (0x381, bytes([0, 0, 0, 0, 0, 0, 0, 4])),
        (0x281, bytes([4, 3, *CONDITION[2:]])),
        (0x181, bytes([4, 0, 4, 0xFF, 0, 0, 0, 0])),
    )
    assert told.status is not None
    assert told.status.high_voltage


@given(data=st.binary(max_size=64), at=st.integers(0, 6))
def test_any_bytes_are_a_reply_or_a_frame_error(data: bytes, at: int) -> None:
    """Whatever the identifier."""
    reader = CanReplyReader(1)
    for id in (reader.ids[at % len(reader.ids)], 0x181):
        try:
            reader.feed(CanFrame(id, data))
        except FrameError:
            continue
    for read in (decode_emergency, unpack_faults, unpack_achieved):
        try:
            read(data)
        except FrameError:
            continue


def test_objects_are_decoded() -> None:
    """Faults, achieved commands, texts and capabilities from bytes written by hand."""
    faults = unpack_faults(bytes.fromhex("01FF DC050000 0402 00000100"))
    assert faults.faults == (
        FaultRecord(Fault.WATCHDOG, None, 1.5),
        FaultRecord(Fault.ARC, 2, 65.536),
    )
    achieved = unpack_achieved(bytes.fromhex("0102 01 9808 D007 D8DC 35 00 05 06"))
    assert achieved.token == 513
    assert achieved.commands == (
        DriveCommand(3, 110.0, 0.2, -90.0, keep_phase=True, onset=5, ending=6),
    )
    texts = {"vendor": b"Acme", "product": b"Quad\0", "serial_number": b"A", "firmware": b"1"}
    assert unpack_identity(texts, b"\4\0").product == "Quad"
    with pytest.raises(FrameError, match=r"vendor .*control characters"):
        unpack_identity({**texts, "vendor": b"A\nB"}, b"\4\0")
    with pytest.raises(FrameError, match="product must be UTF-8"):
        unpack_identity({**texts, "product": b"\xff"}, b"\4\0")
    numbers = {
        **{"channels": 4, "frequency_min": 400, "frequency_max": 12000},
        **{"frequency_step": 1, "level_max": 10000, "level_step": 1, "phase_step": 1},
        **{"ramp_max": 1000, "watchdog_min": 100, "watchdog_max": 2000, "envelope_knots": 32},
        **{"envelope_slots": 63, "envelope_step_min": 10, "envelope_step_max": 1000},
        "features": 0b1_0000_0001_1110,  # bit 12 is not defined yet
        "voices": 4,
    }
    limits = [{"frequency_min": 400, "frequency_max": 6000, "level_max": 5000}] * 4
    known = Feature.WHOLE | Feature(1 << 12)
    each = (ChannelLimits(20.0, 300.0, 0.5),) * 4
    assert unpack_capabilities(numbers, limits) == replace(
        WIDE, channels=4, features=known, channel_limits=each, voices=4
    )


def test_invalid_integer_of_an_entry_is_a_frame_error() -> None:
    """Channels are one byte, up to 16."""
    channels = next(entry for entry in CAPABILITY_ENTRIES if entry.name == "channels")
    assert read_integer(channels, b"\x10") == 16
    with pytest.raises(FrameError, match=r"channels .*got 2"):
        read_integer(channels, b"\x04\x00")
    with pytest.raises(FrameError, match=r"channels .*got 17"):
        read_integer(channels, b"\x11")


def test_block_refuses_a_value_that_does_not_fit() -> None:
    """It would overwrite the neighbouring field."""
    with pytest.raises(ValueError, match="level 65536 does not fit into 16 bits"):
        LAYOUTS["command"].pack(level=1 << 16)


@given(st.data())
def test_block_round_trip(data: st.DataObject) -> None:
    """Any values of any layout; unused bits are 0 and refused otherwise."""
    layout = LAYOUTS[data.draw(st.sampled_from(sorted(LAYOUTS)))]
    values = {
        field.name: data.draw(
            st.integers(-(1 << field.bits - 1), (1 << field.bits - 1) - 1)
            if field.signed
            else st.integers(0, (1 << field.bits) - 1)
        )
        for field in layout.fields.values()
    }
    block = layout.pack(**values)
    assert layout.unpack(block) == values
    used = sum((1 << field.bits) - 1 << field.first for field in layout.fields.values())
    for bit in range(64):
        if not used >> bit & 1:
            wrong = int.from_bytes(block, "little") | 1 << bit
            assert layout.unpack(wrong.to_bytes(8, "little")) is None
