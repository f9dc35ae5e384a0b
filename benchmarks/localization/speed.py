"""How long answers take, on one thread, and how that grows.

Beside the time by the clock, in which other programs have their share, stands the processor's own
time; growth is given in the latter.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from benchmarks.localization.cases import (
    FREQUENCIES,
    contact_sets,
    paper_table,
    question_of,
)
from benchmarks.localization.contrast import Section
from benchmarks.setting import RIG
from model.arrays import FloatArray
from model.finger.grid import Grid
from model.rig.file import load_rig
from model.rig.rig import Rig
from model.table.build import build_table
from model.table.table import LocalizationTable

QUESTIONS = 400
DRIVE_MODES = ("switched", "phased")
MAX_ERAS = 8
CLOSE = 0.03  # m; ten fingers 5 cm apart hardly fit


def timed(call: Callable[[], object]) -> tuple[float, float]:
    """Seconds by the clock and of the processor."""
    started, used = time.perf_counter(), time.process_time()
    call()
    return time.perf_counter() - started, time.process_time() - used


def live_times(
    table: LocalizationTable,
    drive_mode: str,
    *,
    quiet: int,
    rng: np.random.Generator,
    questions: int = QUESTIONS,
) -> FloatArray:
    """Seconds of every answer, (questions, 2)."""
    table.prepare(drive_mode)
    apart = 0.05 if quiet < 6 else CLOSE
    times = []
    for places in contact_sets(questions, fingers=quiet + 1, rng=rng, apart=apart):
        question = question_of(places, drive_mode=drive_mode, level_db_sl=12.0)
        times.append(timed(partial(table.query, question)))
    return np.array(times)


def speed_section(seed: int) -> Section:
    """Times of queries and of building the table."""
    table = paper_table()
    rows = []
    for drive_mode in DRIVE_MODES:
        for quiet in (1, 3, 9):
            rng = np.random.default_rng([seed, 300 + quiet])
            times = live_times(table, drive_mode, quiet=quiet, rng=rng)
            rows.append(_row(f"query, {drive_mode}, {quiet} quiet", times))
    rig = load_rig(RIG)
    clock, used = timed(lambda: build_table(rig, frequencies=FREQUENCIES))
    rows.append(["table build", _readable(clock), "", _readable(used), ""])
    return Section(
        "Time on one thread: median or total, 99th percentile",
        ["", "elapsed", "99th", "processor", "99th"],
        rows,
    )


def _row(name: str, times: Sequence[tuple[float, float]] | FloatArray) -> list[str]:
    """Median and 99th percentile by the clock, and of the processor."""
    clock, used = np.array(times).T
    cells = [(np.median(each), np.percentile(each, 99)) for each in (clock, used)]
    return [name, *(_readable(value) for pair in cells for value in pair)]


def growth_section(seed: int) -> Section:
    """Times against the number of ERAs, of frequencies and of cells, the others as they are."""
    data: dict[Any, dict[str, float]] = {}
    for what, values in (
        ("ERAs", range(4, MAX_ERAS + 1)),  # fewer at corners do not support the plate
        ("frequencies", (9, 27, 54, 93, 185)),
        ("cells", (27, 108, 432, 1728)),
    ):
        for value in values:
            data[what, value] = _times_of(what, value, seed)
    names = ["build", "switched", "phased"]
    rows = [
        [f"{value} {what}", *(_readable(times[name]) for name in names)]
        for (what, value), times in data.items()
    ]
    return Section(
        "Growth: one quiet finger, medians, processor time",
        ["", "table build", "query, switched", "query, phased"],
        rows,
        data=data,
    )


def _times_of(what: str, value: int, seed: int) -> dict[str, float]:
    eras = value if what == "ERAs" else 4
    frequencies = np.linspace(40.0, 500.0, value if what == "frequencies" else 27)
    side = int(np.sqrt((value if what == "cells" else 108) / 108 * 144) + 0.5)
    grid = Grid(side, side * 3 // 4)
    rig = _rig(eras)
    used = time.process_time()
    table = build_table(rig, frequencies=frequencies, grid=grid)
    times = {"build": time.process_time() - used}
    for drive_mode in DRIVE_MODES:
        rng = np.random.default_rng([seed, 320])
        used_for = live_times(table, drive_mode, quiet=1, rng=rng, questions=60)[:, 1]
        times[drive_mode] = float(np.median(used_for))
    return times


def _rig(eras: int) -> Rig:
    """The paper's plate on so many ERAs: its corners first, then the middles of its sides."""
    rig = load_rig(RIG)
    length, width = rig.plate.length, rig.plate.width
    places = [(0, 0), (length, width), (length, 0), (0, width)]
    places += [(length / 2, 0), (length / 2, width), (0, width / 2), (length, width / 2)]
    one = rig.eras[0]
    several = tuple(
        replace(one, name=f"E{number}", x=x, y=y) for number, (x, y) in enumerate(places[:eras])
    )
    return replace(rig, eras=several, wiring={}, amplifiers={})


def _readable(seconds: float) -> str:
    return f"{seconds:.2f} s" if seconds >= 1 else f"{1e3 * seconds:.2f} ms"
