"""The host's amplifier of protocol 4, on real terminals, TCP connections and CAN adapters.

Which amplifier is at an address, and what it reports that it plays against what it was sent.
"""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import asdict, replace
from unittest.mock import AsyncMock, Mock

import pytest

from cases import shortly
from drivers.by_hand.actions import read_electrical
from drivers.errors import CommandError, LinkError, LinkTimeout
from drivers.host.amplifier import Amplifier
from drivers.host.group import Group
from drivers.opening import Lines
from drivers.playing import AmplifierLayer, AmplifierTone
from drivers.ports import PORT_OPENER
from drivers.protocol.achieved import achieved_problem
from drivers.protocol.definition import MESSAGES, REPLY_TIMEOUT
from drivers.protocol.records import Values
from drivers.protocol.sets import Command, LayerSet
from drivers.wires.can_frames import unpack_frames
from drivers.wires.serial_frames import REPLY_BIT, FrameReader, encode_frame
from drivers.wires.serial_line import SerialWire
from drivers.wires.wire import Reply
from kit.clock import KINDS, MemoryLine, in_virtual_time
from kit.wires import WORD_WIRES, hanging_interface, until
from registry.limits import GuardLimits
from sim.amplifier.readings import capabilities
from sim.amplifier.simulated_amplifier import SimulatedAmplifier


def test_second_status_amid_hello_is_not_of_another_amplifier() -> None:
    """Of a request that came twice, and late: each of its replies is of its own moment."""
    line, far = SerialWire(921_600, sequence=1), SimulatedAmplifier("a", channels=2)
    (question,) = FrameReader().feed(line.request(1, "GetStatus", {}))
    arrivals = []
    for temperature in (250, 251):
        words = MESSAGES["GetStatus"].reply.pack({**far.status(0.0), "temperature": temperature})
        arrivals += line.received(
            encode_frame(question._replace(kind=question.kind | REPLY_BIT), words)
        )
        line.request(1, "Hello", {})
    assert [type(arrival) for arrival in arrivals] == [Reply]


@pytest.mark.parametrize("kind", sorted(KINDS.keys() - {"tcp"}))
@in_virtual_time
async def test_second_amplifier_at_an_address_is_told(kind: str) -> None:
    """Both reply to Hello, with their serial numbers; it names the remedy."""
    line = MemoryLine(kind, "a", "b")
    ends = line.far_end, line.kind.far_end({2: SimulatedAmplifier("c", channels=2)}, line.send)
    line.far_end = Mock(receive=lambda data, now: [end.receive(data, now) for end in ends])
    with pytest.raises(LinkError, match="several amplifiers reply at address 2"):
        await line.hosts["b"].open()
    await line.hosts["a"].open()


SENT = LayerSet(2, 20, 0, (Command(0, 2000, 5000, 17_990), Command(1, 2000, 0, 0)))
CAN = {**capabilities(2), "frequency_step": 3, "level_step": 5, "phase_step": 41}
PLAYED = SENT.commands[0]
SAME = [
    *(PLAYED, replace(PLAYED, frequency=2002), replace(PLAYED, level=4997)),
    replace(PLAYED, phase=-17_989),  # 21 steps beyond 179.9 degrees, across 180
]
OTHER = {
    "frequency": [replace(PLAYED, frequency=2003)],
    "level": [replace(PLAYED, level=4996)],
    "phase": [replace(PLAYED, phase=-17_988)],
    "level of channel 0": [],
    "level of channel 1": [PLAYED, Command(1, 2000, 1, 0)],
    "channels that are not driven": [PLAYED, Command(2, 2000, 1, 0)],
}


def shown(*commands: Command) -> Values:
    """The reply to GetAchieved of a layer with these tones."""
    return {**asdict(SENT), "commands": [asdict(command) for command in commands]}


@pytest.mark.parametrize("played", SAME)
def test_half_a_step_and_what_the_wire_rounds_is_no_contradiction(played: Command) -> None:
    """Half of the steps of the amplifier and of the wire: 2, 3 and 21 steps of the wire."""
    assert achieved_problem(SENT, shown(played), CAN, is_exact=False, slack=0.5) is None


