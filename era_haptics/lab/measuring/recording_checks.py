"""Errors in a recording: lost blocks, delays, clocks that drift, levels, cables, coherence.

The loop-back cable reveals delay, converter response, lost blocks, and inputs on another clock than
the outputs. The clocks of two devices, or of an aggregate of two, drift by 10 to 100 ppm. The runs
are then no longer orthogonal, and no other check detects this if the loop-back has the right clock.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from drivers.errors import LinkError
from era_haptics.lab.measuring.multisine import PERIOD, Multisine, ResponseEstimate
from era_haptics.lab.measuring.wiring import SoundCardWiring
from model.arrays import ComplexArray, FloatArray
from model.errors import InputError

SILENT = 1e-5
"""RMS of full scale; an input without a signal stays below it."""

CROSSTALK = 0.02
"""Of the loop-back, allowed for other outputs."""

MIN_COHERENCE = 0.9
"""Lowest coherence of a sensor, in the median over frequencies."""

MIN_RESPONSE = 5.0
"""Smallest response to an output that moves the plate, relative to the noise, in the median over
frequencies and the maximum over sensors."""

_MAX_DELAY = 0.1  # s; lines 10 Hz apart repeat then
_MIN_MATCH = 0.95  # of the best match of a delay, for shorter ones
_MAX_CURVATURE = 0.5  # rad; of a phase that is a straight line
_SAME_PERIOD = 1e-3  # of periods; a lost block makes them differ by 0.8
_CLOCK_TOLERANCE = 2e-6  # 13 s of measuring turn 500 Hz by 5 degrees
_MAX_DRIFT = 1e-3  # a lost block of 64 samples at 48 kHz looks like more
_MIN_SIMILARITY = 0.999  # of the periods, after correction of the drift
_CERTAIN = 5.0  # standard errors
_FULL_SCALE = 0.999
_LOOPED = 0.05  # of a sample that a loop-back brings back at least
_FAINT = 0.01  # of full scale; below it, converter noise is audible next to the signal
_SMALLEST = 1e-300  # in place of a divisor of 0


def has_all_blocks(periods: FloatArray, *, samples: int) -> bool:
    """Return whether all periods of the loop-back (n,) are equal: no block was lost between them.

    False for a silent loop-back, which cannot show lost blocks.
    """
    rows = periods.reshape(-1, samples)
    norm = np.linalg.norm(rows[0])
    difference = np.linalg.norm(rows - rows[0], axis=1).max()
    is_silent = norm <= SILENT * np.sqrt(samples)
    return bool(not is_silent and difference <= _SAME_PERIOD * norm)


def latency(response: ComplexArray, frequencies: FloatArray) -> float:
    """Delay [s] of a response at frequencies [Hz], from 0 to 0.1 s, by the slope of its phase.

    Lines d apart tell delays below 1 / d apart only.

    Raises LinkError where the phase is no straight line, so that nothing is known of the delay.
    """
    unit = response / np.abs(response)
    delays = np.arange(0, _MAX_DELAY, 0.1 / frequencies.max())
    matches = np.abs(np.exp(2j * np.pi * np.outer(delays, frequencies)) @ unit)
    # Lines at equal distances have several such delays: the shortest is meant.
    matching = np.flatnonzero(matches > _MIN_MATCH * matches.max())
    delay = delays[matching[0]]
    residual = unit * np.exp(2j * np.pi * frequencies * delay)
    phase = np.angle(residual / residual.mean())
    slope, offset = np.polyfit(frequencies, phase, 1)
    if np.abs(phase - slope * frequencies - offset).max() > _MAX_CURVATURE:
        raise LinkError(
            f"loop-back: its phase must correspond to a delay of up to {1e3 * _MAX_DELAY:g} ms; "
            f"check "
            "the cable, and that no other signal feeds this input"
        )
    return float(delay - slope / (2 * np.pi))


def certain_drift(multisine: Multisine, runs: Sequence[FloatArray]) -> float:
    """Drift of an input's clock relative to the outputs', from whole periods of each run, (n,).

    Least squares of the phase 2 pi f t drift between the first and the last period, t apart,
    weighted by the power of each line. 0 if the drift is within its error, or if it does not
    explain the difference between the periods (a lost block does not drift).
    """
    samples = multisine.samples
    first = np.array([multisine.amplitudes_in(run[:samples]) for run in runs])
    last = np.array([multisine.amplitudes_in(run[-samples:]) for run in runs])
    duration = PERIOD * (len(runs[0]) / samples - 1)
    products = last * first.conj()
    weights = np.abs(products)
    phases = np.angle(products)
    slopes = np.broadcast_to(2 * np.pi * multisine.frequencies * duration, weights.shape)
    moment = max(float((weights * slopes**2).sum()), _SMALLEST)
    drift = float((weights * slopes * phases).sum()) / moment
    residuals = phases - slopes * drift
    error = np.sqrt(float((weights**2 * slopes**2 * residuals**2).sum())) / moment
    corrected = products * np.exp(-1j * slopes * drift)
    similarity = np.abs(corrected.sum()) / max(weights.sum(), _SMALLEST)
    is_certain = max(_CLOCK_TOLERANCE, _CERTAIN * error) < abs(drift) < _MAX_DRIFT
    return drift if is_certain and similarity > _MIN_SIMILARITY else 0.0


def check_levels(recorded: FloatArray, named: Mapping[int, str]) -> None:
    """Raise InputError for clipped inputs, LinkError for silent ones, in one run (n, inputs).

    named: description of each input to be checked, by input number from 1.
    """
    clipped, silent = [], []
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
        inputs = ", ".join(f"{named[number]} (input {number})" for number in silent)
        raise LinkError(f"silent: {inputs}; check cables, amplifier and sensor supply (IEPE)")


def check_wiring(estimate: ResponseEstimate, wiring: SoundCardWiring) -> None:
    """Raise InputError unless the loop-back, and no sensor, is connected to an output by a cable.

    A cable returns a single output. With a single source, sensors do so too.
    """
    gains = np.median(np.abs(estimate.values), axis=0)  # (inputs, sources)
    cables = _cables(gains, wiring)
    _check_loopback(gains, cables, wiring)
    for sensor in wiring.sensors:
        source = cables[sensor.input - 1]
        if source >= 0:
            raise InputError(
                f"input {sensor.input} must have {wiring.input_names[sensor.input]}, got output "
                f"{wiring.source_outputs[source]} as through a cable; check the plug of that "
                "sensor, Y cables and monitoring of the sound card"
            )


def _cables(gains: FloatArray, wiring: SoundCardWiring) -> NDArray[np.intp]:
    """Return the source connected to each input by a cable, (inputs,), -1 for none.

    gains: (inputs, sources).
    """
    highest = gains.max(axis=1)
    second = np.sort(gains, axis=1)[:, :-1].max(axis=1, initial=0.0)
    numbers = np.arange(1, 1 + len(gains))
    is_distinguishable = (len(wiring.source_outputs) > 1) | (numbers == wiring.loopback_input)
    is_cable = (highest > _LOOPED) & (second < CROSSTALK * highest) & is_distinguishable
    return np.where(is_cable, gains.argmax(axis=1), -1)


def _check_loopback(gains: FloatArray, cables: NDArray[np.intp], wiring: SoundCardWiring) -> None:
    """Raise InputError unless the loop-back's input has its output alone."""
    source = wiring.loopback_source
    number = wiring.loopback_input
    output = wiring.loopback_output
    own_gains = gains[number - 1]
    other_gains = own_gains * (np.arange(gains.shape[1]) != source)
    era_names = list(wiring.era_outputs)
    strongest = int(other_gains.argmax())
    strongest_output = f"output {wiring.source_outputs[strongest]} of ERA {era_names[strongest]}"
    other = f"{other_gains.max():.2g} of {strongest_output}"
    required = f"input {number} must bring back output {output} alone, as the loop-back, got"
    if cables[number - 1] not in (source, -1):
        raise InputError(f"{required} {other}: outputs are swapped; exchange their cables")
    looped_inputs = np.flatnonzero(cables == source) + 1
    if looped_inputs.size and number not in looped_inputs:
        first = looped_inputs[0]
        raise InputError(
            f"the loop-back of output {output} must come back at input {number}, got it at input "
            f"{first}, {wiring.input_names.get(first, 'of no sensor')}: inputs are swapped; "
            "exchange their cables"
        )
    gain = own_gains[source]
    if gain <= _LOOPED:
        raise InputError(f"{required} a gain of {gain:.2g}; connect them by a cable")
    if number not in looped_inputs:
        raise InputError(f"{required} {other}, too; check mixers and monitoring of the sound card")


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
    coherences = np.median(estimate.coherence[:, wiring.sensor_columns], axis=0)
    peaks = np.max([np.abs(run[:, wiring.sensor_columns]).max(axis=0) for run in recorded], axis=0)
    faint: list[str] = []
    disturbed: list[str] = []
    for sensor, coherence, peak in zip(wiring.sensors, coherences, peaks, strict=True):
        if coherence < MIN_COHERENCE:
            rows = faint if peak < _FAINT else disturbed
            level = f"input up to {100 * peak:.2g} % of full scale"
            rows.append(f"{sensor.name} ({coherence:.2f}, {level})")
    for sensors, remedy in (
        (faint, "too low a level: choose a higher --level, or turn up the gain of the input"),
        (disturbed, "fix these sensors to the plate, check their cables and mains hum"),
    ):
        if sensors:
            raise LinkError(
                f"coherence must be at least {MIN_COHERENCE:g} in the median, got "
                f"{', '.join(sensors)}; {remedy}"
            )
    _check_moved(estimate, wiring, is_heard=is_heard)


def _check_moved(estimate: ResponseEstimate, wiring: SoundCardWiring, *, is_heard: bool) -> None:
    """Raise LinkError for an ERA that moves no sensor."""
    values = np.abs(estimate.values[:, wiring.sensor_columns])
    ratios = values / estimate.std[:, wiring.sensor_columns, None]
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


def loopback_gain(
    wiring: SoundCardWiring, multisine: Multisine, number: int, recorded: FloatArray
) -> ComplexArray:
    """Complex gain (f,) of the cable in whole periods of a run (n, inputs)."""
    amplitudes = multisine.played(number)[:, wiring.loopback_source]
    return np.asarray(multisine.amplitudes_in(recorded[:, wiring.loopback_input - 1]) / amplitudes)
