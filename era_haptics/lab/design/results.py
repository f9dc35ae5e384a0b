"""Results of a design: layouts of ERAs with their scores, and with answers at new contact sets."""

from dataclasses import dataclass

from era_haptics.lab.design.assessment import Assessment
from era_haptics.lab.design.layout_keys import layout_keys
from era_haptics.lab.design.layout_search import ScoredLayout
from era_haptics.lab.design.problem import DesignProblem
from model.arrays import FloatArray
from model.config.document import Document
from model.rig.rig import Rig
from model.rig.rig_file import rig_of
from model.rig.rig_writing import document_for
from model.structure.exciter import Actuator


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
    def rig(self) -> Rig:
        """The rig with these ERAs on free channels, if necessary on a new, simulated amplifier."""
        rig_data = document_for(self.problem.rig).data
        keys = layout_keys(self.problem, self.found.positions, rig_data)
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
        gaps = [self.best.mean_db - layout.mean_db for layout in self.starts]
        return max(gaps, default=0.0)
