"""Differences between the clocks, clicks and sets of three amplifiers, for each kind of line.

    python -m benchmarks.clocks [--seeds 2] [--moments 1 30] [--only WORDS] [--firmware SECONDS]

Prints the table in the section Clocks of several amplifiers of docs/measured/figures.md, and the
clock errors in docs/reference/several-amplifiers.md. Clocks: root mean square error of a clock in
the second after each moment since arming, and the host's estimate of this error, while a finger
rests. Click: largest difference between the first and the last start in 40 clicks. Set: median time
from a touch until all amplifiers play, for three amplifiers and for a single one.

The daemon's control loop runs in virtual time. Crystals are 50 ppm off and warm up
(`draw_imperfections`). With --firmware, three processes of the firmware run on terminals in real
time, and their clocks are compared with the machine's.
"""

import argparse
import asyncio
import math
import statistics
from collections.abc import AsyncIterator, Mapping, Sequence
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass
from itertools import combinations
from typing import Any, TypeAlias

from controller.effects.layout import SurfaceLayout
from controller.effects.player import EffectPlayer
from controller.operation.plate_controller import Controller
from controller.sources.touch import Touch, TouchFrame
from drivers.host.amplifier import Amplifier
from drivers.opening import Lines
from drivers.protocol.definition import CLOCK_TURN, FEATURES, ahead, clock_at
from drivers.protocol.records import Values
from kit.clock import run_virtual
from kit.plates import make_paper_rig, small_table
from kit.wires import far_side, on_amplifiers
from model.answer.answer_report import Timing
from model.rig.rig import Rig
from registry import threads
from sim.far_ends.firmware import find_firmware, running_firmware
from sim.far_ends.wire_assignment import SimulatedWire
from sim.plant.imperfections import draw_imperfections

NAMES = ("west", "middle", "east")
SPEEDS = {"serial": 921_600, "modbus-rtu": 115_200, "slcan": 500_000, "socketcand": 500_000}


@dataclass(frozen=True)
class Arrangement:
    """Connection of three amplifiers: wire and kind of line; is_bus: whether all share a line.

    has_mark: whether the amplifiers support Mark.
    """

    wire: str
    line_kind: str
    is_bus: bool = False
    has_mark: bool = True

    def wires(self, names: tuple[str, ...], seed: int) -> Mapping[str, SimulatedWire]:
        """Return the wires by amplifier."""
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
        """Report these fingers and no others; return the time [s]."""
        touches = tuple(Touch(number, *place) for number, place in enumerate(places, start=1))
        now = threads.now()
        self.controller.cycle.deliver(TouchFrame("panel", now, touches))
        return now

    def differences(self) -> list[float]:
        """Return the present differences between the clocks of each pair of amplifiers [s]."""
        now = threads.now()
        shown = [each.clock.seconds(now) for each in self.far.bench.amplifiers.values()]
        return [math.remainder(one - other, CLOCK_TURN) for one, other in combinations(shown, 2)]


def make_rig(names: tuple[str, ...]) -> Rig:
    """Return the paper's plate with its ERAs on amplifiers with these names, in turn."""
    return on_amplifiers(make_paper_rig(12, 9), names)  # type: ignore[no-any-return]


def make_controller(rig: Rig, urls: Mapping[str, str], **more: Any) -> Controller:
    """Return a control loop in which the newest finger feels a buzz; more: for `Controller`."""
    table = small_table()
    intents, timing = EffectPlayer(SurfaceLayout()), Timing(table)
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
    async with far_side(lines.wires(names, seed), rig, imperfections=drawn) as far:
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


_JUDGED = 10  # the shortest one in this many exchanges is used


