"""Errors of a rig file or a measurement that describe another plate: reversed entries.

No fit of values can replace such an entry: positions from another corner, exchanged sensors, the
grain along the other side, a free resonance given as mounted. They are detected from response
shapes and corrected before any fit. On boards as bought, a fit with the right entry leaves a
quarter of the response unexplained, with the reversed one half to 90 %.
"""

import math
from dataclasses import replace
from typing import TypeAlias

import numpy as np
from scipy.optimize import linear_sum_assignment

from model.arrays import ComplexArray, FloatArray, best_by
from model.estimate.gains import gains_of, row_rms
from model.estimate.measurement import Measurement
from model.estimate.plate_match import Match
from model.estimate.sensed_plate import SensedPlate, plate_of
from model.estimate.shape_match import ShapeMatch, match_shapes
from model.estimate.staged_fit import solved_for
from model.estimate.verdict import Finding
from model.quantities import percent
from model.rig.rig import Rig
from model.rig.rig_summary import exciters_of, sections_of
from model.rig.rig_writing import change_rig

_AXES = (("x",), ("y",), ("x", "y"), ("frequency",))
"""Combinations of axes that a measurement can have the wrong way round."""

# Coherence of an exchanged sensor: at most with its own position, at least with the other one.
_OWN_COHERENCE, _OTHER_COHERENCE = 0.8, 0.9
_MAX_COARSE_ERROR = 0.45  # of a coarse fit of the right board that has a fault
_CLEARLY_LESS = 0.6  # of the error as written
_OTHER_MEANING = {"free": "mounted", "mounted": "free"}
_MAX_GAIN_STD = 0.8  # of the logarithms of gains over frequency; no drive has more
_CLEARLY_STEADIER = 0.5  # of the standard error as written

Correction: TypeAlias = tuple[Finding, Rig, Measurement]
"""Finding about a wrong rig file, with the corrected rig and measurement."""


def reversed_axes(
    plate: SensedPlate, shapes: ShapeMatch, observation: Measurement, *, may_be_plugs: bool
) -> Correction | None:
    """Find the axes along which a measurement is noted the wrong way round.

    Channels drive the ERAs of the rig. shapes: match of the observation with the rig's plate;
    may_be_plugs: whether exchanged channels can explain the observation as well.
    """
    as_written = shapes.error()
    if not as_written > _MAX_COARSE_ERROR:
        return None
    candidates = []
    for axes in _AXES:
        reversed_observation = _reversed(observation, axes, plate.sides)
        reversed_plate = plate_of(plate.rig, reversed_observation)
        error = match_shapes(reversed_plate, reversed_observation.values).error()
        candidates.append((error, axes, reversed_observation))
    error, axes, corrected = best_by(candidates, lambda candidate: -candidate[0])
    are_plugs = shapes.error(shapes.nearest) * _CLEARLY_LESS < error
    is_too_large = error >= min(_MAX_COARSE_ERROR, _CLEARLY_LESS * as_written)
    if is_too_large or (are_plugs and not may_be_plugs):
        return None
    names = " and ".join(axes)
    coarse = (
        f"with {names} from the other end a coarse fit leaves {percent(error)} of the "
        f"responses unexplained, as written {percent(as_written)}"
    )
    or_plugs = ", or plug the channels as the rig has them" if are_plugs else ""
    finding = Finding(
        kind="reversed" if axes == ("frequency",) else "mirrored",
        of=names,
        details={"coarse": coarse, "or_plugs": or_plugs},
        json={"reversed_axes": [*axes]},
    )
    return finding, plate.rig, corrected


def _reversed(observation: Measurement, axes: tuple[str, ...], sides: FloatArray) -> Measurement:
    """Return a measurement with some of its axes reversed; sides (2,): of the plate [m]."""
    is_reversed = [axis in axes for axis in "xy"]
    points = np.abs(sides * is_reversed - observation.points)
    values = observation.values
    if "frequency" in axes:
        values = values[::-1]
    return replace(observation.moved(points), values=values)


def exchanged_sensors(match: Match, observation: Measurement) -> Correction | None:
    """Find sensors whose values match the plate at another sensor's position."""
    coherence = _coherence(match)
    at_own = np.diag(coherence)
    names = observation.names
    points = observation.points.copy()
    pairs = {}
    for sensor, position in zip(*linear_sum_assignment(-(coherence**2)), strict=True):
        # Both must be wrong: otherwise two sensors share a position, which is no exchange.
        is_off = max(at_own[sensor], at_own[position]) < _OWN_COHERENCE
        if is_off and coherence[sensor, position] > _OTHER_COHERENCE:
            pairs[names[sensor]] = names[position]
            points[sensor] = observation.points[position]
    if not pairs:
        return None
    exchanges = ", ".join(f"{name} at that of {position}" for name, position in pairs.items())
    finding = Finding("exchanged", exchanges, json={"exchanged_sensors": pairs})
    return finding, match.plate.rig, observation.moved(points)


