"""One run of a multisine, played until no block of it was lost."""

from dataclasses import dataclass

from drivers.errors import LinkError
from model.arrays import ComplexArray, FloatArray
from sim.measuring.checks import check_levels
from sim.measuring.desk import Desk
from sim.measuring.loopback import is_as_late, is_whole
from sim.measuring.multisine import PERIOD, Multisine
from sim.measuring.sound_card import SoundCard

_SETTLING = 1.0  # s; T60 of the paper's plate
_TAIL = 0.05  # s; longer than the ramp

TRIES = 3
"""Attempts of a run."""


@dataclass(frozen=True, eq=False)
class Run:
    """What was recorded of a run: whole periods of the settled plate, (n, inputs).

    loopback (f,): complex gain of the cable; is_whole: whether no block was lost, in the last
    attempt; repeated: attempts before it.
    """

    recorded: FloatArray
    loopback: ComplexArray
    is_whole: bool
    repeated: int


def run_time(periods: int) -> float:
    """Time [s] of a run of which so many periods are analysed."""
    return _SETTLING + PERIOD * periods + _TAIL


def play_run(
    desk: Desk,
    card: SoundCard,
    multisine: Multisine,
    number: int,
    *,
    periods: int,
    before: ComplexArray | None,
    tries: int = TRIES,
) -> Run:
    """Play a run, again where blocks were lost in it or since the first one.

    before (f,): the loop-back's gain in the first run, None in that. Raises InputError, LinkError
    for inputs that are clipped or silent.
    """
    signal = desk.on_outputs(multisine.signal(number, periods=run_time(periods) / PERIOD))
    start = round(_SETTLING * multisine.rate)
    repeated = 0
    while True:
        kept = card.run(signal)[start : start + periods * multisine.samples].astype(float)
        check_levels(kept, desk.sensors, cable=(desk.output, desk.input))
        looped = kept[:, desk.input - 1]
        gain = multisine.found(looped) / multisine.played(number)[:, -1]
        # The cable decides: drivers report losses that were none, and miss others.
        same = is_whole(looped, samples=multisine.samples)
        same = same and (before is None or is_as_late(gain, before))
        if same or repeated == tries - 1:
            return Run(kept, gain, same, repeated)
        repeated += 1


def blocks_lost() -> LinkError:
    """The error for a run that lost blocks each time."""
    return LinkError(
        f"blocks of sound were lost in {TRIES} attempts of a run; end other programs, give "
        "the sound server real-time priority, or choose larger blocks"
    )
