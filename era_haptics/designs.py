"""Places of ERAs for the best contrast, searched or given."""

from dataclasses import dataclass
from functools import partial
from os import PathLike

from era_haptics.arguments import expect_rig
from model.arguments import (
    expect_between,
    expect_number,
    expect_path,
    is_whole,
    shown,
)
from model.design.area import EDGE, area_of
from model.design.contacts import contact_rule
from model.design.problem import DEFAULT_APART, DEFAULT_LOWEST, DesignProblem, supported_layouts
from model.design.run import DEFAULT_FINALISTS, Layout, Runner, rank_layouts, search_layouts
from model.errors import InputError
from model.processes import on_processes
from model.rig.rig import Rig
from model.structure.attachments import Era
from model.structure.support import MIN_RIGID_BODY_FREQUENCY


@dataclass(frozen=True)
class RankedLayout:
    """A layout of a design: its ERAs and its contrast.

    contrast [dB]: promised felt contrast, mean over the numbers of quiet fingers, None unless its
    answers were judged; expected_contrast [dB]: the score by which the others are ranked, None for
    ERAs that do not support the plate.
    """

    name: str
    eras: tuple[Era, ...]
    contrast: float | None
    expected_contrast: float | None


def design(
    rig: Rig,
    eras: int | None = None,
    *,
    layouts: str | PathLike[str] | None = None,
    where: str | PathLike[str] = EDGE,
    contacts: str | PathLike[str] | None = None,
    contents: int = 1,
    apart: float = DEFAULT_APART,
    lowest: float = DEFAULT_LOWEST,
    finalists: int = DEFAULT_FINALISTS,
    starts: int = 4,
    seed: int = 0,
    workers: int = 1,
) -> tuple[RankedLayout, ...]:
    """Find or compare layouts of ERAs, the best promised felt contrast first, as `era design` does.

    eras: how many, as many as the rig's for None; layouts: None to search, `random:N` or a file to
    rank layouts; where: `edge`, `anywhere` or a file; contacts: a file, anywhere for None;
    contents: at the same time, a finger for each; apart [m]: least distance of two ERAs; lowest
    [Hz]: least rigid-body frequency of a supported plate; finalists: given layouts that
    are judged by their tables' answers; starts: of a search; workers: processes. Raises InputError.
    """
    expect_rig(rig)
    count = len(rig.eras) if eras is None else eras
    counts = {
        "eras": count,
        "contents": contents,
        "finalists": finalists,
        "starts": starts,
        "workers": workers,
    }
    for name, value in {**counts, "seed": seed}.items():
        if not is_whole(value):
            raise InputError(f"{name} must be a whole number, got {shown(value)}")
        expect_between(value, int(name in counts), what=name)
    for name, number, unit in (("apart", apart, "metres"), ("lowest", lowest, "hertz")):
        expect_number(number, what=name, unit=unit)
    expect_between(lowest, MIN_RIGID_BODY_FREQUENCY, what="lowest")
    path = None if contacts is None else expect_path(contacts, what="contacts")
    area = area_of(str(expect_path(where, what="where")), rig.plate)
    rule = contact_rule(path, rig.plate, contents)
    problem = DesignProblem(
        rig, count, area, rule, apart=float(apart), lowest=float(lowest), seed=seed
    )
    runner = Runner(machines=partial(on_processes, workers))
    if layouts is None:
        found = search_layouts([problem], starts=starts, runner=runner)
    else:
        text = str(expect_path(layouts, what="layouts"))
        given = supported_layouts(text, [problem])
        found = rank_layouts(given, finalists=finalists, runner=runner)
    return tuple(map(_ranked, found.layouts))


def _ranked(layout: Layout) -> RankedLayout:
    found = layout.found
    return RankedLayout(
        layout.name,
        layout.problem.eras(found.positions),
        None if layout.judged is None else layout.mean_db,
        found.score_db if found.is_supported else None,
    )
