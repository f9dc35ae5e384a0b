"""One row of the demonstration: a touch, what was predicted for it and what was measured."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from model.arrays import FloatArray
from model.finger.contrast import contrast_db, mean_level_db_sl
from model.table.pattern import Pattern
from model.vibration.peak import peak_acceleration

Place: TypeAlias = tuple[float, float]

STEADY_DURATION = 0.4
"""Shortest pattern [s] that counts as steady; the plate rings for 50 ms to 1 s."""


@dataclass(frozen=True)
class FingerVibration:
    """Measured vibration of one fingertip over a window.

    frequencies (f,) [Hz]; amplitudes (f, p) [m/s²] of the steady part at each point of the tip;
    peaks (p,) [m/s²], the largest acceleration there, transients included.
    """

    frequencies: FloatArray
    amplitudes: FloatArray
    peaks: FloatArray

    @property
    def level_db_sl(self) -> float:
        """Sensation level, mean over the tip; -inf without vibration."""
        return mean_level_db_sl(self.frequencies, self.amplitudes)


@dataclass(frozen=True)
class PlayedPattern:
    """The pattern that played longest for a touch.

    predicted and measured figures are of this touch; contrasts are None for a finger alone, and
    measured ones where the pattern was too short. transient: over the first 100 ms of the touch's
    first pattern. drive: achieved by the amplifiers, by ERA; latency [s]: from touch frame to last
    byte on the wire; levels_db_sl: of every finger by id.
    """

    pattern: Pattern
    drive: Mapping[str, Mapping[str, float]]
    latency: float
    duration: float
    is_onset_shaped: bool
    predicted_level_db_sl: float
    measured_level_db_sl: float | None
    predicted_contrast_db: float | None
    measured_contrast_db: float | None
    predicted_transient_contrast_db: float | None
    measured_transient_contrast_db: float | None
    levels_db_sl: Mapping[str, float]

    @property
    def is_steady(self) -> bool:
        """Whether the pattern played long enough for the plate to settle."""
        return self.duration >= STEADY_DURATION


@dataclass(frozen=True)
class TouchRow:
    """A touch from down to up.

    time, until [s] from the start of the recording; target: its place [m]; other_targets [m];
    quiet [m]: other fingertips by id; reason: why nothing was played, if so.
    """

    target_id: str
    time: float
    until: float
    target: Place
    other_targets: tuple[Place, ...]
    quiet: Mapping[str, Place]
    played: PlayedPattern | None
    reason: str | None

    def as_json(self) -> dict[str, Any]:
        """Return the row in the format of `era demo --json`."""
        row: dict[str, Any] = {
            "time_s": self.time,
            "until_s": self.until,
            "targets_m": [list(place) for place in (self.target, *self.other_targets)],
            "quiet_m": [list(place) for place in self.quiet.values()],
            "reason": self.reason,
        }
        played = self.played
        keys = (
            "predicted_contrast_db",
            "measured_contrast_db",
            "predicted_transient_contrast_db",
            "measured_transient_contrast_db",
            "predicted_level_db_sl",
            "measured_level_db_sl",
        )
        if played is None:
            nothing: dict[str, Any] = {
                "drive": {},
                "mode": None,
                "latency_ms": None,
                "played_s": 0.0,
            }
            return row | nothing | {"shaped_onset": False, "steady": False} | dict.fromkeys(keys)
        return row | {
            "drive": {era: dict(tone) for era, tone in played.drive.items()},
            "mode": played.pattern.drive_mode,
            "shaped_onset": played.is_onset_shaped,
            "latency_ms": 1000 * played.latency,
            "played_s": played.duration,
            "steady": played.is_steady,
            **{key: getattr(played, key) for key in keys},
        }


def steady_contrast_db(target: FingerVibration, quiet: Sequence[FingerVibration]) -> float | None:
    """Contrast of the steady parts [dB], defined as in the table's predictions; None if alone."""
    if not quiet:
        return None
    others = np.concatenate([peak_acceleration(finger.amplitudes) for finger in quiet])
    return float(contrast_db([peak_acceleration(target.amplitudes)], others))


def peak_contrast_db(target: FingerVibration, quiet: Sequence[FingerVibration]) -> float:
    """Contrast of the peaks [dB], as `model.transients.measures` predicts for an onset."""
    return float(contrast_db([target.peaks], np.concatenate([finger.peaks for finger in quiet])))
