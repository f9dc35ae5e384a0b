"""The files and the summary of a study."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from model.arrays import FloatArray
from model.config.document import Value
from model.figures import save_figure
from model.files.array_file import whole_or_nothing
from model.files.csv_file import Column, Columns, write_columns
from model.rig.rig import Rig
from model.studies.pictures import PICTURES
from model.studies.ranking import Ranking, era_counts
from model.studies.recommended import in_words, rig_yaml
from model.studies.solve import DRIVE_NAMES, DRIVES
from model.vibration.activation import STATISTICS

MAX_SHOWN = 10
"""Number of ranked cases in a summary; the CSV file has all."""


def write_outcome(
    folder: Path, study: str, rig: Rig, *, data: Mapping[str, Value], ranking: Ranking
) -> list[Path]:
    """Write the recommended rig, the CSV of all cases and the box plots; the rig comes first.

    data: of the rig's file. Raises OSError if the folder cannot be written.
    """
    recommended = folder / "recommended.yaml"
    text = rig_yaml(data, rig, ranking, ranking.recommended)
    with whole_or_nothing(recommended) as stream:
        stream.write(text.encode())
    table = folder / f"{study}.csv"
    write_columns(table, all_columns(ranking))
    for name, figure in PICTURES[study].items():
        save_figure(figure(rig, ranking), folder / name)
    return [recommended, table, *(folder / name for name in PICTURES[study])]


def ranking_summary(rig: Rig, ranking: Ranking) -> dict[str, Any]:
    """The start of the ranking, the rig's own layout, and the recommended case."""
    scored = ranking.scored
    ranks = {int(case): rank for rank, case in enumerate(ranking.order, start=1)}
    shown = [int(case) for case in ranking.order[:MAX_SHOWN]]
    if scored.own is not None and scored.own not in shown:
        shown.append(scored.own)
    best = ranking.recommended
    support = scored.support
    return {
        "ranked_by": "contrast_db",
        "judged": len(ranking.judged),
        "sets": len(ranking.judged[best].contrast_db),
        "tipping": int(support.is_tipping.sum()),
        "too_low": int((~support.is_supported & ~support.is_tipping).sum()),
        "driven": DRIVE_NAMES[DRIVES[scored.drive]],
        "ranking": [{"rank": ranks[case], **case_summary(rig, ranking, case)} for case in shown],
        "recommended": {
            "words": in_words(rig, ranking, best),
            "rank": ranks[best],
            **case_summary(rig, ranking, best),
        },
    }


def case_summary(rig: Rig, ranking: Ranking, case: int) -> dict[str, object]:
    """One case for JSON: places of its ERAs, its contrast, and its loudness with who is driven."""
    scored, results = ranking.scored, ranking.results
    eras = ranking.cases.eras_of(case, rig.eras)
    judged = ranking.judged.get(case)
    loudness = results.statistics[case, scored.drive]
    return {
        "layout": ranking.cases.names[case],
        "supported": bool(scored.support.is_supported[case]),
        "support_problem": scored.support.problem(case),
        "lowest_rigid_body_hz": float(scored.support.lowest_hz[case]),
        "at_m": {era.name: [era.x, era.y] for era in eras},
        "stiffness_n_m": {era.name: era.stiffness for era in eras},
        "contrast_db": None if judged is None else judged.summary,
        "reached_share": None if judged is None else judged.reached_share,
        "expected_contrast_db": _number(results.expected_db[case]),
        "active": [eras[era].name for era in results.active_eras(case, scored.drive)],
        **{
            f"{name.replace(' ', '_')}_m_s2": _number(value)
            for name, value in zip(STATISTICS[:-1], loudness[:-1], strict=True)
        },
        "unfelt_share": _number(loudness[-1]),
    }


def all_columns(ranking: Ranking) -> Columns:
    """Columns with a row for each case and drive."""
    cases, results, support = ranking.cases, ranking.results, ranking.scored.support
    at = [
        " ".join(f"({x:.6g};{y:.6g})" for x, y in cases.positions_of(case).tolist())
        for case in range(len(cases))
    ]
    contrast, ranks = np.full(len(cases), np.nan), np.empty(len(cases), dtype=int)
    ranks[ranking.order] = np.arange(1, len(cases) + 1)
    for case, judged in ranking.judged.items():
        contrast[case] = judged.mean_db
    rows, drives = np.nonzero(~np.isnan(results.statistics[..., 0]))
    pairs = list(zip(rows.tolist(), drives.tolist(), strict=True))
    columns: dict[str, Column] = {
        "layout": [cases.names[case] for case in rows],
        "eras": era_counts(cases)[rows],
        "stiffness_factor": cases.stiffness_factors[rows],
        "at_m": [at[case] for case in rows],
        "rank": ranks[rows],
        "contrast_db": _texts(contrast[rows]),
        "expected_contrast_db": _texts(results.expected_db[rows]),
        "supported": ["yes" if support.is_supported[case] else "no" for case in rows],
        "lowest_rigid_body_hz": support.lowest_hz[rows],
        "driven": [DRIVES[drive] for drive in drives],
        "active": [
            "+".join(str(era + 1) for era in results.active_eras(case, drive))
            for case, drive in pairs
        ],
    }
    statistics = results.statistics[rows, drives]
    return columns | {
        f"{name.replace(' ', '_')}{'' if name == STATISTICS[-1] else '_m_s2'}": statistics[:, k]
        for k, name in enumerate(STATISTICS)
    }


def _number(value: float) -> float | None:
    """A number for JSON, None for NaN."""
    return None if np.isnan(value) else float(value)


def _texts(values: FloatArray) -> list[str]:
    """Numbers for CSV, nothing for NaN."""
    return ["" if np.isnan(value) else f"{value:.6g}" for value in values]
