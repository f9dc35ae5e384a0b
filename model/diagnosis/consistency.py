"""Checks of measured responses before a rig is fitted to them: are they what they claim to be?

A fit can absorb almost any error of a measurement: gains take wrong units, springs a swapped plug,
outlier rejection whole sensors. Each check here looks for one such error alone, in what the fit
would leave free, and names it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from model.arrays import best_by
from model.calibration.calibrate import wrong_size
from model.calibration.fit import SensedPlate, project_gains, row_rms
from model.calibration.responses import Responses, Screening
from model.diagnosis.assignment import ShapeMatch
from model.diagnosis.plate_match import MAX_FIT_ERROR
from model.diagnosis.verdict import Verdict, best_wiring, diagnose
from model.errors import InputError
from model.rig.rig import Rig

GRAVITY = 9.80665  # m/s², standard
_MAX_GAIN = 3.0  # of all channels together; a factor either way is another quantity or unit
_MAX_FREQUENCIES = 16  # ample for every check
_CLEAR = 20.0  # difference of costs


@dataclass(frozen=True)
class _Quantity:
    """What responses may be instead of acceleration per displacement: name, remedy, and factor.

    factor * (i omega)^power times that is recorded.
    """

    name: str
    remedy: str
    factor: float
    power: int = 0


_QUANTITIES = (
    _Quantity("g", f"multiply by {GRAVITY}", 1 / GRAVITY),
    _Quantity("mm/s² per m", "divide by 1000", 1e3),
    _Quantity("m/s² per mm", "multiply by 1000", 1e-3),
    _Quantity("m/s² per µm", "multiply by 1000000", 1e-6),
    _Quantity("g per mm", f"multiply by {1000 * GRAVITY}", 1e-3 / GRAVITY),
    _Quantity("g per µm", f"multiply by {1e6 * GRAVITY}", 1e-6 / GRAVITY),
    _Quantity("velocity in m/s", "multiply by i omega, 2 pi times the frequency", 1.0, -1),
    _Quantity("velocity in mm/s", "multiply by i omega / 1000", 1e3, -1),
    _Quantity("displacement in m", "multiply by -omega², omega 2 pi times the frequency", 1.0, -2),
    _Quantity("displacement in mm", "multiply by -omega² / 1000", 1e3, -2),
    _Quantity("displacement in µm", "multiply by -omega² / 1000000", 1e6, -2),
)


def check_consistency(rig: Rig, responses: Responses) -> Screening:
    """Refuse responses that are not what they claim; return what of them a fit can use.

    Raises InputError that names the cause: too few sensors or frequencies, another quantity or
    unit, a grain along the other side, the other meaning of a resonance, conjugated phases, sensors
    at swapped places, swapped or inverted channels.
    """
    rows = np.unique(
        np.linspace(0, len(responses.frequencies) - 1, _MAX_FREQUENCIES).round().astype(int)
    )
    observation = replace(
        responses, frequencies=responses.frequencies[rows], values=responses.values[rows]
    )
    if observation.measured.any() and not (np.abs(observation.values) > 0).any():
        raise InputError("measured responses must not all be zero; check that ERAs were driven")
    # Values of the plate that are off are what a calibration is for.
    verdict = diagnose(rig, observation, false_alarm=0.0, check=_check_claims)
    _check_wiring(verdict)
    _check_size(verdict)
    assert verdict.match is not None  # noqa: S101  some channels have the rig's gain
    return Screening(
        np.array(["dead" in channel.states for channel in verdict.channels]),
        np.isin(responses.sensors, [each.name for each in verdict.bad_sensors if each.is_mute]),
        verdict.match.x[verdict.match.plate.numbers],
    )


def _check_claims(plate: SensedPlate, shapes: ShapeMatch, observation: Responses) -> None:
    """Raise InputError where responses are of another quantity or phase."""
    _check_quantity(plate, shapes, observation)
    _check_phases(plate, shapes, observation)


def _check_quantity(plate: SensedPlate, shapes: ShapeMatch, observation: Responses) -> None:
    """Raise InputError where gains of all channels are those of another quantity or unit."""
    model = plate.responses(plate.moved(*shapes.start))[:, list(shapes.nearest)]
    weight = np.isfinite(observation.values) / row_rms(observation.values)[:, :, None]
    gains, _ = project_gains(model, observation.values, weight)
    size = np.log(row_rms(observation.values) / row_rms(model))
    known = np.isfinite(gains)
    omega = 2 * np.pi * observation.frequencies[:, None]

    def distance(factor: float, power: int) -> float:
        """Of gains from those of a quantity, by size and by phase."""
        expected = factor * (1j * omega) ** power
        off = np.abs(size - np.log(np.abs(expected)))[known]
        phase = np.angle(gains / expected)[known]
        return float(np.median(off) + 1 - np.median(np.cos(phase)))

    level = float(np.median(size[known]))
    own = distance(1.0, 0)
    nearest = best_by(_QUANTITIES, lambda each: -distance(each.factor, each.power))
    gap = distance(nearest.factor, nearest.power)
    if abs(level) < np.log(_MAX_GAIN) or own < gap:
        return
    if gap < np.log(_MAX_GAIN):
        raise InputError(
            f"responses must be acceleration per base displacement in 1/s², got {nearest.name}, as "
            f"it looks: all are {np.exp(level):.3g} of what the rig predicts; {nearest.remedy}"
        )
    raise InputError(
        f"responses must be those of the rig to a factor of {_MAX_GAIN:g}, got "
        f"{np.exp(level):.3g} of what it predicts; check their unit and the stroke of the ERAs"
    )


def _check_phases(plate: SensedPlate, shapes: ShapeMatch, observation: Responses) -> None:
    """Raise InputError for conjugated phases."""
    match, _ = best_wiring(plate, observation.values, shapes)
    other, _ = best_wiring(plate, observation.values.conj(), shapes)
    if other.cost < match.cost - _CLEAR:
        raise InputError(
            "phases must be for exp(+i omega t), got conjugated ones, as it looks: with the signs "
            "of all imaginary parts changed the plate explains the responses better "
            f"({100 * other.error:.1f} % unexplained instead of {100 * match.error:.1f} %); "
            "change them"
        )


def _check_wiring(verdict: Verdict) -> None:
    """Raise InputError for channels that drive another ERA or have the opposite sign."""
    swapped = {era for cycle in verdict.swapped for era in cycle}
    for cycle in verdict.swapped:
        raise InputError(
            f"channels must drive the ERAs of the rig, got swapped ones: those of "
            f"{_joined(cycle)} drive each other's ERA, as it looks; correct the plugs, the names "
            "in the file, or the channels in the rig, or the sensors' positions if they are "
            "mirrored, and measure again"
        )
    for channel in verdict.channels:
        if "other ERA" in channel.states and channel.era not in swapped:
            raise InputError(
                f"channels must drive the ERAs of the rig, got ERA {channel.drives} driven by that "
                f"of {channel.era}, as it looks; correct the plug or the names in the file"
            )
    inverted = [channel.era for channel in verdict.channels if "inverted" in channel.states]
    if inverted:
        raise InputError(
            f"signs must be upwards positive for sensors and ERAs, got opposite ones of "
            f"{_joined(inverted)}; swap the two wires of these, or turn the sensors over if it is "
            "all of them"
        )


def _check_size(verdict: Verdict) -> None:
    """Raise InputError where another length or width of the plate explains the responses best."""
    if verdict.plate_matches or not verdict.explanations:
        return
    best = verdict.explanations[0]
    if best.cause.is_geometry and best.match.error <= MAX_FIT_ERROR:
        raise wrong_size(best.cause.key, best.expected, best.value)


def _joined(names: Sequence[str]) -> str:
    return " and ".join(filter(None, [", ".join(names[:-1]), names[-1]]))
