"""How much faster than real time the simulated plate is, on one thread, and how that grows.

    python -m benchmarks.plant [--seconds 2] [--repeats 3]

The founding paper's plate on its four ERAs, each driven by a tone that is begun anew twice a
second, two fingertips of 21 points that are sampled at the sensors' rate, all moved on by steps of
10 ms as a far end in real time does. Then one thing at a time is more or less. Times are the
thread's own, which other work lengthens least; the best of the repeats counts, and ratios are to
the first line of the same run. Exits with 1 where that is not fifty times faster than real time.
"""

import argparse
import sys
import time
from collections.abc import Callable
from dataclasses import replace

from benchmarks.plant.problem import Case
from benchmarks.setting import use_one_thread

WANTED = 50.0  # times faster than real time


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.plant", description=__doc__)
    parser.add_argument("--seconds", type=float, default=2.0)
    parser.add_argument("--repeats", type=int, default=3)
    options = parser.parse_args()
    use_one_thread()
    from benchmarks.plant.cases import Rigs, contact_times

    rigs = Rigs()

    def factor(case: Case) -> float:
        run = rigs.prepare(case)
        return max(_factor(run, options.seconds) for _ in range(options.repeats))

    base = Case()
    first = factor(base)
    print(f"{'four ERAs, two fingers':44s} {first:7.0f} times real time")
    for title, cases in (
        ("ERAs", {f"{n} ERAs": Case(eras=n) for n in (3, 8, 16)}),
        (
            "modes kept",
            {
                f"up to {2 * f:.0f} Hz: {rigs.size(f)} coordinates": Case(frequency_max=f)
                for f in (250.0, 500.0, 1000.0, 2000.0)
            },
        ),
        ("fingers that feel", {f"{n} fingers": Case(fingers=n) for n in (0, 1, 5, 10)}),
        (
            "fingers that load",
            {f"{n} fingers": Case(fingers=n, loading=True) for n in (1, 2, 5, 10)},
        ),
        ("steps", {f"{1e3 * s:g} ms": replace(base, step=s) for s in (0.001, 0.1, 1.0)}),
        (
            "one finger that loads, tapping on ten places in turn",
            {f"{n} taps a second": Case(fingers=1, loading=True, taps=n) for n in (2, 5, 10)},
        ),
        (
            "the whole bench, amplifiers and their watchdogs too",
            {
                f"{channels} channels on {n}, {rate} sets a second": Case(
                    eras=channels, amplifiers=n, commands=rate
                )
                for channels, n, rate in (
                    (4, 1, 2),
                    (4, 1, 20),
                    (4, 4, 20),
                    (8, 2, 20),
                    (16, 4, 20),
                )
            },
        ),
    ):
        print(f"\n{title}")
        for name, case in cases.items():
            found = factor(case)
            print(f"  {name:42s} {found:7.0f} times real time, {found / first:5.2f} of the first")
    print("\nwhen fingers that load the plate come")
    for name, seconds in contact_times(rigs):
        print(f"  {name:42s} {1e3 * seconds:7.2f} ms")
    print(f"\n{'at least' if first >= WANTED else 'NOT'} {WANTED:g} times faster than real time")
    return 0 if first >= WANTED else 1


def _factor(run: Callable[[float], None], seconds: float) -> float:
    used = time.thread_time()
    run(seconds)
    return seconds / (time.thread_time() - used)


if __name__ == "__main__":
    sys.exit(main())
