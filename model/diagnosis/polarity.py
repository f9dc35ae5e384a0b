"""Polarity of channels.

With phases relative to the drive each channel's sign is known. Without them channels are driven in
pairs: the shape over the sensors is that of the sum or of the difference. Then only relative signs
are known, and the minority is taken to be inverted.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from model.arrays import ComplexArray, FloatArray
from model.calibration.variable_projection import modal_assurance
from model.diagnosis.observation import Observation

_LEAST_MISFIT = 0.02
UNDECIDED = 0.5
"""Confidence in a sign of half of the channels."""
_MIN_COHERENCE = 0.6  # length of the mean of unit phasors of a reliable phase
_MIN_EVIDENCE = 2.0  # logarithm of misfits, summed over a pair's frequencies


@dataclass(frozen=True)
class ChannelPhase:
    """Phase error of a channel [degrees], None if unknown.

    sign: 1 or -1 relative to the channels of its amplifier, 0 if unknown; confidence 0..1.
    """

    degrees: float | None
    sign: int
    confidence: float


def phases_of_drive(observation: Observation, predicted: ComplexArray) -> list[ChannelPhase]:
    """Phases relative to the drive; predicted (f, e, s), NaN for channels to be skipped."""
    found = []
    for channel in range(predicted.shape[1]):
        measured, model = observation.values[:, channel], predicted[:, channel]
        finite = np.isfinite(measured) & np.isfinite(model)
        inner = (np.where(finite, np.conj(model), 0) * np.where(finite, measured, 0)).sum(axis=1)
        inner = inner[np.abs(inner) > 0]
        if len(inner) == 0:
            found.append(ChannelPhase(None, 0, 0.0))
            continue
        mean = complex(np.mean(inner / np.abs(inner)))
        angle = math.degrees(np.angle(mean))
        if abs(mean) < _MIN_COHERENCE:
            found.append(ChannelPhase(None, 0, abs(mean)))
        else:
            found.append(ChannelPhase(angle, 1 if abs(angle) < 90 else -1, abs(mean)))
    return found


def signs_of_pairs(
    observation: Observation, predicted: ComplexArray, groups: Sequence[Sequence[int]]
) -> list[ChannelPhase]:
    """Signs from pairs and predicted responses (f, e, s).

    groups: channels of each amplifier, which start in phase.
    """
    evidence = np.zeros((predicted.shape[1], predicted.shape[1]))
    for pair in observation.pairs:
        first, second = (_row(observation, predicted, pair.frequency, era) for era in pair.eras)
        if first is None or second is None:
            continue
        shapes = np.array([first + second, first - second])
        mac = np.nan_to_num(modal_assurance(pair.values, shapes))
        plus, minus = np.log(np.maximum(1 - mac, _LEAST_MISFIT))
        evidence[pair.eras] += minus - plus
        evidence[pair.eras[::-1]] += minus - plus
    signs: dict[int, tuple[int, float]] = {}
    for group in groups:
        signs.update(_signs(group, evidence))
    return [
        ChannelPhase(None, *signs[channel]) if channel in signs else ChannelPhase(None, 0, 0.0)
        for channel in range(predicted.shape[1])
    ]


def _row(
    observation: Observation, predicted: ComplexArray, frequency: float, era: int
) -> ComplexArray | None:
    at = np.flatnonzero(np.isclose(observation.frequencies, frequency))
    if not len(at) or not np.isfinite(predicted[at[0], era]).any():
        return None
    return np.asarray(predicted[at[0], era])


def _signs(group: Sequence[int], evidence: FloatArray) -> dict[int, tuple[int, float]]:
    """Signs of the channels that pairs connect, strongest evidence first."""
    best: dict[int, tuple[int, float]] = {}
    for start in group:
        reached = {start: (1, 1.0)}
        while True:
            edges = [
                (abs(evidence[a, b]), a, b)
                for a in reached
                for b in group
                if b not in reached and abs(evidence[a, b]) >= _MIN_EVIDENCE
            ]
            if not edges:
                break
            sure, a, b = max(edges)
            sign = int(math.copysign(reached[a][0], reached[a][0] * evidence[a, b]))
            reached[b] = (sign, min(reached[a][1], 1 / (1 + math.exp(-sure))))
        if len(reached) > len(best):
            best = reached
    if len(best) < 2:
        return {}
    balance = sum(sign for sign, _ in best.values())
    if balance < 0:
        best = {channel: (-sign, sure) for channel, (sign, sure) in best.items()}
    elif balance == 0:  # as many of each sign
        best = {channel: (sign, UNDECIDED) for channel, (sign, _) in best.items()}
    return best
