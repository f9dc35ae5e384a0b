"""Sensors at each other's places, by the responses that they read."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from model.arrays import ComplexArray, FloatArray
from model.calibration.responses import Responses
from model.calibration.variable_projection import project_gains, row_rms

_OWN_PLACE, _OTHER_PLACE = 0.8, 0.9  # coherence of a sensor that is elsewhere


@dataclass(frozen=True)
class ExchangedSensors:
    """Pairs of a sensor and the one at whose place it is, which is elsewhere too."""

    pairs: Sequence[tuple[str, str]]

    label = "PLACES"

    def __str__(self) -> str:
        """What is wrong, and what to do."""
        pairs = ", ".join(f"{name} at that of {place}" for name, place in self.pairs)
        return (
            f"sensors must be at their places, got responses that fit exchanged ones: {pairs}; "
            "correct their positions or names"
        )

    def put_right(self, observation: Responses) -> Responses:
        """The same responses, each sensor where it is."""
        names, points = observation.sensors, observation.points.copy()
        for name, place in self.pairs:
            points[names.index(name)] = observation.points[names.index(place)]
        return replace(observation, points=points)


def exchanged_sensors(observation: Responses, model: ComplexArray) -> ExchangedSensors | None:
    """Find the sensors that read what the model (f, e, s) has at another's place."""
    values = observation.values
    weight = np.isfinite(values) / row_rms(values)[:, :, None]
    gains, _ = project_gains(model, values, weight)
    measured = np.where(weight > 0, values * weight, 0j)
    predicted = np.nan_to_num(gains)[:, :, None] * model / row_rms(values)[:, :, None]
    coherence = _coherence(measured, predicted, weight > 0)
    sensors, places = linear_sum_assignment(-(coherence**2))
    names = observation.sensors
    pairs = [
        (names[sensor], names[place])
        for sensor, place in zip(sensors, places, strict=True)
        if coherence[sensor, sensor] < _OWN_PLACE
        and coherence[place, place] < _OWN_PLACE  # else two are at one place, which is no exchange
        and coherence[sensor, place] > _OTHER_PLACE
    ]
    return ExchangedSensors(pairs) if pairs else None


def _coherence(
    measured: ComplexArray, predicted: ComplexArray, used: NDArray[np.bool_]
) -> FloatArray:
    """Coherence (s, s) of each sensor's responses with the model's at each place."""
    inner = np.abs(np.einsum("fes,fep->sp", measured, predicted.conj()))
    own = (np.abs(measured) ** 2).sum(axis=(0, 1))
    other = np.einsum("fes,fep->sp", used.astype(float), np.abs(predicted) ** 2)
    return np.asarray(inner / np.sqrt(np.maximum(own[:, None] * other, 1e-300)))
