"""The host's side of a CAN bus: bytes by hand, other hosts, and damage."""

import asyncio
import random
from collections.abc import Awaitable, Callable

import pytest

from drivers.errors import LinkError
from drivers.host.group import Group
from drivers.protocol.definition import MESSAGES
from drivers.wires.can_bus import CanWire
from drivers.wires.can_frames import CanFrame, pack_frames, segments, unpack_frames
from drivers.wires.wire import Arrival, Broken, Event, Nak, OtherHost, Reply, Several
from virtual_lines import MemoryLine, group_of, in_virtual_time, run_virtual

NODE = 5
PING, GET_STATUS, STOP = 12, 9, 8


def frames(can_id: int, number: int, kind: int, *words: int) -> bytes:
    """Packed frames of a message."""
    return pack_frames(CanFrame(can_id, data) for data in segments(number, kind, words))


@pytest.fixture
def wire() -> CanWire:
    """A bus at 500 kbit/s on which node 5 was asked for its faults under number 255."""
    wire = CanWire(500_000, sequence=254)
    wire.request(NODE, "GetFaults", {})
    return wire


def test_versions_of_another_protocol_end_hello() -> None:
    """Bit 3 for version 3: such an amplifier has the object, and does not reply to the message."""
    wire = CanWire(500_000, sequence=0)
    wire.request(NODE, "Hello", {})
    versions = [
        pack_frames([CanFrame(can_id, bytes.fromhex(data))])
        for can_id, data in (
            (0x585, "4B00200518000000"),  # 3 and 4
            (0x586, "4B00200508000000"),  # of another node
            (0x585, "8000200500000206"),  # no such object
            (0x585, "4B00200508000000"),
        )
    ]
    assert [wire.received(each) for each in versions] == [[], [], [], [Reply({"versions": 8})]]
    wire.request(NODE, "GetStatus", {})
    assert not wire.received(versions[-1])


def test_broadcast_has_number_0_and_no_reply(wire: CanWire) -> None:
    """On identifier 200; the next request to node 5 goes on from 255 with 1."""
    values = {"session": 0x1234, "token": 7, "at": 0x0102}
    sent, more = unpack_frames(wire.request(0, "Commit", values))
    assert (sent.id, sent.data.hex()) == (0x200, "0000060334120700")
    assert (more.id, more.data.hex()) == (0x200, "0001020100000000")
    (sent,) = unpack_frames(wire.request(NODE, "GetFaults", {}))
    assert sent.data.hex() == "01000a0000000000"


ANSWERS: dict[str, tuple[bytes, list[Arrival]]] = {
    "reply": (frames(0x185, 255, 10, 0), [Reply({"count": 0, "faults": []})]),
    "refusal": (frames(0x185, 255, 31, 10, 5, 255), [Nak("WRONG_STATE", None)]),
    "refusal of a channel": (frames(0x185, 255, 31, 10, 4, 3), [Nak("BAD_CHANNEL", 3)]),
    "older number": (frames(0x185, 254, 10, 0), []),
    "another node": (frames(0x186, 255, 10, 0), []),
    "event": (
        frames(0x185, 0, 30, 7, 1, 255, 3),
        [Event(NODE, {"state": 7, "fault": 1, "channel": 255, "latch": 3})],
    ),
}


@pytest.mark.parametrize("answer", ANSWERS)
def test_reply_has_number_and_node_of_its_request(wire: CanWire, answer: str) -> None:
    """What is neither that nor an event is unexpected, and leaves the request on the wire.

    After a reply another one that differs is of a second amplifier.
    """
    data, expected = ANSWERS[answer]
    assert wire.received(data) == expected
    assert wire.counters.unexpected_frames == (not expected)
    rest = wire.received(ANSWERS["reply"][0])
    if expected in ([], ANSWERS["event"][1]):
        assert len(rest) == 1
    else:
        assert rest == ([Several(NODE)] if isinstance(expected[0], Nak) else [])


def test_reply_of_another_type_is_broken(wire: CanWire) -> None:
    """As is one that is too short for its type."""
    (arrival,) = wire.received(frames(0x185, 255, GET_STATUS, 0))
    assert isinstance(arrival, Broken)
    wire.request(NODE, "GetStatus", {})
    (arrival,) = wire.received(frames(0x185, 1, GET_STATUS, 0))
    assert isinstance(arrival, Broken)


