"""How many touches feel at least the contrast that was promised to them, on plates in time.

    python -m benchmarks.promise.kept [--plates 100] [--touches 3] [--seed 1]

Every plate is drawn within the uncertainty of the paper's rig, as `era sim --seed` draws it, and
vibrates in time under fingers that load it; each touch is another set of contacts, one to three of
them quiet. Exits with status 1 unless 85 to 95 % of all touches keep the promise.
"""

import argparse
import sys
from collections import defaultdict

import numpy as np

from benchmarks.setting import RIG, random_contacts, use_one_thread

DURATION = 1.5  # s; the slowest mode has settled then


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.promise.kept", description=__doc__)
    parser.add_argument("--plates", type=int, default=100)
    parser.add_argument("--touches", type=int, default=3, help="on each plate")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    use_one_thread()

    import era_haptics as era

    rig = era.load_rig(RIG)
    table = era.table(rig, drive_mode="phased")
    size = (rig.plate.length, rig.plate.width)
    rng = np.random.default_rng(options.seed)
    margins: dict[int, list[float]] = defaultdict(list)
    for plate in range(options.plates):
        drawn = era.SolvedPlate(rig, seed=1000 * options.seed + plate)
        for touch in range(options.touches):
            target, *quiet = map(tuple, random_contacts(rng, 2 + touch % 3, size).tolist())
            pattern = era.query(table, target, quiet=quiet)
            felt = drawn.play(pattern, target, quiet=quiet, duration=DURATION).felt_contrast_db
            assert felt is not None
            assert pattern.robust_felt_contrast_db is not None
            margins[len(quiet)].append(felt - pattern.robust_felt_contrast_db)
    print(
        "quiet fingers   touches   promise kept   measured above promised / dB, median (10 %, 90 %)"
    )
    everything = [margin for each in margins.values() for margin in each]
    for name, each in [*((str(n), margins[n]) for n in sorted(margins)), ("all", everything)]:
        low, middle, high = np.percentile(each, [10, 50, 90])
        kept = np.mean(np.array(each) >= 0)
        print(f"{name:>13s} {len(each):9d} {kept:14.0%} {middle:13.1f} ({low:.1f}, {high:.1f})")
    share = np.mean(np.array(everything) >= 0)
    sys.exit(not 0.85 <= share <= 0.95)


if __name__ == "__main__":
    main()
