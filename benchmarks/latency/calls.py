"""Own calls and files on the way of a touch, and what a resting finger and a stop cost.

    OPENBLAS_NUM_THREADS=1 python -m benchmarks.latency.calls [RIG ...] [--stops N]

Each rig of examples/ has a row: its amplifiers are in this process, on a line of memory each, and
their own time is not counted. A touch: from its frame to the last byte of its set, answer included,
after the first such touch. A resting finger: for two seconds, its frames coming 20 times a second.
A stop: from the request to the last amplifier's first byte.
"""

import argparse
import asyncio
import os
import sys
import time
import types
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from controller.effects.layout import SurfaceLayout, default_effects
from controller.effects.player import EffectPlayer
from controller.loop.loop import Controller
from controller.loop.observer import Observer
from controller.sources.touch import Touch, TouchFrame
from drivers.host.amplifier import Amplifier
from drivers.host.line import Line
from drivers.host.serial_wire import SerialWire
from drivers.opening import Lines
from model.rig.file import load_rig
from model.rig.rig import Rig
from model.table.table_cache import cached_table
from model.table.timing import Timing
from registry.limits import GuardLimits
from sim.amplifier.contract import Amplifier as SimulatedAmplifier
from sim.far_ends.serial_amplifiers import SerialAmplifiers

_ROOT = Path(__file__).parents[2]
_OWN = tuple(f"{_ROOT / name}{os.sep}" for name in ("controller", "drivers", "model", "registry"))
_FRAME_INTERVAL, _RESTING = 0.05, 2.0  # s
_LEVEL = 15.0  # dB SL
RIGS = ("paper_plate", "table")


class FarEnd:
    """An amplifier behind a line of memory; used [s]: the processor's time that it has taken."""

    is_blocked = False
    used = 0.0

    def __init__(self, channels: int, written: Callable[[], None]) -> None:
        self._written = written
        self._end = SerialAmplifiers({1: SimulatedAmplifier("any", channels=channels)}, self._reply)
        self.line = Line(SerialWire(0, sequence=0), self, "line")

    def write(self, data: bytes) -> None:
        """Take bytes of the host."""
        self._written()
        asyncio.get_running_loop().call_soon(self._receive, data)

    def poll(self) -> None:
        """Do nothing: all that has come was handed over."""

    def _receive(self, data: bytes) -> None:
        profile, begun = sys.getprofile(), time.process_time()
        sys.setprofile(None)
        self._end.receive(data, time.monotonic())
        sys.setprofile(profile)
        FarEnd.used += time.process_time() - begun

    def _reply(self, data: bytes) -> None:
        asyncio.get_running_loop().call_soon(self.line.received, data)


class MemoryLines(Lines):
    """A new line of memory for each amplifier; written: called with its name at each write."""

    def __init__(self, rig: Rig, written: Callable[[str], None]) -> None:
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
        far_end = FarEnd(max(wired) + 1, partial(self._written, name))
        return Amplifier(far_end.line, 1, limits, name=name, is_output=is_output)


class Count:
    """Own calls by file, while it is entered."""

    def __init__(self) -> None:
        self.calls: Counter[str] = Counter()
        self._pending: Counter[str] = Counter()

    def __enter__(self) -> "Count":
        sys.setprofile(self._count)
        return self

    def __exit__(self, *_: object) -> None:
        sys.setprofile(None)

    def written(self) -> None:
        """Count what was called until now."""
        self.calls, self._pending = self.calls + self._pending, Counter()

    def _count(self, frame: types.FrameType, event: str, _: object) -> None:
        if event == "call" and frame.f_code.co_filename.startswith(_OWN):
            self._pending[frame.f_code.co_filename] += 1


async def measure(rig: Rig, stops: int) -> list[str]:
    """Return the cells of a rig."""
    count, sent_at, played = Count(), dict[str, float](), asyncio.Event()

    def written(name: str) -> None:
        sent_at.setdefault(name, time.perf_counter())
        count.written()

    table, _ = cached_table(rig)
    controller = Controller(
        rig,
        table,
        lines=lambda: MemoryLines(rig, written),
        intent_source=EffectPlayer(SurfaceLayout(effects=default_effects(_LEVEL))),
        timing=Timing(table),
        observer=Observer(pattern_applied=lambda applied: played.set()),
        watchdog=2.0,
    )
    await controller.open()
    await controller.arm()
    running = asyncio.create_task(controller.run())
    x, y = rig.plate.length / 3, rig.plate.width / 3

    async def touch(*touches: Touch) -> None:
        controller.deliver(TouchFrame("panel", asyncio.get_running_loop().time(), touches))
        await asyncio.sleep(_FRAME_INTERVAL)

    async def rest() -> None:
        for _ in range(round(_RESTING / _FRAME_INTERVAL)):
            await touch(Touch(3, x, y))

    await touch(Touch(1, x, y))
    await touch()
    await asyncio.sleep(1.0)
    with count:
        count.calls.clear()
        played.clear()
        controller.deliver(
            TouchFrame("panel", asyncio.get_running_loop().time(), (Touch(2, x + 0.02, y),))
        )
        await played.wait()
    touched = count.calls
    await touch()
    await rest()
    begun, FarEnd.used = time.process_time(), 0.0
    await rest()
    processor = (time.process_time() - begun - FarEnd.used) / _RESTING
    count.calls.clear()
    with count:
        await rest()
    resting = count.calls.total() / _RESTING
    times = []
    for _ in range(stops):
        await controller.arm()
        await touch(Touch(3, x, y))
        sent_at.clear()
        begun = time.perf_counter()
        await controller.stop()
        times.append(1e3 * (max(sent_at.values()) - begun))
        await controller.clear()
    await controller.close()
    await running
    median, late = np.quantile(times, [0.5, 0.99])
    return [
        f"{len(rig.eras)} on {len(rig.amplifiers)}",
        f"{touched.total()}",
        f"{len(touched)}",
        f"{resting:.0f}",
        f"{100 * processor:.1f} %",
        f"{median:.2f}",
        f"{late:.2f}",
    ]


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.latency.calls", description=__doc__)
    parser.add_argument("rigs", nargs="*", default=RIGS, metavar="RIG")
    parser.add_argument("--stops", type=int, default=400)
    options = parser.parse_args()
    print("| rig | ERAs on amplifiers | touch: calls | files | resting: calls a second |", end="")
    print(" processor | stop [ms]: median | 99th |\n|---|---|---|---|---|---|---|---|")
    for name in options.rigs:
        rig = load_rig(_ROOT / "examples" / f"{name}.yaml")
        print(f"| {name} | {' | '.join(asyncio.run(measure(rig, options.stops)))} |", flush=True)


if __name__ == "__main__":
    main()
