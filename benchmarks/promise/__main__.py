"""What answers give at the skin on plates that deviate, beside an independent optimum.

    python -m benchmarks.promise [--sets 200] [--seed 1] [--cases A,B,C,D,D8] [--report]

The plate is NGSolve's, with ERAs and fingertips attached by formulas of this program; the optimum
climbs the percentile that is judged. Answers come from the model's tables. Of every set of contacts
the percentile over fresh plates counts; printed are medians over the sets. With --report, the page
docs/measured/promise.md is written as well.
"""

import argparse
from concurrent.futures import ProcessPoolExecutor
from itertools import product
from multiprocessing import get_context
from pathlib import Path

from benchmarks.page import write_parts
from benchmarks.setting import use_one_thread

PAGE = Path(__file__).parents[2] / "docs" / "measured" / "promise.md"
QUIET = (1, 2, 3)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.promise", description=__doc__)
    parser.add_argument("--sets", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--cases", default="A,B,C,D,D8")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--report", action="store_true")
    options = parser.parse_args()
    use_one_thread()

    from benchmarks.promise.cases import outcomes
    from benchmarks.promise.tables import as_markdown

    keys = options.cases.split(",")
    with ProcessPoolExecutor(options.workers, mp_context=get_context("spawn")) as pool:
        jobs = {
            (key, quiet): pool.submit(outcomes, key, quiet, options.sets, options.seed)
            for key, quiet in product(keys, QUIET)
        }
        found = {which: job.result() for which, job in jobs.items()}
    text = as_markdown(found)
    print(text)
    if options.report:
        run = f"python -m benchmarks.promise --sets {options.sets} --seed {options.seed} --report"
        write_parts(PAGE, {"figures": f"Printed by `{run}`.\n\n{text}"})


if __name__ == "__main__":
    main()