@pytest.mark.parametrize("name", OTHER)
def test_more_than_that_is_one(name: str) -> None:
    """Of frequency, level and phase, and channels that are missing or too many."""
    problem = achieved_problem(SENT, shown(*OTHER[name]), CAN, is_exact=False, slack=0.5)
    assert name in problem.quantity


def test_channels_of_one_level_are_scaled_alike() -> None:
    """Two channels at the same level, one at half of it: a common factor does not explain that."""
    tones = (Command(0, 2000, 5000, 0), Command(1, 2000, 5000, 0))
    layer = replace(SENT, commands=tones)
    halves = [replace(tone, level=2500) for tone in tones]
    limits = {"is_exact": False, "can_scale": True}
    assert achieved_problem(layer, shown(*halves), CAN, **limits) is None
    problem = achieved_problem(layer, shown(halves[0], tones[1]), CAN, **limits)
    assert problem.quantity == "shares of its channels"


@pytest.mark.parametrize("kind", KINDS)
@in_virtual_time
async def test_voltage_and_current_of_each_channel(kind: str) -> None:
    """In volts and amperes; none without the feature."""
    end = MemoryLine(kind, "a")
    far, (host,) = end.far["a"], end.hosts.values()
    values: Values = {
        "count": 2,
        "channels": [
            {"channel_voltage": 12_345, "channel_current": 250},
            {"channel_voltage": 0, "channel_current": 0},
        ],
    }
    handle = far.handle
    far.handle = lambda name, sent, now, **options: (  # type: ignore[method-assign]
        values if name == "GetMeasured" else handle(name, sent, now, **options)
    )
    await host.open()
    assert await read_electrical(host) == [(1234.5, 250e-6), (0.0, 0.0)]
    far.capabilities = {**far.capabilities, "features": 0}
    await host.open()
    assert await read_electrical(host) == []


LIMITS = GuardLimits(20.0, 1000.0, 1.0)
SERVED = [name for name in WORD_WIRES if name.endswith(("tcp", "server", "socketcand"))]


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


def slow_port() -> Mock:
    """The port that is opened, in half a second; it closes as slowly."""

    async def take(*_: object) -> Mock:
        await asyncio.sleep(0.5)
        return port

    port = Mock(is_blocked=False, open=AsyncMock(side_effect=take), wait_closed=take)
    PORT_OPENER.set(port.open)
    return port


@in_virtual_time
async def test_lines_are_closed_before_a_second_close_returns() -> None:
    """A reconnection closes them as well; opened before that, the port would still be taken."""
    slow_port()
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
    port, lines = slow_port(), Lines()
    opening = [
        asyncio.ensure_future(lines.amplifier(f"serial:///dev/x?address={n}", LIMITS, name=f"{n}"))
        for n in (1, 2)
    ]
    await asyncio.sleep(0.1)
    await lines.close()
    for request in opening:
        with pytest.raises(LinkError, match="closed"):
            await request
    assert port.close.call_count == port.open.await_count


@in_virtual_time
async def test_bus_that_is_opened_again_goes_on_with_its_numbers() -> None:
    """An amplifier of a bus discards what has an older number, for 0.1 s: 1 follows 255."""
    slow_port()
    numbers, lines = list[int](), Lines()
    for _ in range(2):
        amplifier = await lines.amplifier("can+slcan:///dev/x#5", LIMITS, name="x")
        sent = amplifier.line.wire.request(5, "GetStatus", {})
        numbers.append(unpack_frames(sent)[0].data[0])
        await lines.close()
        lines = Lines(lines)
    assert numbers[1] == numbers[0] % 255 + 1