def _coherence(match: Match) -> FloatArray:
    """Coherence of each sensor's values with the responses at each sensor's position (s, s)."""
    values = match.values
    model = match.responses[..., match.drives]
    is_measured = np.isfinite(values)
    size = row_rms(values)
    measured = np.where(is_measured, values, 0) / size
    predicted = np.nan_to_num(gains_of(model, values))[:, None] * model / size
    inner = np.abs(np.einsum("fsn,fpn->sp", measured, predicted.conj()))
    measured_power = (np.abs(measured) ** 2).sum(axis=(0, 2))[:, None]
    power = np.einsum("fsn,fpn->sp", is_measured.astype(float), np.abs(predicted) ** 2)
    return np.asarray(inner / np.sqrt(np.maximum(measured_power * power, 1e-300)))


def other_meaning(
    plate: SensedPlate, shapes: ShapeMatch, observation: Measurement
) -> Correction | None:
    """Find a value that the rig of a plate has the wrong way round, the grain first.

    shapes: match of the observation with that plate. None if neither is clearly wrong.
    """
    return turned_grain(plate, shapes, observation) or misread_resonance(plate, shapes, observation)


def turned_grain(
    plate: SensedPlate, shapes: ShapeMatch, observation: Measurement
) -> Correction | None:
    """Find the board with the grain along the other side, if that clearly explains more."""
    rig = plate.rig
    if rig.plate.material.orthotropy is None:
        return None
    turned = replace(rig, plate=replace(rig.plate, material=rig.plate.material.turned()))
    turned = replace(turned, mesh=solved_for(turned, rig.limits.frequency_max).mesh)
    turned_shapes = match_shapes(plate_of(turned, observation), observation.values)
    error = turned_shapes.error(turned_shapes.nearest)
    as_written = shapes.error(shapes.nearest)
    if error > min(_MAX_COARSE_ERROR, _CLEARLY_LESS * as_written):
        return None
    along = "length" if rig.grain == "width" else "width"
    grain = {
        "expected": rig.grain,
        "found": along,
        "unexplained": error,
        "unexplained_as_written": as_written,
    }
    details = {
        "along": along,
        "as_written": rig.grain,
        "percent": percent(error),
        "percent_as_written": percent(as_written),
    }
    return (
        Finding("grain", "plate.grain", details=details, json={"grain": grain}),
        turned,
        observation,
    )


def misread_resonance(
    plate: SensedPlate, shapes: ShapeMatch, observation: Measurement
) -> Correction | None:
    """Find exciters whose other resonance clearly explains the observation better.

    Well above the resonance of the magnet on the glued coil, an exciter pushes the plate against
    its magnet with its full force. Far below, the force is small and has the opposite sign. If a
    file states the data sheet's `free` resonance as `mounted`, the exciters appear reversed, and
    weak by a different factor at each frequency. On twelve boards from standard parts, gains left
    by a coarse fit vary over frequency by 0.15 to 0.43 (RMS of their logarithms, without the mean)
    with the right resonance, and by 1.2 or more with the wrong one.
    """
    rig = plate.rig
    written = {}
    for name, section in sections_of(rig).items():
        if not section.stiffness:
            written[name] = str(section.values["resonance_is"])
    if not written:
        return None
    std_as_written = _gain_std(plate, shapes, observation.values)
    if not std_as_written > _MAX_GAIN_STD:
        return None
    for as_written in dict.fromkeys(written.values()):
        meaning = _OTHER_MEANING[as_written]
        names = [name for name, resonance_is in written.items() if resonance_is == as_written]
        corrected = change_rig(rig, eras={name: {"resonance_is": meaning} for name in names})
        corrected_plate = plate_of(corrected, observation)
        corrected_shapes = match_shapes(corrected_plate, observation.values)
        std = _gain_std(corrected_plate, corrected_shapes, observation.values)
        if std < _CLEARLY_STEADIER * std_as_written:
            exciters = [exciter for exciter in exciters_of(corrected) if exciter.name in names]
            details = {
                "which": meaning,
                "as_written": as_written,
                "factor": math.exp(std),
                "factor_as_written": math.exp(std_as_written),
            }
            finding = Finding(
                kind="resonance",
                of=", ".join(names),
                value=exciters[0].magnet_frequency,
                details=details,
                json={"resonance_is": dict.fromkeys(names, meaning)},
            )
            return finding, corrected, observation
    return None


def _gain_std(plate: SensedPlate, shapes: ShapeMatch, values: ComplexArray) -> float:
    """Spread over frequency of the logarithms of gains (RMS without the mean), the median
    channel's."""
    model = plate.responses(plate.start(*shapes.start))[..., shapes.nearest]
    gains = np.abs(gains_of(model, values))
    driven = np.isfinite(gains).sum(axis=0) > 1
    if not driven.any():
        return 0.0
    with np.errstate(divide="ignore"):
        sizes = np.log(gains[:, driven])
    return float(np.median(np.nanstd(sizes, axis=0)))
