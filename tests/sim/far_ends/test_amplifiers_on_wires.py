"""Simulated amplifiers on wires: their assignment, their reactions, and faults of links.

Links fail over every wire, with the required reaction times by the amplifier's clock, in virtual
time. A rig is also simulated in the host's own process: fingers, faults and their files.
"""

import asyncio
import contextlib
import gc
import json
import threading
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from contextlib import asynccontextmanager, nullcontext
from dataclasses import replace
from pathlib import Path

import pytest

from cases import shortly
from drivers.errors import CommandError, CommandRefused, DriverError, LinkDegraded, LinkError
from drivers.host.group import Group
from drivers.opening import Lines
from drivers.playing import AmplifierLayer, AmplifierTone
from drivers.protocol.definition import (
    HEARTBEAT,
    MESSAGES,
    STATES,
    VERSION,
    loss_detection_time,
)
from drivers.urls import ADDRESS
from drivers.wires.serial_frames import Frame, encode_frame
from kit.clock import in_virtual_time
from kit.plates import TWO_AMPLIFIERS, write_rig
from kit.wires import (
    LIMITS,
    WIRES,
    HostedRig,
    after_each,
    far_side,
    layer,
    on_two_amplifiers,
    rig_on_wire,
)
from model.rig.rig import Rig
from model.rig.rig_file import example_rig_path
from registry import threads
from registry.threads import no_long_collections
from sim.far_ends.wire_assignment import SimulatedWire, assign_wires, choose_lines, links_of
from sim.faults import FaultKind, Faults, FaultWindow, load_faults
from sim.simulation import STEP, SteppedLoop
from sim.transport.simulated_line import SimulatedLine as MemoryLine

URLS = {
    "a": "serial:///dev/ttyUSB0?baud=115200&address=3",
    "b": "serial:///dev/ttyUSB0?address=4",
    "c": "modbus+tcp://192.168.1.7:5020/9",
    "d": "modbus+rtu:///dev/ttyS1?baud=19200#2",
    "e": "can+socketcand://localhost:29536/can0#5",
    "f": "can+slcan:///dev/ttyACM0?bitrate=500000#7",
}


def assigned(
    urls: Mapping[str, str] = URLS,
    *options: str,
    common: SimulatedWire | None = None,
) -> Mapping[str, SimulatedWire]:
    """Assign wires to amplifiers by their URLs and by options."""
    return assign_wires(urls, common=common, options=options, defaults=SimulatedWire("serial"))


def test_assign_wires_follows_the_urls() -> None:
    """Kind, port and address are those of the URL; equal lines are shared.

    An own option goes before a common one, and that before the URL; in the order of the rig.
    """
    wires = assigned()
    assert [(wire.kind, wire.port, wire.address) for wire in wires.values()] == [
        ("serial", 0, 3),
        ("serial", 0, 4),
        ("modbus-tcp", 5020, 9),
        ("modbus-rtu", 0, 2),
        ("socketcand", 29536, 5),
        ("slcan", 0, 7),
    ]
    assert wires["a"] == wires["b"]
    assert wires["a"].shared
    modbus = SimulatedWire("modbus-tcp", port=1502)
    chosen = assigned(URLS, "c=slcan", "a=socketcand:7", common=modbus)
    assert list(chosen) == list(URLS)
    assert [chosen[name] for name in "abc"] == [
        *(SimulatedWire("socketcand", port=7), modbus, SimulatedWire("slcan"))
    ]


def test_terminals_are_placed_where_urls_outside_dev_have_them() -> None:
    """One for each line, but not for a device, a network, or a wire that an option selects."""
    outside_dev = {"g": "serial:///tmp/g", "h": "serial:///tmp/g?address=2", "i": "serial:///tmp/i"}
    wires = assigned(URLS | outside_dev, "i=serial")
    assert links_of(wires) in ({"g": Path("/tmp/g")}, {"h": Path("/tmp/g")})


def test_choose_lines_prefers_a_name_to_all_and_keeps_a_line_whole() -> None:
    """Amplifiers of one line have one kind, in any order of the options."""
    wires = assigned()
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
    arrived, sent = list[float](), list[float]()
    async with far_side(assigned(urls), rig) as far:
        far.machine.passing = (0.0, 0.0)
        after_each(far.device, lambda name, values, reply, now: arrived.append(now))
        place = far.url.removeprefix("serial://").partition("?")[0]
        open_port = await far.machine.open_port(place, lambda data: None, lambda why: None)
        for _ in range(200):
            await asyncio.sleep(0.0207)
            sent.append(threads.now())
            open_port.write(READ_STATUS)
        await asyncio.sleep(0.02)
    return sorted(arrival - departure for arrival, departure in zip(arrived, sent, strict=True))


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
    """Return each wire, in virtual time if it supports that."""
    wire = WIRES[request.param]
    return replace(wire, speed=SPEEDS.get(wire.kind))