@pytest.mark.parametrize(
    ("kind", "expected"),
    [(PING, [OtherHost(NODE)]), (3, [OtherHost(NODE)]), (GET_STATUS, []), (STOP, []), (99, [])],
)
def test_request_that_needs_a_session_is_another_hosts(
    wire: CanWire, kind: int, expected: list[Arrival]
) -> None:
    """Reading and stopping are anyone's; the next number follows the one that was heard."""
    assert wire.received(frames(0x205, 77, kind, 5, 250)) == expected
    assert unpack_frames(wire.request(NODE, "GetStatus", {}))[0].data[0] == 78


def test_echo_of_own_frames_is_none(wire: CanWire) -> None:
    """An adapter may hand over what it sent."""
    echo = wire.request(NODE, "Ping", {"session": 9, "rate": 0})
    assert wire.received(echo) == []
    assert wire.counters.unexpected_frames == 0


def test_exchange_time_counts_the_stuffed_bits() -> None:
    """A frame has 47 + 64 bits and at most 24 stuffed ones; one, and 41 of the longest reply."""
    wire = CanWire(125_000, sequence=0)
    assert wire.exchange_time(0, 120) == pytest.approx(42 * 135 / 125_000)


def test_random_frames_raise_nothing_and_are_no_reply(wire: CanWire) -> None:
    """20 000 of any length; the reply that comes after them is understood."""
    draw = random.Random(5)
    for _ in range(20_000):
        can_id = draw.choice((0x185, 0x205, draw.randrange(0x800)))
        data = draw.randbytes(draw.choice((8, 8, 8, draw.randrange(9))))
        if data[:1] != b"\xff" or can_id != 0x185:
            assert wire.received(pack_frames([CanFrame(can_id, data)])) == []
    assert wire.counters.unexpected_frames > 0
    assert wire.received(ANSWERS["reply"][0]) == ANSWERS["reply"][1]


def beside_another_host(test: Callable[[Group, MemoryLine], Awaitable[None]]) -> None:
    """Run a test with an opened group of one amplifier, which another host arms after that."""

    async def run() -> None:
        end = MemoryLine("can", "a")
        group = await group_of(end, is_armed=False)
        await test(group, end)

    run_virtual(run())


def heard(end: MemoryLine, kind: int = PING, session: int = 5) -> None:
    """Let the host hear another one's request to node 1."""
    end.line.received(frames(0x201, 99, kind, session, 250))


def test_amplifier_that_another_host_drives_is_never_armed() -> None:
    """Neither armed nor disarmed while its frames are heard; armed once they have ended."""

    async def test(group: Group, end: MemoryLine) -> None:
        far = end.far["a"]
        values = {"session": 5, "watchdog": 250, "shift": 0}
        far.handle("Arm", values, end.loop.time())
        heard(end)
        sent = len(end.sent)
        with pytest.raises(LinkError):
            await group.arm()
        assert len(end.sent) == sent
        assert far.state == "OPERATION_ENABLED"
        far.handle("Disarm", {"ramp": 0}, end.loop.time())
        await asyncio.sleep(2.1)
        await group.arm()
        assert far.session == 77

    beside_another_host(test)


def test_another_host_beside_an_armed_one_ends_what_it_plays() -> None:
    """The next heartbeat is not sent, and the amplifier is stopped."""

    async def test(group: Group, end: MemoryLine) -> None:
        await group.arm()
        heard(end, MESSAGES["Arm"].number, 6)
        with pytest.raises(LinkError):
            await group.beat()
        assert not group.is_armed
        assert end.far["a"].state == "QUICK_STOP_ACTIVE"
        assert f"1:{PING}" not in [each for _, each in end.sent]

    beside_another_host(test)


@in_virtual_time
async def test_another_host_is_heard_while_opening() -> None:
    """Its frames show it where its watchdog has not been seen to rise."""
    end = MemoryLine("can", "a")
    far = end.far["a"]
    far.handle("Arm", {"session": 5, "watchdog": 2000, "shift": 0}, end.loop.time())
    end.loop.call_later(0.1, heard, end)
    with pytest.raises(LinkError):
        await end.hosts["a"].open()
    assert far.state == "OPERATION_ENABLED"
