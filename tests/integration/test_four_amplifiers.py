"""Amplifiers over wires in virtual time: sixteen ERAs on four, and what full level is.

The controller and its wires are the project's own; a table that always has the same pattern, in
which every ERA plays, stands for the search.
"""

import asyncio
import math
from collections.abc import Awaitable, Callable, Mapping
from contextlib import AbstractAsyncContextManager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import model
from chain import Chain
from controller.plate_measurement import TonePlayer
from daemons import READY, daemon_at, far_end, until_state
from drivers.by_hand import actions
from drivers.errors import LinkError, LinkTimeout
from drivers.host.group import GroupState
from drivers.opening import Lines
from era_haptics.lab.conformance.contract import opened
from era_haptics.lab.witness.capture import TimeLimits
from long_form import in_turn, shortly
from model.fem import Mesh
from model.rig.rig import Rig
from model.rig.rig_file import load_rig
from model.vibration import Tone
from real_wires import WIRES, far_side
from registry import threads
from registry.limits import GuardLimits
from set_table import SetTable, make_rig
from sim.far_ends.wire_assignment import Wire
from sim.faults import FaultWindow
from virtual_lines import in_virtual_time

NAMES = ("a", "b", "c", "d")
BUSES = {
    "serial": Wire("serial", speed=921_600, shared=True),
    "modbus-rtu": Wire("modbus-rtu", speed=115_200),
    "slcan": Wire("slcan", speed=500_000),
}
"""Wires that all four share."""
LINES = {
    "serial": dict.fromkeys(NAMES, Wire("serial", speed=921_600)),  # not shared: one line each
    "mixed": {
        "a": Wire("serial", speed=921_600),
        "b": Wire("modbus-rtu", speed=115_200),
        "c": Wire("slcan", speed=500_000),
        "d": Wire("modbus-tcp"),
    },
}
"""Four wires for four amplifiers."""
ARRANGED = {
    **{f"one bus, {kind}": dict.fromkeys(NAMES, wire) for kind, wire in BUSES.items()},
    **{f"four lines, {kind}": wires for kind, wires in LINES.items()},
}
MAX_SKEW = 1e-3  # s; of several links, docs/reference/several-amplifiers.md
OWN = 0.250 + 0.010  # s; an amplifier's watchdog and its ramp
FED = 0.050 + 2 * 0.035  # s; a heartbeat later it may be fed, by a request that is sent three times
ALL = OWN + FED + 0.010 + 0.015  # s; and its reaction, and the stop of the others
LEVEL = 0.2


def four_amplifiers(wires: Mapping[str, Wire]) -> AbstractAsyncContextManager[Chain]:
    """The example's sixteen ERAs on a coarse mesh, armed."""
    rig = load_rig(Path(model.__file__).parents[1] / "examples" / "table.yaml")
    rig = replace(rig, mesh=Mesh(8, 8, rig.plate.length, rig.plate.width))
    tones = {
        era.name: Tone(110.0, LEVEL * era.stroke, math.radians(10 * number))
        for number, era in enumerate(rig.eras)
    }
    table = SetTable(tones, rig.plate)
    # On one bus four heartbeats go one after the other, of 20 ms each over RTU.
    return Chain.armed(wires, rig, table, judged={"times": TimeLimits(heartbeat=0.05 + 5 * 0.02)})


def touch(four: Chain) -> None:
    """Put a finger on the panel."""
    four.is_felt = False
    four.at = {1: (0.3, 0.3)}


def starts(four: Chain) -> list[float]:
    """When each channel began to play what it plays now [s]."""
    return [
        voice.transition.start
        for each in four.far.bench.amplifiers.values()
        for voices in each.outputs
        for voice in voices
        if voice.transition.last
    ]


@pytest.mark.parametrize("arranged", ARRANGED)
@in_virtual_time
async def test_sixteen_channels_of_four_amplifiers_start_together(arranged: str) -> None:
    """Every channel plays its level; on one bus from one moment, on four lines within a ms."""
    async with four_amplifiers(ARRANGED[arranged]) as four:
        touch(four)
        await four.hold(0.3)
        levels = four.levels()
        assert {name: len(each) for name, each in levels.items()} == dict.fromkeys(NAMES, 4)
        for each in levels.values():
            assert each == pytest.approx((LEVEL,) * 4, abs=1e-4)
        skew = max(starts(four)) - min(starts(four))
        assert skew <= (1e-9 if arranged.startswith("one bus") else MAX_SKEW)


