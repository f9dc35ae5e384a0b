"""Who is at an address: the expected amplifier, another one, or several."""

import asyncio
from collections.abc import Mapping

import pytest

from drivers.errors import CommandRefused, DriverError, LinkError, LinkTimeout
from drivers.host.amplifier import Amplifier as Host
from drivers.playing import Layer, Tone
from drivers.protocol.definition import MESSAGES
from drivers.wires.serial_frames import REPLY, FrameReader, encode_frame
from drivers.wires.serial_line import SerialWire
from drivers.wires.wire import Reply
from sim.amplifier.readings import capabilities
from sim.amplifier.simulated_amplifier import Amplifier
from virtual_lines import (
    KINDS,
    LIMITS,
    MemoryLine,
    group_of,
    in_virtual_time,
    run_virtual,
    unaltered,
)


def loud(level: float) -> Layer:
    """A tone of 100 Hz on the first channel."""
    return Layer(0, (Tone(0, 100.0, level),), 0.001)


def restart(end: MemoryLine, **changes: object) -> None:
    """Switch the amplifier off and on again, as one with other capabilities: it boots on CAN."""
    far = end.far["a"]
    far.capabilities = {**far.capabilities, **changes}
    far.restart(end.loop.time())
    far.latch = 0
    if end.kind is KINDS["can"]:
        end.boot(1)


@in_virtual_time
async def test_amplifier_that_was_switched_off_is_armed_with_its_new_limits(wire: str) -> None:
    """It plays at most 0.3 since: 0.4 is refused here, before anything is sent."""
    end = MemoryLine(wire, "a")
    group = await group_of(end, is_armed=False)
    restart(end, level_max=3000)
    await group.arm()
    end.sent.clear()
    with pytest.raises(CommandRefused):
        await group.apply({"a": [loud(0.4)]})
    assert end.sent == []
    await group.apply({"a": [loud(0.3)]})


@in_virtual_time
async def test_amplifier_that_restarts_amid_a_session_can_be_cleared_and_armed(wire: str) -> None:
    """Its latches begin anew, so that the stop is not confirmed; clear and arm know it again."""
    end = MemoryLine(wire, "a")
    group = await group_of(end)
    assert (await group.stop())["a"].is_confirmed
    await group.clear()
    group._draw = lambda low, high: 78
    await group.arm()
    await group.apply({"a": [loud(0.5)]})
    restart(end)
    with pytest.raises(DriverError):
        await group.beat()
    await group.stop()
    group._draw = lambda low, high: 79
    await group.clear()
    await group.arm()
    await group.apply({"a": [loud(0.5)]})
    await group.stop()
    assert end.levels("a") == [0.0, 0.0]


@in_virtual_time
async def test_reply_that_comes_twice_is_not_of_two_amplifiers(wire: str) -> None:
    """The same amplifier's, doubled on its way."""
    end = MemoryLine(wire, "a")
    end.outward = lambda name, data: [(0.0002, data), (0.004, data)]
    await end.hosts["a"].open()


def test_second_status_amid_hello_is_not_of_another_amplifier() -> None:
    """Of a request that came twice, and late: each of its replies is of its own moment."""
    line, far = SerialWire(921_600, sequence=1), Amplifier("a", channels=2)
    (asked,) = FrameReader().feed(line.request(1, "GetStatus", {}))
    arrivals = []
    for temperature in (250, 251):
        words = MESSAGES["GetStatus"].reply.pack({**far.status(0.0), "temperature": temperature})
        arrivals += line.received(encode_frame(asked._replace(kind=asked.kind | REPLY), words))
        line.request(1, "Hello", {})
    assert [type(each) for each in arrivals] == [Reply]


