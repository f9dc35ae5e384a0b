"""`make bench-wires`: time of an exchange by the host and by the bare library of each wire.

Writes docs/measured/wire-benchmarks.md. A wire is one entry in WIRES.
"""

import asyncio
import platform
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.page import write_parts
from benchmarks.wires.bare import bare_can, bare_modbus, bare_serial
from benchmarks.wires.bench import (
    REFUSALS,
    Times,
    after_refusals,
    all_at_once,
    far_end,
    make_sets,
    ours,
)
from benchmarks.wires.calls import calls_of_a_set
from benchmarks.wires.stops import STOPS, stop_latencies
from benchmarks.wires.stops import WIRES as STOP_WIRES
from drivers.protocol.records import Values

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "measured" / "wire-benchmarks.md"
COUNT = 1500
ROUNDS = 5  # ours and bare take turns, so that both see the same machine


@dataclass(frozen=True)
class Measured:
    """A wire: options of `era sim`, and the bare library doing the same exchange."""

    options: Sequence[str]
    bare: Callable[[str, Sequence[Values]], list[float]]
    library: str


WIRES: Mapping[str, Measured] = {
    "serial": Measured(["--serial"], bare_serial, "pyserial"),
    "serial, 921 600 baud": Measured(["--serial", "--speed", "921600"], bare_serial, "pyserial"),
    "Modbus TCP": Measured(["--modbus-tcp", "0"], bare_modbus, "pymodbus"),
    "Modbus RTU, 115 200 baud": Measured(
        ["--modbus-rtu", "--speed", "115200"], bare_modbus, "pymodbus"
    ),
    "CAN, socketcand": Measured(["--socketcand", "0"], bare_can, "python-can"),
    "CAN, slcan": Measured(["--slcan"], bare_can, "python-can"),
    "CAN, slcan, 500 kbit/s": Measured(["--slcan", "--speed", "500000"], bare_can, "python-can"),
}


EIGHT: Mapping[str, Sequence[str]] = {
    "eight serial lines": ["--serial"],
    "one Modbus TCP server": ["--modbus-tcp", "0"],
    "one CAN bus, socketcand": ["--socketcand", "0"],
}
EIGHT_ROUNDS = 300


HEAD = (
    "| wire | median [ms] | 99th [ms] | sets/s | bare library | median [ms] | 99th [ms] | ratio |",
    "|---|---|---|---|---|---|---|---|",
)
STOP_HEAD = (
    "| wire | median [ms] | 99th [ms] | maximum [ms] |",
    "|---|---|---|---|",
)
EIGHT_HEAD = (
    "| arrangement | median [ms] | 99th [ms] | CPU [ms] | skew of commits, median [ms] "
    "| 99th [ms] |",
    "|---|---|---|---|---|---|",
)


def main() -> None:
    """Measure every wire and write the page."""
    names = sys.argv[1:] or list(WIRES)
    with tempfile.TemporaryDirectory() as folder:
        rig = _coarse_rig(Path(folder))
        rows = [_row(name, WIRES[name], rig) for name in names]
        stops = [_stop_row(name, options, rig) for name, options in STOP_WIRES.items()]
        eight = _eight(Path(folder))
        refused = _refused(rig)
    machine = f"Python {platform.python_version()}, {platform.system()} {platform.machine()}"
    run = f"{COUNT} exchanges each, in {ROUNDS} alternating rounds ({machine})."
    parts = {
        "wires": "\n".join([run, "", *HEAD, *rows]),
        "stops": "\n".join([f"{STOPS} stops each ({machine}).", "", *STOP_HEAD, *stops]),
        "eight": "\n".join([*EIGHT_HEAD, *eight]),
        "refusals": refused,
        "calls": "\n".join(_calls()),
    }
    print("\n\n".join(parts.values()))
    write_parts(PAGE, parts)


