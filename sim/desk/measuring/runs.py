"""A run through a sound card: what is played, and what is kept of it once the plate has settled."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from drivers.errors import LinkError
from model.arrays import FloatArray
from sim.desk.measuring.desk import MIN_SETTLING
from sim.desk.measuring.multisine import PERIOD, Multisine
from sim.desk.measuring.sound_card import SoundCard

TRIES = 3
"""Attempts of a run."""

_TAIL = 0.05  # s; longer than the ramp


@dataclass(frozen=True, eq=False)
class Run:
    """What was recorded of a run, (n, inputs).

    is_whole: whether no block was lost, in the last attempt; repeated: attempts before it.
    """

    recorded: FloatArray
    is_whole: bool
    repeated: int

    @property
    def whole(self) -> FloatArray:
        """What was recorded; raises LinkError where blocks were lost in each attempt."""
        if self.is_whole:
            return self.recorded
        raise LinkError(
            f"blocks of sound were lost in {self.repeated + 1} attempts of a run; end other "
            "programs, give the sound server real-time priority, or choose larger blocks"
        )


def run_time(periods: int, *, settling: float = MIN_SETTLING) -> float:
    """Time [s] of a run of which so many periods are analysed, after it has settled."""
    return settling + PERIOD * periods + _TAIL


def play(
    card: SoundCard,
    played: FloatArray,
    *,
    settling: float,
    seconds: float,
    is_whole: Callable[[FloatArray], bool],
    tries: int = TRIES,
) -> Run:
    """Play samples (n, outputs), and keep some seconds behind the settling [s].

    is_whole: whether no block was lost in what is kept (n, inputs); the run is repeated otherwise.
    """
    start, count = round(settling * card.rate), round(seconds * card.rate)
    for repeated in range(tries):
        kept = card.run(played)[start : start + count].astype(float)
        if is_whole(kept):
            return Run(kept, True, repeated)
    return Run(kept, False, tries - 1)


def play_on_one(
    card: SoundCard, sines: Multisine, output: int, *, outputs: int, periods: int
) -> FloatArray:
    """Play a multisine on one output, counted from 1, without a loop-back.

    Return what was recorded (n, inputs), whole periods; again where the device reports gaps. Raises
    LinkError after three times.
    """
    signal = sines.signal(0, periods=run_time(periods) / PERIOD)
    return play(
        card,
        signal * np.eye(outputs)[output - 1],
        settling=MIN_SETTLING,
        seconds=PERIOD * periods,
        is_whole=lambda _kept: not card.gaps,
    ).whole
