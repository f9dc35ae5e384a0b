"""Search or rank ERA layouts, evaluate them on parallel processes, and write the results.

A layout is evaluated in full by querying its localization table at contact sets that no search has
used. `design` checks the arguments, then searches or ranks layouts. `write_design` writes the rig
with the best layout, a table of all layouts, pictures and a template.
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
from model.figures import (
    COLORS,
    PAGE_WIDTH,
    SMALL_TEXT,
    Template,
    draw_eras,
    label_plate,
    save_figure,
    write_template,
)
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
"""Channels per added amplifier."""

SENSITIVITY_STEP = 0.005
"""Displacement of an ERA [m] for the sensitivity to its position."""

DEFAULT_FINALISTS = 5
"""Number of given layouts evaluated in full, per ERA count and stiffness."""

CHUNK = 100
"""Given layouts scored per task, about a second of work."""

Machines: TypeAlias = Callable[..., Iterator[tuple[int, Any]]]
"""Solves tasks: `model.processes.on_processes`, or `model.processes.on_cluster` with an address."""

_HERE: Machines = partial(on_processes, 1)

_search_of = lru_cache(maxsize=4)(LayoutSearch)

_LEVEL_MARGIN = 0.1  # dB

MAX_SHOWN = 10
"""Layouts in a summary; the CSV file contains all."""

MAX_STIFFNESSES, MAX_ERAS = 9, 32


@dataclass(frozen=True, eq=False)
class Assessment:
    """Answers for contact sets (s,), with the promised felt contrast [dB] of the worst finger.

    quiet (s,): number of quiet fingers; level_db_sl (s,): promised level of the weakest content.
    """

    quiet: IntArray
    contrast_db: FloatArray
    level_db_sl: FloatArray

    def __repr__(self) -> str:
        return f"<Assessment of {len(self.quiet)} sets: {self.mean_db:.1f} dB>"

    @property
    def mean_db(self) -> float:
        """Mean contrast [dB]; every number of quiet fingers has the same weight."""
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
        """Return mean and medians [dB] for JSON."""
        return {"mean": self.mean_db} | {f"median_{k}_quiet": self.median_db(k) for k in self.kinds}

    @property
    def reached_share(self) -> float:
        """Fraction of the sets in which all contents reach their level on 90 % of plates."""
        return float((self.level_db_sl >= STRONG_DB_SL - _LEVEL_MARGIN).mean())


@dataclass(frozen=True, eq=False)
class RankedLayout:
    """Layout of a design, with its answers at new contact sets if it was evaluated in full.

    name: name of a given layout, or number of the search's start; judged: the answers, comparable
    with `Design.own`.
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
        """Answers of a fully evaluated layout."""
        assert self.judged is not None  # noqa: S101
        return self.judged

    @property
    def mean_db(self) -> float:
        """Mean contrast of a fully evaluated layout [dB]."""
        return self.answers.mean_db

    @property
    def eras(self) -> tuple[Actuator, ...]:
        """ERAs of the layout, without wiring."""
        return self.problem.eras(self.found.positions)

    @property
    def contrast(self) -> float | None:
        """Promised felt contrast [dB], averaged over numbers of quiet fingers; None unless
        evaluated in full."""
        return None if self.judged is None else self.mean_db

    @property
    def score(self) -> float | None:
        """Score that ranks layouts before full evaluation; None if the plate is not supported.

        It has no unit and cannot be compared with a contrast.
        """
        return self.found.score_db if self.found.is_supported else None

    @property
    def expected_contrast(self) -> float | None:
        """The score, under its former name."""
        return self.score

    @property
    def rig(self) -> Rig:
        """The rig with these ERAs on free channels, if necessary on a new, simulated amplifier."""
        keys = layout_keys(self.problem, self.found.positions, stated(self.problem.rig).data)
        return rig_of(Document("RankedLayout.rig", "", keys))


