"""A design: layouts of ERAs searched or given, judged on processes, and written as files.

A layout is judged by the answers of its localization table to contact sets that no search has seen.
`design` checks the request, then searches or ranks layouts; `write_design` writes the rig with the
best one, a table of all layouts, pictures and a template.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from os import PathLike
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from matplotlib.figure import Figure

from era_haptics.lab.design.problem import (
    DEFAULT_ERA_GAP,
    DEFAULT_LOWEST,
    EDGE,
    DesignProblem,
    NamedLayouts,
    area_of,
    contact_rule,
    supported_layouts,
)
from era_haptics.lab.design.score import LayoutSearch, ScoredLayout
from model.answer.plan import answer
from model.answer.stimulus import Finger, Stimulus
from model.arrays import FloatArray, IntArray, best_by, best_first
from model.config.document import Document, Value, data_text
from model.config.fields import section_by_kind
from model.errors import (
    MAX_VALUE,
    InputError,
    expect_between,
    expect_instance,
    expect_number,
    expect_path,
    is_whole,
    shown,
)
from model.figures import COLORS, Template, draw_eras, label_plate, save_figure, write_template
from model.files.array_file import whole_or_nothing
from model.files.csv_file import write_columns
from model.finger import STRONG_DB_SL
from model.processes import Progress, check_progress, on_cluster, on_processes, unseen
from model.quantities import counted
from model.rig.actuator_keys import ACTUATOR_KINDS
from model.rig.rig import Channel, Rig
from model.rig.rig_file import rig_of
from model.rig.rig_writing import stated
from model.structure.attachments import (
    MIN_RIGID_BODY_FREQUENCY,
    rigid_body_frequencies,
    static_loads,
    support_problem,
)
from model.structure.exciter import Actuator
from model.table.table import LocalizationTable
from model.table.table_file import build_table

_MAX_CHANNELS = 4
"""Channels of an amplifier beyond the rig's own ones."""

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

MAX_SHOWN = 10
"""Layouts in a summary; the CSV file has all."""

MAX_STIFFNESSES, MAX_ERAS = 9, 32


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
    def score(self) -> float | None:
        """A number that ranks layouts before they are judged; None if the plate is not supported.

        It has no unit and cannot be compared with a contrast.
        """
        return self.found.score_db if self.found.is_supported else None

    @property
    def expected_contrast(self) -> float | None:
        """The score, under its former name."""
        return self.score

    @property
    def rig(self) -> Rig:
        """The rig with these ERAs on free channels, if need be of another, simulated amplifier."""
        keys = layout_keys(self.problem, self.found.positions, stated(self.problem.rig).data)
        return rig_of(Document("RankedLayout.rig", "", keys))


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


LayoutListener: TypeAlias = Callable[[RankedLayout], None]
"""Is called with every layout as soon as it is scored, and again once it is judged."""


def ignore_layout(layout: RankedLayout) -> None:
    """Ignore a layout that was scored or judged."""


