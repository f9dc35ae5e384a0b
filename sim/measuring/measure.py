"""A rig's plate measured through a sound card."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from model.arrays import ComplexArray, FloatArray
from model.calibration.responses import Responses
from sim.measuring.checks import check_clocks, check_coherence, check_wiring
from sim.measuring.desk import Desk
from sim.measuring.estimate import Estimate, estimate
from sim.measuring.live_plot import Show
from sim.measuring.loopback import converters, latency
from sim.measuring.multisine import Multisine
from sim.measuring.run import TRIES, blocks_lost, play_run, run_time
from sim.measuring.sound_card import SoundCard
from sim.sensors.sensor_file import WiredSensor

Progress = Callable[[int, int], None]


@dataclass(frozen=True, eq=False)
class Measured:
    """Responses with what is known of them.

    coherence (f, sensors), std (f, sensors) relative to the root mean square of the sensor; latency
    [s] through the sound card; even (sensors,): of a square law; repeated: runs played again since
    blocks were lost; converters (f,): response of the loop-back.
    """

    responses: Responses
    coherence: FloatArray
    std: FloatArray
    latency: float
    even: FloatArray
    repeated: int
    converters: ComplexArray


def measure(
    desk: Desk,
    card: SoundCard,
    multisine: Multisine,
    *,
    periods: int = 2,
    progress: Progress = lambda done, total: None,
    show: Show = lambda recorded: None,
) -> Measured:
    """Play all runs of a multisine and estimate the responses.

    periods: of each run that are analysed. progress: called with the milliseconds done and all;
    show: with the runs recorded so far, after each.
    Raises InputError, LinkError for what is clipped, silent, swapped, incoherent, or lost three
    times.
    """
    runs = multisine.sources
    desk.check_times(seconds=run_time(periods), slew=multisine.slew)
    total = round(1e3 * runs * run_time(periods))
    recorded: list[FloatArray] = []
    first: ComplexArray | None = None
    repeated, is_lost = 0, False
    for number in range(runs):
        run = play_run(
            desk,
            card,
            multisine,
            number,
            periods=periods,
            before=first,
            tries=1 if is_lost else TRIES,
            progress=lambda seconds, number=number: progress(  # type: ignore[misc]
                round(1e3 * (number * run_time(periods) + seconds)), total
            ),
        )
        first = run.loopback if first is None else first
        repeated += run.repeated
        is_lost = is_lost or not run.is_whole
        recorded.append(run.recorded)
        show(recorded)
    progress(total, total)
    found = estimate(multisine, recorded)
    # Another signal than the loop-back's, or another clock, looks like lost blocks; that is the
    # cause to be told.
    check_wiring(found, desk.sensors, desk.eras, loopback=desk.input, output=desk.output)
    check_clocks(multisine, recorded, desk.sensors, loopback=desk.input)
    if is_lost:
        raise blocks_lost()
    check_coherence(found, desk.sensors, desk.eras)
    return _measured(desk, multisine, found, repeated)


def _measured(desk: Desk, multisine: Multisine, found: Estimate, repeated: int) -> Measured:
    looped = found.values[:, desk.input - 1, -1]
    return Measured(
        responses_of_samples(desk, multisine.frequencies, found.values, looped),
        coherence=found.coherence[:, _columns(desk.sensors)],
        std=_relative(found, _columns(desk.sensors)),
        latency=latency(looped, multisine.frequencies),
        even=found.even[_columns(desk.sensors)],
        repeated=repeated,
        converters=looped,
    )


def responses_of_samples(
    desk: Desk, frequencies: FloatArray, values: ComplexArray, looped: ComplexArray
) -> Responses:
    """Accelerations per base displacement [1/s²] from responses of samples (f, inputs, sources)."""
    sensitivity = np.array([sensor.sensitivity for sensor in desk.sensors])
    strokes = np.array([era.stroke for era in desk.rig.eras])
    plain = values[:, _columns(desk.sensors), : len(strokes)] / converters(looped)[:, None, None]
    return Responses(
        tuple(sensor.name for sensor in desk.sensors),
        np.array([[sensor.x, sensor.y] for sensor in desk.sensors]),
        frequencies,
        plain.transpose(0, 2, 1) / strokes[:, None] / sensitivity,
    )


def _columns(sensors: Sequence[WiredSensor]) -> list[int]:
    return [sensor.input - 1 for sensor in sensors]


def _relative(found: Estimate, columns: list[int]) -> FloatArray:
    values = found.values[:, columns, :-1]
    rms = np.sqrt((np.abs(values) ** 2).mean(axis=(0, 2)))
    return np.asarray(found.std[:, columns] / rms)
