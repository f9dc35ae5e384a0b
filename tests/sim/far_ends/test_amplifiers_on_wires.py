"""Simulated amplifiers on real wires: which wire each gets, and what they do there."""

import asyncio
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from drivers.errors import CommandRefused, LinkError
from drivers.protocol.definition import FAULTS, MESSAGES, STATES, STATUS, VERSION
from drivers.urls import ADDRESS
from drivers.wires.serial_frames import Frame, encode_frame
from model.rig.rig import Rig
from real_wires import (
    SHARED_WIRES,
    WIRES,
    after_each,
    far_side,
    layer,
    on_two_amplifiers,
    rig_on_wire,
)
from registry import threads
from sim.far_ends.wire_assignment import SimulatedWire, assign_wires, choose_lines, links_of
from sim.faults import FaultKind, FaultWindow
from virtual_lines import VirtualLoop, in_virtual_time

DEFAULTS = SimulatedWire("serial")
URLS = {
    "a": "serial:///dev/ttyUSB0?baud=115200&address=3",
    "b": "serial:///dev/ttyUSB0?address=4",
    "c": "modbus+tcp://192.168.1.7:5020/9",
    "d": "modbus+rtu:///dev/ttyS1?baud=19200#2",
    "e": "can+socketcand://localhost:29536/can0#5",
    "f": "can+slcan:///dev/ttyACM0?bitrate=500000#7",
}


def test_assign_wires_follows_the_urls() -> None:
    """Kind, port and address are those of the URL; equal lines are shared."""
    assigned = assign_wires(URLS, common=None, options=[], defaults=DEFAULTS)
    assert [(wire.kind, wire.port, wire.address) for wire in assigned.values()] == [
        ("serial", 0, 3),
        ("serial", 0, 4),
        ("modbus-tcp", 5020, 9),
        ("modbus-rtu", 0, 2),
        ("socketcand", 29536, 5),
        ("slcan", 0, 7),
    ]
    assert assigned["a"] == assigned["b"]
    assert assigned["a"].shared


def test_terminals_are_placed_where_urls_outside_dev_have_them() -> None:
    """One a line; not of a device, of a network, or where an option chooses the wire."""
    urls = {
        **URLS,
        "g": "serial:///tmp/g",
        "h": "serial:///tmp/g?address=2",
        "i": "serial:///tmp/i",
    }
    wires = assign_wires(urls, common=None, options=["i=serial"], defaults=DEFAULTS)
    assert links_of(wires) in ({"g": Path("/tmp/g")}, {"h": Path("/tmp/g")})


def test_assign_wires_prefers_own_option_to_common_to_url() -> None:
    """The result is in the order of the rig."""
    modbus = SimulatedWire("modbus-tcp", port=1502)
    assigned = assign_wires(
        URLS, common=modbus, options=["c=slcan", "a=socketcand:7"], defaults=DEFAULTS
    )
    assert list(assigned) == list(URLS)
    assert assigned["a"] == SimulatedWire("socketcand", port=7)
    assert assigned["b"] == modbus
    assert assigned["c"] == SimulatedWire("slcan")


def test_choose_lines_prefers_a_name_to_all_and_keeps_a_line_whole() -> None:
    """Amplifiers of one line have one kind, in whatever order the options come."""
    wires = assign_wires(URLS, common=None, options=[], defaults=DEFAULTS)
    chosen = choose_lines(wires, ["b=ftdi", "native"])
    assert [wire.line_kind for wire in chosen.values()] == ["ftdi", "ftdi", *["native"] * 4]
    assert chosen["a"] == chosen["b"]
    assert choose_lines(wires, []) == wires


WAITS = {"/tmp/a": 125e-6, "/dev/ttyUSB0": 1e-3, "/dev/ttyACM0": 1e-3, "/dev/ttyS0": 0.0}
"""Longest wait for a frame of USB on the way out, by the port of a URL [s] (USB 2.0, 4.4)."""
READ_STATUS = encode_frame(Frame(MESSAGES["GetStatus"].number, ADDRESS, 1, b"", VERSION))