@pytest.mark.parametrize("is_output", [True, False])
@in_virtual_time
async def test_full_level_must_be_what_the_rig_says(wire: str, is_output: bool) -> None:
    """A linear amplifier where the rig has a stiff source, and the other way round."""
    end = MemoryLine(wire, "a")
    end.far["a"].capabilities = capabilities(2, is_output=not is_output)
    host = Host(end.line, 1, LIMITS, name="a", is_output=is_output)
    with pytest.raises(LinkError, match="full level"):
        await host.open()
    end.far["a"].capabilities = capabilities(2, is_output=is_output)
    await host.open()


def test_request_that_waits_on_a_busy_machine_contradicts_nothing(wire: str) -> None:
    """It waits 25 ms, ten times what the line needs, before it feeds; two statuses follow.

    Answered or not: a watchdog that was fed later has more left.
    """

    async def run(is_answered: bool) -> None:
        end = MemoryLine(wire, "a")
        await group_of(end)
        (host,) = end.hosts.values()
        end.inward = lambda name, data: [(0.025, data)]
        if is_answered:
            await host.ping()
        else:
            end.outward = lambda name, data: []
            with pytest.raises(LinkTimeout):
                await host.ping()
        end.inward = end.outward = unaltered
        for _ in range(2):
            await host.read_status()
            await asyncio.sleep(0.02)

    for is_answered in (True, False):
        run_virtual(run(is_answered))


@in_virtual_time
async def test_ping_that_a_network_delivers_late_is_accounted_for() -> None:
    """It arrives 0.2 s late: the amplifier plays for longer than its watchdog after the last one.

    By hand: the last of three attempts goes out at 60 ms and feeds at 260 ms, for 250 ms.
    """
    end = MemoryLine("tcp", "a")
    group = await group_of(end)
    await group.apply({"a": [loud(0.5)]})
    (host,) = end.hosts.values()
    end.inward = lambda name, data: [(0.2, data)]
    end.outward = lambda name, data: []
    began = end.loop.time()
    with pytest.raises(LinkTimeout):
        await host.ping()
    await asyncio.sleep(began + 0.5 - end.loop.time())
    assert end.levels("a") == [0.5, 0.0]
    assert began + 0.515 < host.feeding.may_play_until < began + 1.4
    await asyncio.sleep(0.02)
    assert end.levels("a") == [0.0, 0.0]


class Twins:
    """Two amplifiers at each address, which hear and reply at the same time."""

    def __init__(self, line: MemoryLine, others: Mapping[int, Amplifier]) -> None:
        self._first = line._end
        self._second = line.kind.far_end(others, line._send)
        line._end = self

    def receive(self, data: bytes, now: float) -> None:
        """Take bytes from the host at a time [s]."""
        for end in (self._first, self._second):
            end.receive(data, now)


@pytest.mark.parametrize("kind", sorted(KINDS.keys() - {"tcp"}))
@in_virtual_time
async def test_second_amplifier_at_an_address_is_told(kind: str) -> None:
    """Both reply to Hello, with their serial numbers; it names the remedy."""
    line = MemoryLine(kind, "a", "b")
    Twins(line, {2: Amplifier("c", channels=2)})
    with pytest.raises(LinkError, match="several amplifiers reply at address 2"):
        await line.hosts["b"].open()
    await line.hosts["a"].open()


@in_virtual_time
async def test_amplifier_that_is_not_identified_plays_nothing_and_is_silenced(wire: str) -> None:
    """It is named by what is planned for it; what it plays is silenced as before."""
    end = MemoryLine(wire, "a")
    group = await group_of(end)
    await group.apply({"a": [loud(0.5)]})
    end.hosts["a"].capabilities = {}  # as of a stop that found its line closed
    refusal = group.sets.refusal_of({"a": [loud(0.5)]})
    assert "a must be identified" in str(refusal)
    with pytest.raises(CommandRefused, match="a must be identified"):
        await group.apply({"a": [loud(0.4)]})
    await group.silence(0.005)
    await asyncio.sleep(0.01)
    assert end.levels("a") == [0.0, 0.0]
