"""Amplifiers of protocol 4 by their URLs, on real terminals, TCP connections and CAN adapters."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest

from drivers.errors import CommandError, LinkError, LinkTimeout
from drivers.host.amplifier import Amplifier
from drivers.host.group import Group
from drivers.opening import Lines
from drivers.playing import Layer, Tone
from drivers.ports import PORT_OPENER, Port
from drivers.wires.can_frames import unpack_frames
from real_wires import WORD_WIRES
from registry.limits import GuardLimits
from virtual_lines import in_virtual_time

LIMITS = GuardLimits(20.0, 1000.0, 1.0)
SERVED = [name for name in WORD_WIRES if name.endswith(("tcp", "server", "socketcand"))]
CUT = [name for name in WORD_WIRES if "python-can" not in name]


@asynccontextmanager
async def opened_lines() -> AsyncIterator[Lines]:
    """Lines that are closed at the end."""
    lines = Lines()
    try:
        yield lines
    finally:
        await lines.close()


async def read_for_ever(amplifier: Amplifier) -> None:
    """Read the status until an error, for a minute at most."""
    async with asyncio.timeout(60.0):
        while True:
            await amplifier.read_status()


class SlowPort:
    """Opens and closes in half a second; opened, closed: how many were."""

    is_blocked = False
    opened = closed = 0

    async def open(self, *_: object) -> Port:
        """Open a port, which is this one."""
        await asyncio.sleep(0.5)
        self.opened += 1
        return self

    def write(self, data: bytes) -> None:
        """Nothing is there."""

    def poll(self) -> None:
        """Nothing has come."""

    def close(self) -> None:
        """Count it."""
        self.closed += 1

    async def wait_closed(self) -> None:
        """It takes its time."""
        await asyncio.sleep(0.5)


@in_virtual_time
async def test_lines_are_closed_before_a_second_close_returns() -> None:
    """A reconnection closes them as well; opened before that, the port would still be taken."""
    PORT_OPENER.set(SlowPort().open)
    lines, loop = Lines(), asyncio.get_running_loop()
    await lines.amplifier("serial:///dev/x?address=1", LIMITS, name="x")
    first = asyncio.create_task(lines.close())
    await asyncio.sleep(0.1)
    began = loop.time()
    first.cancel()
    await lines.close()
    assert loop.time() - began == pytest.approx(0.4)


@in_virtual_time
async def test_line_that_is_closed_while_it_is_opened_stays_closed() -> None:
    """As by a shutdown during a reconnection; else the port would stay open, and taken."""
    port = SlowPort()
    PORT_OPENER.set(port.open)
    lines = Lines()
    opening = [
        asyncio.ensure_future(lines.amplifier(f"serial:///dev/x?address={n}", LIMITS, name=f"{n}"))
        for n in (1, 2)
    ]
    await asyncio.sleep(0.1)
    await lines.close()
    for each in opening:
        with pytest.raises(LinkError, match="closed"):
            await each
    assert port.closed == port.opened


@in_virtual_time
async def test_bus_that_is_opened_again_goes_on_with_its_numbers() -> None:
    """An amplifier of a bus discards what has an older number, for 0.1 s: 1 follows 255."""
    PORT_OPENER.set(SlowPort().open)
    numbers, lines = list[int](), Lines()
    for _ in range(2):
        amplifier = await lines.amplifier("can+slcan:///dev/x#5", LIMITS, name="x")
        sent = amplifier.line.wire.request(5, "GetStatus", {})
        numbers.append(unpack_frames(sent)[0].data[0])
        await lines.close()
        lines = Lines(lines)
    assert numbers[1] == numbers[0] % 255 + 1


@pytest.mark.real_time
@pytest.mark.parametrize("wire", WORD_WIRES)
async def test_group_plays_over_a_wire_and_stops(
    wire: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two amplifiers on one line: 0.5 on both after one commit, silent after the stop.

    A busy machine may keep the commit waiting for longer than a host allows.
    """
    monkeypatch.setattr("drivers.host.dialogue.COMMIT_DELAY", 10.0)
    async with WORD_WIRES[wire](2) as far, opened_lines() as lines:
        amplifiers = {
            str(number): await lines.amplifier(far.url(number), LIMITS, name=str(number))
            for number in far.amplifiers
        }
        assert len({each.line for each in amplifiers.values()}) == 1
        group = Group(amplifiers, watchdog=2.0)
        await group.open()
        await group.arm()
        layers = [Layer(0, (Tone(0, 100.0, 0.5),), 0.0)]
        await group.apply(dict.fromkeys(amplifiers, layers))
        levels = [far.level(number) for number in far.amplifiers]
        assert levels == pytest.approx([0.5, 0.5], abs=1e-9)
        await group.beat()
        stopped = await group.stop()
        assert all(each.is_confirmed for each in stopped.values())
        assert [far.level(number) for number in far.amplifiers] == [0.0, 0.0]


