"""Soak: the whole chain in virtual time, thousands of times, each time by another number.

python tests/support/soak.py --seeds 4000 --long 500             short ones and long ones
python tests/support/soak.py --seed 17 --trace trace.txt         one of the long again, all of it
python tests/support/soak.py --seed 17 --short --shrink          what of a short one is needed
"""

import argparse
import math
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
_PROGRESS_INTERVAL = 250  # runs


def run_seed(seed: int, wire: str | None = None, *, short: bool = False) -> Outcome:
    """One seed, on one kind of wire where one is named."""
    return run_plan(make_plan(seed, wire, short=short))


def outcomes(
    seeds: Iterator[tuple[int, bool]],
    *,
    wire: str | None = None,
    workers: int = 2,
    hours: float = math.inf,
    minutes: float = math.inf,
) -> Iterator[tuple[Outcome, bool]]:
    """Run seeds on processes of their own, until they, virtual hours or minutes have run out.

    seeds: each with whether it is short; so are the outcomes.
    """
    virtual = 0.0
    begin = time.monotonic()
    running: dict[Future[Outcome], bool] = {}
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        while True:
            if virtual < 3600 * hours and time.monotonic() - begin < 60 * minutes:
                for seed, short in islice(seeds, _AHEAD * workers - len(running)):
                    running[pool.submit(run_seed, seed, wire, short=short)] = short
            if not running:
                return
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                virtual += future.result().virtual
                yield future.result(), running.pop(future)


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


def report(found: Iterator[tuple[Outcome, bool]], *, again: str) -> int:
    """Print what comes of runs, the failed ones as they come; exit status."""
    begin = time.perf_counter()
    totals: Counter[str] = Counter()
    runs: Counter[bool] = Counter()
    failed = 0
    virtual = busy = 0.0
    for outcome, short in found:
        runs[short] += 1
        virtual += outcome.virtual
        busy += outcome.busy
        totals.update(outcome.counts)
        if outcome.violations:
            failed += 1
            _print(f"seed {outcome.seed} failed:")
            for violation in outcome.violations:
                _print(f"    {violation}")
            one = f"--seed {outcome.seed}" + " --short" * short
            _print(f"    again: {again} {one} --trace seed-{outcome.seed}.txt")
        if sum(runs.values()) % _PROGRESS_INTERVAL == 0:
            _print(f"    {sum(runs.values())} seeds, {virtual / 3600:.1f} h, {failed} failed")
    wall = time.perf_counter() - begin
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    busy_cpu = used.ru_utime + used.ru_stime
    _print(f"seeds                     {runs[True]} short, {runs[False]} long")
    _print(f"virtual time              {virtual / 3600:.2f} h, of which busy {busy / 3600:.2f} h")
    for name, count in sorted(totals.items()):
        _print(f"{name:<25} {count}")
    _print(f"runs with violations      {failed}")
    _print(f"wall time                 {wall:.1f} s, {virtual / max(wall, 1e-9):.0f} times faster")
    _print(f"processor time            {busy_cpu:.1f} s, {virtual / busy_cpu:.0f} times faster")
    _print(f"most memory of a process  {used.ru_maxrss / 1024:.0f} MB")
    return 1 if failed else 0


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seeds", type=int, default=4000, help="how many short ones")
    parser.add_argument("--long", type=int, default=500, help="how many long ones")
    parser.add_argument("--first", type=int, default=0, help="the first of each")
    parser.add_argument("--hours", type=float, default=math.inf, help="of virtual time at most")
    parser.add_argument("--minutes", type=float, default=math.inf, help="of real time at most")
    parser.add_argument("--wire", choices=tuple(KINDS), help="on this kind of wire only")
    parser.add_argument("--short", action="store_true", help="with --seed: the short one")
    parser.add_argument("--workers", type=int, default=2, help="processes")
    parser.add_argument("--seed", type=int, help="run only this one, and print its plan's hash")
    parser.add_argument("--trace", type=Path, help="with --seed: write everything that happens")
    parser.add_argument("--shrink", action="store_true", help="with --seed: find what is needed")
    parser.add_argument("--keep", help="with --seed: only these actions of its plan, as 3,17,42")
    options = parser.parse_args()
    if options.seed is None:
        found = outcomes(
            _seeds(options.first, short=options.seeds, long=options.long),
            wire=options.wire,
            workers=options.workers,
            hours=options.hours,
            minutes=options.minutes,
        )
        return report(found, again=_again(options.wire))
    plan = make_plan(options.seed, options.wire, short=options.short)
    if options.keep is not None:
        plan = _only(plan, [int(number) for number in options.keep.split(",") if number])
    if options.shrink:
        plan, kept = shrink(plan)
        _print(f"needed: --keep {','.join(map(str, kept))}")
        for action in plan.actions:
            _print(f"    {str(action)[:200]}")
    opened = options.trace.open("w") if options.trace else nullcontext()
    with opened as file:
        outcome = run_plan(plan, trace=file)
    for violation in outcome.violations:
        _print(violation)
    _print(
        f"seed {outcome.seed} on {plan.wire}: {len(outcome.violations)} violations, "
        f"trace {outcome.digest}"
    )
    return 1 if outcome.violations else 0


def _seeds(first: int, *, short: int, long: int) -> Iterator[tuple[int, bool]]:
    """So many of each, evenly mixed, and whether each is short."""
    given = 0
    for number in range(short):
        yield first + number, True
        while given * short < (number + 1) * long:
            yield first + given, False
            given += 1
    for number in range(given, long):
        yield first + number, False


def _again(wire: str | None) -> str:
    """The command that runs a seed again, without it."""
    options = f" --wire {wire}" * bool(wire)
    return f"{Path(sys.executable).name} tests/support/soak.py{options}"


def _print(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
