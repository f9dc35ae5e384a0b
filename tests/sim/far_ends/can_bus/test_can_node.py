"""A node of the far end, with frames written by hand: NMT, sets, heartbeats, emergencies."""

import itertools
import struct

import pytest

from can_session import INCOMPLETE_LIFE, Timers
from drivers.codec.can_bus.canopen import CanFrame
from drivers.protocol.messages import AmplifierState, Fault, Ping
from fake_device import FakeDevice
from sim.far_ends.can_bus.node import CanNode

REQUEST, ANSWER = 0x481, 0x181
BAD_VALUE, BAD_CHANNEL, WRONG_STATE, BAD_TOKEN, INCOMPLETE = 3, 4, 5, 6, 15


class Bench:
    """A node 1 with four channels, in operation and armed; `sent` since the last request."""

    def __init__(self) -> None:
        self.device = FakeDevice()
        self.sent: list[CanFrame] = []
        self.timers = Timers()
        self.node = CanNode(self.device, 1, send=self.sent.append)  # type: ignore[arg-type]
        self.node.start(self.timers.call_later)

    def tell(self, id: int, data: str) -> list[CanFrame]:
        """Let the node hear a frame; what it says."""
        self.sent.clear()
        self.node.receive(CanFrame(id, bytes.fromhex(data)))
        return list(self.sent)

    def result(self, id: int, data: str) -> int:
        """What the one answer to the last frame of a set says."""
        (reply,) = self.tell(id, data)
        assert reply.id == ANSWER
        return reply.data[1] >> 4

    def expire(self) -> list[CanFrame]:
        """Let 100 ms pass for frames of an incomplete set; what the node says."""
        self.sent.clear()
        self.timers.ring(INCOMPLETE_LIFE)
        return list(self.sent)

    @property
    def state(self) -> AmplifierState:
        """Of the amplifier."""
        return self.device.amplifier.state

    @property
    def levels(self) -> tuple[float, ...]:
        """What it plays."""
        return self.device.status().levels


@pytest.fixture
def bench() -> Bench:
    """In operation and armed for 250 ms by host 127."""
    return armed()


def armed() -> Bench:
    """A node in operation and armed."""
    bench = Bench()
    bench.tell(0x000, "01 01")
    bench.tell(REQUEST, "7F00 0000 FA00 04 01")
    assert bench.state is AmplifierState.OPERATION_ENABLED
    return bench


def command(channel: int, sequence: int, *, level: int = 2000, flags: int = 0) -> str:
    """The eight bytes of a command at 110 Hz."""
    return struct.pack("<HHhBB", 11000, level, 0, flags | channel << 4, sequence).hex()


def apply(token: int, count: int, sequence: int, *, ramp: int = 0, action: int = 1) -> str:
    """The eight bytes of a request with a set."""
    return struct.pack("<HHHBB", token, ramp, 0, action | count << 3, sequence).hex()


def test_node_ignores_requests_before_start() -> None:
    """Pre-operational after boot-up: heartbeat and objects, but nothing that moves."""
    bench = Bench()
    assert bench.sent == [CanFrame(0x701, b"\x00")]
    assert bench.tell(REQUEST, "7F00 0000 FA00 04 01") == []
    assert bench.state is AmplifierState.SWITCH_ON_DISABLED
    assert len(bench.tell(0x601, "40 00 10 00 00000000")) == 1
    bench.tell(0x000, "01 02")  # another node
    assert bench.tell(REQUEST, "7F00 0000 FA00 04 01") == []
    bench.tell(0x000, "01 00")  # all
    assert bench.tell(REQUEST, "7F00 0000 FA00 04 01")[-1].id == ANSWER


def envelope(slot: int) -> list[tuple[int, str]]:
    """The frames that load an envelope of one knot, level 0.3, into a slot."""
    return [(0x601, f"21 00 21 {slot:02X} 07000000"), (0x601, "01 3200 01 B80B 0000")]


SHAPED_SET = (
    (REQUEST, apply(9, 4, 5)),
    *((0x201 + 0x100 * channel, command(channel, 5, flags=4)) for channel in range(4)),
    (0x681, "41 10 04 41 10 04 00 05"),  # onset 1 of every channel
)