@pytest.mark.parametrize("wire", ["can+slcan", "can+socketcand"], indirect=True)
@in_virtual_time
async def test_can_node_does_not_reply_after_a_restart_until_it_is_identified(
    coarse_rig: Rig, wire: SimulatedWire
) -> None:
    """A restarted node has lost its network state and its heartbeats."""
    async with rig_on_wire(coarse_rig, wire) as rig:
        main = rig.group.amplifiers["main"]
        fault(rig, "reboot", lasts=0.2)
        await asyncio.sleep(0.3)

        with pytest.raises(LinkError):
            await main.read_status()

        await main.identify()
        await main.read_status()
        assert main.status["state"] == STATES["SWITCH_ON_DISABLED"]


ROUND_TRIPS = {"&line=prompt": (0.0, 0.0), "": (28e-6, 1e-3), "&line=ftdi": (10e-3, 12e-3)}
"""Medians of an exchange without bits, 5 ms after the one before [s].

Two frames of 125 us at most and the operating system; 16 ms after an FTDI chip's last packet.
"""


@pytest.mark.parametrize("option", ROUND_TRIPS)
@in_virtual_time
async def test_line_is_that_of_its_url_and_of_usb_where_a_rig_has_several(
    option: str, tmp_path: Path
) -> None:
    """By default the delays of a high-speed USB adapter; none with `prompt`."""
    rig = write_rig(tmp_path / "rig.yaml", *TWO_AMPLIFIERS)
    lines = Lines()
    main = await lines.amplifier(f"sim://{rig}?amplifier=main{option}", LIMITS, name="main")
    await main.open()
    round_trips = []
    for _ in range(51):
        await asyncio.sleep(0.005)
        await main.read_status()
        round_trips.append(main.counts.last_round_trip)
    await lines.close()
    shortest, longest = ROUND_TRIPS[option]
    assert shortest <= sorted(round_trips)[25] <= longest


@pytest.mark.parametrize("option", ["line=usb", "line="])
async def test_url_of_an_unknown_line_is_refused(option: str) -> None:
    """An unknown line is an invalid option."""
    with pytest.raises(CommandError, match="line must be one of"):
        await Lines().amplifier(f"sim://rig.yaml?amplifier=a&{option}", LIMITS, name="a")


async def test_amplifiers_of_one_rig_share_its_simulation(tmp_path: Path) -> None:
    """URLs name the amplifiers; the control socket shows both, and ends with them."""
    rig, control = write_rig(tmp_path / "rig.yaml", *TWO_AMPLIFIERS), tmp_path / "control"
    lines = Lines()
    names = ("main", "side")
    group = Group(
        {
            name: await lines.amplifier(
                f"sim://{rig}?control={control}&amplifier={name}", LIMITS, name=name
            )
            for name in names
        },
        watchdog=2.0,
    )
    await group.open()
    await group.arm()
    played = layer((0, 110.0, 0.5), ramp=0.0)
    applied = await group.apply({name: [played] for name in names})
    await asyncio.sleep(applied.starts_at + 0.005 - threads.now())  # by clocks that are just armed
    reader, writer = await asyncio.open_unix_connection(control)
    writer.write(b'{"op": "state"}\n{"op": "inject_fault", "fault": "arc", "amplifier": "side"}\n')
    state = json.loads(await reader.readline())["amplifiers"]
    assert [state[name]["levels"] for name in names] == [[0.5, 0.0]] * 2
    assert [state[name]["state"] for name in names] == ["OPERATION_ENABLED"] * 2
    assert json.loads(await reader.readline())["ok"]
    with pytest.raises(CommandRefused):
        await group.beat()
    writer.close()
    await writer.wait_closed()
    await lines.close()
    assert not control.exists()
    assert not [task for task in asyncio.all_tasks() if "simulated plate" in task.get_name()]


@pytest.mark.parametrize(
    "url",
    [
        "sim://",
        "sim://?control=x",
        "sim:///no/such/rig.yaml",
        *(
            f"sim://{example_rig_path()}?{query}"
            for query in ("speed=2", "amplifier=aux", "seed=x")
        ),
    ],
)
async def test_invalid_url_is_refused(url: str) -> None:
    """A missing rig, an unknown option or amplifier, or a seed that is not a number."""
    with pytest.raises(CommandError, match="sim://"):
        await Lines().amplifier(url, LIMITS, name="a")


FRAME = bytes(range(40))


