"""Errors and times of programs: processor time on a single thread, all programs in turn."""

import os
import platform
import statistics
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path

from benchmarks.plate import programs
from benchmarks.plate.peers.ways import Direct
from benchmarks.plate.problem import CORNERS, OTHERS, Case, difference
from benchmarks.plate.programs import CASES, Setting, reference, settings

SLOW = 0.3  # s; a setting that takes longer is measured in the first rounds only
SLOW_ROUNDS = 3
PACKAGES = ("numpy", "scipy", "ngsolve")


@dataclass
class Measured:
    """A setting with the largest relative L2 error of all layouts, and its times [s]."""

    setting: Setting
    error: float
    times: list[float] = field(default_factory=list)

    @property
    def seconds(self) -> float:
        """Median time for the whole solution, up to the responses of a layout."""
        return statistics.median(self.times)


def measure(case: Case, rounds: int) -> list[Measured]:
    """Return all settings of a case with their errors against the reference, and times."""
    layouts = (CORNERS, *OTHERS)
    expected = reference(case).sweeps(layouts)
    results = []
    for setting in settings(case):
        sweeps = setting.solve().sweeps(layouts)
        errors = [difference(*pair) for pair in zip(sweeps, expected, strict=True)]
        results.append(Measured(setting, max(errors)))
    for number in range(rounds):
        for result in results:
            if number < SLOW_ROUNDS or result.seconds < SLOW:
                begin = time.process_time()
                result.setting.solve().sweep(CORNERS)
                result.times.append(time.process_time() - begin)
    return results


def report(measured: Mapping[Case, Sequence[Measured]]) -> str:
    """Return a table: a row for each accuracy in each case."""
    lines = [
        _machine(),
        "",
        "| plate, error at most | era-haptics | NGSolve, factor per frequency | NGSolve, modes "
        "| best peer by ours |",
        "|---|---|---|---|---|",
    ]
    for case, accuracies in CASES.items():
        own = [each for each in measured[case] if each.setting.program == programs.NAME]
        peers = [each for each in measured[case] if each.setting.program != programs.NAME]
        direct = [each for each in peers if each.setting.way == Direct.way]
        modes = [each for each in peers if each.setting.way != Direct.way]
        for accuracy, result in zip(accuracies, own, strict=True):
            cells = [_cell(group, accuracy) for group in ([result], direct, modes)]
            ratio = _ratio(_quickest([result], accuracy), _quickest(peers, accuracy))
            lines.append(f"| {case.name}, {accuracy:g} % | {' | '.join(cells)} | {ratio} |")
    return "\n".join(lines)


def _quickest(results: Sequence[Measured], accuracy: float) -> Measured | None:
    """Return the quickest result whose error is at most `accuracy` [%]."""
    accurate = [each for each in results if 100 * each.error <= accuracy]
    return min(accurate, key=lambda result: result.seconds, default=None)


def _cell(results: Sequence[Measured], accuracy: float) -> str:
    if not results:
        return ""
    quickest = _quickest(results, accuracy)
    if quickest is None:
        least = min(each.error for each in results)
        return f"not reached ({100 * least:.2g} %)"
    return f"{_time(quickest.seconds)} ({100 * quickest.error:.2g} %)"


def _ratio(own: Measured | None, peer: Measured | None) -> str:
    if own is None or peer is None:
        return ""
    return f"{peer.seconds / own.seconds:.0f}"


def _time(seconds: float) -> str:
    return f"{1e3 * seconds:.3g} ms" if seconds < 0.9995 else f"{seconds:.3g} s"


def _machine() -> str:
    """Return the machine and the versions of the packages that matter."""
    processor = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        models = [each for each in cpuinfo.read_text().splitlines() if "model name" in each]
        processor = models[0].partition(":")[2].strip() if models else processor
    versions = ", ".join(f"{name} {metadata.version(name)}" for name in PACKAGES)
    return (
        f"Machine: {processor}, {os.cpu_count()} cores, {platform.system()}, "
        f"Python {platform.python_version()}, {versions}."
    )
