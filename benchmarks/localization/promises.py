"""What answers promise against what exactly solved plates give, on all sets of the benchmark.

    python -m benchmarks.localization.promises [--only PLATE ...] [--plates N]

Robust felt contrast of answers, mode phased, less the tenth percentile over plates drawn within
each rig's uncertainty and solved exactly (`model.table.exact_plates`): more than 0 is promised too
much.
"""

import argparse
from collections import defaultdict
from dataclasses import replace

from benchmarks.setting import use_one_thread


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.localization.promises",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--only", nargs="+", metavar="PLATE", help="default: all four")
    parser.add_argument("--plates", type=int, default=400, help="for each set")
    options = parser.parse_args()
    use_one_thread()
    import numpy as np

    from benchmarks.contrast.data_set import data_set
    from benchmarks.contrast.score import on_held_out
    from model.table.build import build_table

    found = replace(data_set(), draws=options.plates)
    print(
        f"{'plate':12} {'quiet':>5} {'given [dB]':>11} {'least':>6} {'mean':>6} {'most':>6}  "
        "promised too much"
    )
    for name in options.only or found.plates:
        table = build_table(found.plates[name].rig, drive_mode="phased")
        rows = defaultdict(list)
        for contacts in found.plates[name].sets:
            question = contacts.question(level_db_sl=found.level_db_sl)
            pattern = table.query(question)
            promised = pattern.robust_felt_contrast_db
            if promised is None:
                raise ValueError(f"a set must have a quiet finger, got {contacts.name}")
            given, _ = on_held_out(found, table, contacts, pattern.excitation)
            rows[len(question.quiet)].append((given, promised - given))
        for quiet, row in sorted(rows.items()):
            given, excess = np.array(row).T
            print(
                f"{name:12} {quiet:5d} {np.median(given):11.1f} {excess.min():6.1f} "
                f"{excess.mean():6.1f} {excess.max():6.1f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
