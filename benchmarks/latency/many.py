"""Latency and processor time of a set with four to sixteen ERAs on one to four amplifiers."""

import os
import sys
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.latency.programs import module
from benchmarks.latency.run import Case, Failed, Found, attempt, measure
from benchmarks.latency.touches import Work
from model.rig.file import load_rig
from model.table.file import save_table
from model.table.table_cache import cached_table

EXAMPLES = Path(__file__).parents[2] / "examples"
RIGS = ("paper_plate", "eight_eras", "car_display", "table")
DEFAULT_SECONDS = 20.0
RATE = 50.0  # Hz; of taps, about as many as there are answers of sixteen ERAs
PLACES = 100  # of taps, each asked for once before anything is measured
_UNMEASURED = 2 * PLACES  # the flood's finger may come in between

HEAD = (
    "| rig | ERAs on amplifiers | load | sets | unmatched | median | 99th | CPU | "
    "answers remembered: median | 99th | CPU | of it at rest | other load |\n"
    "|---|---|---|---|---|---|---|---|---|---|---|---|---|"
)


def measure_many(folder: Path, *, seconds: float, seed: int, rigs: tuple[str, ...]) -> None:
    """Measure the cases of these rigs and print a row of each; raises SystemExit for failures."""
    print(HEAD, flush=True)
    failed = 0
    for name in rigs:
        rig = load_rig(EXAMPLES / f"{name}.yaml")
        table, _ = cached_table(rig)
        file = folder / f"{name}.npz"
        save_table(table, file)
        shape = f"{len(rig.eras)} on {len(rig.amplifiers)}"
        for case in _cases(name, seconds, seed):
            remembering = replace(case, daemon=module("remembered"))
            found = [
                attempt(each, partial(measure, each, file, table)) for each in (case, remembering)
            ]
            failed += sum(isinstance(each, Failed) for each in found)
            cells = [name, shape, "loaded" if case.is_loaded else "idle", *_cells(found)]
            print(f"| {' | '.join(cells)} |", flush=True)
    if failed:
        sys.exit(f"no figures of {failed} measurements: leave the machine alone")


def _cases(name: str, seconds: float, seed: int) -> Iterator[Case]:
    """The cases of a rig, each for some seconds."""
    count = _UNMEASURED + max(1, round(seconds * RATE))
    work = Work("taps", count, RATE, seed, repeats_after=PLACES)
    for is_loaded in (False, True):
        yield Case(
            f"{name}{', loaded' if is_loaded else ''}",
            work,
            is_loaded,
            0.0,
            rig=EXAMPLES / f"{name}.yaml",
            unmeasured=_UNMEASURED,
        )


def _cells(found: list[Found | Failed]) -> Iterator[str]:
    """Cells of a case and of the same with answers remembered."""
    for number, one in enumerate(found):
        if isinstance(one, Failed):
            print(f"{one.case.name}: {'; then: '.join(one.why)}", file=sys.stderr)
            yield from [""] * (4 if number else 5)
            continue
        newest = one.matched.newest
        if not number:
            yield str(len(newest))
            yield str(one.matched.unmatched)
        quantiles = np.quantile(newest, [0.5, 0.99]) if len(newest) else [np.inf] * 2
        yield from (f"{1e3 * time:.2f}" for time in quantiles)
        yield f"{1e3 * one.computed / max(1, len(newest)):.2f}"
        if number:
            yield f"{1e3 * one.resting / RATE:.2f}"
    busy = [one.others for one in found if isinstance(one, Found)]
    yield f"{max(busy, default=0.0):.2f} of {os.cpu_count()}"
