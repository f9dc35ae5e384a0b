"""The witness's decoders against the examples of the three pages from which they were written."""

import re
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

import pytest
from cobs import cobs

from sim.witness.can_decoder import CanDecoder
from sim.witness.can_text import CanFrame, SlcanText, SocketcandText
from sim.witness.capture import Direction
from sim.witness.decoded import (
    BootUp,
    ChannelCommand,
    Damaged,
    Message,
    Reply,
    Request,
    RequestKind,
    StateEvent,
)
from sim.witness.modbus_decoder import ModbusDecoder
from sim.witness.modbus_frames import crc16
from sim.witness.serial_decoder import SerialDecoder
from sim.witness.witness import Witness

DOCS = Path(__file__).parents[3] / "docs" / "reference"
# As the pages put it in words: 110 Hz, 0.2, 0 degrees; 250.5 Hz, 1, -90 degrees, keeping phase.
SET = {0: ChannelCommand(110.0, 0.2, 0.0), 3: ChannelCommand(250.5, 1.0, -90.0, keep_phase=True)}


def _serial() -> Iterator[tuple[str, Direction, bytes]]:
    for line in (DOCS / "wire-protocol.md").read_text(encoding="utf-8").splitlines():
        found = re.fullmatch(r"([\w ]+): `((?:[0-9A-F]{2} ?)+)`", line)
        if found:
            is_answer = found[1].endswith("reply") or found[1] == "Event"
            yield found[1], "host" if is_answer else "amplifier", bytes.fromhex(found[2])


def _modbus(transport: str) -> Iterator[tuple[str, Direction, bytes]]:
    for line in (DOCS / "wire-modbus.md").read_text(encoding="utf-8").splitlines():
        found = re.fullmatch(rf"([\w ]+), {transport}: `((?:[0-9A-F]{{2}} ?)+)`", line)
        if found:
            is_answer = found[1].endswith("reply")
            yield found[1], "host" if is_answer else "amplifier", bytes.fromhex(found[2])


def _can() -> Iterator[tuple[Direction, CanFrame]]:
    for line in (DOCS / "wire-can.md").read_text(encoding="utf-8").splitlines():
        found = re.fullmatch(r"    ([<>]) ([0-9A-F]{3})( FD)?((?: [0-9A-F]{2})*)", line)
        if found:
            toward: Direction = "amplifier" if found[1] == ">" else "host"
            data = bytes.fromhex(found[4])
            yield toward, CanFrame(int(found[2], 16), data, bool(found[3]))


def _check(name: str, meaning: Message | None) -> None:
    """An example means what its name says."""
    assert meaning is not None
    assert not isinstance(meaning, Damaged)
    if not isinstance(meaning, Request):
        return
    assert meaning.problem == ""
    words = {*name.split(), *name.removeprefix("Refused ").split()}
    named = [kind for kind in RequestKind if kind.value in words]
    if named and "FC4" not in words:
        assert meaning.kind is named[0]


def test_serial_decoder_decodes_the_page() -> None:
    """Every frame of the page means what stands beside it."""
    decoder = SerialDecoder()
    seen = {}
    for name, toward, data in _serial():
        ((raw, meaning),) = decoder.feed(toward, 0.0, data)
        assert raw == data
        _check(name, meaning)
        seen[name] = meaning
    assert len(seen) >= 30
    apply = seen["Apply request"]
    assert isinstance(apply, Request)
    assert (apply.token, apply.ramp, apply.valid_for) == (513, 0.02, 0.5)
    assert apply.commands == pytest.approx(SET) or apply.commands == SET
    arm = seen["Arm reply"]
    assert isinstance(arm, Reply)
    assert arm.status is not None
    assert (arm.status.state, arm.status.watchdog_left, arm.status.temperature) == (
        4,
        0.25,
        25.0,
    )
    assert seen["Event"] == StateEvent(address=1, state=6, fault=4)


