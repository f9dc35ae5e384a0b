"""Processor time of a table and of its answers, by number of ERAs.

    python -m benchmarks.localization.many

The examples with four, eight, twelve and sixteen ERAs, 47 frequencies, mode phased: building the
table, then answers to random sets of fingers at least 3 cm apart, their median. One thread.
"""

import time
from functools import partial
from pathlib import Path

from benchmarks.setting import random_contacts, use_one_thread

EXAMPLES = Path(__file__).parents[2] / "examples"
PLATES = ("paper_plate", "eight_eras", "car_display", "table")
QUIET = (1, 9, 19)
ANSWERS = 20


def main() -> None:
    use_one_thread()
    import numpy as np

    from model.rig.file import load_rig
    from model.table.build import build_table
    from model.table.question import Question

    heading = "  ".join(f"answer, {count} quiet" for count in QUIET)
    print(f"{'rig':12} {'ERAs':>4}  {'build':>7}  {heading}")
    for name in PLATES:
        rig = load_rig(EXAMPLES / f"{name}.yaml")
        started = time.process_time()
        table = build_table(rig, drive_mode="phased")
        cells = [f"{time.process_time() - started:.2f} s"]
        draw = partial(random_contacts, size=(rig.plate.length, rig.plate.width), apart=0.03)
        for quiet in QUIET:
            rng, times = np.random.default_rng(quiet), []
            for _ in range(ANSWERS + 1):
                target, *others = [(x, y) for x, y in draw(rng, quiet + 1).tolist()]
                question = Question((target,), tuple(others))
                started = time.process_time()
                table.query(question)
                times.append(time.process_time() - started)
            cells.append(f"{1e3 * float(np.median(times[1:])):.1f} ms")  # the first prepares
        print(
            f"{name:12} {len(rig.eras):4d}  {cells[0]:>7}  "
            + "  ".join(f"{c:>15}" for c in cells[1:])
        )


if __name__ == "__main__":
    main()
