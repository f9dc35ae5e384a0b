"""Tables of what was promised and felt: contrasts of cases, and their events."""

from collections.abc import Mapping, Sequence

import numpy as np

from benchmarks.promise.cases import Case
from benchmarks.promise.session import ANSWERS, Outcome

Found = Mapping[Case, Sequence[Outcome]]


def as_markdown(found: Found) -> str:
    """A table of steady contrasts, with a row of all cases, and one of what happens in events."""
    clicked = {case: each for case, each in found.items() if case.clicks}
    found = {case: each for case, each in found.items() if not case.clicks}
    lines = _of_clicks(clicked) if clicked else []
    if not found:
        return "\n".join(lines)
    lines += [
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


def _of_clicks(found: Found) -> list[str]:
    """A table of clicks, with what the others are said to feel meanwhile."""
    lines = [
        "| | plates | promised [dB] (10 %) | felt [dB] (10 %) | kept | others' foreign kept | "
        "others' contrast meanwhile [dB] (10 %) | kept | above own [dB] (10 %) |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for case, each in found.items():
        clicked = [one.clicked for one in each if one.clicked is not None]
        contrasts, foreign, restated = (
            [pair for one in clicked for pair in getattr(one, name)]
            for name in ("contrasts", "foreign", "restated")
        )
        lines.append(
            f"| {case.title} | {len(each)} | {_shown([a for a, _ in contrasts])} | "
            f"{_shown([b for _, b in contrasts])} | {_kept(contrasts)} | {_kept(foreign)} | "
            f"{_shown([a for a, _ in restated])} | {_kept(restated)} | "
            f"{_shown([a for one in clicked for a in one.over_own])} |"
        )
    return [*lines, ""]


def _kept(pairs: Sequence[tuple[float, float]]) -> str:
    """Share of the promises that are kept, of pairs of promised and felt."""
    if not pairs:
        return "-"
    kept = np.mean([felt >= promised for promised, felt in pairs])
    return f"{100 * kept:.0f} % of {len(pairs)}"


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
    return _kept([pair for one in found for pair in one.fingers])


def _shown(values: Sequence[float] | np.ndarray, *, worst: float = 10) -> str:
    """Median, and the worst tenth in brackets."""
    if not len(values):
        return "-"
    return f"{np.median(values):.1f} ({np.percentile(values, worst):.1f})"
