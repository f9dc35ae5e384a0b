"""Running a design: layouts searched or given, judged on processes.

A layout is judged by the answers of its localization table to fresh contact sets.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any, TypeAlias

import numpy as np

from model.answer.plan import answer
from model.answer.stimulus import Finger, Stimulus
from model.arrays import FloatArray, IntArray, best_by, best_first
from model.config.document import Document
from model.design.layout_keys import layout_keys
from model.design.problem import DesignProblem, NamedLayouts
from model.design.search import LayoutSearch, ScoredLayout
from model.drive_modes import UNRESTRICTED
from model.errors import InputError
from model.finger import STRONG_DB_SL
from model.processes import Progress, on_processes, unseen
from model.rig.rig import Rig
from model.rig.rig_file import rig_of
from model.rig.rig_writing import stated
from model.structure.attachments import support_problem
from model.structure.exciter import Actuator
from model.table.table import LocalizationTable
from model.table.table_file import build_table

SENSITIVITY_STEP = 0.005
"""Step [m] of an ERA by which the sensitivity to its place is measured."""

DEFAULT_FINALISTS = 5
"""Given layouts of each number and stiffness of ERAs that are judged."""

CHUNK = 100
"""Given layouts that are scored together, about a second of work."""

Machines: TypeAlias = Callable[..., Iterator[tuple[int, Any]]]
"""Solves tasks: `model.processes.on_processes` or `model.processes.on_cluster` somewhere."""

_HERE: Machines = partial(on_processes, 1)

_search_of = lru_cache(maxsize=4)(LayoutSearch)


_LEVEL_MARGIN = 0.1  # dB


@dataclass(frozen=True, eq=False)
class Assessment:
    """Answers at contact sets (s,): promised felt contrast [dB] of the worst finger.

    quiet (s,): numbers of quiet fingers; level_db_sl (s,): promised level of the weakest content.
    """

    quiet: IntArray
    contrast_db: FloatArray
    level_db_sl: FloatArray

    def __repr__(self) -> str:
        return f"<Assessment of {len(self.quiet)} sets: {self.mean_db:.1f} dB>"

    @property
    def mean_db(self) -> float:
        """Mean contrast [dB], each number of quiet fingers counting the same."""
        return float(np.mean([self.contrast_db[self.quiet == k].mean() for k in self.kinds]))

    @property
    def kinds(self) -> list[int]:
        """Numbers of quiet fingers, ascending."""
        return [int(each) for each in np.unique(self.quiet)]

    def median_db(self, quiet: int) -> float:
        """Median contrast [dB] with a number of quiet fingers."""
        return float(np.median(self.contrast_db[self.quiet == quiet]))

    @property
    def summary(self) -> dict[str, float]:
        """Mean and medians [dB] for JSON."""
        return {"mean": self.mean_db} | {f"median_{k}_quiet": self.median_db(k) for k in self.kinds}

    @property
    def reached_share(self) -> float:
        """Share of the sets whose contents have the level on nine of ten plates."""
        return float((self.level_db_sl >= STRONG_DB_SL - _LEVEL_MARGIN).mean())


def judge(rig: Rig, sets: Sequence[FloatArray], *, contents: int = 1) -> Assessment:
    """What a rig's table answers at contact sets (fingers, 2) [m], fingers with contents first.

    For contents of STRONG_DB_SL, where it cannot be reached for the highest found, none of which is
    shared or held back. Raises InputError for ERAs that do not support the plate.
    """
    table = build_table(rig, drive_mode="phased")
    contrast, level = np.array([_answer(table, contacts, contents) for contacts in sets]).T
    quiet = np.array([len(contacts) - contents for contacts in sets])
    return Assessment(quiet, contrast, level)


def _answer(table: LocalizationTable, contacts: FloatArray, contents: int) -> tuple[float, float]:
    places = [(float(x), float(y)) for x, y in contacts]
    fingers = [Finger(at, Stimulus()) for at in places[:contents]]
    found = answer(
        table,
        fingers,
        quiet=places[contents:],
        drive_mode=UNRESTRICTED,
        min_contrast_db=-math.inf,
    )
    assert found.promised_worst_db is not None  # noqa: S101  a set has two fingers
    level = min(each.promised_level_db_sl for each in found.fingers[:contents])
    return found.promised_worst_db, level


@dataclass(frozen=True, eq=False)
class RankedLayout:
    """A layout of a design, and its answers on fresh contact sets if it was judged.

    name: of a given one, or the number of its start; judged: its answers, to compare with `own` of
    the design.
    """

    problem: DesignProblem
    name: str
    found: ScoredLayout
    judged: Assessment | None = None

    @property
    def count(self) -> int:
        """Number of ERAs."""
        return len(self.found.positions)

    @property
    def answers(self) -> Assessment:
        """Answers of one that was judged."""
        assert self.judged is not None  # noqa: S101
        return self.judged

    @property
    def mean_db(self) -> float:
        """Mean contrast of one that was judged [dB]."""
        return self.answers.mean_db

    @property
    def eras(self) -> tuple[Actuator, ...]:
        """Its ERAs, without wiring."""
        return self.problem.eras(self.found.positions)

    @property
    def contrast(self) -> float | None:
        """Promised felt contrast [dB], mean over numbers of quiet fingers, if it was judged."""
        return None if self.judged is None else self.mean_db

    @property
    def expected_contrast(self) -> float | None:
        """The score [dB] that ranks others, None where it does not support the plate."""
        return self.found.score_db if self.found.is_supported else None

    @property
    def rig(self) -> Rig:
        """The rig with these ERAs on free channels, if need be of another, simulated amplifier."""
        keys = layout_keys(self.problem, self.found.positions, stated(self.problem.rig).data)
        return rig_of(Document("RankedLayout.rig", "", keys, {}))


@dataclass(frozen=True, eq=False)
class Design:
    """Result of a design.

    layouts: judged ones first by their mean contrast, then others by score; starts: ends of the
    best problem's searches; by_count: the best judged for each number of ERAs of that problem;
    by_stiffness: the best for each stiffness [N/m] tried; sensitivities (n,): change of the score
    [dB/m] with the place of each ERA of the best; own: the rig's own layout, None if it does not
    support the plate.
    """

    layouts: tuple[RankedLayout, ...]
    starts: tuple[RankedLayout, ...]
    by_count: dict[int, RankedLayout]
    by_stiffness: dict[float, RankedLayout]
    sensitivities: FloatArray
    own: Assessment | None
    sets: list[FloatArray]

    def __repr__(self) -> str:
        best = f"{self.best.name}, {self.best.count} ERAs, {self.best.mean_db:.1f} dB"
        return f"<Design of {len(self.layouts)} layouts: {best}>"

    @property
    def best(self) -> RankedLayout:
        """The layout of the most contrast of as many ERAs as were sought."""
        return self.layouts[0]

    @property
    def problem(self) -> DesignProblem:
        """That of the best layout."""
        return self.best.problem

    @property
    def gap_db(self) -> float:
        """How far the worst start is behind the best [dB]."""
        return max((self.best.mean_db - each.mean_db for each in self.starts), default=0.0)


@dataclass(frozen=True)
class Runner:
    """Solves tasks on machines; progress: of one stage after the other."""

    machines: Machines = _HERE
    progress: Progress = unseen

    def run(
        self, solve: Callable[[Any, Any], Any], shared: object, tasks: Sequence[Any]
    ) -> list[Any]:
        """Results of tasks, in their order."""
        done: dict[int, Any] = {}
        for number, result in self.machines(solve, shared, dict(enumerate(tasks))):
            done[number] = result
            self.progress(len(done), len(tasks))
        return [done[number] for number in range(len(tasks))]


def search_layouts(problems: Sequence[DesignProblem], *, starts: int, runner: Runner) -> Design:
    """Search from several starts and judge what they find, for problems of different stiffness.

    The first start adds one ERA after the other and so gives a layout for each number; the others
    begin at random. Raises InputError for an area without room, and where no layout supports the
    plate.
    """
    tasks = [(number, start) for number in range(len(problems)) for start in range(starts)]
    layouts = [
        RankedLayout(problems[number], f"start {start}", each)
        for (number, start), found in zip(tasks, runner.run(_start, problems, tasks), strict=True)
        for each in found
    ]
    for problem in problems:
        ends = [each for each in layouts if each.problem is problem and each.count == problem.count]
        if len(ends) < starts:
            raise InputError(
                f"the plate must be supported by {problem.count} ERAs with its lowest rigid-body "
                f"frequency at least {problem.lowest:g} Hz and weight on each of them, got no such "
                "layout; add ERAs or stiffer ones, widen where, or reduce lowest"
            )
    judged = _judged(layouts, runner)
    ends = [each for each in judged if each.count == each.problem.count]
    best = best_by(ends, lambda each: each.mean_db)
    further = _search_of(best.problem).one_more(best.found.positions)
    if further is not None:
        judged += _judged([RankedLayout(best.problem, "one more", further)], runner)
    return _design(best, judged, [each for each in ends if each.problem is best.problem], runner)


def rank_layouts(
    given: Mapping[DesignProblem, NamedLayouts], *, finalists: int, runner: Runner
) -> Design:
    """Rank given layouts, some of which support the plate; of each problem the first are judged."""
    problems = list(given)
    chunks = [
        (number, dict(list(given[problem].items())[at : at + CHUNK]))
        for number, problem in enumerate(problems)
        for at in range(0, len(given[problem]), CHUNK)
    ]
    tasks = [(number, list(chunk.values())) for number, chunk in chunks]
    scored = runner.run(_score, problems, tasks)
    layouts = [
        RankedLayout(problems[number], name, each)
        for (number, chunk), found in zip(chunks, scored, strict=True)
        for name, each in zip(chunk, found, strict=True)
    ]
    order = best_first([each.found.score_db for each in layouts]).tolist()
    ranked = [layouts[each] for each in order]
    supported = [each for each in ranked if each.found.is_supported]
    chosen = []
    for problem in problems:
        chosen += [each for each in supported if each.problem is problem][:finalists]
    judged = _judged(chosen, runner)
    rest = [each for each in ranked if each not in chosen]
    return _design(best_by(judged, lambda each: each.mean_db), judged + rest, [], runner)


def _design(
    best: RankedLayout, layouts: list[RankedLayout], starts: list[RankedLayout], runner: Runner
) -> Design:
    """The result of layouts, of which some were judged, the best among them."""
    judged = [each for each in layouts if each.judged is not None]
    order = best_first([each.mean_db for each in judged]).tolist()
    ranked = [judged[each] for each in order]
    by_count: dict[int, RankedLayout] = {}
    by_stiffness: dict[float, RankedLayout] = {}
    for each in [best, *ranked]:
        if each.problem is best.problem or not starts:
            by_count.setdefault(each.count, each)
        if each.problem.stiffness is not None and each.count == each.problem.count:
            by_stiffness.setdefault(each.problem.stiffness, each)
    problem = best.problem
    rest = [each for each in (*ranked, *layouts) if each is not best]
    own = None
    rig = problem.rig
    if support_problem(rig.plate, rig.eras, loads=rig.masses) is None:
        (own,) = runner.run(_answers, [problem], [(0, None)])
    return Design(
        (best, *dict.fromkeys(rest)),
        tuple(starts),
        dict(sorted(by_count.items())),
        dict(sorted(by_stiffness.items())),
        _search_of(problem).sensitivities(best.found.positions, step=SENSITIVITY_STEP),
        own,
        problem.judged_sets(),
    )


def _judged(layouts: Sequence[RankedLayout], runner: Runner) -> list[RankedLayout]:
    """The layouts with their answers; those of several starts that end in one are found once."""
    problems = list(dict.fromkeys(each.problem for each in layouts))
    keys = [(problems.index(each.problem), each.found.positions.tobytes()) for each in layouts]
    different = dict(zip(keys, layouts, strict=True))
    tasks = [(number, each.found.positions) for (number, _), each in different.items()]
    answers = dict(zip(different, runner.run(_answers, problems, tasks), strict=True))
    return [replace(each, judged=answers[key]) for key, each in zip(keys, layouts, strict=True)]


def _start(problems: Sequence[DesignProblem], task: tuple[int, int]) -> list[ScoredLayout]:
    """Layouts of one start of one problem, the last of the number of ERAs that is sought."""
    number, start = task
    problem = problems[number]
    search = _search_of(problem)
    if start == 0:
        found = list(search.path())
    else:
        found = [search.from_random(np.random.default_rng([problem.seed, start]))]
    return [each for each in found if each.is_supported]


def _score(
    problems: Sequence[DesignProblem], task: tuple[int, list[FloatArray]]
) -> list[ScoredLayout]:
    """Scores of given layouts of one problem."""
    number, layouts = task
    return _search_of(problems[number]).scored(layouts)


def _answers(problems: Sequence[DesignProblem], task: tuple[int, FloatArray | None]) -> Assessment:
    """What positions of ERAs, None for the rig's own, give on fresh contact sets."""
    problem, positions = problems[task[0]], task[1]
    rig = problem.rig if positions is None else problem.rig_with(positions)
    return judge(rig, problem.judged_sets(), contents=problem.contacts.contents)
