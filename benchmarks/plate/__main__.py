"""The plate model compared with NGSolve: error and processor time of each, on one thread.

    python -m benchmarks.plate [--runs 5] [--report]

Measures the whole solution, up to the responses at 27 frequencies and 20 points; all settings take
turns in a process. Prints the table in the section Speed of the plate model of
docs/measured/figures.md; --report writes it there. Needs the extras group `peers`.
"""

import argparse
import sys
from pathlib import Path

from benchmarks.plate.measure import measure, report
from benchmarks.plate.programs import CASES
from benchmarks.setting import write_parts

PAGE = Path(__file__).parents[2] / "docs" / "measured" / "figures.md"


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.plate", description=__doc__)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--report", action="store_true", help=f"write {PAGE.name}")
    options = parser.parse_args()
    measured = {}
    for case in CASES:
        measured[case] = measure(case, options.runs)
        print(f"{case.name}: done", file=sys.stderr)
    text = report(measured)
    print(text)
    if options.report:
        write_parts(PAGE, {"plate": text})


if __name__ == "__main__":
    main()
