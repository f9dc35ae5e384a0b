"""Search or rank ERA layouts, and evaluate them on parallel processes.

A layout is evaluated in full by querying its localization table at contact sets that no search has
used. `design` checks the arguments, then searches or ranks layouts.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from os import PathLike
from typing import Any

import numpy as np

from era_haptics.lab.design.assessment import Assessment, assess
from era_haptics.lab.design.contact_rule import contact_rule
from era_haptics.lab.design.design_arguments import (
    checked_stiffnesses,
    expect_kept,
    expect_real_numbers,
    expect_whole_numbers,
)
from era_haptics.lab.design.era_area import EDGE, area_of
from era_haptics.lab.design.given_layouts import NamedLayouts, supported_layouts
from era_haptics.lab.design.layout_search import LayoutSearch, ScoredLayout
from era_haptics.lab.design.problem import DEFAULT_ERA_GAP, DEFAULT_LOWEST, DesignProblem
from era_haptics.lab.design.results import Design, RankedLayout
from era_haptics.lab.design.runner import LayoutListener, Machines, Runner, ignore_layout
from model.arrays import FloatArray, best_by, best_first
from model.errors import (
    InputError,
    expect_instance,
    expect_path,
    is_whole,
)
from model.processes import Progress, check_progress, on_cluster, on_processes, unseen
from model.rig.rig import Rig
from model.structure.statics import support_problem

SENSITIVITY_STEP = 0.005
"""Displacement of an ERA [m] for the sensitivity to its position."""

DEFAULT_FINALISTS = 5
"""Number of given layouts evaluated in full, per ERA count and stiffness."""

CHUNK = 100
"""Given layouts scored per task, about a second of work."""

_search_of = lru_cache(maxsize=4)(LayoutSearch)


def design(
    rig: Rig,
    eras: int | Sequence[int] | None = None,
    *,
    layouts: str | PathLike[str] | None = None,
    keep: Sequence[str] = (),
    where: str | PathLike[str] = EDGE,
    contacts: str | PathLike[str] | None = None,
    contents: int = 1,
    apart: float = DEFAULT_ERA_GAP,
    lowest: float = DEFAULT_LOWEST,
    stiffness: Sequence[float] = (),
    finalists: int = DEFAULT_FINALISTS,
    starts: int = 4,
    seed: int = 0,
    workers: int | None = None,
    cluster: str | None = None,
    progress: Progress = unseen,
    on_layout: LayoutListener = ignore_layout,
) -> Design:
    """Search or rank layouts of ERAs, the best promised felt contrast first, like `era design`.

    - eras: number of ERAs, or several numbers; None: as many as the rig has.
    - layouts: None to search, `random:N` or a file to rank layouts.
    - keep: names of ERAs that keep their positions.
    - where: `edge`, `anywhere` or a file.
    - contacts: a file; None: anywhere.
    - contents: number of simultaneous contents, one finger each.
    - apart [m]: minimum distance between ERAs.
    - lowest [Hz]: minimum rigid-body frequency of a supported plate.
    - stiffness [N/m]: candidates for new ERAs; the best is used. Empty: the rig's stiffness.
    - finalists: number of given layouts that are evaluated in full.
    - starts: number of starting layouts of a search.
    - workers: number of processes; None: one.
    - cluster: address of a Dask scheduler, instead of workers.
    - progress: called with the number of tasks done and the total, separately for each stage.
    - on_layout: called with every layout as soon as it is scored, and again once it is evaluated in
      full.

    Raises InputError.

    Example:
        >>> designed = era.design(rig, 4, layouts="random:6", finalists=2)
        >>> better = designed.best.rig
    """
    expect_instance(rig, Rig, what="rig", made_by='era.load_rig("rig.yaml")')
    check_progress(progress)
    requested: Any = len(rig.eras) if eras is None else eras
    counts = [requested] if is_whole(requested) or isinstance(requested, str) else requested
    expect_instance(counts, Sequence, what="eras", made_by="range(3, 7)")
    expect_instance(keep, Sequence, what="keep", made_by='["SW"]')
    expect_instance(stiffness, Sequence, what="stiffness", made_by="[17e3]")
    expect_whole_numbers(
        {
            "contents": (contents, 1),
            "finalists": (finalists, 1),
            "starts": (starts, 1),
            "seed": (seed, 0),
            "workers": (1 if workers is None else workers, 1),
        },
        counts,
    )
    expect_real_numbers(apart, lowest, stiffness)
    if not 0 < apart < max(rig.plate.length, rig.plate.width):
        raise InputError(f"apart must be above 0 and below the plate's length, got {apart:g} m")
    expect_kept(rig, keep, min(counts))
    stiffnesses = checked_stiffnesses(stiffness) or [None]
    contacts_path = None if contacts is None else expect_path(contacts, what="contacts")
    rule = contact_rule(contacts_path, rig.plate, contents)
    area = area_of(str(expect_path(where, what="where")), rig.plate)
    problems = []
    for count in counts:
        for value in stiffnesses:
            problem = DesignProblem(
                rig=rig,
                count=count,
                area=area,
                contacts=rule,
                kept=tuple(keep),
                apart=float(apart),
                lowest=float(lowest),
                seed=seed,
                stiffness=value,
            )
            problems.append(problem)
    runner = Runner(_machines_of(workers, cluster), progress, on_layout)
    if layouts is None:
        return search_layouts(problems, starts=starts, runner=runner)
    layouts_text = str(expect_path(layouts, what="layouts"))
    given_layouts = supported_layouts(layouts_text, problems)
    return rank_layouts(given_layouts, finalists=finalists, runner=runner)


def _machines_of(workers: int | None, cluster: str | None) -> Machines:
    """Return the processes, or the cluster, that solve the tasks."""
    if cluster is None:
        return partial(on_processes, workers or 1)
    if workers is not None:
        raise InputError("only one of workers and cluster can be given")
    return partial(on_cluster, cluster)


def search_layouts(problems: Sequence[DesignProblem], *, starts: int, runner: Runner) -> Design:
    """Search from several starts, and evaluate the results, for problems of different stiffness.

    The first start adds one ERA after the other and so produces a layout for each number; the
    others start at random. Raises InputError if the area has no room, or if no layout supports the
    plate.
    """
    tasks = [(number, start) for number in range(len(problems)) for start in range(starts)]

    def layouts_of_start(task: int, scored_layouts: list[ScoredLayout]) -> list[RankedLayout]:
        number, start = tasks[task]
        name = f"start {start}"
        return [RankedLayout(problems[number], name, scored) for scored in scored_layouts]

    layouts = runner.run_layouts(_solve_start, problems, tasks, layouts_of_start)
    for problem in problems:
        own_layouts = [layout for layout in layouts if layout.problem is problem]
        if len(_with_all_eras(own_layouts)) < starts:
            raise InputError(
                f"the plate must be supported by {problem.count} ERAs with its lowest rigid-body "
                f"frequency at least {problem.lowest:g} Hz and weight on each of them, got no such "
                "layout; add ERAs or stiffer ones, widen where, or reduce lowest"
            )
    evaluated = _evaluated(layouts, runner)
    final_layouts = _with_all_eras(evaluated)
    best = best_by(final_layouts, lambda layout: layout.mean_db)
    larger = _search_of(best.problem).one_more(best.found.positions)
    if larger is not None:
        one_more = RankedLayout(best.problem, "one more", larger)
        evaluated += _evaluated([one_more], runner)
    best_starts = [layout for layout in final_layouts if layout.problem is best.problem]
    return _assembled(best, evaluated, best_starts, runner)


def _with_all_eras(layouts: Sequence[RankedLayout]) -> list[RankedLayout]:
    """Return the layouts with the requested number of ERAs."""
    return [layout for layout in layouts if layout.count == layout.problem.count]


def rank_layouts(
    given: Mapping[DesignProblem, NamedLayouts], *, finalists: int, runner: Runner
) -> Design:
    """Rank given layouts (some support the plate); evaluate the first of each problem in full."""
    problems = list(given)
    chunks = []
    for number, problem in enumerate(problems):
        named_layouts = list(given[problem].items())
        for start in range(0, len(named_layouts), CHUNK):
            chunks.append((number, dict(named_layouts[start : start + CHUNK])))
    tasks = [(number, list(chunk.values())) for number, chunk in chunks]

    def layouts_of_chunk(task: int, scored_layouts: list[ScoredLayout]) -> list[RankedLayout]:
        number, chunk = chunks[task]
        rows = zip(chunk, scored_layouts, strict=True)
        return [RankedLayout(problems[number], name, scored) for name, scored in rows]

    layouts = runner.run_layouts(_score_chunk, problems, tasks, layouts_of_chunk)
    order = best_first([layout.found.score_db for layout in layouts]).tolist()
    ranked = [layouts[position] for position in order]
    supported = [layout for layout in ranked if layout.found.is_supported]
    finals: list[RankedLayout] = []
    for problem in problems:
        own_layouts = [layout for layout in supported if layout.problem is problem]
        finals += own_layouts[:finalists]
    evaluated = _evaluated(finals, runner)
    unevaluated = [layout for layout in ranked if layout not in finals]
    best = best_by(evaluated, lambda layout: layout.mean_db)
    return _assembled(best, evaluated + unevaluated, [], runner)


def _assembled(
    best: RankedLayout, layouts: list[RankedLayout], starts: list[RankedLayout], runner: Runner
) -> Design:
    """Assemble the result from layouts (some evaluated in full) and the best layout."""
    evaluated = [layout for layout in layouts if layout.judged is not None]
    order = best_first([layout.mean_db for layout in evaluated]).tolist()
    ranked = [evaluated[position] for position in order]
    problem = best.problem
    by_count: dict[int, RankedLayout] = {}
    by_stiffness: dict[float, RankedLayout] = {}
    for layout in [best, *ranked]:
        if layout.problem is problem or not starts:
            by_count.setdefault(layout.count, layout)
        stiffness = layout.problem.stiffness
        if stiffness is not None and layout.count == layout.problem.count:
            by_stiffness.setdefault(stiffness, layout)
    without_best = [layout for layout in (*ranked, *layouts) if layout is not best]
    own = None
    rig = problem.rig
    if support_problem(rig.plate, rig.eras, loads=rig.masses) is None:
        (own,) = runner.run(_answer_sets, [problem], [(0, None)])
    search = _search_of(problem)
    sensitivities = search.sensitivities(best.found.positions, step=SENSITIVITY_STEP)
    return Design(
        layouts=(best, *dict.fromkeys(without_best)),
        starts=tuple(starts),
        by_count=dict(sorted(by_count.items())),
        by_stiffness=dict(sorted(by_stiffness.items())),
        sensitivities=sensitivities,
        own=own,
        sets=problem.judged_sets(),
    )


def _evaluated(layouts: Sequence[RankedLayout], runner: Runner) -> list[RankedLayout]:
    """Return the layouts with their answers; layouts reached by several starts count once."""
    problems = list(dict.fromkeys(layout.problem for layout in layouts))
    keys = []
    for layout in layouts:
        number = problems.index(layout.problem)
        keys.append((number, layout.found.positions.tobytes()))
    different = dict(zip(keys, layouts, strict=True))
    distinct = list(different.values())
    tasks = [(number, layout.found.positions) for (number, _), layout in different.items()]

    def evaluated_layout(task: int, assessment: Assessment) -> list[RankedLayout]:
        return [replace(distinct[task], judged=assessment)]

    evaluated = runner.run_layouts(_answer_sets, problems, tasks, evaluated_layout)
    answers = {key: layout.judged for key, layout in zip(different, evaluated, strict=True)}
    rows = zip(keys, layouts, strict=True)
    return [replace(layout, judged=answers[key]) for key, layout in rows]


# Tasks


def _solve_start(problems: Sequence[DesignProblem], task: tuple[int, int]) -> list[ScoredLayout]:
    """Return the layouts of a start for a problem; the last has the requested number of ERAs."""
    number, start = task
    problem = problems[number]
    search = _search_of(problem)
    if start == 0:
        layouts = list(search.path())
    else:
        rng = np.random.default_rng([problem.seed, start])
        layouts = [search.from_random(rng)]
    return [layout for layout in layouts if layout.is_supported]


def _score_chunk(
    problems: Sequence[DesignProblem], task: tuple[int, list[FloatArray]]
) -> list[ScoredLayout]:
    """Score given layouts of a problem."""
    number, layouts = task
    return _search_of(problems[number]).scored(layouts)


def _answer_sets(
    problems: Sequence[DesignProblem], task: tuple[int, FloatArray | None]
) -> Assessment:
    """Answer new contact sets with ERAs at given positions, None for the rig's own."""
    number, positions = task
    problem = problems[number]
    rig = problem.rig if positions is None else problem.rig_with(positions)
    return assess(rig, problem.judged_sets(), contents=problem.contacts.contents)
