"""Tables of what was promised and felt: contrasts of cases, and their events."""

from collections.abc import Mapping, Sequence

import numpy as np

from benchmarks.promise.cases import Case
from benchmarks.promise.session import ANSWERS, Outcome

Found = Mapping[Case, Sequence[Outcome]]


def as_markdown(found: Found) -> str:
    """A table of steady contrasts, with a row of all cases, and one of what happens in events."""
    lines = [
        "| | plates | goal | promised [dB] (10 %) | felt [dB] (10 %) | served | promise kept |",
        "|---|---|---|---|---|---|---|",
    ]
    for case, each in found.items():
        promised, felt = np.array([one.worst for one in each]).T
        lines.append(
            f"| {case.title} | {len(each)} | {'-' if case.goal_db is None else case.goal_db} | "
            f"{_shown(promised)} | {_shown(felt)} | "
            f"{100 * np.mean([one.served for one in each]):.0f} % | "
            f"{_shown_kept(each)} |"
        )
    every = [one for each in found.values() for one in each]
    lines.append(f"| all | {len(every)} | - | - | - | - | {_shown_kept(every)} |")
    names = list(dict.fromkeys(n for each in found.values() for one in each for n in one.events))
    lines += ["", f"| | {' | '.join(names)} |", "|---|" + "---|" * len(names)]
    for case, each in found.items():
        columns = [[value for one in each for value in one.events.get(name, [])] for name in names]
        if any(columns):
            cells = [
                _shown(values, worst=_WORST.get(name, 90)) + _share(name, values)
                for name, values in zip(names, columns, strict=True)
            ]
            lines.append(f"| {case.title} | {' | '.join(cells)} |")
    return "\n".join(lines)


_WORST = {ANSWERS: 10, "moves": 10, "first 100 ms, joining": 10, "first 100 ms, beside": 10}
"""Percentile that is the worst tenth, where that is not the 90th."""


def _share(name: str, values: Sequence[float]) -> str:
    """The share of answers that keep their promise."""
    if name != ANSWERS or not values:
        return ""
    return f", {100 * np.mean(np.array(values) >= 0):.0f} % of {len(values)} kept"


def kept(found: Sequence[Outcome]) -> float:
    """Share of the promises that are kept."""
    return float(np.mean([felt >= promised for one in found for promised, felt in one.fingers]))


def _shown_kept(found: Sequence[Outcome]) -> str:
    return f"{100 * kept(found):.0f} % of {sum(len(one.fingers) for one in found)}"


def _shown(values: Sequence[float] | np.ndarray, *, worst: float = 10) -> str:
    """Median, and the worst tenth in brackets."""
    if not len(values):
        return "-"
    return f"{np.median(values):.1f} ({np.percentile(values, worst):.1f})"