class _Readings:
    """Readings of an amplifier's clock in its statuses: time of the exchange, lead [s]."""

    def __init__(self, amplifier: Amplifier) -> None:
        self.taken: list[tuple[float, float]] = []
        self._note = amplifier.note_reply
        amplifier.note_reply = self._take  # type: ignore[method-assign]

    def _take(self, name: str, values: Values, reply: Values, sent_at: float) -> None:
        now = threads.now()
        if "clock" in reply:
            middle = clock_at((sent_at + now) / 2)
            self.taken.append((now - sent_at, ahead(reply["clock"], middle)))
        self._note(name, values, reply, sent_at)

    def lead(self) -> tuple[float, float]:
        """Return the lead of the clock and half the time of its best exchanges [s]."""
        prompt = sorted(self.taken)[: max(len(self.taken) // _JUDGED, 1)]
        return statistics.median([lead for _, lead in prompt]), prompt[-1][0] / 2


async def firmware_skew(seconds: float) -> tuple[float, float]:
    """Return the RMS error of a clock in the last half of a time, and its uncertainty [s]."""
    firmware = find_firmware(is_emulated=False)
    readings: list[_Readings] = []

    def watch(amplifiers: Mapping[str, Amplifier]) -> None:
        readings.extend(map(_Readings, amplifiers.values()))

    async with AsyncExitStack() as stack:
        urls = {
            name: await stack.enter_async_context(running_firmware(firmware, name))
            for name in NAMES
        }
        controller = make_controller(make_rig(NAMES), urls)
        controller.connected.append(watch)
        await controller.open()
        loop = asyncio.create_task(controller.cycle.run())
        await controller.arm()
        for is_judged in (False, True):
            await asyncio.sleep(seconds / 2)
            if not is_judged:
                for each_clock in readings:
                    each_clock.taken.clear()
        await controller.close()
        await loop
    leads, errors = zip(*[each.lead() for each in readings], strict=True)
    return statistics.stdev(leads), max(errors)


ARRANGEMENTS = {
    "native UART, each its own": Arrangement("serial", "native"),
    "USB high speed, each its own": Arrangement("serial", "usb-high-speed"),
    "USB full speed, each its own": Arrangement("serial", "usb-full-speed"),
    "FTDI, 1 ms, each its own": Arrangement("serial", "ftdi-low-latency"),
    "FTDI, 16 ms, each its own": Arrangement("serial", "ftdi"),
    "Modbus TCP, each its own": Arrangement("modbus-tcp", "ethernet"),
    "CAN of the board, one bus": Arrangement("socketcand", "can", is_bus=True),
    "CAN by USB, one bus": Arrangement("slcan", "can-usb", is_bus=True),
    "USB high speed, one bus": Arrangement("serial", "usb-high-speed", is_bus=True),
    "USB full speed, one bus": Arrangement("serial", "usb-full-speed", is_bus=True),
    "The same without Mark": Arrangement("serial", "usb-full-speed", is_bus=True, has_mark=False),
    "Modbus RTU, USB high speed": Arrangement("modbus-rtu", "usb-high-speed", is_bus=True),
}
_WINDOW, _STEP = 1.0, 0.05  # s
_TAPS, _HELD, _APART = 40, 0.05, 0.25  # s

Skews: TypeAlias = tuple[list[float], list[float]]
"""Differences of clocks, and their stated errors [s]."""


async def skews(lines: Arrangement, seed: int, moments: Sequence[float]) -> list[Skews]:
    """Return the differences in the second after each moment since arming."""
    found = []
    async with armed(lines, seed) as session:
        begin = threads.now()
        await asyncio.sleep(0.5)
        for moment in moments:
            session.touch((0.3, 0.4))
            await asyncio.sleep(max(0.0, begin + moment - threads.now()))
            differences, stated = list[float](), list[float]()
            while threads.now() < begin + moment + _WINDOW:
                differences += session.differences()
                stated += session.controller.group.clock_errors.values()
                await asyncio.sleep(_STEP)
            found.append((differences, stated))
            session.touch()
    return found


async def taps(lines: Arrangement, seed: int, names: tuple[str, ...]) -> list[tuple[float, float]]:
    """Return for each tap how long after the first the last amplifier starts, and after the touch.

    In seconds.
    """
    found = []
    async with armed(lines, seed, names) as session:
        await asyncio.sleep(5.0)
        for number in range(_TAPS):
            touched = session.touch((0.2 + 0.6 * number / _TAPS, 0.4))
            await asyncio.sleep(_HELD)
            if starts := _starts(session, touched):
                found.append((max(starts) - min(starts), max(starts) - touched))
            session.touch()
            await asyncio.sleep(_APART)
    return found


def _starts(session: Session, since: float) -> list[float]:
    """Return the times at which amplifiers began their present vibration [s], after a time."""
    session.far.bench.advance(threads.now())
    return [
        min(begun)
        for each in session.far.bench.amplifiers.values()
        if (
            begun := [
                voice.transition.start
                for voices in each.outputs
                for voice in voices
                if voice.transition.start >= since
            ]
        )
    ]


def _rms(values: Sequence[float]) -> float:
    return math.sqrt(statistics.mean(each**2 for each in values))


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seeds", type=int, default=4, help="runs of each arrangement")
    parser.add_argument("--moments", type=float, nargs="*", default=[1.0, 30.0, 600.0])
    parser.add_argument("--only", default="", help="arrangements with this in their name")
    parser.add_argument(
        "--firmware", type=float, metavar="SECONDS", help="instead three processes of the firmware"
    )
    options = parser.parse_args()
    if options.firmware:
        rms, uncertain = asyncio.run(firmware_skew(options.firmware))
        print(f"firmware: rms of one clock {1e6 * rms:.1f} us, known to {1e6 * uncertain:.0f} us")
        return
    heads = "".join(f"{moment:>8g} s, said" for moment in options.moments)
    print(f"{'rms of one clock [us]':<30}{heads}{'click [us]':>12}{'set [ms]':>10}{'of one':>10}")
    for name, lines in ARRANGEMENTS.items():
        if options.only not in name:
            continue
        runs = [run_virtual(skews(lines, n, options.moments)) for n in range(options.seeds)]
        row = ""
        for window in zip(*runs, strict=True):
            off, stated = ([each for run in window for each in run[n]] for n in (0, 1))
            row += f"{1e6 * _rms(off) / 2**0.5:>10.1f} /{1e6 * _rms(stated):>6.1f}"
        apart, late = zip(*run_virtual(taps(lines, 0, NAMES)), strict=True)
        _, alone = zip(*run_virtual(taps(lines, 0, NAMES[:1])), strict=True)
        row += f"{1e6 * max(apart):>12.1f}"
        row += "".join(f"{1e3 * statistics.median(each):>10.2f}" for each in (late, alone))
        print(f"{name:<30}{row}", flush=True)


if __name__ == "__main__":
    main()
