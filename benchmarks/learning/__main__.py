"""How soon answers follow a pattern: from the end of its measurement to the table in its place.

    python -m benchmarks.learning [--patterns 100] [--report]

The estimator is the daemon's, a process of its own at a lower priority; this one takes the daemon's
place. Patterns are those of a hidden thin plate, identified at first, under two to four fingers of
unknown loads, one after the other. Not included: the two or three requests on the wire after the
window. With --report, docs/measured/learning.md is written as well.
"""

import argparse
import asyncio
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks.identification.hidden import LENGTH, WIDTH, Hidden, draw, finger_stiffness
from benchmarks.identification.plates import FREQUENCIES
from benchmarks.page import write_parts
from benchmarks.setting import RIG, random_contacts, use_one_thread
from controller.learning.estimator_process import EstimatorProcess
from controller.learning.messages import Estimate, Note, Ready, Refreshed, Start
from model.identification.forward import RestingFinger, Sensor
from model.identification.identify import identify
from model.identification.measurement import Measurement
from model.identification.settled import SettledPattern
from model.rig.file import load_rig
from model.structure.attachments import Fingertip
from model.table.build import build_table
from model.table.timing import Timing

PAGE = Path(__file__).parents[2] / "docs" / "measured" / "learning.md"
_SEED = 1
_APART = 0.5  # s; between patterns


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.learning")
    parser.add_argument("--patterns", type=int, default=100)
    parser.add_argument("--report", action="store_true")
    options = parser.parse_args()
    use_one_thread()
    with tempfile.TemporaryDirectory() as folder:
        following, placing = asyncio.run(_measured(options.patterns, Path(folder) / "learned.npz"))
    text = _table({"pattern to answers": following, "of these in the daemon's loop": placing})
    print(text)
    if options.report:
        run = f"python -m benchmarks.learning --patterns {options.patterns} --report"
        write_parts(PAGE, {"times": f"Printed by `{run}`.\n\n{text}"})


async def _measured(count: int, file: Path) -> tuple[list[float], list[float]]:
    """Times [ms] from patterns to answers in place, and of that in the process that plays."""
    hidden = draw("form", _SEED)
    written = load_rig(RIG)
    sensors = tuple(Sensor(era.name, era.name) for era in written.eras)
    values = hidden.measured(FREQUENCIES, np.random.default_rng(_SEED))
    rig = identify(written, Measurement.of(sensors, FREQUENCIES, values)).rig
    table = build_table(rig, drive_mode="phased")
    table.prepare("phased")
    timing = Timing(table)
    replies: asyncio.Queue[Ready | Estimate | Refreshed | Note] = asyncio.Queue()
    ended: list[str] = []
    process = EstimatorProcess(
        Start(rig, table, sensors, "phased", file),
        received=replies.put_nowait,
        failed=lambda reason, is_final: ended.append(reason),
    )
    running = asyncio.create_task(process.run())
    following: list[float] = []
    placing: list[float] = []
    try:
        while not isinstance(await replies.get(), Ready):
            pass
        for pattern in _patterns(hidden, table.frequencies, count):
            started_at = time.perf_counter()
            process.hand(pattern)
            while not isinstance(reply := await replies.get(), Estimate):
                pass
            arrived_at = time.perf_counter()
            if reply.answers is None:
                continue
            reply.answers.table.inherit_ringing(table)
            timing = timing.following(reply.answers.table)
            now = time.perf_counter()
            following.append(1e3 * (now - started_at))
            placing.append(1e3 * (now - arrived_at))
            await asyncio.sleep(_APART)
    finally:
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)
    if ended:
        raise SystemExit(f"estimator: {ended[0]}")
    return following, placing


def _patterns(hidden: Hidden, tones: np.ndarray, count: int) -> Iterator[SettledPattern]:
    """Patterns at random touches, read with 1 % of noise."""
    plate = hidden.mounted
    for number in range(count):
        rng = np.random.default_rng([_SEED, number])
        places = random_contacts(rng, int(rng.integers(2, 5)), (LENGTH, WIDTH), margin=0.013)
        frequency = float(rng.choice(tones))
        bases = 50e-6 * rng.uniform(0.2, 1, 4) * np.exp(2j * np.pi * rng.uniform(size=4))
        factors = np.exp(0.5 * rng.standard_normal(len(places)))
        loads = np.array([finger_stiffness(frequency, np.full(4, each)) for each in factors])
        felt = plate.accelerations(frequency, plate.at, fingers=places, loads=loads)
        values = hidden.sensor_gain * (felt @ bases)
        noise = rng.standard_normal((2, 4))
        values = values + 0.01 * np.abs(values) * (noise[0] + 1j * noise[1])
        fingers = tuple(RestingFinger(x, y, Fingertip()) for x, y in places.tolist())
        yield SettledPattern(number * 12.0, frequency, bases, values, fingers, has_phase=False)


def _table(rows: dict[str, list[float]]) -> str:
    """Percentiles of times [ms], as Markdown."""
    lines = ["| | answers | median [ms] | 90 % | 99 % | longest |", "|---|---|---|---|---|---|"]
    for name, times in rows.items():
        found = np.percentile(times, [50, 90, 99, 100])
        lines.append(f"| {name} | {len(times)} | " + " | ".join(f"{x:.1f}" for x in found) + " |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