@pytest.mark.parametrize("transport", ["RTU", "TCP"])
def test_modbus_decoder_decodes_the_page(transport: str) -> None:
    """Every ADU of the page decodes to what the page says, over both transports."""
    decoder = ModbusDecoder(over_tcp=transport == "TCP")
    seen = {}
    for name, toward, data in _modbus(transport):
        ((raw, meaning),) = decoder.feed(toward, 0.0, data)
        assert raw == data
        _check(name, meaning)
        if isinstance(meaning, Reply):
            assert meaning.key is not None, name
        seen[name] = meaning
    assert len(seen) >= 35
    apply, status = seen["Apply request"], seen["GetStatus reply"]
    assert isinstance(apply, Request)
    assert (apply.token, apply.commands) == (513, SET)
    assert isinstance(status, Reply)
    assert status.status is not None
    assert status.status.temperature == pytest.approx(-5.3)
    assert (status.status.state, status.status.fault) == (7, 1)


def test_can_decoder_decodes_the_page() -> None:
    """The session of the page: complete and incomplete sets, classic and FD, watchdog, end."""
    decoder = CanDecoder("slcan", {1: 4})
    seen = [meaning for toward, frame in _can() for meaning in decoder.take(toward, 0.0, frame)]
    assert not any(isinstance(meaning, Damaged) for meaning in seen)
    sets = [one for one in seen if isinstance(one, Request) and one.kind is RequestKind.APPLY]
    assert [one.token for one in sets] == [513, 513, 516, 517, 518]
    assert [bool(one.problem) for one in sets] == [False, False, True, False, False]
    assert sets[0].commands == sets[4].commands == SET  # classic frames, and one CAN FD frame
    refusals = [one.refusal for one in seen if isinstance(one, Reply) and one.refusal]
    assert refusals == [15, 5]  # incomplete set, WRONG_STATE
    assert StateEvent(address=1, state=7, fault=1) in seen
    assert seen.count(BootUp(1)) == 2  # at power-up, and reset at the end


@pytest.mark.parametrize("place", range(1, 13))
def test_serial_decoder_detects_a_flipped_bit(place: int) -> None:
    """No single flipped bit of a stop leaves a frame that means something else."""
    frame = bytes.fromhex("0005080201070205055ED58B3E00")
    for bit in range(8):
        data = bytearray(frame)
        data[place] ^= 1 << bit
        for _, meaning in SerialDecoder().feed("amplifier", 0.0, bytes(data)):
            assert isinstance(meaning, Damaged)


def test_decoders_accept_any_pieces() -> None:
    """However the bytes are cut, the frames are the same, on lines and in the text of adapters."""
    serial = b"".join(data for _, toward, data in _serial() if toward == "amplifier")
    whole = SerialDecoder().feed("amplifier", 0.0, serial)
    decoder = SerialDecoder()
    cut = [one for byte in serial for one in decoder.feed("amplifier", 0.0, bytes([byte]))]
    assert cut == whole
    text = b"< hi >< frame 181 1.5 0104 ><fdframe"
    reader = SocketcandText("host")
    pieces = [one for byte in text for one in reader.feed(bytes([byte]))]
    assert [one.frame for one in pieces] == [None, CanFrame(0x181, b"\x01\x04", False)]
    assert SlcanText("host").feed(b"t18120104\rz\r\a")[0].frame == pieces[1].frame


def _over_tcp(number: int, pdu: str) -> bytes:
    """An ADU for unit 1, with its header."""
    body = bytes.fromhex("01" + pdu)
    return number.to_bytes(2, "big") + b"\0\0" + len(body).to_bytes(2, "big") + body


# docs/reference/wire-modbus.md: a Ping with tag 22, refused with exception 2, and the block
# refusal that is read then: tag, BUSY, no channel, refused_tag.
PING = _over_tcp(1, "17 03E9 000E 0009 0002 04 0016 0009")
REFUSED = _over_tcp(1, "97 02")
WHY = _over_tcp(2, "04 0409 0004")
EARLIER = _over_tcp(2, "04 08 0015 0007 00FF 0003")
PLAN = {
    "wires": {"line": "modbus-tcp"},
    "amplifiers": {
        "main": {
            "wire": "line",
            "address": 1,
            "channels": {n: {"frequency_hz": [40, 500], "level": 1.0} for n in range(4)},
        }
    },
}