def test_load_faults_reads_times_units_and_amplifiers(tmp_path: Path) -> None:
    """Times are in seconds or with a unit; a named amplifier gets its own faults only."""
    (path := tmp_path / "faults.yaml").write_text(
        "seed: 7\n"
        "faults:\n"
        "  - {fault: drop, at: 2, lasts: 1500 ms, share: 20 %, toward: host}\n"
        "  - {fault: unplug, at: 5, amplifier: west}\n",
        encoding="utf-8",
    )
    file = load_faults(path, amplifiers=["east", "west"])
    east = file.of("east", begin=100.0)
    assert east.windows == [FaultWindow(fault="drop", at=2.0, lasts=1.5, share=0.2, toward="host")]
    assert len(file.of("west", begin=100.0).windows) == 2
    assert [east.now("drop", time) for time in (101.9, 102.0, 103.4, 103.5)] == [
        *(False, True, True, False)
    ]


@pytest.mark.parametrize(
    ("kind", "is_so"),
    [
        ("drop", lambda arrived: arrived == []),
        ("duplicate", lambda arrived: arrived == [(0.0, FRAME)] * 2),
        (
            "truncate",
            lambda arrived: FRAME.startswith(arrived[0][1]) and len(arrived[0][1]) < 40,
        ),
        ("incomplete_set", lambda arrived: len(arrived[0][1]) < 40),
        ("delay", lambda arrived: 0 < arrived[0][0] <= 0.1 and arrived[0][1] == FRAME),
        (
            "corrupt",
            lambda arrived: (
                1 <= (int.from_bytes(arrived[0][1]) ^ int.from_bytes(FRAME)).bit_count() <= 3
            ),
        ),
    ],
)
def test_fault_changes_frames_while_active(kind: str, is_so: "object") -> None:
    """Each kind of fault has its effect, only within its window."""
    faults = Faults([FaultWindow(fault=kind, at=1.0, lasts=1.0)], begin=10.0, seed=3)
    assert is_so(faults.pass_on(FRAME, toward="amplifier", time=11.5))
    for time in (10.5, 12.0):
        assert faults.pass_on(FRAME, toward="amplifier", time=time) == [(0.0, FRAME)]


def test_fault_hits_a_share_of_one_direction() -> None:
    """A fifth of the frames to the host; the same seed hits the same ones."""
    first, second = (
        Faults([FaultWindow(fault="drop", share=0.2, toward="host")], seed=5) for _ in range(2)
    )
    run = [bool(first.pass_on(FRAME, toward="host", time=1.0)) for _ in range(2000)]
    assert run == [bool(second.pass_on(FRAME, toward="host", time=1.0)) for _ in range(2000)]
    assert 0.17 < run.count(False) / 2000 < 0.23
    assert first.pass_on(FRAME, toward="amplifier", time=1.0)


@pytest.mark.parametrize("is_closed", [False, True])
def test_line_delivers_frames_at_its_speed_until_closed(is_closed: bool) -> None:
    """At 10 kbit/s, 40 bytes of ten bits take 40 ms; closing loses frames in flight.

    They come in pieces of at most 10 ms.
    """

    arrived: list[float] = []

    async def pass_frames() -> None:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, SteppedLoop)
        line = MemoryLine(
            lambda data, now: arrived.append(loop.time()),
            toward="host",
            faults=Faults(),
            byte_time=1e-3,
        )
        for _ in range(2):
            line.send(FRAME)
        await loop.step(0.06)
        if is_closed:
            line.close()
        await loop.step(0.1)

    with asyncio.Runner(loop_factory=SteppedLoop) as runner:
        runner.run(pass_frames())
    pieces = [0.01 * number for number in range(1, 7 if is_closed else 9)]
    assert arrived == pytest.approx(pieces, abs=STEP)


WATCHDOG = 0.25  # s
THREE_HEARTBEATS = 0.150  # s
FOUR = (0.2,) * 4  # levels
SLOW_WIRES = {
    "serial, 115 200 baud": SimulatedWire("serial", speed=115_200, unpluggable=True),
    "modbus+rtu, 115 200 baud": SimulatedWire("modbus-rtu", speed=115_200, unpluggable=True),
    "modbus+rtu, 19 200 baud": SimulatedWire("modbus-rtu", speed=19_200, unpluggable=True),
    "can+slcan, 125 kbit/s": SimulatedWire("slcan", speed=125_000, unpluggable=True),
}
ALL_WIRES = {**WIRES, **SLOW_WIRES}
SLOWEST = ("modbus+rtu, 19 200 baud", "can+slcan, 125 kbit/s")
SHORT_WIRES = ("serial", "modbus+rtu", *SLOWEST)
"""One of each family, and the slowest; `make test-long` takes the others."""

at_every_speed = pytest.mark.parametrize("wire", shortly(ALL_WIRES, SHORT_WIRES))


