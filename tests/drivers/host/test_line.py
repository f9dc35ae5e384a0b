"""One line: which request goes when, how often, and what callers learn."""

import asyncio
import re
from collections.abc import Callable, Mapping
from itertools import starmap

import pytest

from drivers.errors import CommandRefused, LinkTimeout
from drivers.host.group import Group
from drivers.host.line import Job, Priority
from drivers.playing import Layer, Tone
from drivers.protocol.definition import word_passed
from drivers.protocol.records import Refusal, Values
from drivers.wires.can_frames import CanFrame, pack_frames
from drivers.wires.serial_frames import Frame, encode_frame
from drivers.wires.serial_line import SerialWire
from virtual_lines import KINDS, MemoryLine, grouped, in_virtual_time, unaltered


@pytest.mark.parametrize("wire", KINDS)
@grouped(("a", "b"))
async def test_request_that_has_waited_for_50_ms_goes_before_newer_heartbeats(
    group: Group, ends: list[MemoryLine]
) -> None:
    """With a heartbeat queued whenever one is answered; without that rule it waits for ever."""
    (end,), (first, second) = ends, group.amplifiers.values()
    end.outward = lambda name, data: [(0.004, data)]

    async def beat() -> None:
        while True:
            await first.ping()

    beating = [asyncio.ensure_future(beat()) for _ in range(3)]
    await asyncio.sleep(0.01)
    began = end.loop.time()
    async with asyncio.timeout(0.3):
        await second.read_status()
    assert 0.05 < end.loop.time() - began < 0.1
    for each in beating:
        each.cancel()
    await asyncio.wait(beating)


@grouped(("a", "b"), wire="serial")
async def test_heartbeat_waits_for_one_request_that_has_waited(
    group: Group, ends: list[MemoryLine]
) -> None:
    """Of eight statuses that nobody has answered for 50 ms, each of 20 ms on the line."""
    (end,), (first, second) = ends, group.amplifiers.values()
    end.outward = lambda name, data: [(0.02, data)]
    reading = [asyncio.ensure_future(second.read_status()) for _ in range(8)]
    await asyncio.sleep(0.065)
    began = end.loop.time()
    await first.ping()
    assert end.loop.time() - began < 0.065
    await asyncio.gather(*reading)


@pytest.mark.parametrize(("baud", "attempts"), [(921_600, 3), (9600, 2)])
@in_virtual_time
async def test_request_is_repeated_twice_and_once_on_a_slow_line(baud: int, attempts: int) -> None:
    """A status of 41 bytes takes 43 ms at 9600 baud, more than the 30 ms of others."""
    end = MemoryLine("serial", "a", wire=SerialWire(baud, sequence=0))
    (host,) = end.hosts.values()
    await host.open()
    end.outward = lambda name, data: []
    end.sent.clear()
    with pytest.raises(LinkTimeout):
        await host.read_status()
    assert [each for _, each in end.sent] == ["1:9"] * attempts
    assert (host.counts.timeouts, host.counts.retries) == (attempts, attempts - 1)


@in_virtual_time
async def test_read_behind_a_write_whose_response_was_found_late_is_awaited() -> None:
    """Modbus: only the last look at the port finds that response; the status comes 20 ms on."""
    end = MemoryLine("tcp", "a")
    (host,) = end.hosts.values()
    await host.open()
    unread: list[bytes] = []

    def poll() -> None:
        end.outward = lambda name, data: [(0.02, data)]
        while unread:
            end.line.received(unread.pop())

    end.poll = poll  # type: ignore[method-assign]
    end.outward = lambda name, data: unread.append(data) or []  # type: ignore[func-returns-value]
    await host.read_status()
    assert host.counts.retries == 0


@pytest.mark.parametrize("wire", KINDS)
@grouped(("a",))
async def test_refusal_after_no_reply_says_that_it_may_have_played(
    group: Group, ends: list[MemoryLine]
) -> None:
    """The reply to a commit is lost, and the commit that is repeated is refused; then one alone."""
    (end,), (host,) = ends, group.amplifiers.values()
    await host.stage(5, [Layer(0, (Tone(0, 100.0, 0.5),), 0.001)])
    far = end.far["a"]
    handle, commits = far.handle, iter([True])

    def once(name: str, values: Values, now: float, **options: bool) -> Values:
        if name == "Commit" and not next(commits, False):
            raise Refusal("not now", "WRONG_STATE")
        return handle(name, values, now, **options)

    far.handle = once  # type: ignore[method-assign]
    lost = iter([True])
    end.outward = lambda name, data: [] if next(lost, False) else unaltered(name, data)
    with pytest.raises(CommandRefused) as raised:
        await host.commit(5, word_passed(end.loop.time()))
    assert raised.value.may_play
    await host.stage(6, [Layer(0, ())])
    with pytest.raises(CommandRefused) as raised:
        await host.commit(6, word_passed(end.loop.time()))
    assert not raised.value.may_play


@in_virtual_time
async def test_statistics_are_those_of_the_amplifier_and_of_its_line() -> None:
    """A retry of one of two amplifiers; both have sent frames, and the last round trip is known."""
    end = MemoryLine("serial", "a", "b")
    for host in end.hosts.values():
        await host.open()
    lost = iter([True])
    end.outward = lambda name, data: [] if next(lost, False) else unaltered(name, data)
    await end.hosts["a"].read_status()
    one, other = (end.hosts[name].statistics for name in "ab")
    assert (one.retries, one.timeouts, other.retries, other.timeouts) == (1, 1, 0, 0)
    assert one.frames_out == other.frames_out == 8
    assert one.frames_in == 7
    assert one.last_round_trip == pytest.approx(0.0004)