@pytest.mark.parametrize("last", range(6))
def test_node_plays_a_set_with_the_last_of_its_frames(last: int) -> None:
    """Four channels with envelopes, in each of 720 orders: nothing before, all together then."""
    bench = armed()
    for id, data in envelope(1):
        bench.tell(id, data)
    others = [frame for frame in SHAPED_SET if frame is not SHAPED_SET[last]]
    for token, order in enumerate(itertools.permutations(others), start=1):
        frames = [(id, data) for id, data in (*order, SHAPED_SET[last])]
        frames = [(id, apply(token, 4, 5) if id == REQUEST else data) for id, data in frames]
        for id, data in frames[:-1]:
            assert bench.tell(id, data) == []
        assert bench.device.status().token == token - 1
        assert bench.result(*frames[-1]) == 0
        assert bench.device.status().token == token
        bench.device.pass_time(0.2 / 120)
        assert bench.expire() == []


def test_node_ignores_a_foreign_sync(bench: Bench) -> None:
    """Another device's SYNC between any two frames neither plays nor discards a set."""
    for id, data in ((0x201, command(0, 2)), (0x401, command(2, 2))):
        assert bench.tell(id, data) == []
        assert bench.tell(0x080, "") == bench.tell(0x080, "07") == []
        assert not any(bench.levels)
    assert bench.result(REQUEST, apply(9, 2, 2)) == 0
    assert bench.levels == pytest.approx((0.2, 0.0, 0.2, 0.0))


def test_node_answers_an_exact_set(bench: Bench) -> None:
    """With its sequence number and action, exact, and its token."""
    bench.tell(0x201, command(0, 2))
    (reply,) = bench.tell(REQUEST, apply(9, 1, 2))
    assert reply.data[:2] == bytes([2, 1 | 1 << 3])
    assert reply.data[4:6] == b"\x09\x00"


@pytest.mark.parametrize(
    "frames",
    [
        [(REQUEST, apply(9, 2, 2))],  # one command of two
        [(0x301, command(1, 1)), (REQUEST, apply(9, 2, 2))],  # the other of an older set
        [(0x301, command(1, 0)), (REQUEST, apply(9, 2, 2))],
        [(0x301, command(1, 2)), (REQUEST, apply(9, 1, 2))],  # more than announced
        [(0x301, command(1, 2, flags=4)), (REQUEST, apply(9, 2, 2))],  # shaped, no slots
        [
            (0x681, "0500 0000 0000 00 01"),  # slots of an older set
            (0x301, command(1, 2, flags=4)),
            (REQUEST, apply(9, 2, 2)),
        ],
    ],
)
def test_node_discards_an_incomplete_set(bench: Bench, frames: list[tuple[int, str]]) -> None:
    """After 100 ms, with an answer since its order has come; no output, nothing kept."""
    bench.tell(0x201, command(0, 2))
    for frame in frames:
        assert bench.tell(*frame) == []
    (reply,) = bench.expire()
    assert (reply.id, reply.data[0], reply.data[1]) == (ANSWER, 2, 1 | INCOMPLETE << 4)
    assert not any(bench.levels)
    assert bench.tell(REQUEST, apply(9, 1, 2)) == []  # the command is forgotten
    assert bench.result(0x201, command(0, 2)) == 0


def test_node_discards_commands_without_an_order(bench: Bench) -> None:
    """After 100 ms, without an answer, also with slots."""
    bench.tell(0x201, command(0, 2))
    bench.tell(0x681, "0500 0000 0000 00 02")
    assert bench.expire() == []
    assert bench.tell(REQUEST, apply(9, 1, 2)) == []


