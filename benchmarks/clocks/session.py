"""A host with three amplifiers on lines as they are, in virtual time, with the daemon's own loop.

Crystals are 50 ppm off and warm up, as `draw_imperfections` has them.
"""

import asyncio
import math
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass
from itertools import combinations
from typing import Any

from benchmarks.setting import support
from controller.operation.plate_controller import Controller
from controller.sources.touch import Touch, TouchFrame
from drivers.opening import Lines
from drivers.protocol.definition import CLOCK_TURN, FEATURES
from model.answer.answer_report import Timing
from model.rig.rig import Rig
from registry import threads
from sim.far_ends.wire_assignment import SimulatedWire
from sim.plant.imperfections import draw_imperfections

_far_side: Any = support("real_wires").far_side
_on_amplifiers: Any = support("real_wires").on_amplifiers
_small_table: Any = support("plates").small_table
_paper_rig: Any = support("plates").make_paper_rig
_intents: Any = support("set_table").BuzzNewestContact
run_virtual: Any = support("virtual_lines").run_virtual

NAMES = ("west", "middle", "east")
SPEEDS = {"serial": 921_600, "modbus-rtu": 115_200, "slcan": 500_000, "socketcand": 500_000}


@dataclass(frozen=True)
class Arrangement:
    """How three amplifiers are connected: wire and kind of line; is_bus: all on one line.

    has_mark: whether they know Mark.
    """

    wire: str
    line_kind: str
    is_bus: bool = False
    has_mark: bool = True

    def wires(self, names: tuple[str, ...], seed: int) -> Mapping[str, SimulatedWire]:
        """The wires by amplifier."""
        return {
            name: SimulatedWire(
                self.wire,
                SPEEDS.get(self.wire),
                shared=True,
                line="" if self.is_bus else name,
                line_kind=self.line_kind,
                seed=seed,
            )
            for name in names
        }


@dataclass
class Session:
    """An armed host, and the far side of its lines."""

    controller: Controller
    far: Any

    def touch(self, *places: tuple[float, float]) -> float:
        """Report these fingers alone; returns the time [s]."""
        touches = tuple(Touch(number, *place) for number, place in enumerate(places, start=1))
        now = threads.now()
        self.controller.cycle.deliver(TouchFrame("panel", now, touches))
        return now

    def differences(self) -> list[float]:
        """Return by how much the clocks of each two amplifiers differ now [s]."""
        now = threads.now()
        shown = [each.clock.seconds(now) for each in self.far.bench.amplifiers.values()]
        return [math.remainder(one - other, CLOCK_TURN) for one, other in combinations(shown, 2)]


def make_rig(names: tuple[str, ...]) -> Rig:
    """The paper's plate, its ERAs on amplifiers of these names in turn."""
    return _on_amplifiers(_paper_rig(12, 9), names)  # type: ignore[no-any-return]


def make_controller(rig: Rig, urls: Mapping[str, str], **more: Any) -> Controller:
    """A control loop in which the newest finger feels a buzz; more: as a `Controller` takes."""
    table = _small_table()
    intents, timing = _intents(), Timing(table)
    return Controller(
        rig, table, lines=Lines, urls=urls, intent_source=intents, timing=timing, **more
    )


@asynccontextmanager
async def armed(
    lines: Arrangement, seed: int, names: tuple[str, ...] = NAMES
) -> AsyncIterator[Session]:
    """Open and arm a host."""
    rig = make_rig(names)
    drawn = draw_imperfections(rig, seed=seed)
    async with _far_side(lines.wires(names, seed), rig, imperfections=drawn) as far:
        far.machine.be_prompt()
        for amplifier in () if lines.has_mark else far.bench.amplifiers.values():
            amplifier.capabilities["features"] &= ~(1 << FEATURES["mark"])
        controller = make_controller(rig, far.urls)
        await controller.open()
        running = asyncio.create_task(controller.cycle.run())
        await controller.arm()
        try:
            yield Session(controller, far)
        finally:
            await controller.close()
            await running
