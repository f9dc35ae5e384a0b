"""A design as it is asked for, by the command or a program: checked, then searched or ranked."""

import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from model.arguments import expect_between
from model.cluster import check_address, on_cluster
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
from model.errors import InputError
from model.processes import on_processes
from model.rig.rig import Rig
from model.structure.support import MIN_RIGID_BODY_FREQUENCY

MAX_STIFFNESSES, MAX_ERAS = 9, 32


def find_design(
    rig: Rig,
    counts: Sequence[int],
    *,
    layouts: str = "",
    keep: Sequence[str] = (),
    where: str = EDGE,
    contacts: Path | None = None,
    contents: int = 1,
    apart: float = DEFAULT_APART,
    lowest: float = DEFAULT_LOWEST,
    stiffnesses: Sequence[float] = (),
    finalists: int = DEFAULT_FINALISTS,
    starts: int = 4,
    seed: int = 0,
    runner: Runner,
) -> Design:
    """Search layouts, or rank those of `random:N` or a file.

    counts: numbers of ERAs, kept ones included; keep: names of ERAs that stay; where, contacts: as
    of `area_of` and `contact_rule`; apart [m]: least distance of two ERAs; lowest [Hz]: least
    rigid-body frequency; stiffnesses [N/m]: of which new ERAs get the best, that of the rig's for
    none. Raises InputError.
    """
    if not counts:
        raise InputError("eras must be one number or more, got none")
    own, plate = [era.name for era in rig.eras], rig.plate
    for each in counts:
        expect_between(each, 1, MAX_ERAS, what="eras")
    for name in keep:
        if name not in own:
            raise InputError(f"keep must be ERAs of the rig, {', '.join(own)}, got {name!r}")
    if len(set(keep)) < len(keep) or len(keep) > min(counts):
        raise InputError(
            f"keep must be at most {min(counts)} different ERAs, as many as eras, got "
            f"{', '.join(keep)}"
        )
    if not 0 < apart < max(plate.length, plate.width):
        raise InputError(f"apart must be above 0 and below the plate's length, got {apart:g} m")
    expect_between(lowest, MIN_RIGID_BODY_FREQUENCY, what="lowest")
    tried = sorted({each for each in stiffnesses if 0 < each < math.inf})
    if len(tried) < len(stiffnesses) or len(tried) > MAX_STIFFNESSES:
        raise InputError(
            f"stiffness must be at most {MAX_STIFFNESSES} different values above 0, got "
            f"{', '.join(f'{each:g}' for each in stiffnesses)}"
        )
    area, rule = area_of(where, plate), contact_rule(contacts, plate, contents)
    problems = [
        DesignProblem(rig, count, area, rule, tuple(keep), apart, lowest, seed, stiffness=each)
        for count in counts
        for each in (tried or (None,))
    ]
    if layouts:
        given = supported_layouts(layouts, problems)
        return rank_layouts(given, finalists=finalists, runner=runner)
    return search_layouts(problems, starts=starts, runner=runner)


def machines_of(cluster: str | None, workers: int | None, *, default: int) -> Machines:
    """The cluster at an address, or processes, of a default number. Raises InputError for both."""
    if cluster is None:
        return partial(on_processes, workers or default)
    if workers is not None:
        raise InputError("only one of workers and cluster can be given")
    check_address(cluster)
    return partial(on_cluster, cluster)
