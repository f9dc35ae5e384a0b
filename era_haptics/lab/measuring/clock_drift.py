"""Inputs of a sound card on another clock than its outputs.

The clocks of two devices, or of an aggregate of two, drift by 10 to 100 ppm. The runs are then no
longer orthogonal, and no other check detects this if the loop-back has the right clock.
"""

from collections.abc import Sequence

import numpy as np

from era_haptics.lab.measuring.multisine import PERIOD, Multisine
from era_haptics.lab.measuring.wiring import SoundCardWiring
from model.arrays import FloatArray
from model.errors import InputError

_CLOCK_TOLERANCE = 2e-6  # 13 s of measuring turn 500 Hz by 5 degrees
_MAX_DRIFT = 1e-3  # a lost block of 64 samples at 48 kHz looks like more
_MIN_SIMILARITY = 0.999  # of the periods, after correction of the drift
_CERTAIN = 5.0  # standard errors
_SMALLEST = 1e-300  # in place of a divisor of 0


def certain_drift(multisine: Multisine, runs: Sequence[FloatArray]) -> float:
    """Drift of an input's clock relative to the outputs', from whole periods of each run, (n,).

    Least squares of the phase 2 pi f t drift between the first and the last period, t apart,
    weighted by the power of each line. 0 if the drift is within its error, or if it does not
    explain the difference between the periods (a lost block does not drift).
    """
    samples = multisine.samples
    first = np.array([multisine.amplitudes_in(run[:samples]) for run in runs])
    last = np.array([multisine.amplitudes_in(run[-samples:]) for run in runs])
    products = last * first.conj()
    weights = np.abs(products)
    phases = np.angle(products)
    duration = PERIOD * (len(runs[0]) / samples - 1)
    slopes = np.broadcast_to(2 * np.pi * multisine.frequencies * duration, weights.shape)
    moment = max(float((weights * slopes**2).sum()), _SMALLEST)
    drift = float((weights * slopes * phases).sum()) / moment
    residuals = phases - slopes * drift
    variance = float((weights**2 * slopes**2 * residuals**2).sum())
    error = np.sqrt(variance) / moment
    min_drift = max(_CLOCK_TOLERANCE, _CERTAIN * error)
    if not min_drift < abs(drift) < _MAX_DRIFT:
        return 0.0
    corrected = products * np.exp(-1j * slopes * drift)
    similarity = np.abs(corrected.sum()) / max(weights.sum(), _SMALLEST)
    return drift if similarity > _MIN_SIMILARITY else 0.0


def check_clocks(
    multisine: Multisine, recorded: Sequence[FloatArray], wiring: SoundCardWiring
) -> None:
    """Raise InputError for inputs on another clock than the outputs; recorded: runs (n, inputs)."""
    drifts = []
    for number, name in wiring.input_names.items():
        drift = certain_drift(multisine, [run[:, number - 1] for run in recorded])
        if drift:
            drifts.append(f"{1e6 * drift:.0f} ppm at {name} (input {number})")
    if drifts:
        raise InputError(
            f"inputs must have the clock of the outputs, got a drift of {', '.join(drifts)}; use "
            "one sound card, or a common word clock or ADAT clock"
        )
