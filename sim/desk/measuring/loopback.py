"""What cables tell, and what a measurement is refused for, with its cause.

Of the loop-back: delay, converters, lost blocks, and whether inputs have the clock of the outputs.
Two devices, or an aggregate of two, drift by 10 to 100 millionths. What is played in several runs
is then no longer orthogonal, and nothing else shows it where the loop-back has the right clock.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from drivers.errors import LinkError
from model.arrays import ComplexArray, FloatArray
from model.errors import InputError
from sim.desk.measuring.desk import Desk
from sim.desk.measuring.multisine import PERIOD, Estimate, Multisine

SILENT = 1e-5
"""Of full scale, rms: what an input without a signal stays below."""

_MAX_DELAY = 0.1  # s; lines 10 Hz apart repeat then
_NEARLY = 0.95
_STRAIGHT = 0.5  # rad
_AS_LATE = 0.02  # of the gain; one sample more at 500 Hz and 48 kHz makes 0.065
_SAME = 1e-3  # of periods; a lost block makes them differ by 0.8


def is_whole(periods: FloatArray, *, samples: int) -> bool:
    """Whether all periods of the loop-back (n,) are alike: no block was lost between them.

    Not so where it is silent, which tells nothing.
    """
    each = periods.reshape(-1, samples)
    size = np.linalg.norm(each[0])
    differ = np.linalg.norm(each - each[0], axis=1).max()
    return bool(size > SILENT * np.sqrt(samples) and differ <= _SAME * size)


def is_as_late(gain: ComplexArray, before: ComplexArray) -> bool:
    """Whether two gains (f,) have one delay, which a block lost between two runs changes."""
    return bool(np.abs(gain - before).max() <= _AS_LATE * np.abs(before).max())


def latency(response: ComplexArray, frequencies: FloatArray) -> float:
    """Delay [s] of a response at frequencies [Hz], from 0 to 0.1 s, by the slope of its phase.

    Lines d apart tell delays below 1 / d apart only.

    Raises LinkError where the phase is no straight line, so that nothing is known of the delay.
    """
    unit = response / np.abs(response)
    tried = np.arange(0, _MAX_DELAY, 0.1 / frequencies.max())
    alike = np.abs(np.exp(2j * np.pi * np.outer(tried, frequencies)) @ unit)
    # Lines at equal distances have several such delays: the shortest is meant.
    near = np.flatnonzero(alike > _NEARLY * alike.max())
    first_group = near[near - near[0] == np.arange(len(near))]
    nearest = tried[first_group[alike[first_group].argmax()]]
    rest = unit * np.exp(2j * np.pi * frequencies * nearest)
    phase = np.angle(rest / rest.mean())
    slope, first = np.polyfit(frequencies, phase, 1)
    if np.abs(phase - slope * frequencies - first).max() > _STRAIGHT:
        raise LinkError(
            f"loop-back: its phase must be that of a delay up to {1e3 * _MAX_DELAY:g} ms; check "
            "the cable, and that nothing else feeds this input"
        )
    return float(nearest - slope / (2 * np.pi))


TOLERANCE = 2e-6
"""Of a clock; 13 s of measuring turn 500 Hz by 5 degrees."""

_MAX_DRIFT = 1e-3  # a lost block of 64 samples at 48 kHz looks like more
_ALIKE = 0.999
_SURE = 5.0  # standard errors


def certain_drift(multisine: Multisine, runs: Sequence[FloatArray]) -> float:
    """Drift of an input's clock relative to the outputs', from whole periods of each run, (n,).

    Least squares of the phase 2 pi f t drift between the first and the last period, t apart,
    weighted by the power of each line. 0 where that is within its error, or not all that makes
    periods differ, as a lost block does.
    """
    n = multisine.samples
    first = np.array([multisine.found(each[:n]) for each in runs])
    last = np.array([multisine.found(each[-n:]) for each in runs])
    apart = PERIOD * (len(runs[0]) / n - 1)
    turned = last * first.conj()
    weights = np.abs(turned)
    slopes = np.broadcast_to(2 * np.pi * multisine.frequencies * apart, weights.shape)
    phases = np.angle(turned)
    moment = max(float((weights * slopes**2).sum()), 1e-300)
    relative = float((weights * slopes * phases).sum()) / moment
    rest = phases - slopes * relative
    error = np.sqrt(float((weights**2 * slopes**2 * rest**2).sum())) / moment
    alike = np.abs((turned * np.exp(-1j * slopes * relative)).sum()) / max(weights.sum(), 1e-300)
    is_large = max(TOLERANCE, _SURE * error) < abs(relative) < _MAX_DRIFT
    return relative if is_large and alike > _ALIKE else 0.0


_FULL = 0.999  # of full scale
_LOOPED = 0.05  # of a sample that a loop-back brings back at least
_CROSSTALK = 0.02  # of it, that other outputs may
_COHERENT = 0.9  # in the median over frequencies
_FAINT = 0.01  # of full scale: what converters themselves add is heard beside it
_MOVED = 5.0  # times the noise, in the median over frequencies and the maximum over sensors


def check_levels(recorded: FloatArray, named: Mapping[int, str]) -> None:
    """Raise InputError for clipped inputs, LinkError for silent ones, of one run (n, inputs).

    named: what the inputs have that are checked, by their number from 1.
    """
    clipped = [name for n, name in named.items() if np.abs(recorded[:, n - 1]).max() >= _FULL]
    if clipped:
        raise InputError(
            f"inputs must stay below full scale, got clipping of {', '.join(clipped)}; turn down "
            "the gain of the input, and its full_scale_v, or choose a lower --level"
        )
    silent = [n for n in named if np.sqrt((recorded[:, n - 1] ** 2).mean()) < SILENT]
    if len(silent) == len(named) > 1:
        raise LinkError(
            "all inputs are silent: check that --device is the one that is wired, its outputs and "
            "inputs not swapped, amplifier and sensor supply switched on"
        )
    if silent:
        inputs = ", ".join(f"{named[n]} (input {n})" for n in silent)
        raise LinkError(f"silent: {inputs}; check cables, amplifier and sensor supply (IEPE)")


def check_wiring(found: Estimate, desk: Desk) -> None:
    """Raise InputError unless the loop-back, and no sensor, has its output by a cable.

    A cable brings back one output alone. Sensors of a single source do so, too, and may.
    """
    came = np.median(np.abs(found.values), axis=0)  # (inputs, sources)
    own, at, output, named = desk.looped, desk.input, desk.output, desk.named_inputs
    first, others = came.max(axis=1), np.sort(came, axis=1)[:, :-1].max(axis=1, initial=0.0)
    may_tell = (len(desk.sources) > 1) | (np.arange(1, 1 + len(came)) == at)
    is_cable = (first > _LOOPED) & (others < _CROSSTALK * first) & may_tell
    by_cable = np.where(is_cable, came.argmax(axis=1), -1)  # source at each input, -1 for none
    looped, heard = came[at - 1, own], came[at - 1] * (np.arange(came.shape[1]) != own)
    of_eras = [f"output {to} of ERA {name}" for name, to in desk.eras]
    other = f"{heard.max():.2g} of {of_eras[heard.argmax()]}"
    back = np.flatnonzero(by_cable == own) + 1
    what = f"input {at} must bring back output {output} alone, as the loop-back, got"
    if by_cable[at - 1] not in (own, -1):
        raise InputError(f"{what} {other}: outputs are swapped; exchange their cables")
    if back.size and at not in back:
        raise InputError(
            f"the loop-back of output {output} must come back at input {at}, got it at input "
            f"{back[0]}, {named.get(back[0], 'of no sensor')}: inputs are swapped; exchange "
            "their cables"
        )
    if looped <= _LOOPED:
        raise InputError(f"{what} {looped:.2g} of it; connect them by a cable")
    if at not in back:
        raise InputError(f"{what} {other}, too; check mixers and monitoring of the sound card")
    for n in (each.input for each in desk.sensors if by_cable[each.input - 1] >= 0):
        raise InputError(
            f"input {n} must have {named[n]}, got output {desk.sources[by_cable[n - 1]]} as by a "
            "cable; check the plug of that sensor, Y cables and monitoring of the sound card"
        )


def check_clocks(multisine: Multisine, recorded: Sequence[FloatArray], desk: Desk) -> None:
    """Raise InputError for inputs with another clock than the outputs'; runs (n, inputs) each."""
    found = [
        f"{1e6 * drift:.0f} millionths at {name} (input {n})"
        for n, name in desk.named_inputs.items()
        if (drift := certain_drift(multisine, [each[:, n - 1] for each in recorded]))
    ]
    if found:
        raise InputError(
            f"inputs must have the clock of the outputs, got a drift of {', '.join(found)}; use "
            "one sound card, or clock all of them by one (word clock, ADAT)"
        )


