"""Soak: the whole chain in virtual time, thousands of times, each time by another number.

python tests/programs/soak.py --minutes 600                       4000 short ones and 500 long ones
python tests/programs/soak.py --seed 17 --trace trace.txt         one of the long again, all of it
"""

import argparse
import gc
import hashlib
import os
import resource
import sys
import time
from collections import Counter
from collections.abc import Iterable
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import TypeAlias

for _variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_variable] = "1"  # before numpy loads

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))
from soak_runs import KINDS, PLATES, Plan, make_plan, run_plan  # noqa: E402

_PROGRESS_INTERVAL = 250  # runs
gc.freeze()  # what is loaded stays
gc.set_threshold(100_000)  # a run leaves few cycles


Run: TypeAlias = tuple[Plan, bool, list[str], Counter[str]]
"""A plan, whether it is short, and what came of it."""


def run_seed(job: tuple[int, bool], wire: str | None = None, plate: str | None = None) -> Run:
    """Run a seed, on one kind of wire or plate if it is named."""
    seed, short = job
    plan = make_plan(seed, wire, plate, short=short)
    return plan, short, *run_plan(plan)


def report(results: Iterable[Run], *, minutes: float, again: str) -> int:
    """Print what comes of runs, the failed ones as they come, for some minutes; exit status."""
    begin = time.perf_counter()
    totals: Counter[str] = Counter()
    runs: Counter[bool] = Counter()
    failed = 0
    virtual = busy = 0.0
    for plan, short, violations, counts in results:
        runs[short] += 1
        virtual += plan.lasts
        busy += plan.busy
        totals.update(counts)
        if violations:
            failed += 1
            options = f"--seed {plan.seed}" + " --short" * short
            _print(f"seed {plan.seed} failed:", *(f"    {violation}" for violation in violations))
            _print(f"    again: {again} {options} --trace seed-{plan.seed}.txt")
        if runs.total() % _PROGRESS_INTERVAL == 0:
            _print(f"    {runs.total()} seeds, {virtual / 3600:.1f} h, {failed} failed")
        if time.perf_counter() - begin > 60 * minutes:
            break
    wall = time.perf_counter() - begin
    _print(
        f"seeds                     {runs[True]} short, {runs[False]} long",
        f"virtual time              {virtual / 3600:.2f} h, of which busy {busy / 3600:.2f} h",
        *(f"{name:<25} {count}" for name, count in sorted(totals.items())),
        f"runs with violations      {failed}",
        f"wall time                 {wall:.1f} s, {virtual / max(wall, 1e-9):.0f} times faster",
    )
    return 1 if failed else 0


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seeds", type=int, default=4000, help="how many short ones")
    parser.add_argument("--long", type=int, default=500, help="how many long ones")
    parser.add_argument("--first", type=int, default=0, help="the first of each")
    parser.add_argument("--minutes", type=float, default=20.0, help="at most, of real time")
    parser.add_argument("--wire", choices=tuple(KINDS), help="on this kind of wire only")
    parser.add_argument("--plate", choices=PLATES, help="this plate only")
    parser.add_argument("--short", action="store_true", help="with --seed: the short one")
    parser.add_argument("--workers", type=int, default=2, help="processes")
    parser.add_argument("--seed", type=int, help="run only this one, and print its plan's hash")
    parser.add_argument("--trace", type=Path, help="with --seed: write everything that happens")
    options = parser.parse_args()
    if options.seed is not None:
        return _run_one(options)
    counts = {True: options.seeds, False: options.long}
    jobs = [(number, short) for short, count in counts.items() for number in range(count)]
    jobs.sort(key=lambda job: job[0] / counts[job[1]])  # evenly mixed
    jobs = [(options.first + number, short) for number, short in jobs]
    again = "python tests/programs/soak.py" + f" --wire {options.wire}" * bool(options.wire)
    again += f" --plate {options.plate}" * bool(options.plate)
    with get_context("spawn").Pool(options.workers) as pool:
        results = pool.imap_unordered(
            partial(run_seed, wire=options.wire, plate=options.plate), jobs
        )
        status = report(results, minutes=options.minutes, again=again)
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    _print(f"processor time            {used.ru_utime + used.ru_stime:.1f} s")
    _print(f"most memory of a process  {used.ru_maxrss / 1024:.0f} MB")
    return status


def _run_one(options: argparse.Namespace) -> int:
    """Run one seed."""
    plan = make_plan(options.seed, options.wire, options.plate, short=options.short)
    trace: list[str] = []
    violations, _ = run_plan(plan, trace=trace)
    if options.trace:
        options.trace.write_text("".join(trace), encoding="utf-8")
    digest = hashlib.sha256("".join(trace).encode()).hexdigest()
    ends = f"{len(violations)} violations, trace {digest}"
    _print(*violations, f"seed {plan.seed} on {plan.wire}, {plan.plate}: {ends}")
    return 1 if violations else 0


def _print(*lines: str) -> None:
    sys.stdout.write("\n".join(lines) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
