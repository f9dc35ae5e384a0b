"""Studies small enough for tests."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from model.design.contacts import anywhere
from model.studies.cases import Cases
from model.studies.kinds import placement_cases
from model.studies.solve import CaseResults, StudyProblem, study_problem
from paper_plate import make_paper_rig

FREQUENCIES = np.array([60.0, 110.0, 170.0, 250.0])


def small_study(*, layouts: int, seed: int = 0) -> tuple[StudyProblem, Cases]:
    """Placement of four ERAs on the paper's plate, its mesh coarse, at four frequencies.

    With few contact sets.
    """
    rig = make_paper_rig(12, 9)
    cases = placement_cases(rig, layouts=layouts, seed=seed, raster=(7, 5))
    problem = study_problem(rig, cases, FREQUENCIES, contacts=anywhere(rig.plate))
    return replace(problem, sets=problem.sets[::24]), cases


def chunks_of(cases: Cases, size: int) -> dict[int, Cases]:
    """Cases in chunks, by number."""
    starts = range(0, len(cases), size)
    return {
        number: cases.take(range(start, min(start + size, len(cases))))
        for number, start in enumerate(starts)
    }


def same_to_the_bit(first: Mapping[int, CaseResults], second: Mapping[int, CaseResults]) -> bool:
    """Whether the results of all chunks agree in every bit."""
    return first.keys() == second.keys() and all(
        first[number].expected_db.tobytes() == second[number].expected_db.tobytes()
        and first[number].statistics.tobytes() == second[number].statistics.tobytes()
        and first[number].active.tobytes() == second[number].active.tobytes()
        for number in first
    )