@pytest.mark.parametrize(("late", "new"), [(5, 6), (255, 1), (200, 72), (2, 129)])
def test_node_discards_late_frames_of_an_abandoned_set(bench: Bench, late: int, new: int) -> None:
    """An adapter sends frames of an attempt that was given up between those of the next."""
    bench.tell(0x301, command(1, late, level=9000))
    bench.tell(REQUEST, apply(9, 2, late))
    assert bench.tell(0x201, command(0, new)) == []  # takes the place of the older set
    assert bench.tell(0x201, command(0, late, level=9000)) == []
    assert bench.tell(REQUEST, apply(9, 2, late)) == []
    assert bench.tell(REQUEST, apply(9, 2, new)) == []
    assert bench.tell(0x401, command(2, late, level=9000)) == []
    assert bench.result(0x301, command(1, new)) == 0
    assert bench.levels == pytest.approx((0.2, 0.2, 0.0, 0.0))
    bench.tell(0x201, command(0, late, level=9000))  # one more, when the set plays already
    assert bench.expire() == []
    assert bench.levels == pytest.approx((0.2, 0.2, 0.0, 0.0))


@pytest.mark.parametrize("action", [0, 3, 7])
def test_newer_order_discards_an_incomplete_set(bench: Bench, action: int) -> None:
    """Its late frame plays nothing; an older order leaves the set as it is."""
    bench.tell(0x201, command(0, 5))
    bench.tell(REQUEST, apply(7, 0, 4, action=action))
    assert bench.result(REQUEST, apply(9, 1, 5)) == 0
    bench.tell(REQUEST, apply(10, 1, 6))
    bench.tell(REQUEST, apply(7, 0, 7, action=action))
    assert bench.tell(0x201, command(0, 6, level=9000)) == []
    assert bench.levels[0] == pytest.approx(0.2)


@pytest.mark.parametrize("broadcast", [apply(8, 0, 0, action=3), apply(0, 0, 0, action=0)])
def test_broadcast_leaves_the_frames_of_a_set(bench: Bench, broadcast: str) -> None:
    """It has no sequence number of this host."""
    bench.tell(0x201, command(0, 2))
    assert bench.tell(0x480, broadcast) == []
    assert bench.result(REQUEST, apply(9, 1, 2)) == 0


@pytest.mark.parametrize(
    ("frame", "request_frame", "result", "channel"),
    [
        (command(0, 2, level=10001), apply(9, 1, 2), BAD_VALUE, 0),
        (command(0, 2, flags=8), apply(9, 1, 2), BAD_VALUE, 0),
        (command(3, 2), apply(9, 1, 2), BAD_CHANNEL, 3),  # on the identifier of channel 0
        (command(0, 2), apply(0, 1, 2), BAD_TOKEN, 255),
        (command(0, 2), apply(9, 1, 2, ramp=1001), BAD_VALUE, 255),
    ],
)
def test_node_refuses_an_invalid_set(
    bench: Bench, frame: str, request_frame: str, result: int, channel: int
) -> None:
    """Out of range, an unknown bit, the wrong channel, no token: reason and channel."""
    bench.tell(0x201, frame)
    (reply,) = bench.tell(REQUEST, request_frame)
    assert (reply.data[1] >> 4, reply.data[3]) == (result, channel)
    assert not any(bench.levels)


def test_node_commits_by_broadcast(bench: Bench) -> None:
    """A broadcast commit of 8 leaves the staged set 9, one of 9 plays it; no replies."""
    bench.tell(0x201, command(0, 2))
    assert bench.result(REQUEST, apply(9, 1, 2, action=2)) == 0
    assert not any(bench.levels)
    for token, level in ((8, 0.0), (9, 0.2)):
        assert bench.tell(0x480, apply(token, 0, 0, action=3)) == []
        assert bench.levels[0] == pytest.approx(level)
    bench.tell(0x480, "0000 0000 0000 06 00")
    assert bench.state is AmplifierState.QUICK_STOP_ACTIVE


@pytest.mark.parametrize(
    ("id", "request_frame", "state"),
    [
        (REQUEST, "0000 FFFF 0000 06 02", AmplifierState.QUICK_STOP_ACTIVE),
        (REQUEST, "0000 FFFF 0000 05 02", AmplifierState.SWITCHED_ON),
        (0x480, "0000 FFFF 0000 06 00", AmplifierState.QUICK_STOP_ACTIVE),
    ],
)
def test_node_accepts_any_ramp_for_silencing(
    bench: Bench, id: int, request_frame: str, state: AmplifierState
) -> None:
    """A stop, a disarm and a broadcast stop along 65.5 s are carried out along the longest ramp."""
    bench.tell(0x201, command(0, 1))
    bench.tell(REQUEST, apply(9, 1, 1))
    sent = bench.tell(id, request_frame)
    assert bench.state is state
    assert all(frame.data[1] >> 4 == 0 for frame in sent if frame.id == ANSWER)


