"""A design as it is asked for, by the command or a program: checked, then searched or ranked."""

import math
from collections.abc import Sequence
from functools import partial
from os import PathLike
from typing import Any

from model.design.area import EDGE, area_of
from model.design.contacts import contact_rule
from model.design.problem import DEFAULT_APART, DEFAULT_LOWEST, DesignProblem, supported_layouts
from model.design.run import (
    DEFAULT_FINALISTS,
    Design,
    Machines,
    Runner,
    rank_layouts,
    search_layouts,
)
from model.errors import (
    MAX_VALUE,
    InputError,
    expect,
    expect_between,
    expect_number,
    expect_path,
    is_whole,
    shown,
)
from model.processes import Progress, check_progress, on_cluster, on_processes, unseen
from model.rig.rig import Rig
from model.structure.attachments import MIN_RIGID_BODY_FREQUENCY

MAX_STIFFNESSES, MAX_ERAS = 9, 32


def design(
    rig: Rig,
    eras: int | Sequence[int] | None = None,
    *,
    layouts: str | PathLike[str] | None = None,
    keep: Sequence[str] = (),
    where: str | PathLike[str] = EDGE,
    contacts: str | PathLike[str] | None = None,
    contents: int = 1,
    apart: float = DEFAULT_APART,
    lowest: float = DEFAULT_LOWEST,
    stiffness: Sequence[float] = (),
    finalists: int = DEFAULT_FINALISTS,
    starts: int = 4,
    seed: int = 0,
    workers: int | None = None,
    cluster: str | None = None,
    progress: Progress = unseen,
) -> Design:
    """Find or compare layouts of ERAs, the best promised felt contrast first, as `era design` does.

    eras: how many, or several numbers, as many as the rig's for None; layouts: None to search,
    `random:N` or a file to rank layouts; keep: names of ERAs that stay; where: `edge`, `anywhere`
    or a file; contacts: a file, anywhere for None; contents: at the same time, a finger for each;
    apart [m]: least distance of two ERAs; lowest [Hz]: least rigid-body frequency of a supported
    plate; stiffness [N/m]: of which new ERAs get the best, that of the rig's for none; finalists:
    given layouts that are judged by their tables' answers; starts: of a search; workers: processes,
    one for None; cluster: address of a Dask scheduler in their place; progress: called with the
    tasks done and all, of one stage after the other. Raises InputError.

    Example:
        >>> designed = era.design(rig, 4, layouts="random:6", finalists=2)
        >>> better = designed.best.rig
    """
    expect(rig, Rig, what="rig", made_by='era.load_rig("rig.yaml")')
    check_progress(progress)
    asked: Any = len(rig.eras) if eras is None else eras
    counts = [asked] if is_whole(asked) or isinstance(asked, str) else asked
    for what, row, made_by in (
        ("eras", counts, "range(3, 7)"),
        ("keep", keep, '["SW"]'),
        ("stiffness", stiffness, "[17e3]"),
    ):
        expect(row, Sequence, what=what, made_by=made_by)
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
    if layouts is None:
        return search_layouts(problems, starts=starts, runner=Runner(machines, progress))
    return rank_layouts(
        supported_layouts(str(expect_path(layouts, what="layouts")), problems),
        finalists=finalists,
        runner=Runner(machines, progress),
    )