@asynccontextmanager
async def linked(wire: str, rig: Rig, *, watchdog: float = WATCHDOG) -> AsyncIterator[HostedRig]:
    """The paper's amplifier behind a wire, armed, without a host that feeds it."""
    async with rig_on_wire(rig, ALL_WIRES[wire], watchdog=watchdog) as hosted:
        await hosted.group.arm()
        yield hosted


def fault(hosted: HostedRig, kind: FaultKind, **options: object) -> None:
    """Begin a fault."""
    hosted.devices["main"].inject_fault(FaultWindow(fault=kind, **options))  # type: ignore[arg-type]


async def play(hosted: HostedRig, *levels: float) -> None:
    """Play these levels, from channel 0 on, without a ramp."""
    tones = tuple(AmplifierTone(channel, 110.0, level) for channel, level in enumerate(levels))
    await hosted.group.apply({"main": [AmplifierLayer(0, tones, 0.0)]})


async def beat_on(hosted: HostedRig) -> None:
    """Feed the watchdog as the control loop does, until a heartbeat fails."""
    while True:
        await asyncio.sleep(HEARTBEAT)
        await hosted.group.beat()


async def set_after_a_heartbeat(hosted: HostedRig) -> None:
    """Send a set after a heartbeat's pause."""
    await asyncio.sleep(HEARTBEAT)
    await play(hosted, *FOUR)


async def lost(hosted: HostedRig) -> None:
    """Wait for the loss of the line."""
    line = hosted.group.amplifiers["main"].line
    async with asyncio.timeout(60):
        while line.loss is None:  # noqa: ASYNC110  it has no event
            await asyncio.sleep(0.001)


async def again(hosted: HostedRig) -> None:
    """End all faults, then let it reply, or reopen, clear and arm it."""
    hosted.devices["main"].recover()
    async with asyncio.timeout(60):
        while hosted.group.is_armed and hosted.group.members.degraded:
            await asyncio.sleep(HEARTBEAT)
            with contextlib.suppress(DriverError):
                await hosted.group.beat()
        while not hosted.group.is_armed:
            await hosted.reopen(within=30.0)
            with contextlib.suppress(DriverError):  # not yet silent
                await hosted.group.clear()
                await hosted.group.arm()


@pytest.mark.parametrize(
    ("kind", "at_work"),
    [("unplug", lost), ("hang", beat_on), ("drop", beat_on), ("hang", set_after_a_heartbeat)],
    ids=["unplugged", "hung", "mute", "hung before a set"],
)
@at_every_speed
@in_virtual_time
async def test_loss_is_detected_in_time(
    wire: str,
    kind: FaultKind,
    at_work: Callable[[HostedRig], Awaitable[None]],
    coarse_rig: Rig,
) -> None:
    """From the worst moment, right after a reply; 60 ms if unplugged, even without a request.

    Three heartbeats otherwise, or as many replies of the slowest wires; of a set the computed time.
    """
    async with linked(wire, coarse_rig, watchdog=2.0) as hosted:
        bound = 0.190 if wire in SLOWEST else THREE_HEARTBEATS  # 3 x 30 to 63 ms, by their bytes
        if at_work is set_after_a_heartbeat:
            bound = loss_detection_time([hosted.group.amplifiers["main"].exchange_time("Set")])
        elif kind == "unplug":
            bound = 0.060
        for _ in range(3):
            await again(hosted)
            fault(hosted, kind)
            begun = threads.now()
            noticed = pytest.raises(LinkDegraded) if at_work is not lost else nullcontext()
            with noticed:
                await at_work(hosted)
            assert threads.now() - begun <= bound


def in_use() -> dict[str, int]:
    """Count descriptors, threads and tasks, without asyncio's idle workers."""
    gc.collect()
    threads = [thread for thread in threading.enumerate() if not thread.name.startswith("asyncio_")]
    descriptors = list(Path("/dev/fd").iterdir())
    tasks = asyncio.all_tasks()
    return {"descriptors": len(descriptors), "threads": len(threads), "tasks": len(tasks)}


@pytest.mark.parametrize("wire", shortly(WIRES, SHORT_WIRES))
async def test_replugging_leaks_nothing(wire: str, coarse_rig: Rig) -> None:
    """Real ports: unplug, plug in, reopen: descriptors, threads and tasks stay constant."""
    async with linked(wire, coarse_rig, watchdog=2.0) as hosted:
        with no_long_collections():  # of the suite's own objects
            for number in range(10):
                fault(hosted, "unplug")
                await lost(hosted)
                hosted.devices["main"].recover()
                await hosted.reopen(within=60.0)
                if number == 2:
                    earlier_use = in_use()
            later_use = in_use()
    for kind, count in later_use.items():
        assert count <= earlier_use[kind], kind
