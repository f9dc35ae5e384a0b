"""Drive modes: which frequencies, amplitudes and phases the ERAs may have; a file each.

The modes are nested: each allows every drive of the more restricted ones, and returns the best of
all modes up to its own. All but `switched` drive all ERAs at one frequency. The upper bound of a
mode's score at a frequency also bounds the restricted modes and prunes most of their frequencies.

For a single target, `phased` takes a millisecond and is at least as good as `signed` and `graded`,
up to 0.1 dB (mean), 0.5 dB (maximum) of unconverged iterations, so that it skips their search. It
searches them for several targets, and where its best weights do not reach the wanted level.

Symbols here and in `model.table`: f frequencies, p points under the fingers, q quiet points, r
reduced modal coordinates; h field of an ERA at a point, R Hermitian form of the expected power at
the quiet points, c right-hand side from the targets, w complex weights of the ERAs. In
`model.transients`, q are the modal coordinates and z those of the eigenvectors in time.
"""

from dataclasses import dataclass

import numpy as np

from model.arrays import Complex64Array, Float32Array, IntArray
from model.drive_modes.coherent import Coherent
from model.drive_modes.fields import Evaluation, Fields, Weights, evaluate
from model.drive_modes.graded import GRADED
from model.drive_modes.phased import PHASED
from model.drive_modes.signed import SIGNED
from model.drive_modes.switched import find_switched, max_sensation_switched

MAX_PHASE_STEP = 10.0
"""Largest phase step [degrees] for `phased`: its rms error of 3 degrees is within the allowance."""

MAX_ALTERNATIVES, ALTERNATIVE_RATIO = 4, 10 ** (-3 / 20)

__all__ = [
    "DRIVE_MODES",
    "Choice",
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

    def max_sensation(self, fields: Fields) -> float:
        """Return the highest amplitude to threshold found at the weakest target.

        In this mode alone. For several targets a coherent mode may reach a decibel more.
        """
        search = self.coherent.max_sensation if self.coherent else max_sensation_switched
        return search(fields)


DRIVE_MODES: dict[str, DriveMode] = {
    "switched": DriveMode(None, ()),
    "graded": DriveMode(GRADED, ("switched",)),
    "signed": DriveMode(SIGNED, ("graded", "switched")),
    "phased": DriveMode(PHASED, ("signed", "graded", "switched")),
}
"""Drive modes by name, from the least freedom to the most."""


@dataclass(frozen=True, eq=False)
class Choice:
    """The drive of the best robust score, its evaluation, and alternatives to it.

    frequencies (n,) by index, weights (n, eras), score (n,): the best weights of all ERAs at each
    frequency where they reach the level; empty for `switched`.
    """

    drive: Weights
    evaluation: Evaluation
    frequencies: IntArray
    weights: Complex64Array
    score: Float32Array

    def alternatives(self) -> "Choice":
        """Keep up to MAX_ALTERNATIVES alternatives within 3 dB of the best score, best first.

        Empty where the best drive has several frequencies, and so is not among them.
        """
        left = np.flatnonzero(self.score > ALTERNATIVE_RATIO * self.evaluation.score)
        if self.score.max(initial=0.0) < 0.999 * self.evaluation.score:
            left = left[:0]
        left = left[np.argsort(-self.score[left])[:MAX_ALTERNATIVES]]
        return Choice(
            self.drive,
            self.evaluation,
            frequencies=self.frequencies[left],
            weights=self.weights[left],
            score=self.score[left],
        )


def find_drives(fields: Fields, drive_mode: str) -> Choice | None:
    """Find the drive of the best robust score in a mode and its restricted ones.

    None where no drive reaches the wanted level.
    """
    best: tuple[Weights, Evaluation] | None = None
    open_ = np.arange(fields.frequency_count)
    score = np.zeros(len(open_), dtype=np.float32)
    weights = np.zeros((len(open_), fields.era_count), dtype=np.complex64)
    for name in (drive_mode, *DRIVE_MODES[drive_mode].restricted):
        min_score = best[1].score if best else 0.0
        coherent = DRIVE_MODES[name].coherent
        if coherent is None:
            # The score so far prunes most of the search.
            drive = find_switched(fields, min_score)
        elif len(open_) > 0:
            some = fields if len(open_) == fields.frequency_count else fields.at(open_)
            found = coherent.search(some, min_score)
            better = (found.score > score[open_]).nonzero()[0]
            at = open_[better]
            score[at], weights[at] = found.score[better], found.weights[better]
            top = int(score.argmax())
            drive = Weights.at(top, weights[top]) if score[top] > min_score else None
        else:
            continue
        if drive is not None:
            evaluation = evaluate(fields, drive)
            if best is None or evaluation.score > best[1].score:
                best = drive, evaluation
        if coherent is not None and best is not None:
            left = found.bound > best[1].score
            if name == "phased" and not found.is_level_limited and len(fields.targets) == 1:
                left[:] = False
            open_ = open_[left]
    if best is None:
        return None
    reached = np.flatnonzero(score)
    return Choice(*best, reached, weights[reached], score[reached])


def max_sensation(fields: Fields, drive_mode: str) -> float:
    """Return the highest amplitude to threshold found at the weakest target in a mode."""
    names = (*DRIVE_MODES[drive_mode].restricted, drive_mode)
    return max(DRIVE_MODES[name].max_sensation(fields) for name in names)


def playable_drive_modes(*, level_step: float, phase_step: float) -> tuple[str, ...]:
    """Return the modes that an amplifier with such steps of level and phase [degrees] can play.

    A level step of 1 is on or off; a phase step above 180 degrees is no phase, 180 a sign.
    """
    if level_step >= 1:
        return ("switched",)
    if phase_step > 180:
        return ("switched", "graded")
    return ("switched", "graded", "signed", "phased")[: 4 if phase_step <= MAX_PHASE_STEP else 3]
