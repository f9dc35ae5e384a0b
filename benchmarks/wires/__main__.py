"""`make bench-wires`: time of an exchange by the drivers and by the bare library of each wire.

Writes docs/measured/wire-benchmarks.md. A wire is one entry in WIRES.
"""

import asyncio
import platform
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.page import write_parts
from benchmarks.wires.bare import bare_modbus, bare_serial
from benchmarks.wires.bare_can import bare_can, can_codec
from benchmarks.wires.bench import (
    CHANNELS,
    SESSION,
    Times,
    all_at_once,
    far_end,
    make_sets,
    ours,
    sent_apart,
)
from benchmarks.wires.stops import STOPS, stop_latencies
from benchmarks.wires.stops import WIRES as STOP_WIRES
from drivers.codec.modbus import exchanges
from drivers.codec.modbus.adu import build_adu
from drivers.codec.serial_line.exchanges import decode_request, encode_request
from drivers.codec.serial_line.frame import FrameReader, encode_frame
from drivers.guard import SafeCommandSet
from drivers.protocol.messages import (
    Achieved,
    AmplifierState,
    Apply,
    Broadcast,
    Capabilities,
    Fault,
    Feature,
    Reply,
    Request,
    Status,
)
from sim.far_ends.modbus.unit import ModbusUnit

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "measured" / "wire-benchmarks.md"
COUNT = 1500
ROUNDS = 5  # ours and bare take turns, so that both see the same machine
WIDE = Capabilities(
    *(16, 20.0, 600.0, 0.01, 1.0, 0.0001, 0.01, 1.0, 0.1, 2.0, 32, 63, 0.001, 0.1),
    features=Feature.WHOLE,
)


@dataclass(frozen=True)
class Measured:
    """A wire: options of `era sim`, and the bare library doing the same exchange.

    codec: encodes and decodes a set once; None where the library does that.
    """

    options: Sequence[str]
    bare: Callable[[str, Sequence[SafeCommandSet]], list[float]]
    library: str
    codec: Callable[[SafeCommandSet], None] | None = None


_READER = FrameReader()


def _serial_codec(safe: SafeCommandSet) -> None:
    data = encode_frame(encode_request(Apply(safe, SESSION), address=1, sequence=1))
    decode_request(_READER.feed(data)[0])


class _Accepting:
    """An amplifier that accepts every set."""

    is_answering = True

    def exchange(self, request: Request) -> Reply:
        if isinstance(request, Apply):
            return Achieved(request.command_set.token, request.command_set.commands)
        return Status(
            AmplifierState.OPERATION_ENABLED, Fault.NONE, 1, True, 25.0, 1.0, (0.0,) * CHANNELS
        )

    def broadcast(self, request: Broadcast) -> None:
        pass


_UNIT = ModbusUnit(_Accepting())


def _modbus_codec(safe: SafeCommandSet) -> None:
    exchange = exchanges.encode_request(Apply(safe, SESSION), tag=1, channels=CHANNELS)
    adu = build_adu(exchange.read, exchange.write, unit=1, transaction=1, is_rtu=False)
    answer = _UNIT.reply(adu.frame[7:])
    assert answer is not None


WIRES: Mapping[str, Measured] = {
    "serial": Measured(["--serial"], bare_serial, "pyserial", _serial_codec),
    "serial, 921 600 baud": Measured(["--serial", "--speed", "921600"], bare_serial, "pyserial"),
    "Modbus TCP": Measured(["--modbus-tcp", "0"], bare_modbus, "pymodbus", _modbus_codec),
    "Modbus RTU, 115 200 baud": Measured(
        ["--modbus-rtu", "--speed", "115200"], bare_modbus, "pymodbus"
    ),
    "CAN, socketcand": Measured(["--socketcand", "0"], bare_can, "python-can", can_codec),
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
    "| wire | median [ms] | 99th [ms] | applies/s | bare library | median [ms] | 99th [ms] "
    "| ratio | codec [sets/s, encode and decode] |",
    "|---|---|---|---|---|---|---|---|---|",
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
    machine = f"Python {platform.python_version()}, {platform.system()} {platform.machine()}"
    run = f"{COUNT} exchanges each, in {ROUNDS} alternating rounds ({machine})."
    parts = {
        "wires": "\n".join([run, "", *HEAD, *rows]),
        "stops": "\n".join([f"{STOPS} stops each ({machine}).", "", *STOP_HEAD, *stops]),
        "eight": "\n".join([*EIGHT_HEAD, *eight]),
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
            bare_times += wire.bare(url, make_sets(WIDE, COUNT // ROUNDS))
    mine, bare = Times.of(our_times), Times.of(bare_times)
    return (
        f"| {name} | {mine.median * 1e3:.2f} | {mine.p99 * 1e3:.2f} | {mine.rate:.0f} | "
        f"{wire.library} | {bare.median * 1e3:.2f} | {bare.p99 * 1e3:.2f} | "
        f"{mine.median / bare.median:.2f} | {_codec_rate(wire)} |"
    )


def _stop_row(name: str, options: Sequence[str], rig: Path) -> str:
    with far_end(rig, options) as (url,):
        times = Times.of(asyncio.run(stop_latencies(url)))
    return (
        f"| {name} | {times.median * 1e3:.2f} | {times.p99 * 1e3:.2f} | {times.maximum * 1e3:.2f} |"
    )


def _codec_rate(wire: Measured) -> str:
    if wire.codec is None:
        return ""
    (safe,) = make_sets(WIDE, 1)
    count, begin = 5000, time.perf_counter()
    for _ in range(count):
        wire.codec(safe)
    return f"{count / (time.perf_counter() - begin):.0f}"


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
            cpu = time.process_time()
            together = Times.of(asyncio.run(all_at_once(urls, EIGHT_ROUNDS)))
            cpu = time.process_time() - cpu
        with far_end(rig, options, amplifiers=8) as urls:
            apart = Times.of(asyncio.run(sent_apart(urls, EIGHT_ROUNDS)))
        rows.append(
            f"| {name} | {together.median * 1e3:.2f} | {together.p99 * 1e3:.2f} | "
            f"{cpu / EIGHT_ROUNDS * 1e3:.2f} | {apart.median * 1e3:.3f} | {apart.p99 * 1e3:.3f} |"
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
