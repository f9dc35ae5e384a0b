"""What is promised to each finger and what it feels, over the wire, on plates that deviate.

    python -m benchmarks.promise [--plates 60] [--first 0] [--cases 1,2] [--workers 2] [--report]

Fingers anywhere on the plate, 5 cm apart, with contents of 14 dB SL; another plate, ERAs, drives
and fingertips for each set, drawn within the rig's uncertainty as by `era sim --seed`: the rig's
own (default), or one as after `era rig identify` (identified). Control loop, serial lines and
amplifiers run in virtual time, the plate in time under the fingers; contrast is the least over the
sets of thresholds by which promises hold. With --report, the page
docs/measured/promise.md is written as well. Exits with status 1 unless 80 to 98 % of the
promises are kept, of the default and of the identified rigs each.
"""

import argparse
import sys
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

from benchmarks.promise.cases import CASES
from benchmarks.promise.session import Outcome, as_markdown, kept, outcome
from benchmarks.setting import write_parts

QUARTER = 4
"""Part of the plates for cases with events, which take ten times as long."""

PAGE = Path(__file__).parents[2] / "docs" / "measured" / "promise.md"


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.promise",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--plates", type=int, default=60)
    parser.add_argument("--first", type=int, default=0, help="seed of the first plate")
    parser.add_argument("--cases", help="numbers from 0, in the order of the table; default: all")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--report", action="store_true")
    options = parser.parse_args()

    numbers = [int(n) for n in options.cases.split(",")] if options.cases else [*range(len(CASES))]
    jobs = [
        (number, options.first + plate)
        for number in numbers
        for plate in range(max(1, options.plates // (QUARTER if CASES[number].events else 1)))
    ]
    found: dict[int, list[Outcome]] = {number: [] for number in numbers}
    with ProcessPoolExecutor(options.workers, mp_context=get_context("spawn")) as pool:
        running = [(number, pool.submit(outcome, number, seed)) for number, seed in jobs]
        for number, job in running:
            found[number].append(job.result())
            print(".", end="", flush=True, file=sys.stderr)
    text = as_markdown({CASES[number]: each for number, each in found.items()})
    print(f"\n{text}")
    if options.report:
        run = f"python -m benchmarks.promise --plates {options.plates} --report"
        write_parts(PAGE, {"figures": f"Printed by `{run}`.\n\n{text}"})
    by_rig: dict[bool, list[Outcome]] = {}
    for number, each in found.items():
        if not CASES[number].clicks:
            by_rig.setdefault(CASES[number].is_identified, []).extend(each)
    sys.exit(not all(0.80 <= kept(each) <= 0.98 for each in by_rig.values()))


if __name__ == "__main__":
    main()
