"""Assignment of channels to ERAs by the modal assurance criterion (MAC) of shapes over sensors.

MAC is 1 for the same shape with any gain and phase, about one over the number of sensors for noise.
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import stdtr

from model.arrays import ComplexArray, FloatArray
from model.calibration.sensed_plate import STARTS, SensedPlate
from model.calibration.variable_projection import modal_assurance
from model.choice import best_of

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
    def nearest(self) -> tuple[int, ...]:
        """Index of the ERA most similar to each channel; its own if not driven."""
        typical = np.array(
            [
                [_typical(self.mac[:, i, j]) for j in range(self.mac.shape[2])]
                for i in range(self.mac.shape[1])
            ]
        )
        return tuple(
            best_of(np.nan_to_num(row, nan=-1.0)) if np.isfinite(row).any() else i
            for i, row in enumerate(typical)
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
    best: tuple[float, ShapeMatch] | None = None
    for start in [(0.0, 0.0), *STARTS]:
        mac = _mac(values, plate.responses(plate.moved(*start)))
        found = ShapeMatch(mac, start)
        score = float(
            sum(_typical(mac[:, i, j]) for i, j in enumerate(found.nearest) if _driven(mac, i))
        )
        # Values far from the rig's must be clearly better.
        score -= 0.05 * sum(map(abs, start)) * values.shape[1]
        if best is None or score > best[0]:
            best = (score, found)
    assert best is not None  # noqa: S101  the rig's own values are tried at least
    return best[1]


def match_responses(model: ComplexArray, values: ComplexArray) -> ShapeMatch:
    """Compare values (f, e, s) with responses (f, e, s) of one plate."""
    return ShapeMatch(_mac(values, model), (0.0, 0.0))


def _mac(values: ComplexArray, model: ComplexArray) -> FloatArray:
    """MAC (f, e, e) of each channel with each ERA."""
    return modal_assurance(values[:, :, None], model[:, None])


def _driven(mac: FloatArray, channel: int) -> bool:
    return bool(np.isfinite(mac[:, channel]).any())


def _typical(mac: FloatArray) -> float:
    """Median over frequencies, NaN without values."""
    finite = mac[np.isfinite(mac)]
    return float(np.median(finite)) if len(finite) else float("nan")