@dataclass(frozen=True, eq=False)
class Design:
    """Result of a design.

    - layouts: fully evaluated ones by mean contrast, then the others by score.
    - starts: final layouts of the searches with the best stiffness.
    - by_count: best evaluated layout for each number of ERAs, with the best stiffness.
    - by_stiffness: best layout for each stiffness [N/m] tried.
    - sensitivities (n,): change of the score [dB/m] with the position of each ERA of the best
      layout.
    - own: the rig's own layout, None if it does not support the plate.
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
        """The layout with the highest contrast among those with the requested number of ERAs."""
        return self.layouts[0]

    @property
    def problem(self) -> DesignProblem:
        """The problem that the best layout solves."""
        return self.best.problem

    @property
    def gap_db(self) -> float:
        """How far the worst start is below the best [dB]."""
        return max((self.best.mean_db - each.mean_db for each in self.starts), default=0.0)


LayoutListener: TypeAlias = Callable[[RankedLayout], None]
"""Called with every layout as soon as it is scored, and again once it is evaluated in full."""


def ignore_layout(layout: RankedLayout) -> None:
    """Ignore a layout (default listener)."""


@dataclass(frozen=True)
class Runner:
    """Solves tasks on machines."""

    machines: Machines = _HERE
    progress: Progress = unseen
    """Progress of the current stage."""
    on_layout: LayoutListener = ignore_layout

    def run(
        self,
        solve: Callable[[Any, Any], Any],
        shared: object,
        tasks: Sequence[Any],
        on_result: Callable[[int, Any], None] = lambda number, result: None,
    ) -> list[Any]:
        """Return the results of tasks, in their order.

        on_result: called with each task's number and result as soon as it is done.
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
        """Return the layouts of all results, in the order of their tasks, and notify the listener.

        layouts_of_result: converts a task's number and result to layouts.
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
    """Search from several starts, and evaluate the results, for problems of different stiffness.

    The first start adds one ERA after the other and so produces a layout for each number; the
    others start at random. Raises InputError if the area has no room, or if no layout supports the
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
    """Rank given layouts (some support the plate); evaluate the first of each problem in full."""
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
    """Assemble the result from layouts (some evaluated in full) and the best layout."""
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
    """Return the layouts with their answers; layouts reached by several starts count once."""
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
    """Return the layouts of a start for a problem; the last has the requested number of ERAs."""
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
    """Score given layouts of a problem."""
    number, layouts = task
    return _search_of(problems[number]).scored(layouts)


def _answers(problems: Sequence[DesignProblem], task: tuple[int, FloatArray | None]) -> Assessment:
    """Answer new contact sets with ERAs at given positions, None for the rig's own."""
    problem, positions = problems[task[0]], task[1]
    rig = problem.rig if positions is None else problem.rig_with(positions)
    return assess(rig, problem.judged_sets(), contents=problem.contacts.contents)


def assess(rig: Rig, sets: Sequence[FloatArray], *, contents: int = 1) -> Assessment:
    """Answer contact sets (fingers, 2) [m], fingers with contents first, with a rig's table.

    Contents are at STRONG_DB_SL, or at the highest level found if that cannot be reached; none is
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
    """Write rig.yaml, layouts.csv, contrast.png, count.png and template.svg; data: of the rig file.

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
    """Return the text of the rig file with the best layout's ERAs on free channels."""
    keys = layout_keys(design.problem, design.best.found.positions, data)
    added = [name for name in keys["amplifiers"] if name not in design.problem.rig.amplifiers]
    comment = (
        f"# Designed for contrast: {design.best.count} ERAs, "
        f"{design.best.mean_db:.1f} dB over new contact sets.\n"
    )
    if added:
        comment += (
            f"# Replace the URLs of amplifiers {', '.join(added)} by URLs of real amplifiers.\n"
        )
    return comment + data_text(keys)


def layout_keys(
    problem: DesignProblem, positions: FloatArray, data: Mapping[str, Any]
) -> dict[str, Any]:
    """Return rig-file data with ERAs at positions [m], on free channels; data: of the original rig
    file.

    Missing amplifiers are added as simulated ones.
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
    """Return an ERA's keys with absolute damping, since a ratio depends on the number of ERAs.

    For an exciter, Q is converted likewise, since it depends on the stiffness.
    """
    replaced = _instead_of("damping", section)
    keys = {key: value for key, value in deepcopy(section).items() if key not in replaced}
    return keys | {"damping": float(f"{damping:.6g}")}


def _instead_of(key: str, section: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the keys that `key` replaces in an actuator of the section's kind."""
    return section_by_kind([*ACTUATOR_KINDS.values()], section).instead.get(key, ())


