"""Faults of links over every wire, with the required reaction times, in virtual time.

Times are by the amplifier's clock. Faults of the amplifiers themselves, and damaged frames, are in
tests/sim/far_ends/test_amplifiers_on_wires.py.
"""

import asyncio
import contextlib
import gc
import math
import threading
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager, nullcontext
from pathlib import Path

import pytest

from drivers.errors import DriverError, LinkDegraded
from drivers.host.amplifier import Amplifier
from drivers.playing import AmplifierLayer, AmplifierTone
from drivers.protocol.definition import HEARTBEAT, loss_detection_time
from long_form import shortly
from model.rig.rig import Rig
from real_wires import WIRES, HostedRig, rig_on_wire
from registry import threads as clock
from registry.threads import no_long_collections
from sim.far_ends.wire_assignment import SimulatedWire
from sim.faults import FaultKind, FaultWindow
from virtual_lines import in_virtual_time

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

over_every_wire = pytest.mark.parametrize("wire", shortly(WIRES, SHORT_WIRES))
at_every_speed = pytest.mark.parametrize("wire", shortly(ALL_WIRES, SHORT_WIRES))


@asynccontextmanager
async def linked(wire: str, rig: Rig, *, watchdog: float = WATCHDOG) -> AsyncIterator[HostedRig]:
    """The paper's amplifier behind a wire, armed and beaten by nobody."""
    async with rig_on_wire(rig, ALL_WIRES[wire], watchdog=watchdog) as hosted:
        await hosted.group.arm()
        yield hosted


def host_of(hosted: HostedRig) -> Amplifier:
    """The host of the only amplifier."""
    return hosted.group.amplifiers["main"]


def fault(hosted: HostedRig, kind: FaultKind, **options: object) -> None:
    """Begin a fault."""
    hosted.devices["main"].inject_fault(FaultWindow(fault=kind, **options))  # type: ignore[arg-type]


async def play(hosted: HostedRig, *levels: float) -> None:
    """Play these levels, from channel 0 on, without a ramp."""
    tones = tuple(AmplifierTone(channel, 110.0, level) for channel, level in enumerate(levels))
    await hosted.group.apply({"main": [AmplifierLayer(0, tones, 0.0)]})


async def beat_on(hosted: HostedRig) -> None:
    """Feed the watchdog as the control loop does, until that fails."""
    while True:
        await asyncio.sleep(HEARTBEAT)
        await hosted.group.beat()


async def set_after_a_heartbeat(hosted: HostedRig) -> None:
    """Send a set after a heartbeat's pause."""
    await asyncio.sleep(HEARTBEAT)
    await play(hosted, *FOUR)


async def lost(hosted: HostedRig) -> None:
    """Wait for the loss of the line."""
    async with asyncio.timeout(60):
        while host_of(hosted).line.loss is None:  # noqa: ASYNC110  it has no event
            await asyncio.sleep(0.001)


async def again(hosted: HostedRig) -> None:
    """Let it reply, or reopen, clear and arm it, with all faults over."""
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
    """From the worst moment, right after a reply: 60 ms unplugged, also without a request.

    Three heartbeats otherwise, or as many replies of the slowest wires; of a set the computed time.
    """
    async with linked(wire, coarse_rig, watchdog=2.0) as hosted:
        bound = 0.190 if wire in SLOWEST else THREE_HEARTBEATS  # 3 x 30 to 63 ms, by their bytes
        if at_work is set_after_a_heartbeat:
            bound = loss_detection_time([host_of(hosted).exchange_time("Set")])
        elif kind == "unplug":
            bound = 0.060
        for _ in range(3):
            await again(hosted)
            fault(hosted, kind)
            begun = clock.now()
            noticed = pytest.raises(LinkDegraded) if at_work is not lost else nullcontext()
            with noticed:
                await at_work(hosted)
            assert clock.now() - begun <= bound


@at_every_speed
@in_virtual_time
async def test_slow_wire_is_not_lost(wire: str, coarse_rig: Rig) -> None:
    """Sets and heartbeats that occupy the whole wire are not repeated, not one of 240."""
    async with linked(wire, coarse_rig, watchdog=2.0) as hosted:
        for number in range(60):
            await play(hosted, *(0.2 + 0.01 * (number % 2),) * 4)
            for _ in range(3):
                await hosted.group.beat()
        assert host_of(hosted).statistics.retries == 0


def in_use() -> tuple[int, int, int]:
    """Count descriptors, threads and tasks, without asyncio's idle workers."""
    gc.collect()
    threads = [one for one in threading.enumerate() if not one.name.startswith("asyncio_")]
    return len(list(Path("/dev/fd").iterdir())), len(threads), len(asyncio.all_tasks())


@over_every_wire
async def test_replugging_leaks_nothing(wire: str, coarse_rig: Rig) -> None:
    """Real ports: unplug, plug in, reopen: descriptors, threads and tasks stay constant."""
    before = (math.inf,) * 3
    async with linked(wire, coarse_rig, watchdog=2.0) as hosted:
        with no_long_collections():  # of the suite's own objects
            for number in range(10):
                fault(hosted, "unplug")
                await lost(hosted)
                hosted.devices["main"].recover()
                await hosted.reopen(within=60.0)
                if number == 2:
                    before = in_use()
            after = in_use()
        assert all(now <= then for now, then in zip(after, before, strict=True)), (before, after)
