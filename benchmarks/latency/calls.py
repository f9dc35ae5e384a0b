"""Own calls and files on the way of a touch, and own calls for a finger that rests.

Amplifiers are in this process, on a line of memory each, and not counted; time is virtual, so that
the counts do not depend on the machine. A touch: from its frame to the last byte of its set, answer
included, after the first such touch. A resting finger: for two seconds, its frames coming 20 times
a second.
"""

import asyncio
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from benchmarks.setting import support
from controller.effects.layout import SurfaceLayout, default_effects
from controller.effects.player import EffectPlayer
from controller.operation.plate_controller import Controller
from controller.play.loop import PlayReport
from controller.sources.touch import Touch, TouchFrame
from drivers.host.amplifier import Amplifier
from drivers.host.line import Line
from drivers.opening import Lines
from drivers.wires.serial_line import SerialWire
from model.answer.answer_report import Timing
from model.rig.rig import Rig
from model.rig.rig_file import load_rig
from model.table.table_file import cached_table
from registry.limits import GuardLimits
from sim.amplifier.simulated_amplifier import SimulatedAmplifier as SimulatedAmplifier
from sim.far_ends.serial_amplifiers import SerialAmplifiers

_ROOT = Path(__file__).parents[2]
_run_virtual: Any = support("virtual_lines").run_virtual
_Recorder: Any = support("courses").Recorder
_FRAME_INTERVAL, _RESTING = 0.05, 2.0  # s
_LEVEL = 15.0  # dB SL


class FarEnd:
    """An amplifier behind a line of memory."""

    is_blocked = False

    def __init__(self, channels: int, written: Callable[[], None]) -> None:
        self._written = written
        self._end = SerialAmplifiers({1: SimulatedAmplifier("any", channels=channels)}, self._reply)
        self.line = Line(SerialWire(0, sequence=0), "line")
        self.line.open(self)

    def write(self, data: bytes) -> None:
        """Take bytes of the host."""
        self._written()
        asyncio.get_running_loop().call_soon(self._receive, data)

    def poll(self) -> None:
        """Do nothing: all that has come was handed over."""

    def _receive(self, data: bytes) -> None:
        self._end.receive(data, asyncio.get_running_loop().time())

    def _reply(self, data: bytes) -> None:
        asyncio.get_running_loop().call_soon(self.line.received, data)


class MemoryLines(Lines):
    """A new line of memory for each amplifier; written: called at each write."""

    def __init__(self, rig: Rig, written: Callable[[], None]) -> None:
        super().__init__()
        self._rig = rig
        self._written = written

    async def amplifier(
        self,
        url: str,
        limits: GuardLimits,
        *,
        name: str,
        serial_number: str | None = None,
        is_output: bool | None = False,
    ) -> Amplifier:
        """Return a host's amplifier."""
        wired = [each.number for each in self._rig.wiring.values() if each.amplifier == name]
        far_end = FarEnd(max(wired) + 1, self._written)
        return Amplifier(far_end.line, 1, limits, name=name, is_output=is_output)


async def measure(rig: Rig) -> list[str]:
    """Return the cells of a rig."""
    recorder, played = _Recorder(), asyncio.Event()
    table, _ = cached_table(rig)
    controller = Controller(
        rig,
        table,
        lines=lambda before: MemoryLines(rig, recorder.written),
        intent_source=EffectPlayer(SurfaceLayout(effects=default_effects(_LEVEL))),
        timing=Timing(table),
        watchdog=2.0,
    )

    def reported(report: PlayReport) -> None:
        if report.contents:
            played.set()

    controller.cycle.observers.reported.append(reported)
    await controller.open()
    await controller.arm()
    running = asyncio.create_task(controller.cycle.run())
    x, y = rig.plate.length / 3, rig.plate.width / 3

    def deliver(*touches: Touch) -> None:
        controller.cycle.deliver(TouchFrame("panel", asyncio.get_running_loop().time(), touches))

    async def rest() -> None:
        for _ in range(round(_RESTING / _FRAME_INTERVAL)):
            deliver(Touch(3, x, y))
            await asyncio.sleep(_FRAME_INTERVAL)

    deliver(Touch(1, x, y))
    await asyncio.sleep(_FRAME_INTERVAL)
    deliver()
    await asyncio.sleep(1.0)
    with recorder:
        played.clear()
        deliver(Touch(2, x + 0.02, y))
        await played.wait()
    touched = recorder.way(is_until_written=True)
    in_drivers = sum(n for file, n in touched.calls.items() if file.startswith("drivers/"))
    await rest()
    with recorder:
        await rest()
    resting = recorder.way(is_until_written=True).calls.total() / _RESTING
    await controller.close()
    await running
    return [f"{touched.calls.total()}", f"{in_drivers}", f"{len(touched.files)}", f"{resting:.0f}"]


def table(rigs: Mapping[str, str]) -> str:
    """Measure the rigs of examples, whose names are the values; returns a table."""
    rows = [
        "| rig | touch: calls (goal 300) | of these in drivers | files (goal 22) "
        "| resting: calls a second (goal 3000) |",
        "|---|---|---|---|---|",
    ]
    for name, file in rigs.items():
        cells = _run_virtual(measure(load_rig(_ROOT / "examples" / f"{file}.yaml")))
        rows.append(f"| {' | '.join([name, *cells])} |")
    return "\n".join(rows)
