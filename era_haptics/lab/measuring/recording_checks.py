"""Errors in a recording: clipped and silent inputs, foreign signals, ERAs that move no sensor."""

from collections.abc import Mapping, Sequence

import numpy as np

from drivers.errors import LinkError
from era_haptics.lab.measuring.multisine import ResponseEstimate
from era_haptics.lab.measuring.wiring import SoundCardWiring
from model.arrays import FloatArray
from model.errors import InputError

SILENT = 1e-5
"""RMS of full scale; an input without a signal stays below it."""

MIN_COHERENCE = 0.9
"""Lowest coherence of a sensor, in the median over frequencies."""

MIN_RESPONSE = 5.0
"""Smallest response to an output that moves the plate, relative to the noise, in the median over
frequencies and the maximum over sensors."""

_FULL_SCALE = 0.999
_FAINT = 0.01  # of full scale; below it, converter noise is audible next to the signal


def check_levels(recorded: FloatArray, named: Mapping[int, str]) -> None:
    """Raise InputError for clipped inputs, LinkError for silent ones, in one run (n, inputs).

    named: description of each input to be checked, by input number from 1.
    """
    clipped: list[str] = []
    silent: list[int] = []
    for number, name in named.items():
        samples = recorded[:, number - 1]
        if np.abs(samples).max() >= _FULL_SCALE:
            clipped.append(name)
        if np.sqrt((samples**2).mean()) < SILENT:
            silent.append(number)
    if clipped:
        raise InputError(
            f"inputs must stay below full scale, got clipping of {', '.join(clipped)}; turn down "
            "the gain of the input, and its full_scale_v, or choose a lower --level"
        )
    if len(silent) == len(named) > 1:
        raise LinkError(
            "all inputs are silent: check that --device is the connected sound card, that outputs "
            "and inputs are not swapped, and that amplifier and sensor supply are switched on"
        )
    if silent:
        inputs = [f"{named[number]} (input {number})" for number in silent]
        raise LinkError(
            f"silent: {', '.join(inputs)}; check cables, amplifier and sensor supply (IEPE)"
        )


def check_coherence(
    estimate: ResponseEstimate,
    recorded: Sequence[FloatArray],
    wiring: SoundCardWiring,
    *,
    is_heard: bool = False,
) -> None:
    """Raise LinkError for sensors with foreign signals, and for ERAs that move no sensor.

    estimate: from recorded, runs of (n, inputs); is_heard: whether every ERA was detected at
    another position.
    """
    columns = wiring.sensor_columns
    coherences = np.median(estimate.coherence[:, columns], axis=0)
    run_peaks = [np.abs(run[:, columns]).max(axis=0) for run in recorded]
    peaks = np.max(run_peaks, axis=0)
    faint: list[str] = []
    disturbed: list[str] = []
    for sensor, coherence, peak in zip(wiring.sensors, coherences, peaks, strict=True):
        if coherence < MIN_COHERENCE:
            sensors = faint if peak < _FAINT else disturbed
            level = f"input up to {100 * peak:.2g} % of full scale"
            sensors.append(f"{sensor.name} ({coherence:.2f}, {level})")
    if faint:
        remedy = "too low a level: choose a higher --level, or turn up the gain of the input"
        raise _incoherent(faint, remedy)
    if disturbed:
        remedy = "fix these sensors to the plate, check their cables and mains hum"
        raise _incoherent(disturbed, remedy)
    _check_moved(estimate, wiring, is_heard=is_heard)


def _incoherent(sensors: Sequence[str], remedy: str) -> LinkError:
    return LinkError(
        f"coherence must be at least {MIN_COHERENCE:g} in the median, got {', '.join(sensors)}; "
        f"{remedy}"
    )


def _check_moved(estimate: ResponseEstimate, wiring: SoundCardWiring, *, is_heard: bool) -> None:
    """Raise LinkError for an ERA that moves no sensor."""
    columns = wiring.sensor_columns
    levels = np.abs(estimate.values[:, columns])
    ratios = levels / estimate.std[:, columns, None]
    ratio_by_source = np.median(ratios, axis=0).max(axis=0)
    for (name, output), ratio in zip(wiring.era_outputs.items(), ratio_by_source, strict=False):
        if ratio >= MIN_RESPONSE:
            continue
        if is_heard:
            raise LinkError(
                f"output {output} is not heard here, but was at another place: this one is near a "
                f"nodal line for ERA {name}; s skips it, or move it by a few cm, in its line of "
                "--sensors too (q, then --resume); if the next place does not hear it either, "
                "check its cable"
            )
        raise LinkError(
            f"output {output} moves nothing: check ERA {name}, its amplifier and its cable"
        )