@pytest.mark.parametrize(
    ("arranged", "lost"),
    in_turn(["one bus, serial", "four lines, mixed", "one bus, slcan"], ["a", "c"]),
)
@in_virtual_time
async def test_loss_of_one_of_four_silences_all(arranged: str, lost: str) -> None:
    """Whichever hangs is silent by its watchdog, the others once that has elapsed, and all stay so.

    Until then the others play on: a set is not renewed, and an amplifier may only be late.
    """
    async with four_amplifiers(ARRANGED[arranged]) as four:
        touch(four)
        await four.hold(0.3)
        assert all(level > 0 for each in four.levels().values() for level in each)
        four.witness.disturb()
        four.far.devices[lost].inject_fault(FaultWindow(fault="hang"))
        holding = asyncio.create_task(four.hold(0.6))
        await asyncio.sleep(OWN)
        assert not any(four.levels()[lost])
        await asyncio.sleep(ALL - OWN)
        assert not any(level for each in four.levels().values() for level in each)
        assert four.controller.group.state is GroupState.LOST
        four.far.devices[lost].recover()
        await holding
        assert not any(level for each in four.levels().values() for level in each)


@pytest.mark.parametrize("of_rig", [False, True])
@pytest.mark.parametrize("of_amplifier", [False, True])
@pytest.mark.parametrize("wire", shortly(WIRES, ["serial", "can+slcan"]))
@in_virtual_time
async def test_motion_and_output_are_not_taken_for_each_other(
    wire: str, of_amplifier: bool, of_rig: bool, coarse_rig: Rig
) -> None:
    """An amplifier opens, for touches and for measurements, where its full level is the rig's."""
    rigs = {False: coarse_rig, True: replace(coarse_rig, outputs=frozenset(coarse_rig.amplifiers))}
    rig = rigs[of_rig]
    table = SetTable({}, rig.plate)
    async with Chain.on(WIRES[wire], rig, table, plate=rigs[of_amplifier]) as chain:
        controller, player = chain.controller, TonePlayer(rig, Lines, chain.far.urls)
        if of_amplifier is of_rig:
            await controller.open()
            await controller.close()
            await player.open()
            await player.close()
            return
        for each in (controller, player):
            with pytest.raises(LinkError, match="full level must be"):
                await each.open()
            await each.close()


RIG = make_rig("a", GuardLimits(20.0, 1000.0, 1.0))
SERIAL = ["serial", "modbus+rtu", "can+slcan"]


@pytest.mark.parametrize(("boots", "openings"), [(0.8, 1), (5.0, 1), (9.0, 2)])
@in_virtual_time
async def test_daemon_reaches_it_at_the_first_opening(
    boots: float, openings: int, tmp_path: Path
) -> None:
    """Within 6 s (docs/reference/urls.md), else while the port stays open; also after a loss."""
    async with far_end(tmp_path) as far:
        assert far.machine is not None
        far.machine.boots = boots
        async with daemon_at(far, tmp_path) as bench, await bench.client() as era:
            await until_state(era, READY)
            assert [*far.machine.attempts.values()] == [openings]
            far.device.inject_fault(FaultWindow(fault="unplug"))
            await until_state(era, "COMM_LOST")
            far.device.recover()
            await until_state(era, READY)


async def _conformance(url: str) -> Any:
    async with opened(url) as client:
        return await client.hello()


@pytest.mark.parametrize("action", [actions.identify, actions.status, actions.stop, _conformance])
@pytest.mark.parametrize("wire", SERIAL)
@in_virtual_time
async def test_command_reaches_it(wire: str, action: Callable[[str], Awaitable[Any]]) -> None:
    """Each opens the port for itself; a stop is confirmed as soon as the board has started."""
    async with far_side(WIRES[wire], RIG) as far:
        assert far.machine is not None
        far.machine.boots = 5.0
        began = threads.now()
        found = await action(far.url)
        assert threads.now() - began < 7.0
        assert found.get("silence", "confirmed_silent") == "confirmed_silent"


@pytest.mark.parametrize(("wire", "told_after"), [("serial", 6.0), ("modbus+tcp", 1.5)])
@in_virtual_time
async def test_mute_amplifier_is_told_after_a_time(wire: str, told_after: float) -> None:
    """That of a board that restarts, or three attempts of 0.5 s; the error names the remedy."""
    async with far_side(WIRES[wire], RIG) as far:
        far.device.inject_fault(FaultWindow(fault="hang"))
        began = threads.now()
        with pytest.raises(LinkTimeout) as told:
            await actions.identify(far.url)
        assert threads.now() - began == pytest.approx(told_after, abs=0.6)
        assert ("restarts" in str(told.value)) is (wire == "serial")