@dataclass(frozen=True)
class Runner:
    """Solves tasks on machines."""

    machines: Machines = _HERE
    progress: Progress = unseen
    """Of one stage after the other."""
    on_layout: LayoutListener = ignore_layout

    def run(
        self,
        solve: Callable[[Any, Any], Any],
        shared: object,
        tasks: Sequence[Any],
        on_result: Callable[[int, Any], None] = lambda number, result: None,
    ) -> list[Any]:
        """Return the results of tasks, in their order.

        on_result: called with the number of each task and its result as soon as it is done.
        """
        results: dict[int, Any] = {}
        for number, result in self.machines(solve, shared, dict(enumerate(tasks))):
            results[number] = result
            on_result(number, result)
            self.progress(len(results), len(tasks))
        return [results[number] for number in range(len(tasks))]

    def run_layouts(
        self,
        solve: Callable[[Any, Any], Any],
        shared: object,
        tasks: Sequence[Any],
        layouts_of_result: Callable[[int, Any], list[RankedLayout]],
    ) -> list[RankedLayout]:
        """Return the layouts of all results, in the order of their tasks; tell the listener.

        layouts_of_result: the layouts of a task's number and result.
        """

        def tell(number: int, result: Any) -> None:
            for layout in layouts_of_result(number, result):
                self.on_layout(layout)

        results = self.run(solve, shared, tasks, tell)
        layouts: list[RankedLayout] = []
        for number, result in enumerate(results):
            layouts += layouts_of_result(number, result)
        return layouts


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
    """Find or compare layouts of ERAs, the best promised felt contrast first, as `era design` does.

    eras: how many, or several numbers, as many as the rig's for None; layouts: None to search,
    `random:N` or a file to rank layouts; keep: names of ERAs that stay; where: `edge`, `anywhere`
    or a file; contacts: a file, anywhere for None; contents: at the same time, a finger for each;
    apart [m]: least distance of two ERAs; lowest [Hz]: least rigid-body frequency of a supported
    plate; stiffness [N/m]: of which new ERAs get the best, that of the rig's for none; finalists:
    given layouts that are judged by their tables' answers; starts: of a search; workers: processes,
    one for None; cluster: address of a Dask scheduler in their place; progress: called with the
    tasks done and all, of one stage after the other; on_layout: called with every layout as soon as
    it is scored, and again once it is judged. Raises InputError.

    Example:
        >>> designed = era.design(rig, 4, layouts="random:6", finalists=2)
        >>> better = designed.best.rig
    """
    expect_instance(rig, Rig, what="rig", made_by='era.load_rig("rig.yaml")')
    check_progress(progress)
    requested: Any = len(rig.eras) if eras is None else eras
    counts = [requested] if is_whole(requested) or isinstance(requested, str) else requested
    for what, row, made_by in (
        ("eras", counts, "range(3, 7)"),
        ("keep", keep, '["SW"]'),
        ("stiffness", stiffness, "[17e3]"),
    ):
        expect_instance(row, Sequence, what=what, made_by=made_by)
    for what, value, least in (
        *(("eras", each, 1) for each in (*counts, len(counts))),
        ("contents", contents, 1),
        ("finalists", finalists, 1),
        ("starts", starts, 1),
        ("seed", seed, 0),
        ("workers", 1 if workers is None else workers, 1),
    ):
        if not is_whole(value):
            raise InputError(f"{what} must be a whole number, got {shown(value)}")
        expect_between(value, least, MAX_ERAS if what == "eras" else MAX_VALUE, what=what)
    for what, number, unit in (
        ("apart", apart, "metres"),
        ("lowest", lowest, "hertz"),
        *(("stiffness", each, "newtons per metre") for each in stiffness),
    ):
        expect_number(number, what=what, unit=unit)
    expect_between(lowest, MIN_RIGID_BODY_FREQUENCY, what="lowest")
    if not 0 < apart < max(rig.plate.length, rig.plate.width):
        raise InputError(f"apart must be above 0 and below the plate's length, got {apart:g} m")
    own = [era.name for era in rig.eras]
    if any(each not in own or keep.count(each) > 1 for each in keep) or len(keep) > min(counts):
        raise InputError(
            f"keep must be up to {min(counts)} different ERAs of the rig, {', '.join(own)}, got "
            f"{', '.join(map(str, keep))}"
        )
    tried = sorted({float(each) for each in stiffness if 0 < each < math.inf})
    if len(tried) < len(stiffness) or len(tried) > MAX_STIFFNESSES:
        raise InputError(
            f"stiffness must be at most {MAX_STIFFNESSES} different values above 0 N/m, got "
            f"{', '.join(f'{each:g}' for each in stiffness)}"
        )
    rule = contact_rule(
        None if contacts is None else expect_path(contacts, what="contacts"), rig.plate, contents
    )
    area = area_of(str(expect_path(where, what="where")), rig.plate)
    problems = [
        DesignProblem(
            rig, count, area, rule, tuple(keep), float(apart), float(lowest), seed, stiffness=each
        )
        for count in counts
        for each in (tried or (None,))
    ]
    if cluster is not None and workers is not None:
        raise InputError("only one of workers and cluster can be given")
    machines: Machines = (
        partial(on_processes, workers or 1) if cluster is None else partial(on_cluster, cluster)
    )
    runner = Runner(machines, progress, on_layout)
    if layouts is None:
        return search_layouts(problems, starts=starts, runner=runner)
    return rank_layouts(
        supported_layouts(str(expect_path(layouts, what="layouts")), problems),
        finalists=finalists,
        runner=runner,
    )


