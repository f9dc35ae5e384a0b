"""Tables of sessions as Markdown."""

from collections.abc import Mapping, Sequence

import numpy as np

from benchmarks.promise.cases import MOVES, Case
from benchmarks.promise.session import ANSWERS, BESIDE, JOINING, Outcome, Pair

Outcomes = Mapping[Case, Sequence[Outcome]]

_LOW_IS_WORST = (ANSWERS, MOVES, JOINING, BESIDE)
"""Figures whose worst 10 % are the lowest."""


def as_markdown(outcomes: Outcomes) -> str:
    """Return tables of clicks, of steady contrasts, and of events."""
    clicks = {case: results for case, results in outcomes.items() if case.clicks}
    steady = {case: results for case, results in outcomes.items() if not case.clicks}
    lines = _clicks(clicks) if clicks else []
    if steady:
        lines += [*_contrasts(steady), *_events(steady)]
    return "\n".join(lines)


def _contrasts(outcomes: Outcomes) -> list[str]:
    lines = _head("", "plates", "promised [dB]", "felt [dB]", "served", "kept")
    pairs: list[Pair] = []
    for case, results in outcomes.items():
        promised, felt = np.array([result.worst for result in results]).T
        served = 100 * np.mean([result.served for result in results])
        own = [pair for result in results for pair in result.fingers]
        cells = [f"{len(results)}", _median(promised), _median(felt), f"{served:.0f} %", _kept(own)]
        lines.append(f"| {case.title} | {' | '.join(cells)} |")
        pairs += own
    lines.append(f"| all | {sum(map(len, outcomes.values()))} | - | - | - | {_kept(pairs)} |")
    return lines


def _events(outcomes: Outcomes) -> list[str]:
    names: list[str] = []
    for results in outcomes.values():
        names += [name for result in results for name in result.events if name not in names]
    names = list(dict.fromkeys(names))
    if not names:
        return []
    lines = ["", *_head("", *names)]
    for case, results in outcomes.items():
        if case.events:
            cells = [_event(name, results) for name in names]
            lines.append(f"| {case.title} | {' | '.join(cells)} |")
    return lines


def _event(name: str, results: Sequence[Outcome]) -> str:
    values = [value for result in results for value in result.events.get(name, [])]
    text = _median(values, worst=10 if name in _LOW_IS_WORST else 90)
    if name == ANSWERS and values:
        text += f", {_kept([(0.0, value) for value in values])} kept"
    return text


def _clicks(outcomes: Outcomes) -> list[str]:
    lines = _head("", "plates", "promised [dB]", "felt [dB]", "kept", "others: kept")
    for case, results in outcomes.items():
        clicks = [pair for result in results for pair in result.clicks]
        others = [pair for result in results for pair in result.others]
        promised = _median([promised for promised, _ in clicks])
        felt = _median([felt for _, felt in clicks])
        cells = [f"{len(results)}", promised, felt, _kept(clicks), _kept(others)]
        lines.append(f"| {case.title} | {' | '.join(cells)} |")
    return [*lines, ""]


def _head(*columns: str) -> list[str]:
    return [f"| {' | '.join(columns)} |", "|---" * len(columns) + "|"]


def _kept(pairs: Sequence[Pair]) -> str:
    """Share of the promises that are kept."""
    if not pairs:
        return "-"
    share = np.mean([felt >= promised for promised, felt in pairs])
    return f"{100 * share:.0f} % of {len(pairs)}"


def kept(results: Sequence[Outcome]) -> float:
    """Return the share of the promises that are kept."""
    pairs = [pair for result in results for pair in result.fingers]
    return float(np.mean([felt >= promised for promised, felt in pairs]))


def _median(values: Sequence[float] | np.ndarray, *, worst: float = 10) -> str:
    """Median, and the worst 10 % in parentheses."""
    if not len(values):
        return "-"
    return f"{np.median(values):.1f} ({np.percentile(values, worst):.1f})"
