"""The loop-back cable of a sound card: its delay, its gain, lost blocks, and swapped cables."""

import numpy as np
from numpy.typing import NDArray

from drivers.errors import LinkError
from era_haptics.lab.measuring.multisine import Multisine, ResponseEstimate
from era_haptics.lab.measuring.recording_checks import SILENT
from era_haptics.lab.measuring.wiring import SoundCardWiring
from model.arrays import ComplexArray, FloatArray
from model.errors import InputError

CROSSTALK = 0.02
"""Of the loop-back, allowed for other outputs."""

_MAX_DELAY = 0.1  # s; lines 10 Hz apart repeat then
_MIN_MATCH = 0.95  # of the best match of a delay, for shorter ones
_MAX_CURVATURE = 0.5  # rad; of a phase that is a straight line
_SAME_PERIOD = 1e-3  # of periods; a lost block makes them differ by 0.8
_LOOPED = 0.05  # of a sample that a loop-back brings back at least


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

    Lines d apart distinguish only delays less than 1 / d apart. Raises LinkError if the phase is
    not a straight line, so that the delay is unknown.
    """
    unit = response / np.abs(response)
    delays = np.arange(0, _MAX_DELAY, 0.1 / frequencies.max())
    matches = np.abs(np.exp(2j * np.pi * np.outer(delays, frequencies)) @ unit)
    # Lines at equal distances match several delays; take the shortest.
    matching = np.flatnonzero(matches > _MIN_MATCH * matches.max())
    delay = delays[matching[0]]
    residual = unit * np.exp(2j * np.pi * frequencies * delay)
    phase = np.angle(residual / residual.mean())
    slope, offset = np.polyfit(frequencies, phase, 1)
    straight_line = slope * frequencies + offset
    if np.abs(phase - straight_line).max() > _MAX_CURVATURE:
        raise LinkError(
            f"loop-back: its phase must correspond to a delay of up to {1e3 * _MAX_DELAY:g} ms; "
            "check the cable, and that no other signal feeds this input"
        )
    return float(delay - slope / (2 * np.pi))


def loopback_gain(
    wiring: SoundCardWiring, multisine: Multisine, number: int, recorded: FloatArray
) -> ComplexArray:
    """Complex gain (f,) of the cable in whole periods of a run (n, inputs)."""
    amplitudes = multisine.played(number)[:, wiring.loopback_source]
    returned = multisine.amplitudes_in(recorded[:, wiring.loopback_input - 1])
    return np.asarray(returned / amplitudes)


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
    other = _strongest_other(own_gains, wiring)
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


def _strongest_other(gains: FloatArray, wiring: SoundCardWiring) -> str:
    """Name the strongest output other than the loop-back's; gains (sources,): of one input."""
    is_other = np.arange(len(gains)) != wiring.loopback_source
    other_gains = gains * is_other
    source = int(other_gains.argmax())
    era_names = list(wiring.era_outputs)
    output = f"output {wiring.source_outputs[source]} of ERA {era_names[source]}"
    return f"{other_gains[source]:.2g} of {output}"
