"""What is known of a plate that is learned, for status, events and metrics."""

from dataclasses import dataclass
from enum import Enum


class LearningState(Enum):
    """What happens to what is measured; the values are those of the API."""

    OFF = "off"
    STARTING = "starting"
    FOLLOWING = "following"
    EXPLAINING = "explaining"
    CHANGED = "changed"
    ONLY_ALARMS = "only_alarms"
    RESTARTING = "restarting"
    FAILED = "failed"

    @property
    def is_bad(self) -> bool:
        """Whether somebody should look after the plate or the estimator."""
        return self in (LearningState.CHANGED, LearningState.RESTARTING, LearningState.FAILED)


@dataclass(frozen=True)
class LearningStatus:
    """State of the learning and its cause, remedy if there is one, and counts since the start.

    readings: of settled patterns; estimates: of these, by the estimator; discarded: those that will
    not be, since it ended or had too many; disturbed: readings that a change, an overload or the
    link has spoilt; corrections: of the answers; alarms; restarts: of the
    estimator; are_robust: whether answers are those of a plate that is not known; last_at [s]: of
    the last estimate, None before the first.
    """

    state: LearningState = LearningState.OFF
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
