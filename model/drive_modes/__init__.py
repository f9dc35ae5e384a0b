"""Drive modes, from what every amplifier can do to what takes amplitude and phase; a file each.

Every mode but the first finds one frequency for all ERAs. More freedom must not be worse: what a
mode allows, the modes after it allow too, so each answer is the best of all up to its own.
"""

from collections.abc import Callable
from dataclasses import dataclass

from model.drive_modes.fields import Drive, Fields, Outcome, judge
from model.drive_modes.graded import GRADED
from model.drive_modes.phased import PHASED
from model.drive_modes.signed import SIGNED
from model.drive_modes.switched import find_switched, loudest_switched

FINE_PHASE = 10.0  # degrees

__all__ = ["MODES", "Mode", "best_drive", "loudest", "playable_modes"]


@dataclass(frozen=True)
class Mode:
    """A drive mode.

    find: the best drive with at least a score, or None; loudest: how many times above threshold the
    targets can be made to feel it; poorer: the modes whose drives are considered too.
    """

    find: Callable[[Fields, float], Drive | None]
    loudest: Callable[[Fields], float]
    poorer: tuple[str, ...]


MODES: dict[str, Mode] = {
    "switched": Mode(find_switched, loudest_switched, ()),
    "graded": Mode(GRADED.find, GRADED.loudest, ("switched",)),
    "signed": Mode(SIGNED.find, SIGNED.loudest, ("graded", "switched")),
    "phased": Mode(PHASED.find, PHASED.loudest, ("switched",)),
}
"""By name, from the least freedom to the most."""


def best_drive(fields: Fields, mode: str) -> tuple[Drive, Outcome] | None:
    """The drive of the best robust score in a mode and the poorer ones, and what it does.

    None where none reaches the wanted level.
    """
    best: tuple[Drive, Outcome] | None = None
    for name in (mode, *MODES[mode].poorer):
        # What is there already lets most of the search for something better be left out.
        drive = MODES[name].find(fields, best[1].score if best else 0.0)
        if drive is not None:
            outcome = judge(fields, drive)
            if best is None or outcome.score > best[1].score:
                best = drive, outcome
    return best


def loudest(fields: Fields, mode: str) -> float:
    """How many times above threshold the targets can be made to feel it in a mode."""
    return max(MODES[name].loudest(fields) for name in (*MODES[mode].poorer, mode))


def playable_modes(*, level_step: float, phase_step: float) -> tuple[str, ...]:
    """The modes that an amplifier can play whose levels and phases [degrees] have such steps.

    A level step of 1 is on or off; phase steps above 180 degrees are no phase, 180 a sign.
    """
    if level_step >= 1:
        return ("switched",)
    if phase_step > 180:
        return ("switched", "graded")
    # Ten degrees are wrong by three at random, within what `phased` allows for.
    return ("switched", "graded", "signed", "phased")[: 4 if phase_step <= FINE_PHASE else 3]
