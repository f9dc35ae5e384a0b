"""Tables of the outcomes of contact sets."""

from collections.abc import Mapping, Sequence

import numpy as np

from benchmarks.promise.cases import CASES, Outcome

Found = Mapping[tuple[str, int], Sequence[Outcome]]
"""Outcomes by case and number of quiet fingers."""


def as_markdown(found: Found) -> str:
    """Contrast beside the optimum, and how far promises are kept."""
    keys = list(dict.fromkeys(key for key, _ in found))
    counts = sorted({quiet for _, quiet in found})
    heads = " / ".join(str(count) for count in counts)
    lines = [
        f"## Contrast [dB], median over the sets, {heads} quiet fingers",
        "",
        "| | median plate: answer | optimum | nine of ten plates: answer | optimum | mean loss |",
        "|---|---|---|---|---|---|",
    ]
    for key in keys:
        rows = [found[key, count] for count in counts]
        loss = [_values(row, "optimum_tenth") - _values(row, "answer_tenth") for row in rows]
        columns = ("answer_median", "optimum_median", "answer_tenth", "optimum_tenth")
        cells = " | ".join(_medians(rows, name) for name in columns)
        lines.append(
            f"| {key}. {CASES[key].name} | {cells} | {_joined([each.mean() for each in loss], 2)} |"
        )
    lines += [
        "",
        "## Promise and level, the same sets",
        "",
        "| | promise [dB] | plates that keep it | sets kept by fewer than 80 % | "
        "level of nine of ten plates, answer [dB SL] | optimum |",
        "|---|---|---|---|---|---|",
    ]
    for key in keys:
        rows = [found[key, count] for count in counts]
        kept = [_values(row, "kept") for row in rows]
        lines.append(
            f"| {key} | {_medians(rows, 'promise')} | "
            f"{_joined([100 * each.mean() for each in kept], 1)} % | "
            f"{_joined([100 * (each < 0.8).mean() for each in kept], 0)} % | "
            f"{_medians(rows, 'answer_level')} | {_medians(rows, 'optimum_level')} |"
        )
    return "\n".join(lines)


def _values(row: Sequence[Outcome], name: str) -> np.ndarray:
    return np.array([getattr(each, name) for each in row], dtype=float)


def _medians(rows: Sequence[Sequence[Outcome]], name: str) -> str:
    return _joined([float(np.median(_values(row, name))) for row in rows], 1)


def _joined(values: Sequence[float], digits: int) -> str:
    return " / ".join(f"{value:.{digits}f}" for value in values)