async def delays_of_requests(port: str, rig: Rig) -> list[float]:
    """How long each of 200 requests is on its way to the first amplifier of a rig [s], sorted."""
    urls = {name: f"serial://{port}{n or ''}" for n, name in enumerate(rig.amplifiers)}
    wires = assign_wires(urls, common=None, options=[], defaults=DEFAULTS)
    arrived: list[float] = []
    async with far_side(wires, rig) as far:
        assert far.machine is not None
        far.machine.passing = (0.0, 0.0)
        after_each(far.device, lambda name, values, reply, now: arrived.append(now))
        place = far.url.removeprefix("serial://").partition("?")[0]
        open_port = await far.machine.open_port(place, lambda data: None, lambda why: None)
        sent = []
        for _ in range(200):
            await asyncio.sleep(0.0207)
            sent.append(threads.now())
            open_port.write(READ_STATUS)
        await asyncio.sleep(0.02)
    return sorted(after - before for after, before in zip(arrived, sent, strict=True))


@pytest.mark.parametrize("port", WAITS)
@in_virtual_time
async def test_line_of_several_amplifiers_delays_as_its_port_does(
    port: str, coarse_rig: Rig
) -> None:
    """Requests to one of two wait for a frame of USB and for their bits, those to one alone not."""
    late = await delays_of_requests(port, on_two_amplifiers(coarse_rig))
    bits = 10 * 12 / 921_600  # a frame without words has 12 bytes
    assert late[0] > bits
    longest = late[-10] - bits  # of all that the operating system does not stall
    assert 0.9 * WAITS[port] < longest < WAITS[port] + 100e-6
    assert (await delays_of_requests(port, coarse_rig))[-1] < 1e-6


SPEEDS = {"serial": 921_600, "modbus-rtu": 115_200, "slcan": 500_000, "socketcand": 500_000}


@pytest.fixture(params=WIRES)
def wire(request: pytest.FixtureRequest) -> SimulatedWire:
    """Each wire, in its own time where it has one."""
    found = WIRES[request.param]
    return replace(found, speed=SPEEDS.get(found.kind))


