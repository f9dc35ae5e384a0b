"""What a measurement is refused for, with its cause."""

from collections.abc import Sequence

import numpy as np

from drivers.errors import LinkError
from model.arrays import FloatArray
from model.errors import InputError
from sim.measuring.loopback import SILENT, certain_drift
from sim.measuring.multisine import Estimate, Multisine
from sim.sensors.sensor_file import WiredSensor

_FULL = 0.999  # of full scale
_LOOPED = 0.05  # of a sample that a loop-back brings back at least
_CROSSTALK = 0.02  # of it, that other outputs may
_COHERENT = 0.9  # in the median over frequencies
_MOVED = 5.0  # times the noise, in the median over frequencies and the maximum over sensors


def check_levels(
    recorded: FloatArray,
    sensors: Sequence[WiredSensor],
    *,
    cable: tuple[int, int] | None = None,
) -> None:
    """Raise InputError for clipped inputs, LinkError for silent ones, of one run (n, inputs).

    cable: output and input of the loop-back, to be checked too.
    """
    named = {sensor.input: f"sensor {sensor.name}" for sensor in sensors}
    if cable is not None:
        named[cable[1]] = "the loop-back"
    clipped = [name for n, name in named.items() if np.abs(recorded[:, n - 1]).max() >= _FULL]
    if clipped:
        raise InputError(
            f"inputs must stay below full scale, got clipping of {', '.join(clipped)}; turn down "
            "the gain of the input, and its full_scale_v, or choose a lower --level"
        )
    silent = [n for n in named if np.sqrt((recorded[:, n - 1] ** 2).mean()) < SILENT]
    if len(silent) == len(named):
        raise LinkError(
            "all inputs are silent: check that --device is the one that is wired, its outputs and "
            "inputs not swapped, amplifier and sensor supply switched on"
        )
    if silent:
        hint = ""
        if cable is not None and cable[1] in silent:
            hint = f"; the loop-back is a cable from output {cable[0]} to input {cable[1]}"
        inputs = ", ".join(f"{named[n]} (input {n})" for n in silent)
        raise LinkError(f"silent: {inputs}; check cables and the supply of sensors (IEPE){hint}")


def check_wiring(
    found: Estimate,
    sensors: Sequence[WiredSensor],
    eras: Sequence[tuple[str, int]],
    *,
    loopback: int,
    output: int,
) -> None:
    """Raise InputError where the loop-back shows inputs or outputs to be swapped.

    eras: name and output of each source, in order; the loop-back is the last one.
    """
    came = np.median(np.abs(found.values), axis=0)  # (inputs, sources)
    named = {sensor.input: f"of sensor {sensor.name}" for sensor in sensors}
    *_, second, first = np.sort(came[loopback - 1])
    source = int(came[loopback - 1].argmax())
    if source < len(eras) and first > _LOOPED and second < _CROSSTALK * first:
        name, at = eras[source]
        raise InputError(
            f"input {loopback} must bring back output {output}, got output {at} of ERA {name}: "
            "outputs are swapped; exchange their cables"
        )
    back = int(came[:, -1].argmax()) + 1
    if back != loopback and came[back - 1, -1] > _LOOPED:
        raise InputError(
            f"the loop-back of output {output} must come back at input {loopback}, got it at input "
            f"{back}, {named.get(back, 'of no sensor')}: inputs are swapped; exchange their cables"
        )
    if came[loopback - 1, -1] < _LOOPED:
        raise InputError(
            f"input {loopback} must bring back output {output} as the loop-back, got "
            f"{came[loopback - 1, -1]:.2g} of it; connect them by a cable"
        )
    others = came[loopback - 1, : len(eras)]
    if others.max(initial=0) > _CROSSTALK * came[loopback - 1, -1]:
        name, at = eras[int(others.argmax())]
        raise InputError(
            f"the loop-back must be output {output} alone, got {others.max():.2g} of output {at} "
            f"of ERA {name} too; check mixers and monitoring of the sound card"
        )


def check_clocks(
    multisine: Multisine,
    recorded: Sequence[FloatArray],
    sensors: Sequence[WiredSensor],
    *,
    loopback: int,
) -> None:
    """Raise InputError for inputs with another clock than the outputs'; runs (n, inputs) each."""
    named = {loopback: "the loop-back"} | {s.input: f"sensor {s.name}" for s in sensors}
    drifts = {n: certain_drift(multisine, [each[:, n - 1] for each in recorded]) for n in named}
    found = [
        f"{1e6 * each:.0f} millionths at {named[n]} (input {n})"
        for n, each in drifts.items()
        if each
    ]
    if found:
        raise InputError(
            f"inputs must have the clock of the outputs, got a drift of {', '.join(found)}; use "
            "one sound card, or clock all of them by one (word clock, ADAT)"
        )


def check_coherence(
    found: Estimate, sensors: Sequence[WiredSensor], eras: Sequence[tuple[str, int]]
) -> None:
    """Raise LinkError for sensors that hear something else, and for ERAs that move nothing."""
    columns = [sensor.input - 1 for sensor in sensors]
    coherence = np.median(found.coherence[:, columns], axis=0)
    incoherent = [
        f"{sensor.name} ({each:.2f})"
        for sensor, each in zip(sensors, coherence, strict=True)
        if each < _COHERENT
    ]
    if incoherent:
        raise LinkError(
            f"coherence must be at least {_COHERENT:g} in the median, got {', '.join(incoherent)}; "
            "check how these sensors are mounted, their cables and mains hum, choose a higher "
            "--level or more --periods, or delete their lines"
        )
    moved = np.abs(found.values[:, columns]) / found.std[:, columns, None]
    for (name, at), each in zip(eras, np.median(moved, axis=0).max(axis=0), strict=False):
        if each < _MOVED:
            raise LinkError(
                f"output {at} moves nothing: check ERA {name}, its amplifier and its cable"
            )
