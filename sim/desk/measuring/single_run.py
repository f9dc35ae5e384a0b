"""One multisine on some outputs of a sound card, without a loop-back: whole settled periods."""

import numpy as np

from drivers.errors import LinkError
from model.arrays import FloatArray
from sim.desk.measuring.multisine import PERIOD, Multisine
from sim.desk.measuring.sound_card import SoundCard

_SETTLING, _TAIL = 1.0, 0.05  # s
_TRIES = 3


def run_time(periods: int) -> float:
    """Time [s] of a run of which so many periods are analysed."""
    return _SETTLING + PERIOD * periods + _TAIL


def settled(
    card: SoundCard, sines: Multisine, output: int, *, outputs: int, periods: int
) -> FloatArray:
    """Play on one output, counted from 1; return what was recorded (n, inputs) once settled.

    Again where the device reports gaps; raises LinkError after three times.
    """
    signal = sines.signal(0, periods=run_time(periods) / PERIOD)
    played = np.zeros((len(signal), outputs))
    played[:, output - 1] = signal[:, 0]
    start = round(_SETTLING * sines.rate)
    for _ in range(_TRIES):
        recorded = card.run(played)[start : start + periods * sines.samples]
        if not card.gaps:
            return recorded.astype(float)
    raise LinkError(
        f"blocks of sound were lost in {_TRIES} attempts of a run; end other programs, give "
        "the sound server real-time priority, or choose larger blocks"
    )