def test_modbus_decoder_matches_a_refusal_of_an_earlier_write() -> None:
    """A damaged write leaves no tag; a refusal of this write must carry its tag."""
    for refusal, is_answer in ((EARLIER, True), (EARLIER[:-2] + b"\0\x16", False)):
        decoder = ModbusDecoder(over_tcp=True)
        decoder.feed("amplifier", 0.0, PING)
        decoder.feed("host", 0.001, REFUSED)
        ((_, request),) = decoder.feed("amplifier", 0.002, WHY)
        ((_, answer),) = decoder.feed("host", 0.003, refusal)
        assert isinstance(request, Request)
        assert isinstance(answer, Reply)
        assert answer.problem == "tag 21, expected 22"
        assert (answer.key == request.key) is is_answer


def test_modbus_decoder_reports_an_exception_cut_short() -> None:
    """Modbus TCP with a length damaged on its way: an exception without its code is no reply."""
    decoder = ModbusDecoder(over_tcp=True)
    ((_, request),) = decoder.feed("amplifier", 0.0, bytes.fromhex("000100000006010300000002"))
    ((_, cut),) = decoder.feed("host", 0.01, bytes.fromhex("0001000000020183"))
    assert isinstance(cut, Damaged)
    ((_, whole),) = decoder.feed("host", 0.02, bytes.fromhex("000100000003018302"))
    assert isinstance(request, Request)
    assert whole == Reply(1, request.key, refusal=2)


@pytest.mark.parametrize("are_on", [False, True])
def test_witness_reports_a_stale_refusal_unless_disturbed(are_on: bool) -> None:
    """While disturbed it is excused, and the next request violates nothing."""
    witness = Witness(PLAN)
    if are_on:
        witness.faults(0.0, "line", are_on=True)
    again = PING[:1] + b"\3" + PING[2:-4] + b"\0\x17" + PING[-2:]
    pieces: tuple[tuple[float, Direction, bytes], ...] = (
        (0.001, "amplifier", PING),
        (0.002, "host", REFUSED),
        (0.003, "amplifier", WHY),
        (0.004, "host", EARLIER),
        (0.005, "amplifier", again),
    )
    for time, toward, data in pieces:
        witness.record_bytes("line", toward, time, data)
    found = [violation.invariant for violation in witness.finish(0.010)]
    assert found == ([] if are_on else ["answer"])


@pytest.mark.parametrize(("over", "broken"), [(1.0, []), (0.4, ["garbage"])])
@pytest.mark.parametrize("kind", ["serial", "modbus-rtu", "slcan", "socketcand"])
def test_witness_excuses_a_frame_cut_while_disturbed(
    kind: str, over: float, broken: list[str]
) -> None:
    """A frame is cut at 1 s, which shows when the next comes at 4 s; trouble counts 0.5 s more."""
    whole = {
        "serial": next(data for name, _, data in _serial() if name == "Ping request"),
        "modbus-rtu": next(data for name, _, data in _modbus("RTU") if name == "Ping request"),
        "slcan": b"t77F105\r",
        "socketcand": b"< send 77F 1 5 >",
    }[kind]
    witness = Witness(PLAN | {"wires": {"line": kind}})
    witness.faults(0.0, "line", are_on=True)
    witness.faults(over, "line", are_on=False)
    witness.record_bytes("line", "amplifier", 1.0, whole[:-3])
    witness.record_bytes("line", "amplifier", 4.0, whole)
    assert [violation.invariant for violation in witness.finish(4.001)] == broken


def test_modbus_decoder_ignores_replies_of_another_unit() -> None:
    """Two units of one RTU line are identified; the first replies twice, then the other.

    The page's Hello, once more with 2 for its unit.
    """
    frames = {name: data for name, _, data in _modbus("RTU")}
    first = [frames["Hello request"], frames["Hello reply"]]
    other = [b"\2" + data[1:-2] for data in first]
    decoder = ModbusDecoder(over_tcp=False)
    pieces: tuple[tuple[Direction, bytes], ...] = (
        ("amplifier", first[0]),
        ("host", first[1]),
        ("amplifier", other[0] + crc16(other[0])),
        ("host", first[1]),
        ("host", other[1] + crc16(other[1])),
    )
    seen = [decoder.feed(toward, 0.0, data)[0][1] for toward, data in pieces]
    request = [one.key for one in seen if isinstance(one, Request)]
    answered = [(one.address, one.key) for one in seen if isinstance(one, Reply)]
    assert answered == [(1, request[0]), (1, None), (2, request[1])]


