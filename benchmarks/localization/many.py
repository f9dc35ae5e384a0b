"""Times of a table, of its answers and of the simulated plate, by number of ERAs.

    python -m benchmarks.localization.many [--only RIG ...]

The examples with four, eight, twelve and sixteen ERAs, 47 frequencies, mode phased:

- seconds of `era table build`, of `era table show`, which uses all processors, and of `era table
  verify`, as these commands print them, with the checks that pass;
- processor time of answers to random sets of fingers at least 3 cm apart, their median;
- how much faster than real time the plate in time is, the whole bench of the paper's plate with as
  many channels on four-channel amplifiers and 20 sets a second (`benchmarks.plant`), on one thread.

The first figures need a machine that does nothing else.
"""

import argparse
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from benchmarks.plant.problem import Case
from benchmarks.setting import random_contacts, use_one_thread

if TYPE_CHECKING:
    from model.rig.rig import Rig
    from model.table.table import LocalizationTable

EXAMPLES = Path(__file__).parents[2] / "examples"
PLATES = ("paper_plate", "eight_eras", "car_display", "table")
QUIET = (1, 9, 19)
ANSWERS = 20
CHANNELS, SETS = 4, 20  # of an amplifier; a second
BENCH_SECONDS, REPEATS = 1.0, 5


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.localization.many",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--only", nargs="+", choices=PLATES, default=PLATES, metavar="RIG")
    options = parser.parse_args()
    use_one_thread()
    from model.rig.file import load_rig
    from model.table.build import build_table

    quiet = "/".join(map(str, QUIET))
    print(
        f"{'rig':12} {'ERAs':>4}  {'build':>7}  {'show':>7}  {'verify':>14}  "
        f"{f'answer, {quiet} quiet':>22}  {'plate in time':>13}"
    )
    for name in options.only:
        rig = load_rig(EXAMPLES / f"{name}.yaml")
        started = time.perf_counter()
        table = build_table(rig, drive_mode="phased")
        build = time.perf_counter() - started
        answers = " / ".join(f"{1e3 * _answer_time(table, count):.1f}" for count in QUIET)
        verify, passed = _verify(replace(table), rig)
        print(
            f"{name:12} {len(rig.eras):4d}  {build:5.2f} s  {_show(replace(table)):5.1f} s  "
            f"{verify:5.1f} s {passed:>6}  {answers:>19} ms  "
            f"{_plate_in_time(len(rig.eras)):11.0f} x",
            flush=True,
        )


def _show(table: "LocalizationTable") -> float:
    """Processor time [s] of what `era table show` computes."""
    from model.table.overview import find_overview
    from model.table.summary import summarize

    started = time.process_time()
    summarize(table, find_overview(table))
    return time.process_time() - started


def _verify(table: "LocalizationTable", rig: "Rig") -> tuple[float, str]:
    """Seconds of `era table verify`, and how many of its checks pass."""
    from model.table.verify import verify_table

    started = time.perf_counter()
    found = verify_table(table, rig)
    count = len(found.checks)
    return time.perf_counter() - started, f"{count - found.failed_count}/{count}"


def _answer_time(table: "LocalizationTable", quiet: int) -> float:
    """Median processor time [s] of answers with quiet fingers."""
    import numpy as np

    from model.table.question import Question

    size = (table.plate.length, table.plate.width)
    draw = partial(random_contacts, size=size, apart=0.03)
    rng, times = np.random.default_rng(quiet), []
    for _ in range(ANSWERS + 1):
        target, *others = [(x, y) for x, y in draw(rng, quiet + 1).tolist()]
        question = Question((target,), tuple(others))
        started = time.process_time()
        table.query(question)
        times.append(time.process_time() - started)
    return float(np.median(times[1:]))  # the first prepares


def _plate_in_time(eras: int) -> float:
    """Times real time of the whole bench, the best of some runs."""
    from benchmarks.plant.cases import Rigs

    run = Rigs().prepare(Case(eras=eras, amplifiers=eras // CHANNELS, commands=SETS))
    best = float("inf")
    for _ in range(REPEATS):
        started = time.thread_time()
        run(BENCH_SECONDS)
        best = min(best, time.thread_time() - started)
    return BENCH_SECONDS / best


if __name__ == "__main__":
    main()
