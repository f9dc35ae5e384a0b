"""The host's amplifier of protocol 4, on real terminals, TCP connections and CAN adapters.

The host identifies the amplifier at an address, and compares reported layers with requested ones.
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
from kit.wires import until
from registry.limits import GuardLimits
from sim.amplifier.readings import capabilities
from sim.amplifier.simulated_amplifier import SimulatedAmplifier
from tests.drivers.hanging_bus import hanging_interface
from tests.drivers.host.group_on_lines import connect, intercept
from tests.drivers.word_wires import WORD_WIRES, WordFarSide


def test_second_status_during_hello_is_not_from_another_amplifier() -> None:
    """A request arrived twice: its two replies differ in time, but have the same sender."""
    wire = SerialWire(921_600, sequence=1)
    amplifier = SimulatedAmplifier("a", channels=2)
    (request,) = FrameReader().feed(wire.request(1, "GetStatus", {}))
    arrivals = []
    for temperature in (250, 251):
        status = {**amplifier.status(0.0), "temperature": temperature}
        words = MESSAGES["GetStatus"].reply.pack(status)
        reply = request._replace(kind=request.kind | REPLY_BIT)
        arrivals += wire.received(encode_frame(reply, words))
        wire.request(1, "Hello", {})

    assert [type(arrival) for arrival in arrivals] == [Reply]


@pytest.mark.parametrize("kind", ["can", "rtu", "serial"])
@in_virtual_time
async def test_second_amplifier_at_an_address_is_reported(kind: str) -> None:
    """Both reply to Hello with their serial numbers; other addresses can be opened."""
    line = MemoryLine(kind, "a", "b")
    first = line.far_end
    second = line.kind.far_end({2: SimulatedAmplifier("c", channels=2)}, line.send)

    def receive(data: bytes, now: float) -> None:
        first.receive(data, now)
        second.receive(data, now)

    line.far_end = Mock(receive=receive)
    with pytest.raises(LinkError, match="several amplifiers reply at address 2"):
        await line.hosts["b"].open()
    await line.hosts["a"].open()


SENT = LayerSet(2, 20, 0, (Command(0, 2000, 5000, 17_990), Command(1, 2000, 0, 0)))
STEPS = {**capabilities(2), "frequency_step": 3, "level_step": 5, "phase_step": 41}
REQUESTED = SENT.commands[0]
CONTRADICTIONS = {
    "frequency": [replace(REQUESTED, frequency=2003)],
    "level": [replace(REQUESTED, level=4996)],
    "phase": [replace(REQUESTED, phase=-17_988)],
    "level of channel 0": [],
    "level of channel 1": [REQUESTED, Command(1, 2000, 1, 0)],
    "channels that are not driven": [REQUESTED, Command(2, 2000, 1, 0)],
}
"""Reported tones by the quantity that differs from the requested ones."""


def achieved(*commands: Command) -> Values:
    """Return the reply to GetAchieved of a layer with these tones."""
    return {**asdict(SENT), "commands": [asdict(command) for command in commands]}


@pytest.mark.parametrize("quantity", CONTRADICTIONS)
def test_larger_difference_is_a_contradiction(quantity: str) -> None:
    """In frequency, level or phase, or by missing or additional channels."""
    reply = achieved(*CONTRADICTIONS[quantity])

    problem = achieved_problem(SENT, reply, STEPS, is_exact=False, slack=0.5)

    assert quantity in problem.quantity


def test_channels_of_one_level_are_scaled_alike() -> None:
    """A common factor does not explain two equal channels of which one plays at half level."""
    first = Command(0, 2000, 5000, 0)
    second = Command(1, 2000, 5000, 0)
    half_first = replace(first, level=2500)
    half_second = replace(second, level=2500)
    layer = replace(SENT, commands=(first, second))
    limits = {"is_exact": False, "can_scale": True}

    assert achieved_problem(layer, achieved(half_first, half_second), STEPS, **limits) is None
    problem = achieved_problem(layer, achieved(half_first, second), STEPS, **limits)
    assert problem.quantity == "shares of its channels"


@pytest.mark.parametrize("wire", KINDS)
@in_virtual_time
async def test_voltage_and_current_of_each_channel(wire: str) -> None:
    """In volts and amperes; an amplifier without the feature has none."""
    rig = await connect("a", wire=wire, is_armed=False)
    first = {"channel_voltage": 12_345, "channel_current": 250}
    second = {"channel_voltage": 0, "channel_current": 0}
    intercept(rig.far["a"], "GetMeasured", lambda _: {"count": 2, "channels": [first, second]})
    host = rig.hosts["a"]
    assert await read_electrical(host) == [(1234.5, 250e-6), (0.0, 0.0)]

    rig.far["a"].capabilities = {**rig.far["a"].capabilities, "features": 0}
    await host.open()
    assert await read_electrical(host) == []


LIMITS = GuardLimits(20.0, 1000.0, 1.0)
SERVED = [name for name in WORD_WIRES if name.endswith(("tcp", "server", "socketcand"))]


@asynccontextmanager
async def opened_lines() -> AsyncIterator[Lines]:
    """Yield lines that are closed at the end."""
    lines = Lines()
    try:
        yield lines
    finally:
        await lines.close()


async def amplifiers_of(lines: Lines, far: WordFarSide) -> dict[str, Amplifier]:
    """Return all amplifiers of a far side by their numbers."""
    amplifiers = {}
    for number in far.amplifiers:
        name = str(number)
        amplifiers[name] = await lines.amplifier(far.url(number), LIMITS, name=name)
    return amplifiers


async def play_half(amplifiers: dict[str, Amplifier]) -> Group:
    """Open and arm a group, and play 0.5 on the first channel of all amplifiers."""
    group = Group(amplifiers)
    await group.open()
    await group.arm()
    layers = [AmplifierLayer(0, (AmplifierTone(0, 100.0, 0.5),), 0.0)]
    await group.apply(dict.fromkeys(amplifiers, layers))
    return group


async def read_until_lost(amplifier: Amplifier) -> None:
    """Read the status until an error, for a minute at most."""
    async with asyncio.timeout(60.0):
        while True:
            await amplifier.read_status()


def slow_port() -> Mock:
    """Replace all ports by one that opens and closes in half a second."""

    async def wait(*_: object) -> Mock:
        await asyncio.sleep(0.5)
        return port

    port = Mock(is_blocked=False, open=AsyncMock(side_effect=wait), wait_closed=wait)
    PORT_OPENER.set(port.open)
    return port


@in_virtual_time
async def test_line_that_is_closed_while_it_is_opened_stays_closed() -> None:
    """A shutdown during a reconnection must not leave the port open."""
    port = slow_port()
    lines = Lines()
    requests = []
    for address in ("1", "2"):
        request = lines.amplifier(f"serial:///dev/x?address={address}", LIMITS, name=address)
        requests.append(asyncio.ensure_future(request))
    await asyncio.sleep(0.1)

    await lines.close()

    for request in requests:
        with pytest.raises(LinkError, match="closed"):
            await request
    assert port.close.call_count == port.open.await_count


@in_virtual_time
async def test_bus_that_is_opened_again_continues_its_numbers() -> None:
    """For 0.1 s an amplifier discards frames with an older number: 1 follows 255."""
    slow_port()
    lines = Lines()
    numbers: list[int] = []
    for _ in range(2):
        amplifier = await lines.amplifier("can+slcan:///dev/x#5", LIMITS, name="x")
        request = amplifier.line.wire.request(5, "GetStatus", {})
        first_frame = unpack_frames(request)[0]
        numbers.append(first_frame.data[0])
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

    No amplifier has the third address; the others continue to reply.
    """
    async with WORD_WIRES[wire](2) as far, opened_lines() as lines:
        amplifiers = await amplifiers_of(lines, far)
        assert amplifiers["1"].line is amplifiers["2"].line

        group = await play_half(amplifiers)

        levels = {number: far.level(number) for number in far.amplifiers}
        assert levels == pytest.approx({1: 0.5, 2: 0.5}, abs=1e-9)
        await group.beat()
        outcomes = await group.stop()
        confirmed = {name: outcome.is_confirmed for name, outcome in outcomes.items()}
        assert confirmed == {"1": True, "2": True}
        assert {number: far.level(number) for number in far.amplifiers} == {1: 0.0, 2: 0.0}

        missing = await lines.amplifier(far.url(3), LIMITS, name="3")
        with pytest.raises(LinkTimeout):
            await missing.request("GetStatus", {}, timeout=REPLY_TIMEOUT)
        await amplifiers["1"].read_status()


