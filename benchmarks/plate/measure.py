"""Errors and times of programs: processor time on one thread, all programs in turns.

The tables and the picture of docs/measured/benchmarks.md are made of them.
"""

import os
import platform
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from benchmarks.plate import programs
from benchmarks.plate.peers.ways import Direct
from benchmarks.plate.problem import (
    CAR,
    CORNERS,
    OTHERS,
    PAPER,
    PAPER_ON_FEET,
    TABLE,
    Case,
    difference,
)
from benchmarks.plate.programs import ACCURACIES, CASES, Setting, Solved, reference, settings
from benchmarks.setting import write_parts
from model.arrays import FloatArray

SLOW = 0.3  # s; a setting that takes longer is measured in the first rounds alone
SLOW_ROUNDS = 3


@dataclass
class Measured:
    """Relative L2 errors of a setting at the corners, and the largest elsewhere; seconds."""

    setting: Setting
    corners: float
    elsewhere: float
    all_nothing: list[float] = field(default_factory=list)
    all_further: list[float] = field(default_factory=list)

    @property
    def anywhere(self) -> float:
        """The larger of both errors."""
        return max(self.corners, self.elsewhere)

    @property
    def nothing(self) -> float:
        """Median seconds from nothing to the sweep of one layout."""
        return statistics.median(self.all_nothing)

    @property
    def further(self) -> float:
        """Median seconds of a further layout at four places never seen before."""
        return statistics.median(self.all_further)


def measure(case: Case, rounds: int) -> list[Measured]:
    """All settings of a case: errors against the reference, and times."""
    exact = reference(case)
    layouts = (CORNERS, *OTHERS)
    expected = exact.sweeps(layouts)
    found, solved = [], []
    for setting in settings(case):
        plate = setting.solve()
        errors = [
            difference(each, answer)
            for each, answer in zip(plate.sweeps(layouts), expected, strict=True)
        ]
        found.append(Measured(setting, errors[0], max(errors[1:])))
        solved.append(plate)
    rng = np.random.default_rng(0)
    for number in range(rounds):
        layout = rng.uniform(0, 1, (4, 2))
        for each, plate in zip(found, solved, strict=True):
            if number < SLOW_ROUNDS or each.nothing < SLOW:
                _run(each, plate, layout)
    return found


def _run(measured: Measured, solved: Solved, layout: FloatArray) -> None:
    started = time.process_time()
    measured.setting.solve().sweep(CORNERS)
    measured.all_nothing.append(time.process_time() - started)
    started = time.process_time()
    solved.sweep(layout)
    measured.all_further.append(time.process_time() - started)


PACKAGES = ("numpy", "scipy", "ngsolve")
COLORS = {"era-haptics": "#d62728", "NGSolve": "#1f77b4"}

Read = Callable[[Measured], float]

TABLES: dict[str, tuple[str, Read, Read]] = {
    "corners": ("from nothing, corners", lambda m: m.corners, lambda m: m.nothing),
    "anywhere": ("from nothing, anywhere", lambda m: m.anywhere, lambda m: m.nothing),
    "further": ("further layout", lambda m: m.anywhere, lambda m: m.further),
}
"""Heading, error and time of each kind of measurement."""


def write_report(
    measured: Mapping[Case, Sequence[Measured]],
    study: tuple[float, float] | None,
    note: str,
    folder: Path,
) -> None:
    """Write measured/benchmarks.md and pictures/benchmarks.png."""
    parts = {"machine": f"{_machine()}\n{note}"}
    for name in TABLES:
        parts[name] = "\n\n".join(_table(case, measured[case], name) for case in _with_errors())
    parts["goals"] = _goals(measured, study)
    parts["settings"] = _settings(measured)
    write_parts(folder / "measured" / "benchmarks.md", parts)
    figure = _picture(measured)
    FigureCanvasAgg(figure)
    figure.savefig(folder / "pictures" / "benchmarks.png", dpi=110)


def best(found: Sequence[Measured], target: float, error: Read, seconds: Read) -> Measured | None:
    """The quickest with an error of at most a target in per cent."""
    enough = [each for each in found if error(each) <= target / 100]
    return min(enough, key=seconds, default=None)


def _with_errors() -> list[Case]:
    """Cases with all errors to reach."""
    return [case for case, targets in CASES.items() if targets == ACCURACIES]


def _split(found: Sequence[Measured]) -> tuple[list[Measured], list[Measured]]:
    """Ours, and the peers'."""
    own = [each for each in found if each.setting.program == programs.NAME]
    return own, [each for each in found if each.setting.program != programs.NAME]


def _table(case: Case, found: Sequence[Measured], name: str) -> str:
    """Times of every program in every way by the error to reach."""
    _, error, seconds = TABLES[name]
    own, peers = _split(found)
    ways = list(dict.fromkeys(each.setting.name for each in peers))
    head = ["error at most", "era-haptics", *ways, "best peer by ours"]
    lines = [f"| {case.name}: {' | '.join(head)} |", "|---" * len(head) + "|"]
    for target, mine in zip(ACCURACIES, own, strict=True):
        cells = [_cell([mine], target, error, seconds)]
        cells += [
            _cell([each for each in peers if each.setting.name == way], target, error, seconds)
            for way in ways
        ]
        cells.append(_ratio([mine], peers, target, error, seconds))
        lines.append(f"| {target:g} % | {' | '.join(cells)} |")
    return "\n".join(lines)


