"""Promised and felt contrast on plates within the tolerances: docs/measured/promise.md.

    python -m benchmarks.promise [--cases 1,2] [--plates 60] [--first 0] [--workers 2]
    python -m benchmarks.promise PART [--sets N] [--plates N]

Without a part, it runs sessions through the complete signal chain, by case number. Each
session has its own plate, ERAs, drives and fingertips, drawn within the uncertainty of the rig.
--first is the seed of the first plate. Cases with events, which take ten times as long, use a
quarter of the plates. Control loop, serial lines and amplifiers run in virtual time, and the plate
is simulated in time under the fingers. Exits with status 1 unless 80 to 98 % of the promises are
kept, both of default and of identified rigs.

Parts: contents: by number of ERAs. clicks: without the wire. everyday: hands, force, objects and
people; --only WORD ... selects rows. weather: after a change of weather. air: with air around the
plate. levels: with gains that depend on the level. modes: both drive modes, and a finger alone.
"""

import argparse
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

from benchmarks.promise import air, clicks, contents, everyday, levels, modes, weather
from benchmarks.promise.cases import CASES
from benchmarks.promise.report import as_markdown, kept
from benchmarks.promise.session import Outcome, outcome

QUARTER = 4
"""Divisor of the number of plates for cases with events."""


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.promise",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parts = ("sessions", "contents", "clicks", "everyday", "weather", "air", "levels", "modes")
    parser.add_argument("part", nargs="?", choices=parts, default="sessions")
    parser.add_argument("--cases", help="numbers of sessions from 0; default: all")
    parser.add_argument("--first", type=int, default=0, help="seed of the first plate")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--plates", type=int, help="of each case, or of each set of fingers")
    parser.add_argument("--sets", type=int, help="of fingers")
    parser.add_argument("--only", nargs="+", default=[""], help="words in the rows of everyday")
    options = parser.parse_args()
    if options.part == "contents":
        contents.run(options.sets or 240)
    elif options.part == "clicks":
        clicks.run(options.sets or 60, options.plates or 4)
    elif options.part == "everyday":
        everyday.run(options.sets or 20, options.plates or 60, options.only)
    elif options.part == "weather":
        weather.run(options.sets or 16, options.plates or 40)
    elif options.part == "air":
        air.run(options.sets or 24, options.plates or 40)
    elif options.part == "levels":
        levels.run(options.sets or 24, options.plates or 40)
    elif options.part == "modes":
        modes.run(options.sets or 30)
    else:
        numbers = list(range(len(CASES)))
        if options.cases:
            numbers = [int(number) for number in options.cases.split(",")]
        outcomes = sessions(numbers, options.plates or 60, options.first, options.workers)
        print(as_markdown({CASES[number]: results for number, results in outcomes.items()}))
        sys.exit(not are_kept(outcomes))


def sessions(
    numbers: Sequence[int], plates: int, first: int, workers: int
) -> dict[int, list[Outcome]]:
    """Run sessions of some cases in separate processes."""
    outcomes: dict[int, list[Outcome]] = {number: [] for number in numbers}
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        jobs = []
        for number in numbers:
            count = max(1, plates // QUARTER) if CASES[number].events else plates
            for seed in range(first, first + count):
                jobs.append((number, pool.submit(outcome, number, seed)))
        for number, job in jobs:
            outcomes[number].append(job.result())
            print(".", end="", flush=True, file=sys.stderr)
    print(file=sys.stderr)
    return outcomes


def are_kept(outcomes: dict[int, list[Outcome]]) -> bool:
    """Whether 80 to 98 % of the promises of steady contents are kept."""
    by_rig: dict[bool, list[Outcome]] = {}
    for number, results in outcomes.items():
        if not CASES[number].clicks:
            by_rig.setdefault(CASES[number].is_identified, []).extend(results)
    return all(0.80 <= kept(results) <= 0.98 for results in by_rig.values())


if __name__ == "__main__":
    main()