def _free_channels(rig: Rig, kept: tuple[str, ...], *, count: int) -> list[Channel]:
    """Return the rig's channels except the ones of kept ERAs, then channels of added amplifiers."""
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
    """Layouts of an interrupted design, as far as they were scored or evaluated in full."""

    def __init__(self) -> None:
        self._layouts: dict[tuple[DesignProblem, bytes], RankedLayout] = {}

    def add(self, layout: RankedLayout) -> None:
        """Add a scored layout, or replace it once it is evaluated in full."""
        key = layout.problem, layout.found.positions.tobytes()
        self._layouts[key] = layout

    @property
    def layouts(self) -> list[RankedLayout]:
        """Layouts that support the plate: fully evaluated ones by contrast, then the others by
        score."""
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
        """Write the best layouts as a file for the `layouts` argument of `design`.

        Raises OSError if it cannot be written.
        """
        positions = {}
        for rank, layout in enumerate(self.layouts[:MAX_SHOWN], start=1):
            added = layout.found.positions[len(layout.problem.kept) :]
            positions[f"{rank}: {_name(layout)}"] = added.tolist()
        comment = "# Layouts of an interrupted design, best first.\n"
        with whole_or_nothing(path) as stream:
            stream.write((comment + data_text({"layouts": positions})).encode())


def _name(layout: RankedLayout) -> str:
    """Return the name of a layout, unique across numbers of ERAs."""
    return f"{layout.name}, {counted(layout.count, 'ERA')}"


def _rank(layout: RankedLayout) -> tuple[bool, float]:
    """Return a key that sorts evaluated layouts by contrast, then the others by score."""
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
    """Draw the promised felt contrast of new contact sets, a panel per number of quiet fingers."""
    contents = design.problem.contacts.contents
    plate, judged = design.problem.rig.plate, design.best.answers
    eras = design.best.eras
    kinds = judged.kinds
    width = PAGE_WIDTH if len(kinds) > 1 else PAGE_WIDTH / 2
    panel_width = (width - 1.4) / len(kinds)
    height = panel_width * plate.width / plate.length + 1.1
    figure = Figure(figsize=(width, height), layout="compressed")
    panels = figure.subplots(1, len(kinds), squeeze=False, sharey=True)[0]
    targets = np.array([contacts[:contents] for contacts in design.sets])  # (sets, contents, 2)
    ends = np.percentile(judged.contrast_db, [2, 98])
    for axes, quiet in zip(panels, kinds, strict=True):
        chosen = judged.quiet == quiet
        image = axes.scatter(
            *(100 * targets[chosen].reshape(-1, 2).T),
            c=np.repeat(judged.contrast_db[chosen], contents),
            cmap=COLORS,
            vmin=ends[0],
            vmax=ends[1],
            s=20,
        )
        draw_eras(axes, eras, active=[era.name for era in eras])
        label_plate(axes)
        axes.set_xlim(0, 100 * plate.length)
        axes.set_ylim(0, 100 * plate.width)
        fingers = counted(int(quiet), "quiet finger")
        axes.set_title(f"{fingers}: median {judged.median_db(quiet):.1f} dB", fontsize=9)
        axes.label_outer()
    figure.colorbar(image, ax=panels, label="promised contrast / dB")
    figure.supxlabel("Circles: target fingers. Squares: ERAs.", fontsize=SMALL_TEXT)
    return figure


_COUNT_STYLES = (("--", "s"), ("-.", "^"), (":", "D"))  # line and marker


def count_figure(design: Design) -> Figure:
    """Draw contrast against the number of ERAs, and the gain of each."""
    counts = list(design.by_count)
    means = [layout.mean_db for layout in design.by_count.values()]
    figure = Figure(figsize=(5.2, 3.6), layout="constrained")
    axes = figure.subplots()
    axes.plot(counts, means, "o-", color="black", label="mean")
    for number, quiet in enumerate(design.best.answers.kinds):
        medians = [layout.answers.median_db(quiet) for layout in design.by_count.values()]
        line, marker = _COUNT_STYLES[number % len(_COUNT_STYLES)]
        label = f"{counted(int(quiet), 'quiet finger')}, median"
        axes.plot(counts, medians, line, marker=marker, ms=4, label=label)
    for count, low, high in zip(counts[1:], means, means[1:], strict=False):
        axes.annotate(f"{high - low:+.1f}", (count, high), (0, 7), textcoords="offset points")
    axes.set_xlabel("number of ERAs")
    axes.set_ylabel("promised contrast / dB")
    axes.set_xticks(counts)
    axes.margins(x=0.1)  # room for the last number next to its point
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    return figure
