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

__all__ = ["MODES", "Mode", "best_drive", "loudest"]


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