def check_coherence(
    found: Estimate,
    recorded: Sequence[FloatArray],
    desk: Desk,
    *,
    is_heard: bool = False,
) -> None:
    """Raise LinkError for sensors that hear something else, and for ERAs that move nothing.

    found: of what was recorded, runs (n, inputs) each; is_heard: whether every ERA was heard at
    another place.
    """
    coherence = np.median(found.coherence[:, desk.columns], axis=0)
    peaks = np.max([np.abs(each[:, desk.columns]).max(axis=0) for each in recorded], axis=0)
    for are_faint, remedy in (
        (True, "too low a level: choose a higher --level, or turn up the gain of the input"),
        (False, "fix these sensors to the plate, check their cables and mains hum"),
    ):
        incoherent = [
            f"{sensor.name} ({each:.2f}, input up to {100 * peak:.2g} % of full scale)"
            for sensor, each, peak in zip(desk.sensors, coherence, peaks, strict=True)
            if each < _COHERENT and (peak < _FAINT) == are_faint
        ]
        if incoherent:
            raise LinkError(
                f"coherence must be at least {_COHERENT:g} in the median, got "
                f"{', '.join(incoherent)}; {remedy}"
            )
    moved = np.abs(found.values[:, desk.columns]) / found.std[:, desk.columns, None]
    for (name, at), each in zip(desk.eras, np.median(moved, axis=0).max(axis=0), strict=False):
        if each < _MOVED:
            raise LinkError(
                f"output {at} is not heard here, but was at another place: this one is near a "
                f"nodal line for ERA {name}; s skips it, or move it by a few cm, in its line of "
                "--sensors too (q, then --resume); if the next place does not hear it either, "
                "check its cable"
                if is_heard
                else f"output {at} moves nothing: check ERA {name}, its amplifier and its cable"
            )
