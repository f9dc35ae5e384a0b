"""A rig's plate measured through a sound card."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from model.arrays import ComplexArray, FloatArray
from model.calibration.responses import Responses
from model.rig.rig import Rig
from sim.measuring.checks import check_clocks, check_coherence, check_wiring
from sim.measuring.desk import Desk
from sim.measuring.estimate import estimate
from sim.measuring.loopback import latency
from sim.measuring.multisine import Multisine, default_frequencies
from sim.measuring.run import TRIES, blocks_lost, play_run, run_time
from sim.measuring.sound_card import SoundCard, open_card
from sim.sensors.sensor_file import read_sensors

LEVEL = 0.3
"""Usual largest sample of each output."""

Show = Callable[[Sequence[FloatArray]], None]
"""Takes what was recorded so far: whole periods of each run, (n, inputs)."""


@dataclass(frozen=True, eq=False)
class Measured:
    """Responses with what is known of them.

    coherence (f, sensors), std (f, sensors) relative to the root mean square of the sensor; latency
    [s] through the sound card; even (sensors,): of a square law; repeated: runs played again since
    blocks were lost; looped (f,): response of the loop-back.
    """

    responses: Responses
    coherence: FloatArray
    std: FloatArray
    latency: float
    even: FloatArray
    repeated: int
    looped: ComplexArray


@contextmanager
def open_desk(
    rig: Rig,
    sensors_file: Path,
    device: str,
    *,
    level: float | None,
    frequencies: FloatArray | None,
    seed: int,
) -> Iterator[tuple[Desk, SoundCard, Multisine]]:
    """A rig at an open device, and the multisine for it.

    level: None for 0.3, or less where the rig's limits allow less; frequencies (f,) [Hz], None for
    odd ones within its limits. Raises InputError, LinkError.
    """
    desk = Desk(rig, read_sensors(sensors_file, rig.plate))
    level = min(LEVEL, desk.highest) if level is None else level
    desk.check(level)
    if frequencies is None:
        frequencies = default_frequencies(rig.limits.frequency_min, rig.limits.frequency_max)
    desk.check_frequencies(frequencies, what="--frequencies")
    card = open_card(device, outputs=desk.output, inputs=desk.input, limit=level)
    try:
        yield desk, card, Multisine(frequencies, len(desk.eras) + 1, card.rate, level, seed)
    finally:
        card.close()


def measure(
    desk: Desk,
    card: SoundCard,
    multisine: Multisine,
    *,
    periods: int = 2,
    show: Show = lambda recorded: None,
) -> Measured:
    """Play all runs of a multisine and estimate the responses.

    periods: of each run that are analysed. show: called with the runs recorded so far, after each.
    Raises InputError, LinkError for what is clipped, silent, swapped, incoherent, or lost three
    times.
    """
    desk.check_times(seconds=run_time(periods), slew=multisine.slew)
    recorded: list[FloatArray] = []
    first: ComplexArray | None = None
    repeated, is_lost = 0, False
    for number in range(multisine.sources):
        tries = 1 if is_lost else TRIES
        run = play_run(desk, card, multisine, number, periods=periods, before=first, tries=tries)
        first = run.loopback if first is None else first
        repeated += run.repeated
        is_lost = is_lost or not run.is_whole
        recorded.append(run.recorded)
        show(recorded)
    found = estimate(multisine, recorded)
    # Another signal than the loop-back's, or another clock, looks like lost blocks; that is the
    # cause to be told.
    check_wiring(found, desk.sensors, desk.eras, loopback=desk.input, output=desk.output)
    check_clocks(multisine, recorded, desk.sensors, loopback=desk.input)
    if is_lost:
        raise blocks_lost()
    check_coherence(found, desk.sensors, desk.eras)
    looped, columns = found.values[:, desk.input - 1, -1], desk.columns
    rms = np.sqrt((np.abs(found.values[:, columns, :-1]) ** 2).mean(axis=(0, 2)))
    return Measured(
        desk.responses(multisine.frequencies, found.values, looped),
        found.coherence[:, columns],
        found.std[:, columns] / rms,
        latency(looped, multisine.frequencies),
        found.even[columns],
        repeated,
        looped,
    )
