"""One row of the demonstration: a touch, what was predicted for it and what was measured."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any, TypeAlias

import numpy as np

from model.answer.answer import Layer
from model.arrays import FloatArray
from model.finger import (
    DEFAULT_THRESHOLD,
    contrast_db,
    mean_level_db_sl,
    sensation_level,
)

Position: TypeAlias = tuple[float, float]

SAME_FREQUENCY = 1.0
"""Difference [Hz] within which a tone is that of a content, as its amplifier has rounded it."""


@dataclass(frozen=True)
class FingerVibration:
    """Measured vibration of one fingertip over a window.

    frequencies (f,) [Hz]; amplitudes (f, p) [m/s²] of the steady part at each point of the tip;
    peaks (p,) [m/s²], the largest acceleration there, transients included; weights (p,) of the
    points in the mean over the tip; threshold: name of the set that levels are above.
    """

    frequencies: FloatArray
    amplitudes: FloatArray
    peaks: FloatArray
    weights: FloatArray
    threshold: str = DEFAULT_THRESHOLD

    @property
    def level_db_sl(self) -> float:
        """Sensation level, mean over the tip; -inf without vibration."""
        return mean_level_db_sl(self.frequencies, self.amplitudes, self.weights, self.threshold)

    @property
    def loudest_db_sl(self) -> float:
        """Sensation level at the loudest point of the tip; -inf without vibration."""
        return float(sensation_level(self.frequencies, self.amplitudes, self.threshold).max())

    def parted(self, frequency: float) -> tuple["FingerVibration", "FingerVibration"]:
        """Return the part of a content's frequency [Hz], and that of all others."""
        is_own = np.abs(self.frequencies - frequency) < SAME_FREQUENCY
        own, others = (
            replace(self, frequencies=self.frequencies[some], amplitudes=self.amplitudes[some])
            for some in (is_own, ~is_own)
        )
        return own, others


@dataclass(frozen=True, kw_only=True)
class FingerRow:
    """A finger among several contents: its frequency and verdict, what was promised and measured.

    Contrasts are those of its own level above that of the power of all others' contents here.
    Measured ones are None where nothing of its own, or nothing else, was measured.
    """

    at_m: Position
    frequency_hz: float | None
    verdict: str
    promised_contrast_db: float | None
    measured_contrast_db: float | None
    measured_level_db_sl: float | None


@dataclass(frozen=True, kw_only=True)
class TouchRow:
    """A touch from down to up, with its last steady pattern of most contents.

    Its fields are the keys of `era demo --json`, but for those that `_OWN` names: quiet: other
    fingertips by id [m]; pattern; levels_db_sl by id: of the target the mean over its tip, of any
    other finger its loudest point, whose least difference is the contrast. Contrasts are None for
    a finger alone, and measured ones if the pattern was too short: predicted ones are of the
    table's plate, promised ones what nine of ten plates within the uncertainty give, in levels;
    transient ones are in accelerations, over the first 100 ms of the touch's first pattern.
    drive: as the amplifiers achieved it, by ERA; latency_ms: from touch frame to last byte on the
    wire; reason: why nothing played, if so. fingers: of several contents, each; contrasts are then
    to the contents of others at this finger; contents: their patterns, in the order of layers.
    """

    target_id: str
    time_s: float
    until_s: float
    targets_m: Sequence[Position]
    quiet: Mapping[str, Position]
    reason: str | None = None
    drive: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    mode: str | None = None
    shaped_onset: bool = False
    latency_ms: float | None = None
    played_s: float = 0.0
    steady: bool = False
    predicted_contrast_db: float | None = None
    promised_contrast_db: float | None = None
    measured_contrast_db: float | None = None
    predicted_transient_contrast_db: float | None = None
    measured_transient_contrast_db: float | None = None
    predicted_level_db_sl: float | None = None
    measured_level_db_sl: float | None = None
    pattern: Layer | None = None
    levels_db_sl: Mapping[str, float] = field(default_factory=dict)
    fingers: Sequence[FingerRow] = ()
    contents: Sequence[Layer] = ()

    @property
    def keeps_promise(self) -> bool | None:
        """Whether the steady felt contrast is at least the promised one; None if not measured."""
        promised, measured = self.promised_contrast_db, self.measured_contrast_db
        if not self.steady or promised is None or measured is None:
            return None
        return measured >= promised

    def as_json(self) -> dict[str, Any]:
        """Return the row in the format of `era demo --json`."""
        row = {each.name: getattr(self, each.name) for each in fields(self)}
        row = {key: row[key] for key in row if key not in _OWN}
        row["quiet_m"] = list(self.quiet.values())
        if self.fingers:
            row["fingers"] = [asdict(each) for each in self.fingers]
        return row


_OWN = ("target_id", "quiet", "pattern", "levels_db_sl", "fingers", "contents")


def steady_contrast_db(target: FingerVibration, quiet: Sequence[FingerVibration]) -> float | None:
    """Level of the target above that of the loudest quiet point [dB], steady; None if alone."""
    if not quiet:
        return None
    return target.level_db_sl - max(finger.loudest_db_sl for finger in quiet)


def peak_contrast_db(target: FingerVibration, quiet: Sequence[FingerVibration]) -> float:
    """Contrast of the peaks [dB], as `model.transients.shaping` predicts for an onset."""
    others = np.concatenate([finger.peaks for finger in quiet])
    return float(contrast_db([target.peaks], others, [target.weights]))
