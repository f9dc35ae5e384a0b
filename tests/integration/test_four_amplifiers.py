"""Four amplifiers with sixteen ERAs on wires in virtual time.

Their table has one pattern, in which every ERA plays.
"""

import asyncio
import itertools
import math
from collections.abc import Mapping
from contextlib import AbstractAsyncContextManager
from dataclasses import replace
from pathlib import Path

import pytest

import model
from cases import in_turn, shortly
from drivers.host.group_states import GroupState
from kit.chain import Chain
from kit.clock import in_virtual_time
from kit.host_rules import HostTimes
from kit.set_table import SetTable
from model.fem import Mesh
from model.rig.rig_file import load_rig
from model.vibration import Tone
from sim.far_ends.wire_assignment import SimulatedWire
from sim.faults import FaultWindow

NAMES = ("a", "b", "c", "d")
BUSES = {
    "serial": SimulatedWire("serial", speed=921_600, shared=True),
    "modbus-rtu": SimulatedWire("modbus-rtu", speed=115_200),
    "slcan": SimulatedWire("slcan", speed=500_000),
}
"""Wires that all four share."""
LINES = {
    "serial": dict.fromkeys(
        NAMES, SimulatedWire("serial", speed=921_600)
    ),  # not shared: one line each
    "mixed": {
        "a": SimulatedWire("serial", speed=921_600),
        "b": SimulatedWire("modbus-rtu", speed=115_200),
        "c": SimulatedWire("slcan", speed=500_000),
        "d": SimulatedWire("modbus-tcp"),
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


def four_amplifiers(wires: Mapping[str, SimulatedWire]) -> AbstractAsyncContextManager[Chain]:
    """The example's sixteen ERAs on a coarse mesh, armed."""
    rig = load_rig(Path(model.__file__).parents[1] / "examples" / "table.yaml")
    rig = replace(rig, mesh=Mesh(8, 8, rig.plate.length, rig.plate.width))
    tones = {
        era.name: Tone(110.0, LEVEL * era.stroke, math.radians(10 * number))
        for number, era in enumerate(rig.eras)
    }
    table = SetTable(tones, rig.plate)
    # On one bus four heartbeats go one after the other, of 20 ms each over RTU.
    return Chain.armed(wires, rig, table, times=HostTimes(heartbeat=0.05 + 5 * 0.02))


def touch(four: Chain) -> None:
    """Put a finger on the panel."""
    four.is_felt = False
    four.at = {1: (0.3, 0.3)}


def levels_of_all(four: Chain) -> list[float]:
    """The level of every channel of the four amplifiers."""
    return [*itertools.chain(*four.levels().values())]


@pytest.mark.parametrize("arranged", shortly(ARRANGED, ["one bus, serial", "four lines, mixed"]))
@in_virtual_time
async def test_sixteen_channels_of_four_amplifiers_start_together(arranged: str) -> None:
    """Every channel plays its level; on one bus from one moment, on four lines within a ms."""
    async with four_amplifiers(ARRANGED[arranged]) as four:
        touch(four)
        await four.hold(0.3)
        levels = four.levels()
        assert [*levels] == [*NAMES]
        for name, channel_levels in levels.items():
            assert channel_levels == pytest.approx((LEVEL,) * 4, abs=1e-4), name
        starts = list[float]()
        for amplifier in four.far.bench.amplifiers.values():
            voices = itertools.chain(*amplifier.outputs)
            starts += [voice.transition.start for voice in voices if voice.transition.last]
        limit = 1e-9 if arranged.startswith("one bus") else MAX_SKEW
        assert max(starts) - min(starts) <= limit


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
        assert min(levels_of_all(four)) > 0
        four.host_rules.disturb()
        four.far.devices[lost].inject_fault(FaultWindow(fault="hang"))
        holding = asyncio.create_task(four.hold(0.6))
        await asyncio.sleep(OWN)
        assert four.levels()[lost] == (0,) * 4
        await asyncio.sleep(ALL - OWN)
        assert max(levels_of_all(four)) == 0
        assert four.controller.group.state is GroupState.LOST
        four.far.devices[lost].recover()
        await holding
        assert max(levels_of_all(four)) == 0
