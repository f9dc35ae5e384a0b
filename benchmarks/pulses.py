"""Short vibrations along ramps of several lengths: how much of the level arrives, and when.

    python -m benchmarks.pulses [--sets 40] [--seed 1]

The paper's plate with its default table, 40 random touches, alone and beside a finger at least 5 cm
away, on the plate without fingers' weight. Of vibrations of 20 and 40 ms, median (tenth or
ninetieth percentile, the worse) over the touches, in dB:

    lag         level of the rms over the duration, relative to the steady level
    strongest   the strongest stretch of that length, and of 10 ms, above it
    contrast    that of the whole vibration, against the loudest point of the other finger over as
                long, up to 0.1 s after the end
"""

import argparse

import numpy as np

from benchmarks.setting import RIG, use_one_thread
from model.arrays import FloatArray

DURATIONS = (0.020, 0.040)
SHARES = (1 / 8, 1 / 4, 1 / 2, 3 / 4, 1.0)  # of the duration


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.pulses", description=__doc__)
    parser.add_argument("--sets", type=int, default=40)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    use_one_thread()
    from model.finger.fingertip import fingertip_points, fingertip_weights
    from model.rig.file import load_rig
    from model.table.build import build_table
    from model.table.question import Question
    from model.transients.base_motion import ramped_pulse
    from model.transients.measures import SAMPLE_RATE, Transients

    rig = load_rig(RIG)
    table = build_table(rig)
    transients = Transients(table.in_time)
    rng = np.random.default_rng(options.seed)
    size = [rig.plate.length, rig.plate.width]
    touches: list[tuple[tuple[float, float], tuple[float, float]]] = []
    while len(touches) < options.sets:
        (x0, y0), (x1, y1) = rng.uniform(0, size, (2, 2)).tolist()
        if np.hypot(x0 - x1, y0 - y1) >= 0.05:
            touches.append(((x0, y0), (x1, y1)))

    print(f"{options.sets} touches, seed {options.seed}")
    for duration in DURATIONS:
        print(f"\n{1e3 * duration:.0f} ms")
        print("| ramp / ms | lag | strongest | in 10 ms | contrast |")
        for share in SHARES:
            rows = []
            for target, other in touches:
                question = Question((target,), (other,), drive_mode="phased")
                pattern = table.query(question)
                weights = fingertip_weights(*target, rig.plate)
                points = [fingertip_points(*each, rig.plate) for each in (target, other)]
                moved = [
                    transients.acceleration(
                        ramped_pulse(
                            pattern.excitation, table.eras, ramp=share * duration, duration=length
                        ),
                        np.concatenate(points),
                        duration=length + 0.1,
                    )
                    for length in (duration, 0.5)
                ]
                count, count_10 = round(duration * SAMPLE_RATE), round(0.01 * SAMPLE_RATE)
                at_target, at_other = np.split(moved[0], [len(points[0])], axis=1)
                steady = moved[1][round(0.3 * SAMPLE_RATE) : round(0.5 * SAMPLE_RATE)]
                whole = np.sqrt((at_target[:count] ** 2).mean(axis=0)) @ weights
                rows.append(
                    [
                        whole / (np.sqrt((steady[:, : len(points[0])] ** 2).mean(0)) @ weights),
                        (strongest(at_target, count) @ weights).max() / whole,
                        (strongest(at_target, count_10) @ weights).max() / whole,
                        whole / strongest(at_other, count).max(),
                    ]
                )
            found = 20 * np.log10(np.array(rows))
            cells = [
                f"{np.median(column):.1f} ({np.percentile(column, worse):.1f})"
                for column, worse in zip(found.T, (10, 90, 90, 10), strict=True)
            ]
            print(f"| {1e3 * share * duration:.1f} | {' | '.join(cells)} |")


def strongest(acceleration: FloatArray, count: int) -> FloatArray:
    """Rms over every stretch of a number of samples, (n, p), of acceleration (m, p) [m/s²]."""
    total = np.cumsum(np.vstack([0 * acceleration[:1], acceleration**2]), axis=0)
    return np.sqrt(np.maximum((total[count:] - total[:-count]) / count, 1e-30))


if __name__ == "__main__":
    main()
