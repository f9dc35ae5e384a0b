"""The host's side of Modbus: how much is read, and responses that belong to no request."""

import asyncio

import pytest

from drivers.protocol.definition import MESSAGES, STATUS
from drivers.protocol.records import Values
from drivers.wires.modbus import ModbusWire
from drivers.wires.modbus_frames import HEAD
from drivers.wires.wire import Broken, More, Nak, Reply
from sim.amplifier.simulated_amplifier import Amplifier
from sim.far_ends.modbus_amplifiers import ModbusAmplifiers
from virtual_lines import MemoryLine, in_virtual_time, unaltered


class Peer:
    """An amplifier of four channels at unit 1, its bytes kept."""

    def __init__(self, *, is_rtu: bool) -> None:
        self.sent: list[bytes] = []
        self.amplifier = Amplifier("a", channels=4)
        self.end = ModbusAmplifiers({1: self.amplifier}, self.sent.append, is_rtu=is_rtu)

    def reply(self, data: bytes, now: float = 0.0) -> bytes:
        """The bytes with which it responds."""
        self.sent.clear()
        self.end.receive(data, now)
        return b"".join(self.sent)


def reply_to(wire: ModbusWire, peer: Peer, name: str, values: Values) -> Reply | Nak | Broken:
    """What becomes of a request to a peer, in its two transactions."""
    (more,) = wire.received(peer.reply(wire.request(1, name, values)))
    assert isinstance(more, More)
    (arrival,) = wire.received(peer.reply(more.data))
    assert isinstance(arrival, Reply | Nak | Broken)
    return arrival


def test_as_many_registers_are_read_as_the_reply_can_have() -> None:
    """Of 4 channels and 8 layers, at first of the most: levels, tokens, limits, tones of each."""
    wire, peer = ModbusWire(0, is_rtu=True, number=0), Peer(is_rtu=True)
    status = HEAD + STATUS.words + sum(each.words for each in STATUS.added)
    capabilities = HEAD + MESSAGES["GetCaps"].reply.words + 3 * 16
    achieved = HEAD + MESSAGES["GetAchieved"].reply.words
    both = {"GetCaps": capabilities, "GetFaults": 122}
    counts = {"GetStatus": status + 16 + 16, "GetAchieved": achieved + 4 * 16, **both}
    after = {"GetStatus": status + 4 + 8, "GetAchieved": achieved + 4 * 4, **both}
    for expected in (counts, after):
        for name, count in expected.items():
            values = {"layer": 0} if name == "GetAchieved" else {}
            (more,) = wire.received(peer.reply(wire.request(1, name, values)))
            assert isinstance(more, More)
            assert more.data[4:6] == count.to_bytes(2)
        assert isinstance(reply_to(wire, peer, "GetCaps", {}), Reply)


@pytest.mark.parametrize("is_rtu", [True, False])
def test_late_responses_are_credited_to_nothing(is_rtu: bool) -> None:
    """Of an earlier read, of an earlier write, doubled, of another unit; the reply still counts."""
    wire, peer = ModbusWire(0, is_rtu=is_rtu, number=0), Peer(is_rtu=is_rtu)
    (more,) = wire.received(peer.reply(wire.request(1, "GetStatus", {})))
    assert isinstance(more, More)
    late = peer.reply(more.data)
    wire.withdraw()
    echo = peer.reply(wire.request(1, "GetStatus", {}))
    assert wire.received(late) == []
    (more,) = wire.received(echo + echo)
    assert isinstance(more, More)
    assert wire.received(late + echo) == []
    assert wire.counters.unexpected_frames == 4
    response = peer.reply(more.data)
    of_unit_2 = ModbusWire(0, is_rtu=is_rtu, number=2)
    assert of_unit_2.request(2, "GetStatus", {})
    assert of_unit_2.received(echo) == []
    assert [type(each) for each in wire.received(late + response + response)] == [Reply]
    assert wire.counters.unexpected_frames == 6


@pytest.mark.parametrize(
    ("exception", "expected"),
    [
        (0, []),
        (1, [Nak("UNKNOWN_TYPE", None)]),
        (2, [Nak("UNKNOWN_TYPE", None)]),
        (3, [Nak("BAD_LENGTH", None)]),
        (4, [Broken("Modbus exception 4")]),
        (6, [Nak("BUSY", None)]),
        (10, []),
        (11, []),
    ],
)
def test_exceptions_are_refusals_or_no_response(exception: int, expected: list[object]) -> None:
    """Those of a gateway, and one without a code, are none: the request is repeated."""
    wire = ModbusWire(0, is_rtu=False, number=0)
    wire.request(1, "GetStatus", {})
    assert wire.received(bytes([0, 1, 0, 0, 0, 3, 1, 0x90, exception])) == expected


@pytest.mark.parametrize("exception", [1, 2, 3, 4])
def test_device_without_an_identity_is_no_amplifier(exception: int) -> None:
    """As another Modbus device at this address, which has no such registers."""
    wire = ModbusWire(0, is_rtu=False, number=0)
    wire.request(7, "Hello", {})
    (arrival,) = wire.received(bytes([0, 1, 0, 0, 0, 3, 7, 0x84, exception]))
    assert isinstance(arrival, Broken)
    assert "unit 7 is no amplifier" in arrival.reason


@pytest.mark.parametrize("is_rtu", [True, False])
def test_reply_to_another_master_is_credited_to_nothing(is_rtu: bool) -> None:
    """It wrote the same message before the reply was read; the next attempt has it."""
    wire, peer = ModbusWire(0, is_rtu=is_rtu, number=0), Peer(is_rtu=is_rtu)
    other = ModbusWire(0, is_rtu=is_rtu, number=500)
    (more,) = wire.received(peer.reply(wire.request(1, "GetStatus", {})))
    assert isinstance(more, More)
    peer.reply(other.request(1, "GetStatus", {}))
    assert wire.received(peer.reply(more.data)) == []
    assert wire.counters.unexpected_frames == 1
    assert isinstance(reply_to(wire, peer, "GetStatus", {}), Reply)


