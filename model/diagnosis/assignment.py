"""What channels drive: ERAs by the modal assurance criterion (MAC) of shapes; polarity by phases.

MAC is 1 for the same shape with any gain and phase, about one over the number of sensors for noise.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import stdtr

from model.arrays import ComplexArray, FloatArray, best_by, best_of
from model.calibration.fit import STARTS, SensedPlate, modal_assurance
from model.calibration.responses import Responses, typical

_MIN_COHERENCE = 0.6  # length of the mean of unit phasors of a reliable phase
_LEAST_MISFIT = 0.02  # below it sensors' errors dominate


@dataclass(frozen=True, eq=False)
class ShapeMatch:
    """MAC of channels and ERAs on the most similar plate.

    mac (f, e, e): of the channel that the rig wires to the first ERA with the second ERA, NaN if
    not driven; start: logarithms of that plate's factors on modulus and stiffnesses.
    """

    mac: FloatArray
    start: tuple[float, float]

    @property
    def starts(self) -> tuple[tuple[float, float], ...]:
        """Logarithms of factors from which to search: none, and those of that plate."""
        return tuple(dict.fromkeys([(0.0, 0.0), self.start]))

    @property
    def nearest(self) -> tuple[int, ...]:
        """Index of the ERA most similar to each channel; its own if not driven."""
        found = np.array(
            [
                [typical(self.mac[:, i, j]) for j in range(self.mac.shape[2])]
                for i in range(self.mac.shape[1])
            ]
        )
        return tuple(
            best_of(np.nan_to_num(row, nan=-1.0)) if np.isfinite(row).any() else i
            for i, row in enumerate(found)
        )

    @property
    def error(self) -> float:
        """Share of the responses, rms over them, that is not of the shapes of the nearest ERAs."""
        return self._error(self.nearest)

    @property
    def error_as_wired(self) -> float:
        """The same, of the shapes of the ERAs that the rig says."""
        return self._error(range(self.mac.shape[1]))

    def _error(self, eras: Sequence[int]) -> float:
        alike = self.mac[:, range(self.mac.shape[1]), eras]
        return (
            math.sqrt(max(0.0, float(np.nanmean(1 - alike))))
            if np.isfinite(alike).any()
            else math.inf
        )

    def confidence(self, channel: int, era: int, other: int) -> float:
        """Confidence 0..1 that the channel drives one ERA and not the other.

        By Student's t-test of the difference of their misfits over frequencies.
        """
        misfit = np.log(np.maximum(1 - self.mac[:, channel], _LEAST_MISFIT))
        gain = misfit[:, other] - misfit[:, era]
        gain = gain[np.isfinite(gain)]
        if len(gain) < 3 or np.ptp(gain) == 0:
            return 0.5
        t = gain.mean() * np.sqrt(len(gain)) / gain.std(ddof=1)
        return float(stdtr(len(gain) - 1, t))


def match_shapes(plate: SensedPlate, values: ComplexArray) -> ShapeMatch:
    """Compare values (f, e, s) with a rig's ERAs on plates of other modulus and stiffnesses."""
    tried = [
        match_responses(plate.responses(plate.moved(*start)), values, start)
        for start in [(0.0, 0.0), *STARTS]
    ]

    def score(found: ShapeMatch) -> float:
        alike = [typical(found.mac[:, i, j]) for i, j in enumerate(found.nearest)]
        # Values far from the rig's must be clearly better.
        return float(np.nansum(alike) - 0.05 * sum(map(abs, found.start)) * values.shape[1])

    return best_by(tried, score)


def match_responses(
    model: ComplexArray, values: ComplexArray, start: tuple[float, float] = (0.0, 0.0)
) -> ShapeMatch:
    """Compare values (f, e, s) with responses (f, e, s) of one plate."""
    return ShapeMatch(modal_assurance(values[:, :, None], model[:, None]), start)


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
    if not observation.has_phases:
        return [ChannelPhase()] * predicted.shape[1]
    found = []
    for channel in range(predicted.shape[1]):
        measured, model = observation.values[:, channel], predicted[:, channel]
        finite = np.isfinite(measured) & np.isfinite(model)
        inner = (np.where(finite, np.conj(model), 0) * np.where(finite, measured, 0)).sum(axis=1)
        inner = inner[np.abs(inner) > 0]
        mean = complex(np.mean(inner / np.abs(inner))) if len(inner) else 0j
        angle = math.degrees(np.angle(mean))
        found.append(
            ChannelPhase(angle, 1 if abs(angle) < 90 else -1, abs(mean))
            if abs(mean) >= _MIN_COHERENCE
            else ChannelPhase(confidence=abs(mean))
        )
    return found
