"""Runs that play a signal and record simultaneously, repeated if blocks were lost."""

from collections.abc import Callable
from dataclasses import dataclass

from drivers.errors import LinkError
from era_haptics.lab.measuring.multisine import PERIOD
from era_haptics.lab.measuring.settling import MIN_SETTLING
from era_haptics.lab.measuring.sound_card import SoundCard
from model.arrays import FloatArray
from model.errors import InputError

TRIES = 3
"""Attempts of a run."""

_TAIL = 0.05  # s; longer than the ramp


@dataclass(frozen=True, eq=False)
class Run:
    """Recording of a run, (n, inputs).

    is_whole: whether the last attempt lost no block; repeated: number of attempts before it.
    """

    recorded: FloatArray
    is_whole: bool
    repeated: int

    @property
    def whole(self) -> FloatArray:
        """Return the recording; raises LinkError if every attempt lost blocks."""
        if self.is_whole:
            return self.recorded
        raise LinkError(
            f"blocks of sound were lost in {self.repeated + 1} attempts of a run; end other "
            "programs, give the sound server real-time priority, or choose larger blocks"
        )


def run_time(periods: int, *, settling: float = MIN_SETTLING) -> float:
    """Duration of a run [s] with `periods` analyzed periods after settling."""
    return settling + PERIOD * periods + _TAIL


def play_and_record(
    card: SoundCard,
    played: FloatArray,
    *,
    settling: float,
    seconds: float,
    is_whole: Callable[[FloatArray], bool],
    tries: int = TRIES,
) -> Run:
    """Play samples (n, outputs), and keep `seconds` of the recording after `settling` [s].

    is_whole: checks the kept recording (n, inputs) for lost blocks; if it fails, the run is
    repeated. Raises InputError for a signal that ends before.
    """
    start = round(settling * card.rate)
    count = round(seconds * card.rate)
    if len(played) < start + count:
        raise InputError(
            f"a run must last at least {settling + seconds:g} s, {settling:g} s of settling and "
            f"{seconds:g} s to keep, got {len(played) / card.rate:g} s; play a longer signal"
        )
    for repeated in range(tries):
        kept = card.run(played)[start : start + count].astype(float)
        if is_whole(kept):
            return Run(kept, True, repeated)
    return Run(kept, False, tries - 1)
