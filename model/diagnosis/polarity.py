"""Polarity of channels, from phases relative to the drive."""

import math
from dataclasses import dataclass

import numpy as np

from model.arrays import ComplexArray
from model.calibration.responses import Responses

_MIN_COHERENCE = 0.6  # length of the mean of unit phasors of a reliable phase


@dataclass(frozen=True)
class ChannelPhase:
    """Phase error of a channel [degrees], None if unknown.

    sign: 1 or -1, 0 if unknown; confidence 0..1.
    """

    degrees: float | None = None
    sign: int = 0
    confidence: float = 0.0


def phases_of_drive(observation: Responses, predicted: ComplexArray) -> list[ChannelPhase]:
    """Phases relative to the drive; predicted (f, e, s), NaN for channels to be skipped."""
    found = []
    for channel in range(predicted.shape[1]):
        measured, model = observation.values[:, channel], predicted[:, channel]
        finite = np.isfinite(measured) & np.isfinite(model)
        inner = (np.where(finite, np.conj(model), 0) * np.where(finite, measured, 0)).sum(axis=1)
        inner = inner[np.abs(inner) > 0]
        if len(inner) == 0:
            found.append(ChannelPhase())
            continue
        mean = complex(np.mean(inner / np.abs(inner)))
        angle = math.degrees(np.angle(mean))
        if abs(mean) < _MIN_COHERENCE:
            found.append(ChannelPhase(None, 0, abs(mean)))
        else:
            found.append(ChannelPhase(angle, 1 if abs(angle) < 90 else -1, abs(mean)))
    return found
