"""Running a design: several starts on processes, their layouts judged, finished ones kept."""

import hashlib
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, product
from pathlib import Path

import numpy as np

from model.arrays import FloatArray
from model.choice import best_of
from model.cluster import Cluster
from model.design.judge import JUDGED_SEED, JUDGED_SETS, Judged, judge
from model.design.search import CANDIDATES, DesignProblem, Found, LayoutSearch
from model.design.support import MIN_SUPPORTING
from model.errors import InputError
from model.files.array_file import Arrays
from model.files.kept_arrays import keep_arrays, kept_arrays
from model.processes import on_processes
from model.version import NUMERICS_VERSION

SENSITIVITY_STEP = 0.005
"""Step [m] of an ERA by which the sensitivity to its place is measured."""

_TYPES = {"positions": "<f8", "scores": "<f8", "counts": "<i8", "quiet": "<i8", "answers": "<f8"}


@dataclass(frozen=True, eq=False)
class JudgedLayout:
    """A layout that was found, and what it gives on fresh contact sets."""

    found: Found
    judged: Judged

    @property
    def count(self) -> int:
        """Number of ERAs."""
        return len(self.found.positions)


@dataclass(frozen=True, eq=False)
class Design:
    """Result of a design.

    problem: the one with the best answers; starts: the layout of each of its starts; best: of
    these; by_count: the best found for each number of ERAs; by_stiffness: the best for each
    stiffness [N/m] tried; sensitivities (n,): change of the score [dB/m] with the place of each
    ERA of the best; own: the rig's own layout, None if it does not support the plate;
    resumed_count: of starts.
    """

    problem: DesignProblem
    starts: tuple[JudgedLayout, ...]
    best: JudgedLayout
    by_count: dict[int, JudgedLayout]
    by_stiffness: dict[float, JudgedLayout]
    sensitivities: FloatArray
    own: Judged | None
    sets: list[FloatArray]
    resumed_count: int

    @property
    def gap_db(self) -> float:
        """How far the worst start is behind the best [dB]."""
        return self.best.judged.mean_db - min(each.judged.mean_db for each in self.starts)


def problem_digest(problem: DesignProblem, where: str) -> str:
    """SHA-256 over all that the layouts of a problem depend on; where: text of its area."""
    parts = [
        problem.rig.fingerprint,
        problem.rig.mesh.to_dict(),
        list(problem.kept),
        [problem.rig.limits.frequency_min, problem.rig.limits.frequency_max],
        where,
        problem.contacts.text,
        problem.apart,
        problem.lowest,
        problem.count,
        problem.seed,
        problem.stiffness,
        [NUMERICS_VERSION, JUDGED_SETS, *CANDIDATES.values()],
    ]
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()