@pytest.mark.real_time
@pytest.mark.usefixtures("unhurried")
async def test_stop_of_another_line_is_sent_while_a_can_adapter_hangs() -> None:
    """The other amplifier replies and becomes silent during the call that hangs.

    Once the call returns, the amplifier behind the adapter is stopped, too.
    """
    async with (
        WORD_WIRES["can+python-can virtual"](1) as can_far,
        WORD_WIRES["serial"](1) as serial_far,
        opened_lines() as lines,
    ):
        with hanging_interface() as adapter:
            can_url = can_far.url(1).replace("virtual", "hanging")
            amplifiers = {
                "can": await lines.amplifier(can_url, LIMITS, name="can"),
                "serial": await lines.amplifier(serial_far.url(1), LIMITS, name="serial"),
            }
            group = await play_half(amplifiers)
            await until(lambda: can_far.level(1) == pytest.approx(0.5))
            adapter.hangs = True

            stopping = asyncio.create_task(group.stop())

            await until(lambda: serial_far.level(1) == 0.0)
            await amplifiers["serial"].read_status()
            await until(lambda: adapter.sending == 1)
            adapter.resume()
            outcomes = await stopping
            assert outcomes["serial"].is_confirmed
            await until(lambda: can_far.level(1) == 0.0)


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
    """Requests to both amplifiers fail with the same message, but succeed on a new line."""
    async with WORD_WIRES[wire](2) as far, opened_lines() as lines:
        amplifiers = await amplifiers_of(lines, far)
        for amplifier in amplifiers.values():
            await amplifier.open()
        line = amplifiers["1"].line
        far.unplug()

        for amplifier in amplifiers.values():
            with pytest.raises(LinkError) as loss:
                await read_until_lost(amplifier)
            assert str(loss.value) == line.loss
        assert "was lost" in str(line.loss)
        if wire in SERVED:  # whose server continues to listen
            reopened = await amplifiers_of(lines, far)
            for amplifier in reopened.values():
                await amplifier.open()
            assert reopened["1"].line is reopened["2"].line
            assert reopened["1"].line is not line
        else:
            with pytest.raises(LinkError, match=r"cannot be opened|refused"):
                await lines.amplifier(far.url(1), LIMITS, name="a")


async def test_ports_are_for_one_program_alone() -> None:
    """A second host of a terminal is rejected, and so is a second user of an address."""
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