@pytest.mark.real_time
@pytest.mark.parametrize("wire", CUT)
async def test_cut_line_is_lost_once_and_opened_again(wire: str) -> None:
    """Requests of both amplifiers fail with the same message, and those of a new line do not."""
    async with WORD_WIRES[wire](2) as far, opened_lines() as lines:
        both = [
            await lines.amplifier(far.url(number), LIMITS, name="a") for number in far.amplifiers
        ]
        for amplifier in both:
            await amplifier.open()
        far.unplug()
        messages = set()
        for amplifier in both:
            with pytest.raises(LinkError) as lost:
                await read_for_ever(amplifier)
            messages.add(str(lost.value))
        assert messages == {both[0].line.loss}
        assert "was lost" in messages.pop()
        if wire in SERVED:  # whose server listens on
            again = await asyncio.gather(
                *(lines.amplifier(far.url(number), LIMITS, name="a") for number in far.amplifiers)
            )
            for amplifier in again:
                await amplifier.open()
            assert len({each.line for each in (*again, both[0])}) == 2
        else:
            with pytest.raises(LinkError, match=r"cannot be opened|refused"):
                await lines.amplifier(far.url(1), LIMITS, name="a")


@pytest.mark.real_time
@pytest.mark.parametrize("wire", WORD_WIRES)
async def test_amplifier_that_does_not_reply_leaves_the_line(wire: str) -> None:
    """Nobody has the second address; the first one replies as before."""
    async with WORD_WIRES[wire](1) as far, opened_lines() as lines:
        first, second = [
            await lines.amplifier(far.url(number), LIMITS, name="a") for number in (1, 2)
        ]
        await first.open()
        with pytest.raises(LinkTimeout):
            await second.read_status()
        await first.read_status()


async def test_ports_are_for_one_program_alone() -> None:
    """A second host of the same terminal is refused, and a second user of the same address."""
    async with WORD_WIRES["serial"](1) as far, opened_lines() as first, opened_lines() as second:
        await first.amplifier(far.url(1), LIMITS, name="a")
        with pytest.raises(LinkError, match="in use by another program"):
            await second.amplifier(far.url(1), LIMITS, name="a")
        with pytest.raises(LinkError, match="used once"):
            await first.amplifier(far.url(1), LIMITS, name="b")
        with pytest.raises(LinkError, match="baud must be 921600"):
            await first.amplifier(far.url(2) + "&baud=115200", LIMITS, name="b")


@pytest.mark.parametrize(
    ("url", "error"),
    [
        ("serial:///dev/none-such?address=1", LinkError),
        ("serial:///dev/ttyS0?address=248", CommandError),
        ("serial://nonsense", CommandError),
        ("modbus+tcp://127.0.0.1:1/1", LinkError),
        ("can+slcan:///dev/none-such#1", LinkError),
        ("can+slcan:///dev/ttyACM0?bitrate=300000#1", CommandError),
        ("can+socketcand://127.0.0.1:1/can0#1", LinkError),
        ("can+socketcan://none-such0#1", LinkError),
        ("can+python-can://none-such/0#1", LinkError),
        ("carrier+pigeon://roof", CommandError),
    ],
)
async def test_line_that_cannot_be_opened_is_refused(url: str, error: type[Exception]) -> None:
    """No such port or server, an address that cannot be, an unknown wire."""
    with pytest.raises(error):
        await Lines().amplifier(url, LIMITS, name="a")
