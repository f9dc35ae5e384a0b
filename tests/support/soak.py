"""Soak: the whole chain in virtual time, thousands of times, each time by another number.

python tests/support/soak.py --seeds 4000 --workers 2
python tests/support/soak.py --seed 17 --trace trace.txt         one of them again, all of it
python tests/support/soak.py --seed 17 --shrink                  what of its plan is needed
"""

import argparse
import os
import resource
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from contextlib import nullcontext
from dataclasses import replace
from itertools import islice
from multiprocessing import get_context
from pathlib import Path

for _variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_variable] = "1"  # before numpy loads

from soak_chain import Outcome, run_plan  # noqa: E402
from soak_plan import KINDS, Plan, make_plan  # noqa: E402

_AHEAD = 4  # runs that wait for a process, for each


def run_seed(seed: int, wire: str | None = None, *, short: bool = False) -> Outcome:
    """One seed, on one kind of wire where one is named."""
    return run_plan(make_plan(seed, wire, short=short))


def outcomes(
    seeds: Iterator[int],
    *,
    wire: str | None = None,
    short: bool = False,
    workers: int = 2,
    hours: float | None = None,
) -> Iterator[Outcome]:
    """Run seeds on processes of their own, until they or the virtual hours have run out."""
    virtual = 0.0
    running: set[Future[Outcome]] = set()
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        while True:
            if hours is None or virtual < 3600 * hours:
                for seed in islice(seeds, _AHEAD * workers - len(running)):
                    running.add(pool.submit(run_seed, seed, wire, short=short))
            if not running:
                return
            done, running = wait(running, return_when=FIRST_COMPLETED)
            for future in done:
                virtual += future.result().virtual
                yield future.result()


def shrink(plan: Plan) -> tuple[Plan, list[int]]:
    """Leave out of a plan that fails all without which it fails, too; and what is left of it."""
    kept = list(range(len(plan.actions)))
    size = max(1, len(kept) // 2)
    while True:
        at = 0
        while at < len(kept):
            fewer = kept[:at] + kept[at + size :]
            if run_plan(_only(plan, fewer)).violations:
                kept = fewer
            else:
                at += size
        if size == 1:
            return _only(plan, kept), kept
        size //= 2


def _only(plan: Plan, kept: Sequence[int]) -> Plan:
    return replace(plan, actions=tuple(plan.actions[number] for number in kept))


def report(found: Iterator[Outcome], *, again: str) -> int:
    """Print what comes of runs, the failed ones as they come; exit status."""
    begin = time.perf_counter()
    totals: Counter[str] = Counter()
    runs = failed = 0
    virtual = busy = 0.0
    for outcome in found:
        runs += 1
        virtual += outcome.virtual
        busy += outcome.busy
        totals.update(outcome.counts)
        if outcome.violations:
            failed += 1
            _say(f"seed {outcome.seed} failed:")
            for violation in outcome.violations:
                _say(f"    {violation}")
            _say(f"    again: {again} --seed {outcome.seed} --trace seed-{outcome.seed}.txt")
    wall = time.perf_counter() - begin
    peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
    _say(f"seeds                     {runs}")
    _say(f"virtual time              {virtual / 3600:.2f} h, of which busy {busy / 3600:.2f} h")
    for name, count in sorted(totals.items()):
        _say(f"{name:<25} {count}")
    _say(f"runs with violations      {failed}")
    _say(f"wall time                 {wall:.1f} s, {virtual / max(wall, 1e-9):.0f} times faster")
    _say(f"most memory of a process  {peak:.0f} MB")
    return 1 if failed else 0


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seeds", type=int, default=4000, help="how many")
    parser.add_argument("--first", type=int, default=0, help="the first of them")
    parser.add_argument("--hours", type=float, help="end after so many virtual hours")
    parser.add_argument("--wire", choices=tuple(KINDS), help="on this kind of wire only")
    parser.add_argument("--short", action="store_true", help="one scene each, as in make test")
    parser.add_argument("--workers", type=int, default=2, help="processes")
    parser.add_argument("--seed", type=int, help="run only this one, and print its plan's hash")
    parser.add_argument("--trace", type=Path, help="with --seed: write everything that happens")
    parser.add_argument("--shrink", action="store_true", help="with --seed: find what is needed")
    parser.add_argument("--keep", help="with --seed: only these actions of its plan, as 3,17,42")
    options = parser.parse_args()
    if options.seed is None:
        seeds = iter(range(options.first, options.first + options.seeds))
        found = outcomes(
            seeds,
            wire=options.wire,
            short=options.short,
            workers=options.workers,
            hours=options.hours,
        )
        return report(found, again=_again(options.wire, options.short))
    plan = make_plan(options.seed, options.wire, short=options.short)
    if options.keep is not None:
        plan = _only(plan, [int(number) for number in options.keep.split(",") if number])
    if options.shrink:
        plan, kept = shrink(plan)
        _say(f"needed: --keep {','.join(map(str, kept))}")
        for action in plan.actions:
            _say(f"    {str(action)[:200]}")
    opened = options.trace.open("w") if options.trace else nullcontext()
    with opened as file:
        outcome = run_plan(plan, trace=file)
    for violation in outcome.violations:
        _say(violation)
    _say(
        f"seed {outcome.seed} on {plan.wire}: {len(outcome.violations)} violations, "
        f"trace {outcome.digest}"
    )
    return 1 if outcome.violations else 0


def _again(wire: str | None, short: bool) -> str:
    """The command that runs a seed again, without it."""
    options = f" --wire {wire}" * bool(wire) + " --short" * short
    return f"{Path(sys.executable).name} tests/support/soak.py{options}"


def _say(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