def search_layouts(problems: Sequence[DesignProblem], *, starts: int, runner: Runner) -> Design:
    """Search from several starts and judge what they find, for problems of different stiffness.

    The first start adds one ERA after the other and so gives a layout for each number; the others
    begin at random. Raises InputError for an area without room, and where no layout supports the
    plate.
    """
    tasks = [(number, start) for number in range(len(problems)) for start in range(starts)]

    def layouts_of_start(task: int, found: list[ScoredLayout]) -> list[RankedLayout]:
        number, start = tasks[task]
        return [RankedLayout(problems[number], f"start {start}", scored) for scored in found]

    layouts = runner.run_layouts(_start, problems, tasks, layouts_of_start)
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

    def layouts_of_chunk(task: int, found: list[ScoredLayout]) -> list[RankedLayout]:
        number, chunk = chunks[task]
        return [
            RankedLayout(problems[number], name, scored)
            for name, scored in zip(chunk, found, strict=True)
        ]

    layouts = runner.run_layouts(_score, problems, tasks, layouts_of_chunk)
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
    distinct = list(different.values())
    tasks = [(number, each.found.positions) for (number, _), each in different.items()]

    def judged_layout(task: int, assessment: Assessment) -> list[RankedLayout]:
        return [replace(distinct[task], judged=assessment)]

    judged = runner.run_layouts(_answers, problems, tasks, judged_layout)
    answers = {key: layout.judged for key, layout in zip(different, judged, strict=True)}
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
    return assess(rig, problem.judged_sets(), contents=problem.contacts.contents)


def assess(rig: Rig, sets: Sequence[FloatArray], *, contents: int = 1) -> Assessment:
    """What a rig's table answers at contact sets (fingers, 2) [m], fingers with contents first.

    For contents of STRONG_DB_SL, where it cannot be reached for the highest found, none of which is
    shared or held back. Raises InputError for ERAs that do not support the plate.
    """
    table = build_table(rig)
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
        min_contrast_db=-math.inf,
    )
    assert found.promised_worst_db is not None  # noqa: S101  a set has two fingers
    level = min(each.promised_level_db_sl for each in found.fingers[:contents])
    return found.promised_worst_db, level


def write_design(folder: Path, design: Design, data: Mapping[str, Value]) -> list[Path]:
    """Write rig.yaml, layouts.csv, contrast.png, count.png and template.svg; data: of the file.

    Raises OSError if the folder cannot be written.
    """
    rig, table = folder / "rig.yaml", folder / "layouts.csv"
    with whole_or_nothing(rig) as stream:
        stream.write(rig_text(design, data).encode())
    rows = [_row(each) for each in design.layouts]
    at = [" ".join(f"({x:.6g};{y:.6g})" for x, y in row["at_m"].values()) for row in rows]
    columns = {key: ["" if row[key] is None else row[key] for row in rows] for key in rows[0]}
    contrast = [f"{each.mean_db:.6g}" if each.judged else "" for each in design.layouts]
    write_columns(
        table, {"rank": range(1, len(rows) + 1), **columns, "at_m": at, "contrast_db": contrast}
    )
    pictures = {"contrast.png": _contrast_figure, "count.png": count_figure}
    for name, figure in pictures.items():
        save_figure(figure(design), folder / name)
    template = folder / "template.svg"
    write_template(template, Template(replace(design.problem.rig, eras=design.best.eras), {}))
    return [rig, table, *(folder / name for name in pictures), template]


def rig_text(design: Design, data: Mapping[str, Value]) -> str:
    """The text of the rig's file with the ERAs of the best layout, on free channels."""
    keys = layout_keys(design.problem, design.best.found.positions, data)
    added = [name for name in keys["amplifiers"] if name not in design.problem.rig.amplifiers]
    comment = (
        f"# Designed for contrast: {design.best.count} ERAs, "
        f"{design.best.mean_db:.1f} dB over fresh contact sets.\n"
    )
    if added:
        comment += f"# Give the amplifiers {', '.join(added)} the URLs of real ones.\n"
    return comment + data_text(keys)


