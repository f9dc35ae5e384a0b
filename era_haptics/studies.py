"""Studies of layouts: places, numbers and stiffnesses of ERAs compared."""

from collections.abc import Sequence
from dataclasses import dataclass
from os import PathLike

from era_haptics.arguments import as_frequencies, as_pair, expect_rig
from model.arguments import (
    expect_at_least,
    expect_number,
    expect_one_of,
    expect_path,
    is_whole,
    shown,
)
from model.arrays import FloatArray
from model.design.contacts import contact_rule
from model.design.support import DEFAULT_LOWEST
from model.errors import InputError
from model.rig.rig import Rig
from model.structure.actuator import Era
from model.structure.support import MIN_RIGID_BODY_FREQUENCY
from model.studies.finalists import DEFAULT_FINALISTS, judge_finalists
from model.studies.kinds import STUDIES
from model.studies.ranking import Ranking, score_order
from model.studies.run import run_study
from model.studies.solve import DRIVES, study_problem
from model.studies.supported import check_supported_cases, support_of
from model.studies.workers import on_processes, useful_processes


@dataclass(frozen=True)
class RankedLayout:
    """A layout of a study: its ERAs, its contrast, and how strongly the plate vibrates.

    support_problem: why the ERAs do not support the plate, None if they do; contrast [dB]: robust
    felt contrast, mean over the numbers of quiet fingers, None unless the layout is a finalist;
    expected_contrast [dB]: the estimate by which the others are ranked, NaN without support;
    driven: names of the ERAs that vibrate; minimum to maximum [m/s²]: over the plate, of the peak
    acceleration summed over the frequencies; unfelt_share: of the plate.
    """

    name: str
    eras: tuple[Era, ...]
    support_problem: str | None
    contrast: float | None
    expected_contrast: float
    driven: tuple[str, ...]
    minimum: float
    lower_quartile: float
    median: float
    upper_quartile: float
    maximum: float
    unfelt_share: float


def study(
    rig: Rig,
    what: str = "placement",
    *,
    layouts: int = 200,
    active: str = "2",
    frequencies: Sequence[float] | FloatArray = tuple(range(60, 321, 10)),
    contacts: str | PathLike[str] | None = None,
    lowest: float = DEFAULT_LOWEST,
    finalists: int = DEFAULT_FINALISTS,
    candidates: tuple[int, int] = (13, 13),
    seed: int = 0,
    workers: int = 1,
) -> tuple[RankedLayout, ...]:
    """Compare layouts of a rig's ERAs, the best robust felt contrast first, as `era study` does.

    what: `placement`, `count` or `stiffness`; active: loudness of the best single ERA (`1`), the
    best pair (`2`) or `all`; frequencies (f,) [Hz]: of loudness; contacts: a file, anywhere for
    None; lowest [Hz]: least rigid-body frequency of a supported plate; finalists: layouts judged
    by their tables' answers; candidates: places along x and y, edges included; seed: of the random
    layouts; workers: processes, at most. Raises InputError.
    """
    expect_rig(rig)
    expect_one_of(STUDIES, what, what="what")
    expect_one_of(DRIVES, active, what="active")
    counts = {"layouts": layouts, "finalists": finalists, "seed": seed, "workers": workers}
    for name, value in counts.items():
        if not is_whole(value):
            raise InputError(f"{name} must be a whole number, got {shown(value)}")
    expect_number(lowest, what="lowest", unit="hertz")
    expect_at_least(lowest, MIN_RIGID_BODY_FREQUENCY, what="lowest")
    expect_at_least(finalists, 1, what="finalists")
    path = None if contacts is None else expect_path(contacts, what="contacts")
    raster = as_pair(candidates, what="candidates", such_as="places along x and y such as (13, 13)")
    cases = STUDIES[what](rig, layouts=layouts, seed=seed, raster=raster)
    check_supported_cases(support_of(rig, cases, lowest=lowest))
    rule = contact_rule(path, rig.plate)
    problem = study_problem(rig, cases, as_frequencies(frequencies), contacts=rule, lowest=lowest)
    processes = on_processes(useful_processes(problem, cases, workers))
    run = run_study(problem, cases, workers=processes)
    scored = score_order(rig, cases, run.results, drive=DRIVES.index(active), lowest=lowest)
    ranking = judge_finalists(
        rig, scored, contacts=rule, finalists=finalists, workers=max(1, workers)
    )
    return tuple(_layout(rig, ranking, int(case)) for case in ranking.order)


def _layout(rig: Rig, ranking: Ranking, case: int) -> RankedLayout:
    scored, results = ranking.scored, ranking.results
    eras = ranking.cases.eras_of(case, rig.eras)
    judged = ranking.judged.get(case)
    return RankedLayout(
        ranking.cases.names[case],
        eras,
        scored.support.problem(case),
        None if judged is None else judged.mean_db,
        float(results.expected_db[case]),
        tuple(eras[number].name for number in results.active_eras(case, scored.drive)),
        *results.statistics[case, scored.drive].tolist(),
    )
