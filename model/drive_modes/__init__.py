"""Drive modes: which frequencies, amplitudes and phases the ERAs may have; a file each.

The modes are nested: each allows every drive of the more restricted ones, and returns the best of
all modes up to its own. All but `switched` drive all ERAs at one frequency. The upper bound of a
mode's score at a frequency also bounds the restricted modes and prunes most of their frequencies.

For a single target a coherent mode is at least as good as the more restricted ones, up to
unconverged iterations, so that it skips their search: `model.table.thorough_query` does it. It
searches them for several targets, and where no weights reach the wanted level; `graded` always.

Symbols here and in `model.table`: f frequencies, p points under the fingers, q quiet fingertips, r
reduced modal coordinates; h field of an ERA at a point, R Hermitian form of the expected power at
the quiet fingertips, c right-hand side from the targets, w complex weights of the ERAs. In
`model.transients`, q are the modal coordinates and z those of the eigenvectors in time.
"""

from dataclasses import dataclass

import numpy as np

from model.choice import best_first
from model.drive_modes.coherent import PRUNE_MARGIN, Coherent
from model.drive_modes.forms import Forms, Weights
from model.drive_modes.graded import GRADED
from model.drive_modes.phased import PHASED
from model.drive_modes.signed import SIGNED
from model.drive_modes.switched import find_switched, max_sensation_switched

MAX_PHASE_STEP = 10.0
"""Largest phase step [degrees] for `phased`: its rms error of 3 degrees is within the allowance."""

ALTERNATIVES = 4
"""Drives that are returned, the best first."""

__all__ = [
    "DRIVE_MODES",
    "UNRESTRICTED",
    "DriveMode",
    "find_drives",
    "max_sensation",
    "playable_drive_modes",
]


@dataclass(frozen=True)
class DriveMode:
    """A drive mode.

    coherent: search for weights of all ERAs at one frequency, None for `switched`; restricted: the
    modes that it contains, least restricted first.
    """

    coherent: Coherent | None
    restricted: tuple[str, ...]

    def max_sensation(self, forms: Forms) -> float:
        """Return the highest amplitude to threshold found at the weakest target.

        In this mode alone. For several targets a coherent mode may reach a decibel more.
        """
        search = self.coherent.max_sensation if self.coherent else max_sensation_switched
        return search(forms)


DRIVE_MODES: dict[str, DriveMode] = {
    "switched": DriveMode(None, ()),
    "graded": DriveMode(GRADED, ("switched",)),
    "signed": DriveMode(SIGNED, ("graded", "switched")),
    "phased": DriveMode(PHASED, ("signed", "graded", "switched")),
}
"""Drive modes by name, from the least freedom to the most."""

UNRESTRICTED = "phased"
"""The mode of any weights."""


def find_drives(forms: Forms, drive_mode: str) -> list[tuple[float, Weights]]:
    """Find the drives of the best robust scores in a mode and its restricted ones.

    Up to ALTERNATIVES at one frequency and as many of `switched`, with their scores, best first;
    empty where no drive reaches the wanted level.
    """
    mixed: list[tuple[float, Weights]] = []
    open_ = np.arange(forms.frequency_count)
    score = np.zeros(len(open_), dtype=np.float32)
    weights = np.zeros((len(open_), forms.era_count), dtype=np.complex64)
    best = 0.0
    for name in (drive_mode, *DRIVE_MODES[drive_mode].restricted):
        coherent = DRIVE_MODES[name].coherent
        if coherent is None:
            mixed = find_switched(forms, PRUNE_MARGIN * best)
            continue
        if len(open_) == 0:
            continue
        some = forms if len(open_) == forms.frequency_count else forms.at(open_)
        found = coherent.search(some, best)
        better = (found.score > score[open_]).nonzero()[0]
        at = open_[better]
        score[at], weights[at] = found.score[better], found.weights[better]
        best = max(best, float(score.max()))
        # Two tones may be worth more than amplitudes at one, and are soon searched.
        is_done = name != "graded" and not found.is_level_limited
        if best > 0 and is_done and len(forms.targets) == 1:
            break
        open_ = open_[found.bound > best]
    top = best_first(score)[:ALTERNATIVES].tolist()
    drives = [(float(score[f]), Weights.at(f, weights[f])) for f in top if score[f] > 0]
    drives += mixed[:ALTERNATIVES]
    return [drives[each] for each in best_first([score for score, _ in drives])]


def max_sensation(forms: Forms, drive_mode: str) -> float:
    """Return the highest amplitude to threshold found at the weakest target in a mode."""
    names = (*DRIVE_MODES[drive_mode].restricted, drive_mode)
    return max(DRIVE_MODES[name].max_sensation(forms) for name in names)


def playable_drive_modes(*, level_step: float, phase_step: float) -> tuple[str, ...]:
    """Return the modes that an amplifier with such steps of level and phase [degrees] can play.

    A level step of 1 is on or off; a phase step above 180 degrees is no phase, 180 a sign.
    """
    if level_step >= 1:
        return ("switched",)
    if phase_step > 180:
        return ("switched", "graded")
    return ("switched", "graded", "signed", "phased")[: 4 if phase_step <= MAX_PHASE_STEP else 3]
