"""What answers lose by searching only the frequencies that a preselection keeps.

    python -m benchmarks.localization.preselection [--sets N] [--only RIG ...]

Robust felt contrast, mode phased, of random fingers at least 3 cm apart on the examples with four,
eight, twelve and sixteen ERAs, against the answer that searches every frequency.
"""

import argparse
from dataclasses import replace
from itertools import chain
from typing import TYPE_CHECKING

from benchmarks.localization.many import EXAMPLES, PLATES
from benchmarks.setting import random_contacts, use_one_thread

if TYPE_CHECKING:
    from model.table.question import Question
    from model.table.table import LocalizationTable

QUIET = (1, 2, 3, 9)


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.localization.preselection",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--sets", type=int, default=60, help="for each number of quiet fingers")
    parser.add_argument("--only", nargs="+", choices=PLATES, default=PLATES, metavar="RIG")
    options = parser.parse_args()
    use_one_thread()
    import numpy as np

    from model.rig.file import load_rig
    from model.table.build import build_table
    from model.table.question import Question

    print(f"{'rig':12} {'quiet':>5} {'mean [dB]':>10} {'95 % [dB]':>10} {'most [dB]':>10}")
    for name in options.only:
        table = build_table(load_rig(EXAMPLES / f"{name}.yaml"), drive_mode="phased")
        size = (table.plate.length, table.plate.width)
        for quiet in QUIET:
            rng = np.random.default_rng(quiet)
            drawn = (random_contacts(rng, quiet + 1, size, apart=0.03) for _ in range(options.sets))
            sets = ([(x, y) for x, y in each.tolist()] for each in drawn)
            lost = list(
                chain(*(_lost(table, Question((first,), tuple(rest))) for first, *rest in sets))
            )
            mean, most = np.mean(lost), np.max(lost)
            print(f"{name:12} {quiet:5d} {mean:10.3f} {np.percentile(lost, 95):10.2f} {most:10.2f}")


def _lost(table: "LocalizationTable", question: "Question") -> list[float]:
    """Decibels of robust felt contrast that are lost; none where the level is not reached."""
    import numpy as np

    from model.table.contents import Contents
    from model.table.contents_kernel import choose_tones

    rows = np.arange(len(table.frequencies))
    ranked = Contents.of(question, table.read_fingertips(question.contacts), rows)
    each = [
        choose_tones(table, replace(ranked, is_ranked=is_ranked)) for is_ranked in (True, False)
    ]
    worst = [found.worst for found in each if found is not None]
    return [] if len(worst) < 2 else [20 * float(np.log10(worst[1] / worst[0]))]


if __name__ == "__main__":
    main()
