"""How a vibration starts and ends: abruptly, along a ramp, shaped; and what shaping takes.

    python -m benchmarks.transients [--sets 60] [--draws 16] [--seed 1] [--picture FILE.png]

On the paper's plate: random contact sets, one target and one to three quiet fingers at least 5 cm
apart, robust phased patterns at the best of 27 frequencies from 40 to 500 Hz that reach 1 m/s².
Realised: gains wrong by 5 % and phases by 5 degrees (standard deviations, normal); of each set the
median of its draws counts. Printed: the median over the sets, in brackets the tenth percentile (for
endings, where less is better, the ninetieth).
"""

import argparse
from pathlib import Path

from benchmarks.setting import RIG, use_one_thread

LOW = 150.0  # Hz; below it an ending has fewer periods in which to stop the plate


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.transients", description=__doc__)
    parser.add_argument("--sets", type=int, default=60)
    parser.add_argument("--draws", type=int, default=16)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--picture", type=Path)
    options = parser.parse_args()
    use_one_thread()
    import numpy as np

    from benchmarks.transients.bench import Bench, print_columns
    from benchmarks.transients.cases import find_cases
    from benchmarks.transients.picture import draw
    from model.rig.rig_file import load_rig

    rng = np.random.default_rng(options.seed)
    rig = load_rig(RIG)
    print(f"{options.sets} contact sets for each count, {options.draws} draws, seed {options.seed}")
    bench = Bench(rig, draws=options.draws, rng=rng)
    everything = []
    for others in (1, 2, 3):
        cases = find_cases(rig, others=others, count=options.sets, rng=rng)
        everything += [patterns[0] for patterns in cases]
        title = f"contrast of the peaks over the first 100 ms, {others} quiet, full stroke"
        print_columns(title, bench.onsets(cases), worse=10)
        if others == 1 and options.picture:
            draw(bench.plate, rig, cases, options.picture)
    for full in (True, False):
        how = "full stroke" if full else "at 20 dB SL"
        for title, chosen in (
            (f"below {LOW:g} Hz", [case for case in everything if case.frequency < LOW]),
            (f"{LOW:g} Hz and above", [case for case in everything if case.frequency >= LOW]),
        ):
            left, contrast = bench.endings(chosen, full=full)
            name = f"{title}, {len(chosen)} patterns, {how}"
            print_columns(f"left in the 100 ms after the end, {name}", left, worse=90)
            if not full:
                print_columns(f"contrast from the end on, {title}, {how}", contrast, worse=10)
    bench.clock.show()


if __name__ == "__main__":
    main()