@in_virtual_time
async def test_broadcast_commit_starts_all_at_one_moment(
    coarse_rig: Rig, wire: SimulatedWire, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On one line by their own clocks, however long the simulation of each takes; not over TCP.

    And however much either has sent before.
    """
    rig_of_two = on_two_amplifiers(coarse_rig)
    async with rig_on_wire(rig_of_two, replace(wire, shared=True)) as rig:
        loop, exchange = asyncio.get_running_loop(), rig.bench.exchange
        assert isinstance(loop, VirtualLoop)

        def exchange_slowly(name: str, *request: Any, now: float) -> Any:
            loop.now += 0.002
            return exchange(name, *request, now=now)

        monkeypatch.setattr(rig.bench, "exchange", exchange_slowly)
        await rig.group.arm()
        for number in range(1, 4):
            for _ in range(number):
                await rig.group.amplifiers["east"].read_status()
            played = [layer((0, 100.0 + number, 0.1 * number))]
            await rig.group.apply({"east": played, "west": played})
            origins = [one.outputs[0][-1].began for one in rig.bench.amplifiers.values()]
            assert abs(origins[0] - origins[1]) <= (0.005 if wire.kind == "modbus-tcp" else 0.0)
        await rig.group.disarm()


@pytest.mark.parametrize("name", ["can+slcan", "can+socketcand"])
@in_virtual_time
async def test_node_that_has_restarted_is_mute_until_it_is_identified(
    coarse_rig: Rig, name: str
) -> None:
    """Its network state is lost with its supply, and heartbeats with it."""
    async with rig_on_wire(coarse_rig, WIRES[name]) as rig:
        main = rig.group.amplifiers["main"]
        rig.devices["main"].inject_fault(FaultWindow(fault="reboot", lasts=0.2))
        await asyncio.sleep(0.3)
        with pytest.raises(LinkError):
            await main.read_status()
        await main.identify()
        assert (await main.read_status())["state"] == STATES["SWITCH_ON_DISABLED"]


@pytest.mark.parametrize(
    ("kind", "fault"),
    [
        ("over_voltage", "OVER_VOLTAGE"),
        ("arc", "ARC"),
        ("over_current", "OVER_CURRENT"),
        ("channel", "CHANNEL"),
        ("over_temperature", "OVER_TEMPERATURE"),
        ("interlock", "INTERLOCK"),
        ("hang", "WATCHDOG"),
        ("nak_storm", "WATCHDOG"),
        ("reboot", "NONE"),
        ("unplug", "WATCHDOG"),
    ],
)
def test_fault_silences_and_its_amplifier_is_found_again(
    coarse_rig: Rig, wire: SimulatedWire, kind: FaultKind, fault: str
) -> None:
    """A second of it: silent in time; the host stops, and finds what has happened afterwards."""

    @in_virtual_time
    async def run() -> None:
        async with rig_on_wire(coarse_rig, wire) as rig:
            await rig.group.arm()
            await rig.group.apply({"main": [layer((0, 110.0, 1.0))]})
            await rig.beat_until(threads.now() + 0.2)
            assert rig.levels("main")[0] == 1.0
            rig.devices["main"].inject_fault(FaultWindow(fault=kind, lasts=1.0))
            with pytest.raises((CommandRefused, LinkError)):
                await rig.beat_until(threads.now() + 2.0)
            assert not rig.group.is_armed
            await asyncio.sleep(0.3)
            assert not any(rig.levels("main"))
            await asyncio.sleep(1.0)
            await rig.reopen(within=5.0)
            status = rig.group.amplifiers["main"].status
            assert status is not None
            assert status["fault"] == FAULTS[fault]
            allowed = ["FAULT", "QUICK_STOP_ACTIVE", *(["SWITCH_ON_DISABLED"] * (kind == "reboot"))]
            assert status["state"] in [STATES[each] for each in allowed]
            await rig.group.clear()
            await rig.group.arm()
            await rig.group.apply({"main": [layer((0, 110.0, 0.5))]})
            await rig.group.disarm()

    run()


@pytest.mark.parametrize("name", SHARED_WIRES)
@in_virtual_time
async def test_hung_amplifier_of_a_line_leaves_the_other_to_be_stopped(
    coarse_rig: Rig, name: str
) -> None:
    """East hangs: west is silent within 50 ms of the stop, east by its watchdog."""
    async with rig_on_wire(on_two_amplifiers(coarse_rig), SHARED_WIRES[name]) as rig:
        await rig.group.arm()
        played = [layer((0, 110.0, 0.5))]
        await rig.group.apply({"east": played, "west": played})
        rig.devices["east"].inject_fault(FaultWindow(fault="hang"))
        begin = threads.now()
        stopping = asyncio.create_task(rig.group.stop())
        await asyncio.sleep(0.05)
        assert not any(rig.levels("west"))
        assert rig.levels("east")[0] == 0.5
        stopped = await stopping
        assert stopped["west"].is_confirmed
        assert not stopped["east"].is_confirmed
        await asyncio.sleep(begin + 0.3 - threads.now())
        assert not any(rig.levels("east"))
        assert stopped["east"].may_play_until > begin


@pytest.mark.parametrize(("kind", "bits"), [("serial", 10), ("modbus-rtu", 11)])
@in_virtual_time
async def test_frames_take_their_time_on_a_slow_line(coarse_rig: Rig, kind: str, bits: int) -> None:
    """At 9600 bit/s a status of an amplifier of four channels takes as long as its bytes do.

    Request and reply have 19 words and 8 to 9 bytes more each way on a serial line.
    """
    async with rig_on_wire(coarse_rig, SimulatedWire(kind, speed=9600), watchdog=2.0) as rig:
        main = rig.group.amplifiers["main"]
        begin = threads.now()
        await main.read_status()
        words = STATUS.words + 4 + 8  # levels, tokens
        least = 2 * words * bits / 9600
        assert least < threads.now() - begin < 2 * least + 0.02
