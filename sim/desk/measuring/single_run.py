"""One multisine on some outputs of a sound card, without a loop-back: whole settled periods."""

import numpy as np

from model.arrays import FloatArray
from sim.desk.measuring.desk import MIN_SETTLING
from sim.desk.measuring.measure import TRIES, blocks_lost, run_time
from sim.desk.measuring.multisine import PERIOD, Multisine
from sim.desk.measuring.sound_card import SoundCard


def settled(
    card: SoundCard, sines: Multisine, output: int, *, outputs: int, periods: int
) -> FloatArray:
    """Play on one output, counted from 1; return what was recorded (n, inputs) once settled.

    Again where the device reports gaps; raises LinkError after three times.
    """
    signal = sines.signal(0, periods=run_time(periods) / PERIOD)
    played = np.zeros((len(signal), outputs))
    played[:, output - 1] = signal[:, 0]
    start = round(MIN_SETTLING * sines.rate)
    for _ in range(TRIES):
        recorded = card.run(played)[start : start + periods * sines.samples]
        if not card.gaps:
            return recorded.astype(float)
    raise blocks_lost()
