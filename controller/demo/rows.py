"""One row a touch: what was asked, what was predicted, what the fingertips felt."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

from controller.demo.measure import Measured
from model.table.pattern import Pattern

Place: TypeAlias = tuple[float, float]

# The plate rings for 50 ms to 1 s; a pattern held shorter than this is judged while it still rings.
STEADY_AFTER = 0.4


@dataclass(frozen=True)
class Onset:
    """The first 100 ms of a touch: contrast of the peaks [dB].

    predicted: None where there is nobody to tell it from, or something played before; measured:
    None then too, and where it was over sooner.
    """

    is_shaped: bool
    predicted_contrast_db: float | None
    measured_contrast_db: float | None


@dataclass(frozen=True)
class PlayedPattern:
    """A pattern as it was played and felt.

    predicted_level_db_sl, predicted_contrast_db: of this touch, steady; onset: of the first pattern
    that was played for it; drive: what the amplifiers achieved, by ERA; latency [s] from the touch
    frame to the last byte on the wire; duration [s]; measured: None where it was too short; levels
    [dB SL] that each finger felt, by id.
    """

    pattern: Pattern
    predicted_level_db_sl: float
    predicted_contrast_db: float | None
    onset: Onset
    drive: Mapping[str, Mapping[str, float]]
    latency: float
    duration: float
    measured: Measured | None
    levels: Mapping[str, float]

    @property
    def is_steady(self) -> bool:
        """Whether it was held long enough for the plate to settle."""
        return self.duration >= STEADY_AFTER

    @property
    def measured_contrast_db(self) -> float | None:
        """Contrast at the fingertips [dB]; None where one was alone or it was too short."""
        return self.measured.contrast_db if self.measured else None


@dataclass(frozen=True)
class TouchRow:
    """A touch from down to up, with the pattern that was played longest for it.

    time, until [s] from the recording's start; target: the touch itself [m]; together: the other
    targets [m]; quiet: the other fingertips [m] by id. Where nothing was played for it, reason says
    why.
    """

    target_id: str
    time: float
    until: float
    target: Place
    together: tuple[Place, ...]
    quiet: Mapping[str, Place]
    played: PlayedPattern | None
    reason: str | None

    def as_json(self) -> dict[str, Any]:
        """The row as `era demo --json` prints it."""
        played = self.played
        measured = played.measured if played else None
        return {
            "time_s": self.time,
            "until_s": self.until,
            "targets_m": [list(place) for place in (self.target, *self.together)],
            "quiet_m": [list(place) for place in self.quiet.values()],
            "drive": {era: dict(tone) for era, tone in played.drive.items()} if played else {},
            "mode": played.pattern.drive_mode if played else None,
            "shaped_onset": played is not None and played.onset.is_shaped,
            "predicted_contrast_db": played.predicted_contrast_db if played else None,
            "measured_contrast_db": measured.contrast_db if measured else None,
            "predicted_transient_contrast_db": (
                played.onset.predicted_contrast_db if played else None
            ),
            "measured_transient_contrast_db": played.onset.measured_contrast_db if played else None,
            "predicted_level_db_sl": played.predicted_level_db_sl if played else None,
            "measured_level_db_sl": measured.level_db_sl if measured else None,
            "latency_ms": 1000 * played.latency if played else None,
            "played_s": played.duration if played else 0.0,
            "steady": played is not None and played.is_steady,
            "reason": self.reason,
        }
