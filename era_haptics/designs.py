"""Places of ERAs for the best contrast, searched or given."""

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from os import PathLike
from typing import Any

from era_haptics.arguments import as_progress, as_stiffnesses, expect_rig
from model.arguments import expect, expect_between, expect_number, expect_path, is_whole, shown
from model.config.document import Document
from model.design.area import EDGE
from model.design.layout_keys import layout_keys
from model.design.problem import DEFAULT_APART, DEFAULT_LOWEST
from model.design.request import find_design, machines_of
from model.design.run import DEFAULT_FINALISTS, Layout, Runner
from model.errors import InputError
from model.progress import Progress
from model.rig.file import rig_of
from model.rig.from_keys import stated
from model.rig.rig import Rig
from model.structure.attachments import Era


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
    _layout: Layout = field(repr=False, compare=False)

    @property
    def rig(self) -> Rig:
        """The rig with these ERAs on free channels, of simulated amplifiers where it has too few.

        As `era design` writes it. Raises InputError for one that no file states.
        """
        data = stated(self._layout.problem.rig).data
        return rig_of(Document("RankedLayout.rig", "", layout_keys(self._layout, data), {}))


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
    stiffness: float | Sequence[float] = (),
    finalists: int = DEFAULT_FINALISTS,
    starts: int = 4,
    seed: int = 0,
    workers: int | None = None,
    cluster: str | None = None,
    progress: Progress | None = None,
) -> tuple[RankedLayout, ...]:
    """Find or compare layouts of ERAs, the best promised felt contrast first, as `era design` does.

    eras: how many, or several numbers, as many as the rig's for None; layouts: None to search,
    `random:N` or a file to rank layouts; keep: names of ERAs that stay; where: `edge`, `anywhere`
    or a file; contacts: a file, anywhere for None; contents: at the same time, a finger for each;
    apart [m]: least distance of two ERAs; lowest [Hz]: least rigid-body frequency of a supported
    plate; stiffness [N/m]: of new ERAs, the best of several, that of the rig's for none;
    finalists: given layouts that are judged by their tables' answers; starts: of a search;
    workers: processes, one for None; cluster: address of a Dask scheduler in their place;
    progress: called with the tasks done and all, of one stage after the other. Raises InputError.
    """
    expect_rig(rig)
    numbers: Any = len(rig.eras) if eras is None else eras
    numbers = [numbers] if is_whole(numbers) else numbers
    expect(numbers, Sequence, what="eras", made_by="range(3, 7)")
    expect(keep, Sequence, what="keep", made_by='["SW"]')
    counts = {"contents": contents, "finalists": finalists, "starts": starts}
    counts |= {f"eras[{place}]": each for place, each in enumerate(numbers)}
    counts |= {} if workers is None else {"workers": workers}
    for name, value in {**counts, "seed": seed}.items():
        if not is_whole(value):
            raise InputError(f"{name} must be a whole number, got {shown(value)}")
        expect_between(value, int(name in counts), what=name)
    for name, number, unit in (("apart", apart, "metres"), ("lowest", lowest, "hertz")):
        expect_number(number, what=name, unit=unit)
    update = as_progress(progress)
    found = find_design(
        rig,
        numbers,
        layouts="" if layouts is None else str(expect_path(layouts, what="layouts")),
        keep=keep,
        where=str(expect_path(where, what="where")),
        contacts=None if contacts is None else expect_path(contacts, what="contacts"),
        contents=contents,
        apart=float(apart),
        lowest=float(lowest),
        stiffnesses=as_stiffnesses(stiffness),
        finalists=finalists,
        starts=starts,
        seed=seed,
        runner=Runner(machines_of(cluster, workers, default=1), lambda what: nullcontext(update)),
    )
    return tuple(map(_ranked, found.layouts))


def _ranked(layout: Layout) -> RankedLayout:
    found = layout.found
    return RankedLayout(
        layout.name,
        layout.problem.eras(found.positions),
        None if layout.judged is None else layout.mean_db,
        found.score_db if found.is_supported else None,
        layout,
    )
