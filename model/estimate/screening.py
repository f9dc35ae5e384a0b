"""Screening of responses before a fit: contradictions with their metadata, and dead channels.

A fit can absorb almost any measurement error: gains absorb wrong units, springs a swapped plug,
outlier rejection whole sensors.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from model.arrays import FloatArray
from model.errors import InputError
from model.estimate.findings import cycles
from model.estimate.measurement import Measurement
from model.estimate.plate_match import MAX_FIT_ERROR
from model.estimate.rig_check import diagnose
from model.estimate.verdict import Verdict
from model.quantities import in_display_unit
from model.rig.rig import Rig

_MAX_FREQUENCIES = 16  # enough for every check


@dataclass(frozen=True, eq=False)
class Screening:
    """Result of checking responses before a fit."""

    dead_eras: NDArray[np.bool_]
    """Mask (e,) of the ERAs that do not move the plate."""
    dead_sensors: NDArray[np.bool_]
    """Mask (s,) of the sensors with almost no signal."""
    start: FloatArray
    """Fitted values (n,) of the most likely plate, in the order of `SensedPlate.numbers`."""

    def live(self, measured: Measurement) -> Measurement:
        """Return the responses of the sensors and ERAs that are not dead."""
        live = measured.without(self.dead_sensors)
        return replace(live, values=np.where(self.dead_eras, np.nan, live.values))


def check_consistency(rig: Rig, responses: Measurement) -> Screening:
    """Check that responses agree with their metadata, and find dead channels.

    Raises InputError with the cause: too few sensors or frequencies, wrong quantity or unit, grain
    along the other side, free and mounted resonance confused, conjugated phases, sensors at swapped
    positions, swapped or inverted channels.
    """
    last = len(responses.frequencies) - 1
    rows = np.unique(np.linspace(0, last, _MAX_FREQUENCIES).round().astype(int))
    values = responses.values[rows]
    observation = replace(
        responses, frequencies=responses.frequencies[rows], values=values, errors=None
    )
    if observation.count and not (np.abs(values) > 0).any():
        raise InputError("measured responses must not all be zero; check that ERAs were driven")
    # A calibration corrects wrong plate values, so these are no reason to reject.
    verdict = diagnose(rig, observation, false_alarm=0.0, refuses=True)
    _check_wiring(verdict)
    _check_size(verdict)
    assert verdict.match is not None  # noqa: S101  some channels have the rig's gain
    silent = [finding.of for finding in verdict.of_kinds("silent", "mute")]
    return Screening(
        dead_eras=np.array(["dead" in channel.states for channel in verdict.channels]),
        dead_sensors=np.isin(responses.names, silent),
        start=verdict.match.fit.x[verdict.match.plate.numbers],
    )


def _check_wiring(verdict: Verdict) -> None:
    """Raise InputError for channels that drive another ERA or have inverted polarity."""
    for cycle in cycles(verdict.channels):
        names = _joined([channel.era for channel in cycle])
        raise InputError(
            f"channels must drive the ERAs of the rig; the channels of {names} appear to be "
            "swapped. Correct the plugs, the names in the file, or the channels in the rig (or the "
            "sensors' positions if they are mirrored), and measure again"
        )
    for channel in verdict.channels:
        if "other ERA" in channel.states:
            raise InputError(
                f"channels must drive the ERAs of the rig; the channel of {channel.era} appears to "
                f"drive ERA {channel.drives}. Correct the plug or the names in the file"
            )
    inverted = [channel.era for channel in verdict.channels if "inverted" in channel.states]
    if inverted:
        raise InputError(
            f"signs must be positive upwards for sensors and ERAs, got inverted signs for "
            f"{_joined(inverted)}; swap their two wires, or turn the sensors over if all "
            "are inverted"
        )


def _check_size(verdict: Verdict) -> None:
    """Raise InputError if a plate of another size explains the responses best."""
    for hypothesis in verdict.hypotheses[:1]:
        is_size = hypothesis.key in ("plate.length", "plate.width")
        if is_size and hypothesis.match.error <= MAX_FIT_ERROR:
            raise wrong_size(hypothesis.key, hypothesis.expected, hypothesis.value)


def wrong_size(key: str, rig_size: float, fitted_size: float) -> InputError:
    """Return the error for a side [m] of the plate, by key, if another size fits better."""
    rig_text = in_display_unit(rig_size, "m", digits=4)
    fitted_text = in_display_unit(fitted_size, "m", digits=4)
    return InputError(
        f"{key} must match the measured plate, got {rig_text} in the rig; the responses fit "
        f"{fitted_text}. Measure the plate and correct the rig, or use the measurement of this "
        "plate"
    )


def _joined(names: Sequence[str]) -> str:
    """Join names by commas, the last two by "and"."""
    *first, last = names
    return f"{', '.join(first)} and {last}" if first else last