def test_request_of_all_units_has_no_reply() -> None:
    """Unit 0 on a line; over TCP a write to each unit that is known, whose responses pass."""
    commit = ("Commit", {"session": 9, "token": 7, "at": 0})
    wire = ModbusWire(0, is_rtu=True, number=0)
    frame = wire.request(0, *commit)
    assert frame[:-2] == bytes.fromhex("00 10 0600 0004 08 0001 0009 0007 0000")

    wire = ModbusWire(0, is_rtu=False, number=0)
    for unit in (1, 2):
        wire.request(unit, "GetStatus", {})
    frames = wire.request(0, *commit)
    assert [frames[6], frames[13:15], frames[27], len(frames)] == [1, b"\0\x03", 2, 42]
    for number in (3, 4):
        echo = bytes([0, number, 0, 0, 0, 6, number - 2, 16, 6, 0, 0, 3])
        assert wire.received(echo) == []
    assert wire.counters.unexpected_frames == 0


def test_echo_without_a_response_is_named() -> None:
    """Of the write and of the read that follows it; an adapter of RS-485 may hear itself."""
    wire, peer = ModbusWire(115_200, is_rtu=True, number=0), Peer(is_rtu=True)
    frame = wire.request(1, "GetStatus", {})
    (more,) = wire.received(frame + peer.reply(frame))
    assert isinstance(more, More)
    assert wire.received(more.data) == []
    wire.withdraw()
    assert "request itself came back" in wire.counters.remark


@pytest.mark.parametrize("is_rtu", [True, False])
def test_noise_is_counted_and_not_kept(is_rtu: bool) -> None:
    """All of its bytes, over as many parts as it has."""
    wire = ModbusWire(115_200, is_rtu=is_rtu, number=0)
    wire.request(1, "GetStatus", {})
    for _ in range(100):
        assert wire.received(b"\xff" * 4096) == []
    assert wire.counters.invalid_frames == 1
    assert len(wire._damaged) < 512
    wire.withdraw()
    assert f"{100 * 4096} bytes that are no valid frame" in wire.counters.remark


def test_number_of_an_unanswered_broadcast_can_be_used_again() -> None:
    """Transactions come again after 65 535: then one is a healthy unit's."""
    wire, peer = ModbusWire(0, is_rtu=False, number=0), Peer(is_rtu=False)
    wire.request(1, "GetStatus", {})
    wire.request(
        0, "Commit", {"session": 9, "token": 7, "at": 0}
    )  # transaction 2, without a response
    wire._number = 1
    assert isinstance(reply_to(wire, peer, "GetStatus", {}), Reply)


@in_virtual_time
async def test_damaged_length_costs_one_attempt() -> None:
    """A write that seems to go on for 255 bytes ends with the pause before its repetition."""
    end = MemoryLine("rtu", "a")
    damaged = iter([True])

    def lengthened(name: str, data: bytes) -> list[tuple[float, bytes]]:
        if next(damaged, False):
            data = data[:6] + b"\xff" + data[7:]
        return unaltered(name, data)

    await end.hosts["a"].open()
    end.inward = lengthened
    await end.hosts["a"].read_status()
    assert end.retries == 1


@in_virtual_time
async def test_stop_is_not_sent_over_a_reply() -> None:
    """On RTU a status of two channels, 8 + 39 characters and two silences, begins 4 ms late."""
    end = MemoryLine("rtu", "a")
    host = end.hosts["a"]
    await host.open()
    takes = 47 * 11 / 115_200 + 2 * 0.00175 + 0.004
    end.outward = lambda name, data: [(takes if len(data) > 8 else 0.0, data)]
    begin = end.loop.time()
    reading = asyncio.ensure_future(host.read_status())
    await asyncio.sleep(0.001)
    assert (await host.stop()).is_confirmed
    await reading
    stopped = min(time for time, request in end.sent if request == "1:8")
    assert stopped - begin >= takes
    assert (end.retries, end.line.wire.counters.unexpected_frames) == (0, 0)


def test_times_on_a_line_are_those_of_its_characters() -> None:
    """A set of 22 words: 55 + 8 + 8 + 5 + 2 · 5 characters of 11 bits, four silences."""
    wire = ModbusWire(115_200, is_rtu=True, number=0)
    assert wire.exchange_time(22, 3) == pytest.approx(86 * 11 / 115_200 + 4 * 0.00175)
    slow = ModbusWire(9600, is_rtu=True, number=0)
    assert slow.silence == pytest.approx(3.5 * 11 / 9600)
    assert ModbusWire(0, is_rtu=False, number=0).exchange_time(22, 3) == 0


def test_broadcast_over_a_gateway_arrives_after_the_writes_before() -> None:
    """By hand: to three units 3 · 17 characters at 9600 baud, two echoes of 8, five silences.

    Each echo may begin 10 ms late. A network has no time of its own.
    """
    commit = ("Commit", {"session": 9, "token": 7, "at": 0})
    wire = ModbusWire(9600, is_rtu=False, number=0)
    for unit in (1, 2, 3):
        wire.request(unit, "GetStatus", {})
    wire.request(0, *commit)
    characters = 3 * 17 + 2 * 8 + 5 * 3.5
    assert wire.takes == pytest.approx(characters * 11 / 9600 + 2 * 0.01)
    network = ModbusWire(0, is_rtu=False, number=0)
    network.request(1, "GetStatus", {})
    network.request(0, *commit)
    assert network.takes == 0