@pytest.mark.real_time
@pytest.mark.parametrize(
    "wire",
    shortly(
        WORD_WIRES,
        ["serial", "modbus+rtu", "modbus+tcp", "can+slcan", "can+python-can udp_multicast"],
    ),
)
@pytest.mark.usefixtures("unhurried")
async def test_group_plays_over_a_wire_and_stops(wire: str) -> None:
    """Two amplifiers on one line: 0.5 on both after one commit, silent after the stop.

    Nobody has the third address; the others reply as before.
    """
    async with WORD_WIRES[wire](2) as far, opened_lines() as lines:
        amplifiers = {
            str(number): await lines.amplifier(far.url(number), LIMITS, name=str(number))
            for number in far.amplifiers
        }
        assert len({amplifier.line for amplifier in amplifiers.values()}) == 1
        group = Group(amplifiers)
        await group.open()
        await group.arm()
        layers = [AmplifierLayer(0, (AmplifierTone(0, 100.0, 0.5),), 0.0)]
        await group.apply(dict.fromkeys(amplifiers, layers))
        levels = [far.level(number) for number in far.amplifiers]
        assert levels == pytest.approx([0.5, 0.5], abs=1e-9)
        await group.beat()
        stopped = await group.stop()
        assert all(outcome.is_confirmed for outcome in stopped.values())
        assert [far.level(number) for number in far.amplifiers] == [0.0, 0.0]
        nobody = await lines.amplifier(far.url(3), LIMITS, name="3")
        with pytest.raises(LinkTimeout):
            await nobody.request("GetStatus", {}, timeout=REPLY_TIMEOUT)
        await group.amplifiers["1"].read_status()


@pytest.mark.real_time
@pytest.mark.usefixtures("unhurried")
async def test_stop_of_another_line_is_sent_while_a_can_adapter_hangs() -> None:
    """The other amplifier replies and falls silent during the call that hangs.

    Once the call returns, the amplifier behind the adapter is stopped, too.
    """
    async with (
        WORD_WIRES["can+python-can virtual"](1) as behind_adapter,
        WORD_WIRES["serial"](1) as serial,
        opened_lines() as lines,
    ):
        with hanging_interface() as adapter:
            url = behind_adapter.url(1).replace("virtual", "hanging")
            amplifiers = {
                "adapter": await lines.amplifier(url, LIMITS, name="adapter"),
                "other": await lines.amplifier(serial.url(1), LIMITS, name="other"),
            }
            group = Group(amplifiers)
            await group.open()
            await group.arm()
            layers = [AmplifierLayer(0, (AmplifierTone(0, 100.0, 0.5),), 0.0)]
            await group.apply(dict.fromkeys(amplifiers, layers))
            await until(lambda: behind_adapter.level(1) == pytest.approx(0.5))
            adapter.hangs = True
            stopping = asyncio.create_task(group.stop())
            await until(lambda: serial.level(1) == 0.0)
            await amplifiers["other"].read_status()
            assert adapter.sending == 1
            adapter.resume()
            stopped = await stopping
            assert stopped["other"].is_confirmed
            await until(lambda: behind_adapter.level(1) == 0.0)


@pytest.mark.real_time
@pytest.mark.parametrize(
    "wire",
    shortly(
        [name for name in WORD_WIRES if "python-can" not in name],
        ["modbus+rtu", "serial+tcp", "modbus+tcp", "can+slcan server"],
    ),
)
@pytest.mark.usefixtures("unhurried")
async def test_cut_line_is_lost_once_and_opened_again(wire: str) -> None:
    """Requests of both amplifiers fail with the same message, and those of a new line do not."""
    async with WORD_WIRES[wire](2) as far, opened_lines() as lines:
        amplifiers = [
            await lines.amplifier(far.url(number), LIMITS, name="a") for number in far.amplifiers
        ]
        for amplifier in amplifiers:
            await amplifier.open()
        far.unplug()
        messages = set()
        for amplifier in amplifiers:
            with pytest.raises(LinkError) as lost:
                await read_for_ever(amplifier)
            messages.add(str(lost.value))
        assert messages == {amplifiers[0].line.loss}
        assert "was lost" in messages.pop()
        if wire in SERVED:  # whose server listens on
            again = await asyncio.gather(
                *(lines.amplifier(far.url(number), LIMITS, name="a") for number in far.amplifiers)
            )
            for amplifier in again:
                await amplifier.open()
            assert len({amplifier.line for amplifier in (*again, amplifiers[0])}) == 2
        else:
            with pytest.raises(LinkError, match=r"cannot be opened|refused"):
                await lines.amplifier(far.url(1), LIMITS, name="a")


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