def test_node_watchdog_is_fed_by_the_host_heartbeat_only(bench: Bench) -> None:
    """127 armed it: its heartbeat is a sign of life, that of 126 and a status are none."""
    for feeding, id in ((False, 0x77E), (True, 0x77F)):
        bench.device.asked.clear()
        bench.tell(id, "05")
        assert (Ping() in bench.device.asked) is feeding
    bench.device.pass_time(0.2)
    bench.tell(0x77F, "05")
    bench.device.pass_time(0.2)
    assert bench.state is AmplifierState.OPERATION_ENABLED
    bench.tell(REQUEST, "0000 0000 0000 00 05")
    bench.device.pass_time(0.051)
    assert bench.device.amplifier.fault is Fault.WATCHDOG


@pytest.mark.parametrize("nmt", ["02 01", "80 01", "82 01", "02 00"])
def test_node_stops_when_leaving_operational(bench: Bench, nmt: str) -> None:
    """Stop, pre-operational, reset communication: a host that is not heard must not be needed."""
    bench.tell(0x201, command(0, 2))
    bench.tell(REQUEST, apply(9, 1, 2))
    bench.tell(0x000, nmt)
    assert bench.state is AmplifierState.QUICK_STOP_ACTIVE
    bench.device.pass_time(0.005)
    assert not any(bench.levels)
    assert bench.tell(REQUEST, "0000 0000 0000 00 05") == []
    if nmt.startswith("02"):  # stopped: no SDO, but a heartbeat with that state
        assert bench.tell(0x601, "40 00 10 00 00000000") == []
        bench.sent.clear()
        bench.timers.ring()
        assert bench.sent == [CanFrame(0x701, b"\x04")]


def test_node_reset_discards_everything(bench: Bench) -> None:
    """Silent at once, disarmed, the host forgotten; a boot-up message."""
    bench.tell(0x201, command(0, 2))
    bench.tell(REQUEST, apply(9, 1, 2))
    assert bench.tell(0x000, "81 01")[-1] == CanFrame(0x701, b"\x00")
    assert bench.state is AmplifierState.SWITCH_ON_DISABLED
    assert not any(bench.levels)
    assert bench.tell(0x601, "40 16 10 01 00000000")[0].data[4:] == bytes(4)


def test_node_sends_emcy_for_a_fault_and_its_end(bench: Bench) -> None:
    """Code and register by the table of CiA 301, state, fault, channel; code 0 in the end."""
    bench.sent.clear()
    bench.device.amplifier.trip(Fault.ARC, bench.device.now, channel=2)
    bench.device.pass_time(0.01)
    assert bench.sent == [
        CanFrame(0x081, bytes.fromhex("4023 03 46 02 000000")),
        CanFrame(0x081, bytes.fromhex("4023 03 47 FF 000000")),
    ]
    assert CanFrame(0x081, bytes.fromhex("0000 00 01 FF 000000")) in bench.tell(
        REQUEST, "0100 0000 0000 07 05"
    )


def test_node_accepts_commands_by_sdo(bench: Bench) -> None:
    """2020sub1 and 2021 written by SDO: the same as by RPDO."""
    for index, data in ((0x2020, command(0, 2)), (0x2021, apply(9, 1, 2))):
        subindex = 1 if index == 0x2020 else 0
        value = bytes.fromhex(data)
        begin = struct.pack("<BHBL", 0x21, index, subindex, 8).hex()
        assert bench.tell(0x601, begin)[0].data[0] == 0x60
        assert bench.tell(0x601, "00" + value[:7].hex())[0].data[0] == 0x20
        sent = bench.tell(0x601, "1D" + value[7:].hex() + "00" * 6)
    (answer,) = [frame for frame in sent if frame.id == ANSWER]
    assert answer.data[1] >> 4 == 0
    assert bench.levels[0] == pytest.approx(0.2)