@pytest.mark.parametrize(("over", "broken"), [(0.02, ["answer"]), (0.04, [])])
def test_witness_excuses_a_reply_due_while_disturbed(over: float, broken: list[str]) -> None:
    """A Ping at 0.5 s without reply, then nothing until 2 s; 0.5 s is still disturbed.

    Its answer is due after 31 ms.
    """
    witness = Witness(PLAN)
    witness.faults(over, "line", are_on=False)
    witness.record_bytes("line", "amplifier", 0.5, PING)
    assert [violation.invariant for violation in witness.finish(2.0)] == broken


def test_witness_accepts_a_late_reply_to_a_repeated_request() -> None:
    """A set asked for twice, then another: the first answer comes last, and no set is taken back.

    docs/reference/wire-modbus.md: Arm, and the Apply of token 513; the other one has token 514.
    """
    frames = {name: data for name, _, data in _modbus("TCP")}
    witness = Witness(PLAN)
    witness.faults(0.9, "line", are_on=True)

    def passes(time: float, toward: Direction, name: str, number: int, token: int = 513) -> None:
        data = bytearray(number.to_bytes(2, "big") + frames[name][2:])
        if token != 513:
            at = data.index((513).to_bytes(2, "big"), 14)
            data = data[:at] + data[at:].replace(b"\2\1", token.to_bytes(2, "big"))
        witness.record_bytes("line", toward, time, bytes(data))

    passes(1.000, "amplifier", "Arm request", 3)
    passes(1.001, "host", "Arm reply", 3)
    passes(1.010, "amplifier", "Apply request", 4)
    passes(1.040, "amplifier", "Apply request", 5)
    passes(1.0401, "host", "Apply reply", 5)
    passes(1.0402, "amplifier", "Apply request", 6, 514)
    passes(1.0403, "host", "Apply reply", 6, 514)
    passes(1.0404, "host", "Apply reply", 4)
    assert [str(violation) for violation in witness.finish(1.05)] == []


@pytest.mark.parametrize(
    ("count", "phase", "problem"),
    [
        (2, 17999, ""),
        (32, 0, ""),
        (33, 0, "envelope_knots must be 0 to 32, got 33"),
        (2, 18000, "phase must be -18000 to 17999, got 18000"),
    ],
)
def test_decoders_check_the_bounds_of_envelopes(count: int, phase: int, problem: str) -> None:
    """The bounds of the page's table: an envelope beyond them is wrong, whichever wire it is on."""
    knots = [1000, phase] * count
    head = bytes.fromhex("0D 02 01 07 00")  # of the page's LoadEnvelope
    body = head + struct.pack(f"<BHB{2 * count}H", 5, 50, count, *knots)
    line = b"\0" + cobs.encode(body + struct.pack("<I", zlib.crc32(body))) + b"\0"
    block = struct.pack(f">{3 + 2 * count}H", 5, 50, count, *knots)
    written = struct.pack(">H", 8) + block
    pdu = bytes.fromhex("17 00 65 00 04 00 65")
    pdu += struct.pack(">HB", len(written) // 2, len(written)) + written
    tcp = struct.pack(">HHHB", 8, 0, len(pdu) + 1, 1) + pdu
    for decoder, data in ((SerialDecoder(), line), (ModbusDecoder(over_tcp=True), tcp)):
        ((_, meaning),) = decoder.feed("amplifier", 0.0, data)
        assert isinstance(meaning, Request)
        assert meaning.problem == problem


def test_refusal_of_a_hello_has_version_0() -> None:
    """It is a reply like one of the present version, not a damaged frame."""
    for version in (0, 2):
        content = struct.pack("<BBBH", 0x9F, version, 1, 7) + bytes([1, 7, 255])
        body = content + zlib.crc32(content).to_bytes(4, "little")
        (frame,) = SerialDecoder().feed("host", 0.0, b"\0" + cobs.encode(body) + b"\0")
        assert isinstance(frame[1], Reply)
