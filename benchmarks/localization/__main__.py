"""Contrast on the paper's plate by method, and speed.

    python -m benchmarks.localization [--sets 200] [--draws 32] [--seed 1] [--report]

Contact sets: fingertips anywhere on the plate, at least 5 cm apart, one the target, the others
quiet; 27 frequencies from 40 to 500 Hz; the target at 1 m/s² or more at full stroke. Realised:
gains wrong by 5 % and phases by 5 degrees (standard deviations, normal); of each set the median of
its draws counts. Printed: the median over the sets, in brackets the tenth percentile. With
--report, docs/measured/localization-benchmarks.md and its pictures are written as well.
"""

import argparse
from functools import partial

from benchmarks.setting import use_one_thread


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.localization", description=__doc__)
    parser.add_argument("--sets", type=int, default=200)
    parser.add_argument("--draws", type=int, default=32)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--report", action="store_true")
    options = parser.parse_args()
    use_one_thread()

    from benchmarks.localization.contrast import (
        contrast_section,
        ensemble_section,
        freedom_section,
        two_target_section,
    )
    from benchmarks.localization.report import write_report
    from benchmarks.localization.speed import growth_section, speed_section

    print(f"{options.sets} contact sets for each count, {options.draws} draws, seed {options.seed}")
    sections = []
    for section in (
        partial(contrast_section, options.sets, options.draws, options.seed),
        partial(two_target_section, options.sets, options.draws, options.seed),
        partial(ensemble_section, options.sets, options.seed),
        partial(freedom_section, options.sets, options.seed),
        partial(speed_section, options.seed),
        partial(growth_section, options.seed),
    ):
        sections.append(section())
        print()
        print(sections[-1].text())
    if options.report:
        write_report(sections, sets=options.sets, draws=options.draws, seed=options.seed)


if __name__ == "__main__":
    main()
