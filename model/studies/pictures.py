"""Box plots of a study's cases."""

from collections.abc import Callable, Iterable, Mapping

import numpy as np
from matplotlib.figure import Figure

from model.counting import counted
from model.figures.layout_boxes import LayoutBox, layout_boxes_figure
from model.rig.rig import Rig
from model.studies.ranking import Ranking, era_counts


def ranking_figure(rig: Rig, ranking: Ranking) -> Figure:
    """Box plots of the rig's own, the best, the middle and the worst case."""
    scored = ranking.scored
    shown = {"best": ranking.best, "middle": scored.middle, "worst": scored.worst}
    if scored.own in ranking.judged and scored.own is not None:
        shown = {"the rig": scored.own, **shown}
    if ranking.recommended != ranking.best:
        shown["recommended"] = ranking.recommended
    title = f"{counted(len(scored.supported_order), 'case')} that support the plate"
    return _boxes(rig, ranking, shown.items(), title=title)


def count_figure(rig: Rig, ranking: Ranking) -> Figure:
    """Box plots of the best layout for each number of ERAs."""
    best = ranking.best_by(era_counts(ranking.cases))
    named = [("one ERA" if count == 1 else f"{count:.0f} ERAs", n) for count, n in best.items()]
    return _boxes(rig, ranking, named, title="The best layout for each number of ERAs")


def stiffness_figure(rig: Rig, ranking: Ranking) -> Figure:
    """Box plots of the best layout for each stiffness."""
    stiffest = max(era.stiffness for era in rig.eras) / 1000
    best = ranking.best_by(ranking.cases.stiffness_factors)
    named = [(f"{stiffest * factor:.3g}\nkN/m", case) for factor, case in best.items()]
    return _boxes(rig, ranking, named, title="The best layout for each ERA stiffness")


PICTURES: dict[str, Mapping[str, Callable[[Rig, Ranking], Figure]]] = {
    "placement": {"placement_ranking.png": ranking_figure},
    "count": {"count_ranking.png": ranking_figure, "count_best.png": count_figure},
    "stiffness": {"stiffness_ranking.png": ranking_figure, "stiffness_best.png": stiffness_figure},
}
"""Functions that draw the pictures of each study, by file name."""


def _boxes(rig: Rig, ranking: Ranking, named: Iterable[tuple[str, int]], *, title: str) -> Figure:
    def box(label: str, case: int) -> LayoutBox:
        positions = ranking.cases.positions_of(case)
        five = np.percentile(ranking.judged[case].contrast_db, [0, 25, 50, 75, 100])
        return LayoutBox(label, positions, range(len(positions)), five)

    return layout_boxes_figure(
        rig.plate,
        [box(*one) for one in named],
        title=title,
        label="robust felt contrast / dB",
        over="contact sets",
    )
