"""Studies of layouts: places, numbers and stiffnesses of ERAs compared."""

from collections.abc import Sequence
from dataclasses import dataclass

from era_haptics.arguments import as_frequencies, as_pair, expect_rig
from model.arguments import expect_one_of, is_whole, shown
from model.arrays import FloatArray
from model.errors import InputError
from model.rig.rig import Rig
from model.structure.actuator import Era
from model.studies.kinds import STUDIES
from model.studies.ranking import Ranking, check_supported_cases, rank
from model.studies.run import run_study
from model.studies.solve import DRIVES, study_problem
from model.studies.workers import on_processes, useful_processes


@dataclass(frozen=True)
class RankedLayout:
    """A layout of a study: its ERAs, and how strongly the plate vibrates.

    driven: names of the ERAs that vibrate; is_supported: whether all carry the plate; minimum to
    maximum [m/s²]: over the plate, of the peak acceleration summed over the frequencies;
    unfelt_share: of the plate.
    """

    name: str
    eras: tuple[Era, ...]
    driven: tuple[str, ...]
    is_supported: bool
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
    candidates: tuple[int, int] = (13, 13),
    seed: int = 0,
    workers: int = 1,
) -> tuple[RankedLayout, ...]:
    """Compare layouts of a rig's ERAs, the strongest median first, as `era study` does.

    what: `placement`, `count` or `stiffness`; active: rank by the best single ERA (`1`), the best
    pair (`2`) or `all`; frequencies (f,) [Hz]; candidates: places along x and y, edges included;
    seed: of the random layouts; workers: processes, at most. Raises InputError.
    """
    expect_rig(rig)
    expect_one_of(STUDIES, what, what="what")
    expect_one_of(DRIVES, active, what="active")
    counts = (("layouts", layouts), ("seed", seed), ("workers", workers))
    for name, value in counts:
        if not is_whole(value):
            raise InputError(f"{name} must be a whole number, got {shown(value)}")
    raster = as_pair(candidates, what="candidates", such_as="places along x and y such as (13, 13)")
    cases = STUDIES[what](rig, layouts=layouts, seed=seed, raster=raster)
    check_supported_cases(rig, cases)
    problem = study_problem(rig, cases, as_frequencies(frequencies))
    processes = on_processes(useful_processes(problem, cases, workers))
    run = run_study(problem, cases, workers=processes)
    ranking = rank(rig, cases, run.results, drive=DRIVES.index(active))
    return tuple(_layout(rig, ranking, int(case)) for case in ranking.order)


def _layout(rig: Rig, ranking: Ranking, case: int) -> RankedLayout:
    eras = ranking.cases.eras_of(case, rig.eras)
    driven = ranking.results.active_eras(case, ranking.drive)
    return RankedLayout(
        ranking.cases.names[case],
        eras,
        tuple(eras[number].name for number in driven),
        bool(ranking.supported[case]),
        *ranking.results.statistics[case, ranking.drive].tolist(),
    )
