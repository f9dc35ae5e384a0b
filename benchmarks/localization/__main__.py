"""Contrast on the paper's plate in every drive mode, and speed.

    python -m benchmarks.localization [--sets 100] [--seed 1] [--report]

Contact sets: fingertips anywhere on the plate, at least 5 cm apart, the first ones targets, the
others quiet; 27 frequencies from 40 to 500 Hz; 20 dB SL. Each answer is judged on 200 fresh plates
within the rig's uncertainty, solved exactly with the fingers on them. Printed: the median over the
sets, in brackets the tenth percentile. With --report, docs/measured/localization-benchmarks.md and
its pictures are written as well. For an independent optimum see benchmarks.promise.
"""

import argparse
from functools import partial

from benchmarks.setting import use_one_thread


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.localization", description=__doc__)
    parser.add_argument("--sets", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--report", action="store_true")
    options = parser.parse_args()
    use_one_thread()

    from benchmarks.localization.contrast import mode_section
    from benchmarks.localization.report import write_report
    from benchmarks.localization.speed import growth_section, speed_section

    print(f"{options.sets} contact sets for each count, seed {options.seed}")
    sections = []
    for section in (
        partial(mode_section, options.sets, options.seed),
        partial(speed_section, options.seed),
        partial(growth_section, options.seed),
    ):
        sections.append(section())
        print()
        print(sections[-1].text())
    if options.report:
        write_report(sections, sets=options.sets, seed=options.seed)


if __name__ == "__main__":
    main()