def _cell(found: Sequence[Measured], target: float, error: Read, seconds: Read) -> str:
    quickest = best(found, target, error, seconds)
    if quickest is None:
        return f"not reached ({100 * min(map(error, found)):.2g} %)"
    return f"{_time(seconds(quickest))} ({100 * error(quickest):.2g} %)"


def _ratio(
    own: Sequence[Measured], peers: Sequence[Measured], target: float, error: Read, seconds: Read
) -> str:
    mine, other = (best(each, target, error, seconds) for each in (own, peers))
    return f"{seconds(other) / seconds(mine):.0f}" if mine and other else ""


def _goals(measured: Mapping[Case, Sequence[Measured]], study: tuple[float, float] | None) -> str:
    """Goals with what is reached."""
    rows: list[tuple[str, str, Case, float, str]] = [
        ("from nothing, corners, 1 %", "5 ms, 40 times the best peer", PAPER, 1.0, "corners"),
        ("from nothing, anywhere, 1 %", "7 ms", PAPER, 1.0, "anywhere"),
        ("from nothing, anywhere, 0.5 %", "20 ms", PAPER, 0.5, "anywhere"),
        ("from nothing, corners on feet, 0.1 %", "8 ms, 100 times the best peer",
         PAPER_ON_FEET, 0.1, "corners"),
        ("further layout, 1 %", "0.8 ms; 300 times a factor per frequency, 6 times modes",
         PAPER, 1.0, "further"),
        ("car cover glass, anywhere, 1 %", "30 ms", CAR, 1.0, "anywhere"),
        ("table plate to 500 Hz, anywhere, 1 %", "40 ms", TABLE, 1.0, "anywhere"),
    ]  # fmt: skip
    lines = [
        "| | goal | reached (error) | best peer, factor per frequency | best peer, modes |",
        "|---|---|---|---|---|",
    ]
    for what, goal, case, target, name in rows:
        _, error, seconds = TABLES[name]
        own, peers = _split(measured[case])
        mine = [each for each in own if each.setting.mesh == f"auto {target:g} %"]
        missed = "" if error(mine[0]) <= target / 100 else ", missed"
        cells = [f"{_time(seconds(mine[0]))} ({100 * error(mine[0]):.3g} %{missed})"]
        for is_direct in (True, False):
            way = [each for each in peers if (each.setting.way == Direct.way) == is_direct]
            ratio = _ratio(mine, way, target, error, seconds)
            other = _cell(way, target, error, seconds) if way else "not measured"
            cells.append(other + (f": {ratio} times ours" if ratio else ""))
        lines.append(f"| {what} | {goal} | {' | '.join(cells)} |")
    if study is not None:
        elapsed, used = map(_time, study)
        cell = f"{elapsed}, {used} of processor time"
        lines.append(f"| ten thousand layouts, two processes | 3 s | {cell} | | |")
    return "\n".join(lines)


def _settings(measured: Mapping[Case, Sequence[Measured]]) -> str:
    """All that was measured."""
    lines = [
        "| plate | program | mesh | error: corners | elsewhere | from nothing | further layout |",
        "|---|---|---|---|---|---|---|",
    ]
    for case, found in measured.items():
        lines += [
            f"| {case.name} | {each.setting.name} | {each.setting.mesh} | "
            f"{100 * each.corners:.2g} % | {100 * each.elsewhere:.2g} % | "
            f"{_time(each.nothing)} | {_time(each.further)} |"
            for each in found
        ]
    return "\n".join(lines)


def _picture(measured: Mapping[Case, Sequence[Measured]]) -> Figure:
    """Error against time: a line through the settings that no other beats in both."""
    figure = Figure(figsize=(11, 7.5), layout="constrained")
    cases = _with_errors()
    panels = figure.subplots(len(cases), len(TABLES), sharex=True, squeeze=False)
    for row, case in zip(panels, cases, strict=True):
        for axes, (title, error, seconds) in zip(row, TABLES.values(), strict=True):
            _draw(axes, measured[case], error, seconds)
            axes.set_title(f"{case.name}:\n{title}", fontsize=10)
        row[0].set_ylabel("processor time / ms")
    for axes in panels[-1]:
        axes.set_xlabel("error / %")
    handles, labels = panels[0][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False)
    return figure


def _draw(axes: Axes, found: Sequence[Measured], error: Read, seconds: Read) -> None:
    for name in dict.fromkeys(each.setting.name for each in found):
        own = [each for each in found if each.setting.name == name]
        own = [
            each
            for each in own
            if not any(
                error(other) <= error(each) and seconds(other) < seconds(each) for other in own
            )
        ]
        own.sort(key=error)
        setting = own[0].setting
        axes.loglog(
            [100 * error(each) for each in own],
            [1e3 * seconds(each) for each in own],
            "o--" if setting.way == Direct.way else "o-",
            color=COLORS[setting.program],
            label=name,
        )
    axes.grid(alpha=0.3)
    axes.set_xlim(12, 0.008)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def _time(seconds: float) -> str:
    return f"{1e3 * seconds:.3g} ms" if seconds < 0.9995 else f"{seconds:.3g} s"


def _machine() -> str:
    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        lines = cpuinfo.read_text().splitlines()
        model = next((each.split(":")[1].strip() for each in lines if "model name" in each), model)
    versions = []
    for name in PACKAGES:
        try:
            versions.append(f"{name} {metadata.version(name)}")
        except metadata.PackageNotFoundError:
            continue
    return (
        f"Machine: {model}, {os.cpu_count()} cores, {platform.system()}, "
        f"Python {platform.python_version()}, {', '.join(versions)}."
    )
