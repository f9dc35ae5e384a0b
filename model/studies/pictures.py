"""Box plots of a study's cases."""

from collections.abc import Callable, Iterable, Mapping

from matplotlib.figure import Figure

from model.arrays import FloatArray
from model.counting import counted
from model.figures.layout_boxes import LayoutBox, layout_boxes_figure
from model.rig.rig import Rig
from model.studies.ranking import Ranking, era_counts
from model.studies.solve import DRIVE_NAMES, DRIVES

_MAX_LINEAR_RATIO = 5.0  # of medians; beyond it the scale is logarithmic


def ranking_figure(rig: Rig, ranking: Ranking) -> Figure:
    """Box plots of the rig's own, the best, the middle and the worst case."""
    shown = {"best": ranking.best, "middle": ranking.middle, "worst": ranking.worst}
    if ranking.own is not None:
        shown = {"the rig": ranking.own, **shown}
    if ranking.recommended != ranking.best:
        shown["recommended"] = ranking.recommended
    title = f"{counted(len(ranking.order), 'case')}, {DRIVE_NAMES[DRIVES[ranking.drive]]} driven"
    wide = ranking.medians[ranking.best] > _MAX_LINEAR_RATIO * ranking.medians[ranking.worst]
    return _boxes(rig, ranking, shown.items(), title=title, logarithmic=wide)


def count_figure(rig: Rig, ranking: Ranking) -> Figure:
    """Box plots of the best layout for each number of ERAs."""
    best = ranking.best_by(era_counts(ranking.cases))
    named = [("one ERA" if count == 1 else f"{count:.0f} ERAs", n) for count, n in best.items()]
    return _boxes(rig, ranking, named, title="The best layout for each number of ERAs")


def stiffness_figure(rig: Rig, ranking: Ranking) -> Figure:
    """Box plots of the best layout for each stiffness, on a logarithmic scale."""
    stiffest = max(era.stiffness for era in rig.eras) / 1000
    best = ranking.best_by(ranking.cases.stiffness_factors)
    named = [(f"{stiffest * factor:.3g}\nkN/m", case) for factor, case in best.items()]
    return _boxes(
        rig, ranking, named, title="The best layout for each ERA stiffness", logarithmic=True
    )


PICTURES: dict[str, Mapping[str, Callable[[Rig, Ranking], Figure]]] = {
    "placement": {"placement_ranking.png": ranking_figure},
    "count": {"count_ranking.png": ranking_figure, "count_best.png": count_figure},
    "stiffness": {"stiffness_ranking.png": ranking_figure, "stiffness_best.png": stiffness_figure},
}
"""Functions that draw the pictures of each study, by file name."""


def _boxes(
    rig: Rig,
    ranking: Ranking,
    named: Iterable[tuple[str, int]],
    *,
    title: str,
    logarithmic: bool = False,
) -> Figure:
    def box(label: str, case: int) -> LayoutBox:
        five: FloatArray = ranking.results.statistics[case, ranking.drive, :5]
        active = ranking.results.active_eras(case, ranking.drive)
        return LayoutBox(label, ranking.cases.positions_of(case), active, five)

    return layout_boxes_figure(
        rig.plate, [box(*one) for one in named], title=title, logarithmic=logarithmic
    )
