"""Measured responses that are not what they claim, from a measurement that is."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from model.calibration.responses import Responses

G = 9.80665  # m/s², standard gravity


def _exchanged(responses: Responses, axis: int, first: int, second: int) -> Responses:
    values = np.moveaxis(responses.values, axis, 0).copy()
    values[[first, second]] = values[[second, first]]
    return replace(responses, values=np.moveaxis(values, 0, axis))


def _times(factor: Callable[[np.ndarray], np.ndarray]) -> Callable[[Responses], Responses]:
    def change(responses: Responses) -> Responses:
        omega = 2 * np.pi * responses.frequencies[:, None, None]
        return replace(responses, values=responses.values * factor(omega))

    return change


DISTORTIONS: dict[str, Callable[[Responses], Responses]] = {
    "g": _times(lambda omega: 1 / G + 0 * omega),
    "velocity": _times(lambda omega: 1 / (1j * omega)),
    "displacement": _times(lambda omega: -1 / omega**2),
    "opposite": _times(lambda omega: -1 + 0 * omega),
    "conjugated": lambda responses: replace(responses, values=responses.values.conj()),
    "swapped_channels": lambda responses: _exchanged(responses, 1, 0, 1),
    "swapped_sensors": lambda responses: _exchanged(responses, 2, 0, 5),
    "two_sensors": lambda responses: replace(
        responses,
        sensors=responses.sensors[:2],
        points=responses.points[:2],
        values=responses.values[:, :, :2],
    ),
}
"""By name, what is done to the responses."""


def every(responses: Responses, step: int, *, up_to: float) -> Responses:
    """Every so many frequencies, up to one [Hz]."""
    rows = np.flatnonzero(responses.frequencies <= up_to)[::step]
    return replace(
        responses, frequencies=responses.frequencies[rows], values=responses.values[rows]
    )