def _row(name: str, wire: Measured, rig: Path) -> str:
    our_times: list[float] = []
    bare_times: list[float] = []
    for _ in range(ROUNDS):
        with far_end(rig, wire.options) as (url,):
            our_times += asyncio.run(ours(url, COUNT // ROUNDS))
        with far_end(rig, wire.options) as (url,):
            bare_times += wire.bare(url, make_sets(COUNT // ROUNDS))
    mine, bare = Times.of(our_times), Times.of(bare_times)
    return (
        f"| {name} | {mine.median * 1e3:.2f} | {mine.p99 * 1e3:.2f} | {mine.rate:.0f} | "
        f"{wire.library} | {bare.median * 1e3:.2f} | {bare.p99 * 1e3:.2f} | "
        f"{mine.median / bare.median:.2f} |"
    )


def _stop_row(name: str, options: Sequence[str], rig: Path) -> str:
    with far_end(rig, options) as (url,):
        times = Times.of(asyncio.run(stop_latencies(url)))
    return (
        f"| {name} | {times.median * 1e3:.2f} | {times.p99 * 1e3:.2f} | {times.maximum * 1e3:.2f} |"
    )


def _refused(rig: Path) -> str:
    """A sentence about sets before and after many that the amplifier refuses."""
    with far_end(rig, ["--serial"]) as (url,):
        before, after = map(Times.of, asyncio.run(after_refusals(url, COUNT // ROUNDS)))
    return (
        f"Serial, medians of {COUNT // ROUNDS} sets: {before.median * 1e3:.2f} ms CPU before "
        f"{REFUSALS} refusals, {after.median * 1e3:.2f} ms after them."
    )


def _calls() -> list[str]:
    """How many functions of the host one set enters, and in how many files, a row each."""
    rows = ["| amplifiers | calls | files |", "|---|---|---|"]
    for amplifiers in (1, 4):
        entered = asyncio.run(calls_of_a_set(amplifiers))
        rows.append(f"| {amplifiers} | {entered.total()} | {len(entered)} |")
    return rows


def _eight(folder: Path) -> list[str]:
    """Eight amplifiers at once behind each kind of wire, a row each."""
    rig = folder / "eight.yaml"
    text = (ROOT / "examples" / "paper_plate.yaml").read_text(encoding="utf-8")
    eras = "\n".join(
        f"  E{number}: {{at: [{number % 4 * 4} in, {number // 4 * 9} in], stiffness: 17000, "
        f"damping_ratio: 0.05, bolt_mass: 0, stroke: 100 um, amplifier: a{number}, channel: 0}}"
        for number in range(8)
    )
    amplifiers = "\n".join(f'  a{number}: {{url: "sim://"}}' for number in range(8))
    head = text[: text.index("eras:")].replace("mesh: auto", "mesh: 12x9")
    limits = text[text.index("# Limits of commands") :]
    rig.write_text(f"{head}eras:\n{eras}\namplifiers:\n{amplifiers}\n{limits}", encoding="utf-8")
    rows = []
    for name, options in EIGHT.items():
        with far_end(rig, options, amplifiers=8) as urls:
            found = asyncio.run(all_at_once(urls, EIGHT_ROUNDS))
        together, apart = Times.of(found.times), Times.of(found.skews)
        rows.append(
            f"| {name} | {together.median * 1e3:.2f} | {together.p99 * 1e3:.2f} | "
            f"{found.computed * 1e3:.2f} | {apart.median * 1e3:.3f} | {apart.p99 * 1e3:.3f} |"
        )
    return rows


def _coarse_rig(folder: Path) -> Path:
    """A rig with a coarse mesh, since the plate does not matter here."""
    text = (ROOT / "examples" / "paper_plate.yaml").read_text(encoding="utf-8")
    path = folder / "coarse.yaml"
    path.write_text(text.replace("mesh: auto", "mesh: 12x9"), encoding="utf-8")
    return path


if __name__ == "__main__":
    main()