def layout_keys(
    problem: DesignProblem, positions: FloatArray, data: Mapping[str, Any]
) -> dict[str, Any]:
    """Data of a rig file with ERAs at positions [m], on free channels; data: of the rig's file.

    Amplifiers that are missing are added, simulated.
    """
    rig = problem.rig
    before, amplifiers = data["eras"], data["amplifiers"]
    channels = iter(_free_channels(rig, problem.kept, count=len(positions)))
    eras: dict[str, Any] = {}
    mounts = rig.masses[len(rig.masses) - len(rig.supports) :]
    for name, mount in zip(rig.supports, mounts, strict=True):
        eras[name] = _damped(before[name], mount.damping)
    used = {}
    like = _damped(before[problem.like.name], problem.like.damping)
    if problem.stiffness is not None:
        for key in _instead_of("stiffness", like):
            like.pop(key, None)
        like["stiffness"] = problem.stiffness
    for era in problem.eras(positions):
        if era.name in problem.kept:
            eras[era.name] = _damped(before[era.name], era.damping)
            continue
        channel = next(channels)
        used[channel.amplifier] = True
        eras[era.name] = deepcopy(like) | {
            "at": [round(era.x, 6), round(era.y, 6)],
            "amplifier": channel.amplifier,
            "channel": channel.number,
        }
    own = {rig.wiring[name].amplifier for name in problem.kept}
    given = {name: amplifiers[name] for name in amplifiers if name in own or name in used}
    added = {name: {"url": "sim://"} for name in used if name not in amplifiers}
    return {**data, "eras": eras, "amplifiers": {**given, **added}}


def _damped(section: Mapping[str, Any], damping: float) -> dict[str, Any]:
    """A copy of an ERA's keys with its damping by itself: a ratio refers to the number of ERAs.

    And a quality of an exciter to its stiffness.
    """
    replaced = _instead_of("damping", section)
    keys = {key: value for key, value in deepcopy(section).items() if key not in replaced}
    return keys | {"damping": float(f"{damping:.6g}")}


def _instead_of(key: str, section: Mapping[str, Any]) -> tuple[str, ...]:
    """Keys that one replaces in an actuator of the section's kind."""
    return section_by_kind([*ACTUATOR_KINDS.values()], section).instead.get(key, ())


def _free_channels(rig: Rig, kept: tuple[str, ...], *, count: int) -> list[Channel]:
    """The rig's channels without those of kept ERAs, and further amplifiers of _MAX_CHANNELS."""
    free = [channel for name, channel in rig.wiring.items() if name not in kept]
    names = (
        name for number in range(2, 99) if (name := f"amplifier{number}") not in rig.amplifiers
    )
    while len(free) < count:
        name = next(names)
        free += [Channel(name, number) for number in range(_MAX_CHANNELS)]
    return free


def design_summary(design: Design) -> dict[str, Any]:
    """The design for JSON."""
    problem, best = design.problem, design.best
    eras, rig = best.eras, problem.rig
    loads = static_loads(rig.plate, eras, loads=rig.masses)
    lowest = float(rigid_body_frequencies(rig.plate, eras, loads=rig.masses)[0])
    return {
        "eras": {
            era.name: {
                "at_m": [era.x, era.y],
                "sensitivity_db_per_mm": float(sensitivity) / 1000,
                "static_load_n": float(load),
            }
            for era, sensitivity, load in zip(eras, design.sensitivities, loads, strict=False)
        },
        "contrast_db": best.answers.summary,
        "own_contrast_db": None if design.own is None else design.own.summary,
        "reached_share": best.answers.reached_share,
        "starts_db": [each.mean_db for each in design.starts],
        "gap_db": design.gap_db,
        "by_count_db": {str(n): each.mean_db for n, each in design.by_count.items()},
        "by_stiffness_db": {
            f"{stiffness:g}": each.mean_db for stiffness, each in design.by_stiffness.items()
        },
        "layout_count": len(design.layouts),
        "unsupported": sum(not each.found.is_supported for each in design.layouts),
        "layouts": [
            {"rank": rank, **_row(each)}
            for rank, each in enumerate(design.layouts[:MAX_SHOWN], start=1)
        ],
        "lowest_rigid_body_hz": lowest,
        "contents": problem.contacts.contents,
        "sets": len(design.sets),
    }


