"""Sensors at each other's places or noted from another side, by the responses that they read.

A plate that is turned over is another one by a mirror, and no fit of its values makes up for it.
Both are fitted as coarsely as wiring is first looked at (`model.diagnosis.assignment`): shapes of
boards as bought leave a quarter unexplained with the right side, nine tenths with another.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from model.arrays import ComplexArray, FloatArray, best_by
from model.calibration.fit import SensedPlate, plate_of, project_gains, row_rms
from model.calibration.responses import Responses
from model.diagnosis.assignment import ShapeMatch, match_shapes
from model.quantities import percent
from model.rig.rig import Rig

_OWN_PLACE, _OTHER_PLACE = 0.8, 0.9  # coherence of a sensor that is elsewhere
_CLEARLY = 0.6  # of the error as written
_MAX_ERROR = 0.45  # of a coarse fit of the right board, a fault beside
_X, _Y, _FREQUENCY = "x", "y", "frequency"


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


@dataclass(frozen=True)
class ReversedAxes:
    """Axes along which a measurement is noted the wrong way round.

    axes: "x", "y" or both of the places, or "frequency"; error, error_as_written: shares of the
    responses that coarse fits of either leave unexplained; is_wiring: whether exchanged channels
    explain them as well.
    """

    axes: tuple[str, ...]
    error: float
    error_as_written: float
    is_wiring: bool

    label = "PLACES"

    def __str__(self) -> str:
        """What is wrong, and what to do."""
        names = " and ".join(self.axes)
        found = (
            f"with {names} from the other end a coarse fit leaves {percent(self.error)} of the "
            f"responses unexplained, as written {percent(self.error_as_written)}"
        )
        if self.axes == (_FREQUENCY,):
            return f"frequencies must be those of their responses, got reversed ones: {found}"
        wiring = ", or plug the channels as the rig has them" if self.is_wiring else ""
        return (
            f"places of sensors must be from the corner from which those of ERAs are, got ones "
            f"mirrored in {names}: {found}; correct the positions of all{wiring}"
        )

    def put_right(self, observation: Responses, rig: Rig) -> Responses:
        """The same responses, noted the other way round."""
        size = np.array([rig.plate.length, rig.plate.width])
        mirrored = size * [axis in self.axes for axis in (_X, _Y)]
        step = -1 if _FREQUENCY in self.axes else 1
        points, values = np.abs(mirrored - observation.points), observation.values[::step]
        return replace(observation, points=points, values=values)


def reversed_axes(
    plate: SensedPlate, shapes: ShapeMatch, observation: Responses
) -> ReversedAxes | None:
    """Find the axes whose other direction is clearly the measured one, of a rig's own wiring.

    shapes: of the observation, by the rig's plate. None where that is right to a fault.
    """
    as_written = shapes.error_as_wired
    if not as_written > _MAX_ERROR:
        return None
    tried = []
    for axes in ((_X,), (_Y,), (_X, _Y), (_FREQUENCY,)):
        put_right = ReversedAxes(axes, 0.0, as_written, False).put_right(observation, plate.rig)
        error = match_shapes(plate_of(plate.rig, put_right), put_right.values).error_as_wired
        is_wiring = shapes.error * _CLEARLY < error
        tried.append(ReversedAxes(axes, error, as_written, is_wiring))
    found = best_by(tried, lambda each: -each.error)
    return found if found.error < min(_MAX_ERROR, _CLEARLY * as_written) else None


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
