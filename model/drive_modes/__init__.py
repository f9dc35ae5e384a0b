"""Drive modes: which frequencies, amplitudes and phases the ERAs may have; a file each.

`switched` drives one or two ERAs at full stroke, each at a frequency of its own; `phased` all ERAs
at one frequency with any weights, and contains what `switched` can do. For a single target it is at
least as good, up to unconverged iterations, so that it skips that search: `model.table.
thorough_query` does it, and it itself for several targets and where no weights reach the level.

Symbols here and in `model.table`: f frequencies, p points under the fingers, q quiet fingertips, r
reduced modal coordinates; h field of an ERA at a point, R Hermitian form of the expected power at
the quiet fingertips, c right-hand side from the targets, w complex weights of the ERAs. In
`model.transients`, q are the modal coordinates and z those of the eigenvectors in time.
"""

from model.choice import best_first
from model.drive_modes.coherent import PRUNE_MARGIN
from model.drive_modes.forms import Forms, Weights
from model.drive_modes.phased import PHASED
from model.drive_modes.switched import find_switched, max_sensation_switched

MAX_PHASE_STEP = 10.0
"""Largest phase step [degrees] for `phased`: its rms error of 3 degrees is within the allowance."""

ALTERNATIVES = 4
"""Drives that are returned, the best first."""

DRIVE_MODES = ("switched", "phased")
"""Drive modes, from the least freedom to the most."""

UNRESTRICTED = "phased"
"""The mode of any weights."""


def find_drives(forms: Forms, drive_mode: str) -> list[tuple[float, Weights]]:
    """Find the drives of the best robust scores in a mode.

    Up to ALTERNATIVES at one frequency and as many of `switched`, with their scores, best first;
    empty where no drive reaches the wanted level.
    """
    if drive_mode == "switched":
        return find_switched(forms, 0.0)[:ALTERNATIVES]
    found = PHASED.search(forms)
    score, best = found.score, float(found.score.max())
    top = best_first(score)[:ALTERNATIVES].tolist()
    drives = [(float(score[f]), Weights.at(f, found.weights[f])) for f in top if score[f] > 0]
    # Two tones may reach what weights at one frequency do not.
    if best == 0 or found.is_level_limited or len(forms.targets) > 1:
        drives += find_switched(forms, PRUNE_MARGIN * best)[:ALTERNATIVES]
    return [drives[each] for each in best_first([score for score, _ in drives])]


def max_sensation(forms: Forms, drive_mode: str) -> float:
    """Return the highest amplitude to threshold found at the weakest target in a mode.

    For several targets `phased` may reach a decibel more.
    """
    highest = max_sensation_switched(forms)
    return highest if drive_mode == "switched" else max(highest, PHASED.max_sensation(forms))


def playable_drive_modes(*, level_step: float, phase_step: float) -> tuple[str, ...]:
    """Return the modes that an amplifier with such steps of level and phase [degrees] can play.

    A level step of 1 is on or off.
    """
    return DRIVE_MODES if level_step < 1 and phase_step <= MAX_PHASE_STEP else DRIVE_MODES[:1]