IN_PLACE: Mapping[str, tuple[str, Callable[[bytes], bytes], str]] = {
    # What stands in place of each reply, by hand, and what the error must name.
    "serial, wrong speed": ("serial", lambda data: b"\xf8\x80" * 9, "bytes .*f8 80.*baud rate"),
    "serial, damaged": (
        "serial",
        lambda data: data[:-5] + b"\1" + data[-4:],
        "no valid frame.*cable",
    ),
    "serial, echo": ("serial", lambda data: ECHO, "request itself came back"),
    "serial, late": ("serial", lambda data: LATE, "address 1 to another request.*delays"),
    "rtu, wrong speed": ("rtu", lambda data: b"\xf8\x80" * 9, "18 bytes .*f8 80.*parity"),
    "can, text that is none": ("can", lambda data: frames((0x800, b"\xf8")), r"\(f8\).*baud rate"),
    "rtu, other unit": (
        "rtu",
        lambda data: bytes.fromhex("02 90 01 7d c0"),
        "unit 2.*check the unit",
    ),
    "tcp, transaction 0": (
        "tcp",
        lambda data: b"\0\0" + data[2:],
        "transaction 0, unit 1.*gateway",
    ),
    "tcp, unit 255": (
        "tcp",
        lambda data: data[:6] + b"\xff" + data[7:],
        "unit 255.*check the unit",
    ),
    "tcp, exception 10": ("tcp", lambda data: data[:5] + b"\3\1\x90\x0a", "no path to unit 1"),
    "tcp, exception 11": ("tcp", lambda data: data[:5] + b"\3\1\x90\x0b", "no response of unit 1"),
    "tcp, RTU in it": ("tcp", lambda data: b"\1\x10\x09\0\0\1\2\x55", r"Modbus TCP.*modbus\+rtu"),
    "can, other node": ("can", lambda data: frames((0x705, b"\5")), "node 5 came .* of node 1:"),
    "can, heartbeat": (
        "can",
        lambda data: frames((0x701, b"\5"), (0x702, b"\5")),
        "node 1 came in place of .* of node 1:",
    ),
    "can, BEL": ("can", lambda data: frames((0x800, b"\7")), r"adapter .*\(07\).*termination"),
}


def frames(*given: tuple[int, bytes]) -> bytes:
    """Frames by identifier and data, as a port of frames has them."""
    return pack_frames(starmap(CanFrame, given))


ECHO = encode_frame(Frame(9, 1, 4, b"", 3))
LATE = encode_frame(Frame(0x89, 1, 3, b"", 3))


@pytest.mark.parametrize("case", IN_PLACE)
@in_virtual_time
async def test_error_of_no_reply_names_what_came_in_its_place(case: str) -> None:
    """And what to check, which differs; as does the reason why nothing new is played."""
    wire, in_place, named = IN_PLACE[case]
    end = MemoryLine(wire, "a")
    (host,) = end.hosts.values()
    await host.open()
    end.outward = lambda name, data: [(0.0002, in_place(data))]
    with pytest.raises(LinkTimeout, match=f"no reply within 30 ms, but .*{named}"):
        await host.read_status()
    assert re.search(named, host.silence_cause or "")
    end.outward = unaltered
    await host.read_status()
    end.outward = lambda name, data: []
    with pytest.raises(LinkTimeout, match="30 ms; check that the amplifier is switched on"):
        await host.read_status()
    end = MemoryLine("serial", "a")  # its replies to Hello, of type 81, alone arrive
    end.outward = lambda name, data: unaltered(name, data) * (data[2:3] == b"\x81")
    with pytest.raises(LinkTimeout, match="; it answered Hello, but not GetCaps"):
        await end.hosts["a"].open()


@in_virtual_time
async def test_error_of_late_replies_names_the_delay() -> None:
    """The first requests wait longer than the next; 400 ms: two, of a write and of a read."""
    end = MemoryLine("tcp", "a")
    end.outward = lambda name, data: [(0.2, data)]
    with pytest.raises(LinkTimeout, match="30 ms, but the reply before took 400 ms"):
        await end.hosts["a"].open()


@pytest.mark.parametrize(("wire", "named"), [("serial", "flow control"), ("can", "acknowledges")])
@in_virtual_time
async def test_error_of_a_port_that_takes_nothing_names_what_to_check(
    wire: str, named: str
) -> None:
    """A bus on which no node acknowledges fills the queue of its adapter."""
    end = MemoryLine(wire, "a")
    end.is_blocked = True
    end.inward = lambda name, data: []
    with pytest.raises(LinkTimeout, match=named):
        await end.hosts["a"].open()


async def test_stop_supersedes_what_feeds_plays_arms_or_acknowledges() -> None:
    """Of requests that wait; what reads goes on waiting."""
    result = asyncio.get_running_loop().create_future()
    waiting = [Job(None, priority, "", {}, 0.03, 0.0, result=result) for priority in Priority]
    obsolete = {job.priority for job in waiting if job.is_superseded_by(Priority.STOP, None)}
    assert obsolete == {Priority.HEARTBEAT, Priority.SET, Priority.ARM, Priority.CLEAR}