class UnfinishedDesign:
    """The layouts of a design that was interrupted, as far as they were scored or judged."""

    def __init__(self) -> None:
        self._layouts: dict[tuple[DesignProblem, bytes], RankedLayout] = {}

    def add(self, layout: RankedLayout) -> None:
        """Add a layout that was scored, or replace it once it is judged."""
        key = layout.problem, layout.found.positions.tobytes()
        self._layouts[key] = layout

    @property
    def layouts(self) -> list[RankedLayout]:
        """Layouts that support the plate: judged ones by their contrast, then others by score."""
        supported = [layout for layout in self._layouts.values() if layout.found.is_supported]
        return sorted(supported, key=_rank)

    def summary(self) -> dict[str, Any]:
        """The layouts for JSON."""
        layouts = self.layouts
        return {
            "incomplete": True,
            "layout_count": len(layouts),
            "judged": sum(layout.judged is not None for layout in layouts),
            "layouts": [
                {"rank": rank, **_row(layout), "layout": _name(layout)}
                for rank, layout in enumerate(layouts[:MAX_SHOWN], start=1)
            ],
        }

    def write(self, path: Path) -> None:
        """Write the first layouts as a file that `design` takes as `layouts`.

        Raises OSError if it cannot be written.
        """
        positions = {}
        for rank, layout in enumerate(self.layouts[:MAX_SHOWN], start=1):
            added = layout.found.positions[len(layout.problem.kept) :]
            positions[f"{rank}: {_name(layout)}"] = added.tolist()
        comment = "# Layouts of a design that was interrupted, the best first.\n"
        with whole_or_nothing(path) as stream:
            stream.write((comment + data_text({"layouts": positions})).encode())


def _name(layout: RankedLayout) -> str:
    """The name of a layout among those of several numbers of ERAs."""
    return f"{layout.name}, {counted(layout.count, 'ERA')}"


def _rank(layout: RankedLayout) -> tuple[bool, float]:
    """A key that sorts judged layouts by their contrast, then others by their score."""
    if layout.judged is None:
        return True, -layout.found.score_db
    return False, -layout.mean_db


def _row(layout: RankedLayout) -> dict[str, Any]:
    """A layout for JSON."""
    eras = layout.eras
    return {
        "layout": layout.name,
        "at_m": {era.name: [era.x, era.y] for era in eras},
        "stiffness_n_m": eras[-1].in_time.stiffness,
        "supported": layout.found.is_supported,
        "score": layout.score,
        "expected_contrast_db": layout.score,  # its former name, for one release
        "contrast_db": layout.judged.summary if layout.judged else None,
    }


def _contrast_figure(design: Design) -> Figure:
    """Promised felt contrast of fresh contact sets at their contents, a panel by quiet fingers."""
    contents = design.problem.contacts.contents
    plate, judged = design.problem.rig.plate, design.best.answers
    eras = design.best.eras
    ratio = plate.width / plate.length
    kinds = judged.kinds
    figure = Figure(figsize=(3.4 * len(kinds) + 1, 3.0 * ratio + 1.2), layout="compressed")
    grid = figure.subplots(1, len(kinds), squeeze=False, sharey=True)[0]
    places = np.array([contacts[:contents] for contacts in design.sets])  # (sets, contents, 2)
    ends = np.percentile(judged.contrast_db, [2, 98])
    for axes, quiet in zip(grid, kinds, strict=True):
        chosen = judged.quiet == quiet
        image = axes.scatter(
            *(100 * places[chosen].reshape(-1, 2).T),
            c=np.repeat(judged.contrast_db[chosen], contents),
            cmap=COLORS,
            vmin=ends[0],
            vmax=ends[1],
            s=26,
        )
        draw_eras(axes, eras, active=[era.name for era in eras])
        label_plate(axes)
        axes.set_xlim(0, 100 * plate.length)
        axes.set_ylim(0, 100 * plate.width)
        axes.set_title(f"{quiet} quiet: median {judged.median_db(quiet):.1f} dB")
        axes.label_outer()
    figure.colorbar(image, ax=grid, label="promised contrast / dB")
    return figure


def count_figure(design: Design) -> Figure:
    """Contrast against the number of ERAs, with what each buys."""
    counts = list(design.by_count)
    means = [each.mean_db for each in design.by_count.values()]
    figure = Figure(figsize=(5.2, 3.6), layout="constrained")
    axes = figure.subplots()
    axes.plot(counts, means, "o-", color="black", label="mean")
    for quiet in design.best.answers.kinds:
        medians = [each.answers.median_db(quiet) for each in design.by_count.values()]
        axes.plot(counts, medians, "--", marker=".", label=f"{quiet} quiet, median")
    for count, low, high in zip(counts[1:], means, means[1:], strict=False):
        axes.annotate(f"{high - low:+.1f}", (count, high), (0, 7), textcoords="offset points")
    axes.set_xlabel("ERAs")
    axes.set_ylabel("promised contrast / dB")
    axes.set_xticks(counts)
    axes.margins(x=0.1)  # the last figure stands beside its point
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    return figure
