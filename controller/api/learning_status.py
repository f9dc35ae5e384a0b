"""What is known of a plate that is learned, for status, events and metrics."""

from dataclasses import dataclass
from typing import Literal, TypeAlias

LearningState: TypeAlias = Literal[
    "off",
    "starting",
    "following",
    "explaining",
    "changed",
    "only_alarms",
    "restarting",
    "failed",
]
"""What happens to what settled patterns show of the plate."""

BAD: tuple[LearningState, ...] = ("changed", "restarting", "failed")
"""States in which somebody should look after the plate or the estimator."""


@dataclass(frozen=True)
class LearningStatus:
    """State of the learning and its cause, remedy if there is one, and counts since the start.

    readings: of settled patterns; estimates: of these, by the estimator; discarded: those that will
    not be, since it ended or had too many; disturbed: readings that a change, an overload or the
    link has spoilt; corrections: of the answers; alarms; restarts: of the
    estimator; are_robust: whether answers are those of a plate that is not known; last_at [s]: of
    the last estimate, None before the first.
    """

    state: LearningState = "off"
    cause: str = "amplifiers not asked for their sensors yet"
    remedy: str | None = None
    readings: int = 0
    estimates: int = 0
    discarded: int = 0
    disturbed: int = 0
    corrections: int = 0
    alarms: int = 0
    restarts: int = 0
    are_robust: bool = False
    last_at: float | None = None
