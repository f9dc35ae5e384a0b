"""The files and the summary of a study."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

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
    ranks = {int(case): rank for rank, case in enumerate(ranking.order, start=1)}
    shown = [int(case) for case in ranking.order[:MAX_SHOWN]]
    if ranking.own is not None and ranking.own not in shown:
        shown.append(ranking.own)
    best = ranking.recommended
    return {
        "ranked_by": "median_m_s2",
        "driven": DRIVE_NAMES[DRIVES[ranking.drive]],
        "ranking": [{"rank": ranks[case], **case_summary(rig, ranking, case)} for case in shown],
        "recommended": {
            "words": in_words(rig, ranking, best),
            "rank": ranks[best],
            **case_summary(rig, ranking, best),
        },
    }


def case_summary(rig: Rig, ranking: Ranking, case: int) -> dict[str, object]:
    """One case for JSON: places of its ERAs, which are driven, and statistics."""
    eras = ranking.cases.eras_of(case, rig.eras)
    driven = ranking.results.active_eras(case, ranking.drive)
    statistics = ranking.results.statistics[case, ranking.drive]
    return {
        "layout": ranking.cases.names[case],
        "supported": bool(ranking.supported[case]),
        "at_m": {era.name: [era.x, era.y] for era in eras},
        "stiffness_n_m": {era.name: era.stiffness for era in eras},
        "active": [eras[era].name for era in driven],
        **{
            f"{name.replace(' ', '_')}_m_s2": float(value)
            for name, value in zip(STATISTICS[:-1], statistics[:-1], strict=True)
        },
        "unfelt_share": float(statistics[-1]),
    }


def all_columns(ranking: Ranking) -> Columns:
    """Columns with a row for each case and drive."""
    cases, results = ranking.cases, ranking.results
    at = [
        " ".join(f"({x:.6g};{y:.6g})" for x, y in cases.positions_of(case).tolist())
        for case in range(len(cases))
    ]
    rows, drives = np.nonzero(~np.isnan(results.statistics[..., 0]))
    pairs = list(zip(rows.tolist(), drives.tolist(), strict=True))
    columns: dict[str, Column] = {
        "layout": [cases.names[case] for case in rows],
        "eras": era_counts(cases)[rows],
        "stiffness_factor": cases.stiffness_factors[rows],
        "at_m": [at[case] for case in rows],
        "driven": [DRIVES[drive] for drive in drives],
        "active": [
            "+".join(str(era + 1) for era in results.active_eras(case, drive))
            for case, drive in pairs
        ],
    }
    statistics = results.statistics[rows, drives]
    return (
        columns
        | {
            f"{name.replace(' ', '_')}{'' if name == STATISTICS[-1] else '_m_s2'}": statistics[:, k]
            for k, name in enumerate(STATISTICS)
        }
        | {"supported": ["yes" if ranking.supported[case] else "no" for case in rows]}
    )
