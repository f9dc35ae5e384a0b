"""Amplifiers that share a bus are stopped by one frame, in virtual time over real far ends."""

import asyncio
from collections.abc import Callable, Coroutine
from dataclasses import replace
from functools import partial
from typing import Any

import pytest

from controller.group.amplifier_group import AmplifierGroup
from drivers.amplifier import Amplifier
from drivers.protocol.messages import AmplifierState, Reply, Request, Stop
from drivers.registry import open_backend
from memory_machine import live_in_memory
from model.rig.rig import Channel, Rig
from sim.far_ends.wires import Wire
from sim.faults.fault_window import FaultWindow
from virtual_loop import run_virtual
from wires import FarSide, far_side

BUSES = {
    "serial": Wire("serial", speed=115_200, shared=True),
    "modbus+rtu": Wire("modbus-rtu", speed=115_200, shared=True),
    "can+slcan": Wire("slcan", shared=True),
}
FRAME = 0.004  # s; a broadcast stop on the slowest of these, with the silence before it
NAMES = ("first", "second", "third")


def on_a_bus(
    bus: str,
    rig: Rig,
    use: Callable[[FarSide, AmplifierGroup, list[tuple[str, float]]], Coroutine[Any, Any, None]],
) -> None:
    """Use three armed amplifiers; `use` also gets which received a Stop, and when [s]."""
    wiring = {era: Channel(NAMES[number % 3], number // 3) for number, era in enumerate(rig.wiring)}
    three = replace(rig, wiring=wiring, amplifiers=dict.fromkeys(NAMES, "sim://"))
    heard: list[tuple[str, float]] = []

    def note(
        name: str, exchange: Callable[[Request], Reply | None], request: Request
    ) -> Reply | None:
        if isinstance(request, Stop):
            heard.append((name, asyncio.get_running_loop().time()))
        return exchange(request)

    async def run() -> None:
        live_in_memory()
        async with far_side(BUSES[bus], three) as far:
            for name, device in far.devices.items():
                device.exchange = partial(note, name, device.exchange)  # type: ignore[method-assign]
            group = AmplifierGroup(
                {name: Amplifier(open_backend(url)) for name, url in far.urls.items()}
            )
            await group.open()
            await group.arm()
            await asyncio.sleep(0.02)  # the line has been silent for long
            await use(far, group, heard)
            await group.close({})

    run_virtual(run())


@pytest.mark.parametrize("bus", BUSES)
def test_stop_on_a_bus_is_not_delayed_by_a_hung_amplifier(bus: str, coarse_rig: Rig) -> None:
    """The others are stopped and latched within the duration of a frame."""

    async def use(far: FarSide, group: AmplifierGroup, heard: list[tuple[str, float]]) -> None:
        far.devices["first"].inject_fault(FaultWindow("hang"))
        begin = asyncio.get_running_loop().time()
        await group.stop()
        for name in NAMES[1:]:
            assert min(moment for who, moment in heard if who == name) - begin < FRAME
            assert far.devices[name].status().state is AmplifierState.QUICK_STOP_ACTIVE

    on_a_bus(bus, coarse_rig, use)


@pytest.mark.parametrize("lost", [None, "first"])
@pytest.mark.parametrize("bus", BUSES)
def test_stop_on_a_bus_is_one_frame_then_a_stop_of_each(
    bus: str, lost: str | None, coarse_rig: Rig
) -> None:
    """At one moment; over the link of another amplifier if one is lost."""

    async def use(far: FarSide, group: AmplifierGroup, heard: list[tuple[str, float]]) -> None:
        if lost is not None:
            await group._amplifiers[lost].close()  # as until it is opened again
        await group.stop()
        names = sorted(name for name in NAMES if name != lost)
        reached = [(name, moment) for name, moment in heard if name != lost]
        together, each = reached[: len(names)], reached[len(names) :]
        assert sorted(name for name, _ in together) == names
        assert together[-1][1] - together[0][1] < 0.001
        assert sorted(name for name, _ in each) == names

    on_a_bus(bus, coarse_rig, use)
