"""Figures of the model that decide whether kept results can be reused, and their record.

    python tests/programs/reference_figures.py

records them with the present NUMERICS_VERSION.
"""

import json
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))
from era_haptics.lab.design.contact_rule import anywhere
from era_haptics.lab.design.era_area import area_of
from era_haptics.lab.design.given_layouts import layouts_of
from era_haptics.lab.design.layout_search import LayoutSearch
from era_haptics.lab.design.problem import DesignProblem
from kit.plates import make_paper_rig, small_problem
from model.answer.answer_report import Timing
from model.answer.answer_report import measures as measures_of
from model.answer.plan import query
from model.answer.stimulus import Placement
from model.caching import NUMERICS_VERSION
from model.drive_modes import DRIVE_MODES
from model.table.table_file import solve_table
from model.vibration import natural_modes

RECORD = Path(__file__).parents[1] / "model" / "reference_figures.json"

CONTACTS = {"quiet": ((0.22, 0.16), (0.05, 0.19)), "alone": ()}


def reference_figures() -> dict[str, list[float]]:
    """Figures by name; levels and contrasts, found by searches, end in _db."""
    rig = make_paper_rig(12, 9)
    figures = {
        f"natural_frequencies_{support}": natural_modes(rig, 5, support=support).frequencies
        for support in ("eras", "simply-supported")
    }
    table = solve_table(small_problem(), drive_mode="switched")
    figures |= {
        "table_omega": table.omega[:8],
        "table_acceleration": np.linalg.norm(
            table.unit_fields(table.raster.points), axis=2
        ).ravel(),
        "table_discretisation_error": table.discretization_error,
        "table_shapes": np.linalg.norm(table.shapes[:, :8], axis=0),
    }
    problem = DesignProblem(rig, 4, area_of("edge", rig.plate), anywhere(rig.plate))
    layouts = layouts_of("random:8", problem)
    scored = LayoutSearch(problem).scored(list(layouts.values()))
    figures["layout_scores_db"] = np.array([value.score_db for value in scored])
    timing = Timing(table)
    for drive_mode in DRIVE_MODES:
        for name, quiet in CONTACTS.items():
            placed = Placement(((0.09, 0.07),), quiet)
            answer = timing.shaped(query(table, placed, drive_mode=drive_mode))
            felt, contrasts = answer.fingers[0], measures_of(table, answer, timing=timing)
            measures = (
                felt.contrast_db,
                answer.layers[0].contrast_to_plate_db,
                felt.promised_contrast_db,
                felt.promised_level_db_sl,
                contrasts.transient_contrast_db,
                contrasts.residual_db,
            )
            figures[f"query_{drive_mode}_{name}_db"] = np.array(
                [value for value in measures if value is not None]
            )
    return {name: [float(value) for value in values] for name, values in figures.items()}


if __name__ == "__main__":
    record = {"numerics_version": NUMERICS_VERSION, "figures": reference_figures()}
    RECORD.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
