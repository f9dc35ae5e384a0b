"""Print how far apart clocks, clicks and sets of three amplifiers are, for each kind of line.

clocks: rms of one clock, from the differences of each two, over a second from 1 s, 30 s and 10 min
after arming on, and what the host says of them then; a finger rests from 0.5 s on. click: the
longest of 40 from the first amplifier's start to the last one's. set: median from a touch until all
play, of three amplifiers and of one.
"""

import argparse
import asyncio
import math
import statistics
from collections.abc import Sequence
from typing import TypeAlias

from benchmarks.clocks.firmware import firmware_skew
from benchmarks.clocks.session import NAMES, Arrangement, Session, armed, run_virtual
from registry import threads

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
"""Differences of clocks, and errors that are stated of them [s]."""


async def skews(lines: Arrangement, seed: int, moments: Sequence[float]) -> list[Skews]:
    """Return those in a second from each moment after arming on."""
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
    """When each amplifier began to play what it plays [s]; none before a time."""
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
    """The command line."""
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