def run_design(
    problems: Sequence[DesignProblem],
    *,
    where: str,
    starts: int,
    folder: Path,
    workers: int = 1,
    cluster: Cluster | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Design:
    """Search from several starts and judge what they find, for problems of different stiffness.

    The first start adds one ERA after the other and so gives a layout for each number; the others
    begin at random. Finished ones are in files of the folder; where: text of the problems' area;
    cluster: in place of so many workers on this machine.
    Raises InputError for an area without room, and where no layout supports the plate.
    """
    digests = [problem_digest(problem, where) for problem in problems]
    tasks = {
        number: (problem, start)
        for number, (problem, start) in enumerate(product(range(len(problems)), range(starts)))
    }
    texts = {number: f"{digests[one]} {start}" for number, (one, start) in tasks.items()}
    paths = {
        number: folder / f"start-{start}-{digests[one][:12]}.npz"
        for number, (one, start) in tasks.items()
    }
    kept = {number: kept_arrays(path, texts[number], _TYPES) for number, path in paths.items()}
    done: dict[int, Arrays] = {number: found for number, found in kept.items() if found is not None}
    resumed_count = len(done)
    progress(len(done), len(tasks))
    missing = {number: task for number, task in tasks.items() if number not in done}
    processes = min(workers, max(1, len(missing)))
    for number, arrays in (
        on_processes(processes, _start, problems, missing)
        if cluster is None
        else cluster.solve(_as_they_are, problems, _start, missing)
    ):
        keep_arrays(paths[number], texts[number], arrays)
        done[number] = arrays
        progress(len(done), len(tasks))
    found = [
        [list(_layouts(done[number])) for number in tasks if tasks[number][0] == one]
        for one in range(len(problems))
    ]
    ends = [[path[-1] for path in each] for each in found]
    bests = [each[best_of([_mean(end) for end in each])] for each in ends]
    chosen = best_of([_mean(best) for best in bests])
    problem, best = problems[chosen], bests[chosen]
    search = LayoutSearch(problem)
    sets = judged_sets(problem)
    by_count: dict[int, JudgedLayout] = {}
    for layout in [*chain(*found[chosen]), *_one_more(search, best, sets)]:
        known = by_count.get(layout.count)
        if known is None or _mean(layout) > _mean(known):
            by_count[layout.count] = layout
    return Design(
        problem,
        tuple(path[-1] for path in found[chosen]),
        best,
        dict(sorted(by_count.items())),
        {each.stiffness: one for each, one in zip(problems, bests, strict=True) if each.stiffness},
        search.sensitivities(best.found.positions, step=SENSITIVITY_STEP),
        _own(problem, sets),
        sets,
        resumed_count,
    )


def worthwhile_count(design: Design, worth: float) -> int:
    """The number of ERAs up to which each further one buys at least so much contrast [dB]."""
    means = {count: _mean(layout) for count, layout in design.by_count.items()}
    for count in sorted(means):
        if count >= design.problem.count or means.get(count + 1, 0.0) - means[count] < worth:
            return count
    return design.problem.count


def _mean(layout: JudgedLayout) -> float:
    return layout.judged.mean_db


def judged_sets(problem: DesignProblem) -> list[FloatArray]:
    """Fresh contact sets."""
    return problem.contacts.sets(JUDGED_SETS, seed=problem.seed + JUDGED_SEED)


def _as_they_are(problems: Sequence[DesignProblem]) -> Sequence[DesignProblem]:
    return problems


def _start(problems: Sequence[DesignProblem], task: tuple[int, int]) -> Arrays:
    """Layouts of one start of one problem, the last of the wanted number of ERAs."""
    problem, number = problems[task[0]], task[1]
    search = LayoutSearch(problem)
    if number == 0:
        found = list(_path(search))
    else:
        layout = search.random_layout(np.random.default_rng([problem.seed, number]))
        found = [search.refine(search.exchange(layout))]
    found = [each for each in found if each.is_supported]
    if not found or len(found[-1].positions) < problem.count:
        raise InputError(
            f"the plate must be supported by {problem.count} ERAs with its lowest rigid-body "
            f"frequency at least {problem.lowest:g} Hz and weight on each of them, got no such "
            "layout; add ERAs or stiffer ones, widen --where, or lower --lowest"
        )
    sets = judged_sets(problem)
    judged = [judge(problem.rig_with(each.positions), sets) for each in found]
    return {
        "positions": np.vstack([each.positions for each in found]),
        "scores": np.array([each.score_db for each in found]),
        "counts": np.array([len(each.positions) for each in found]),
        "quiet": judged[0].quiet,
        "answers": np.array([[each.contrast_db, each.level_db_sl] for each in judged]),
    }


def _path(search: LayoutSearch) -> Iterator[Found]:
    """Layouts of ever more ERAs, from those kept or as few as support the plate."""
    layout = search.kept_layout()
    while len(layout) < search.problem.count:
        layout = search.add(layout)
        if len(layout) + search.problem.supports >= MIN_SUPPORTING:
            layout = search.exchange(layout, sweeps=1 + (len(layout) == search.problem.count))
            yield search.refine(layout)
    if len(layout) == len(search.kept_layout()):
        yield search.refine(layout)


def _one_more(
    search: LayoutSearch, best: JudgedLayout, sets: list[FloatArray]
) -> list[JudgedLayout]:
    """The best layout with one ERA more."""
    found = search.one_more(best.found.positions)
    if found is None:
        return []
    return [JudgedLayout(found, judge(search.problem.rig_with(found.positions), sets))]


def _layouts(arrays: Arrays) -> Iterator[JudgedLayout]:
    ends = np.cumsum(arrays["counts"])
    parts = np.split(arrays["positions"], ends[:-1])
    for positions, score, (contrast, level) in zip(
        parts, arrays["scores"].tolist(), arrays["answers"], strict=True
    ):
        yield JudgedLayout(Found(positions, score), Judged(arrays["quiet"], contrast, level))


def _own(problem: DesignProblem, sets: list[FloatArray]) -> Judged | None:
    from model.structure.support import support_problem

    rig = problem.rig
    if support_problem(rig.plate, rig.eras, loads=rig.masses) is not None:
        return None
    return judge(rig, sets)
