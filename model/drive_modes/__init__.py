"""Drive modes, from what every amplifier can do to what takes amplitude and phase; a file each.

Every mode but the first finds one frequency for all ERAs. More freedom must not be worse: what a
mode allows, the modes after it allow too, so each answer is the best of all up to its own. What a
richer mode could have at most at a frequency bounds the poorer ones too, so that few frequencies
are left to them.

`phased` has a millisecond for one target. It considers `signed` and `graded` where there are more,
or where the level wanted keeps its own best weights from being used: what is given up for the
level is then found by trial, and the poorer modes may have found better. Elsewhere its own search
contains theirs but for unfinished rounds: 0.1 dB on average, 0.5 dB at the most.
"""

from dataclasses import dataclass

import numpy as np

from model.arrays import IntArray
from model.drive_modes.coherent import Coherent
from model.drive_modes.fields import Drive, Fields, Outcome, Single, SingleComplex, judge
from model.drive_modes.graded import GRADED
from model.drive_modes.phased import PHASED
from model.drive_modes.signed import SIGNED
from model.drive_modes.switched import find_switched, loudest_switched

FINE_PHASE = 10.0  # degrees

NEAR, NEARLY_AS_GOOD = 4, 10 ** (-3 / 20)

__all__ = ["MODES", "Choice", "Mode", "find_drives", "loudest", "playable_modes"]


@dataclass(frozen=True)
class DriveMode:
    """A drive mode.

    coherent: how it finds weights of all ERAs at one frequency, None for `switched`; poorer: the
    modes whose drives are considered too, from the richest on.
    """

    coherent: Coherent | None
    poorer: tuple[str, ...]

    def loudest(self, fields: Fields) -> float:
        """How many times above threshold the targets can be made to feel it in this mode alone.

        The most that was found: of several targets a coherent mode may reach a decibel more.
        """
        return (self.coherent.loudest if self.coherent else loudest_switched)(fields)


DRIVE_MODES: dict[str, DriveMode] = {
    "switched": DriveMode(None, ()),
    "graded": DriveMode(GRADED, ("switched",)),
    "signed": DriveMode(SIGNED, ("graded", "switched")),
    "phased": DriveMode(PHASED, ("signed", "graded", "switched")),
}
"""By name, from the least freedom to the most."""


@dataclass(frozen=True, eq=False)
class Choice:
    """The drive of the best robust score, what it does, and what is nearly as good.

    frequencies (n,) by index, weights (n, eras), score (n,): the best that was found of all ERAs at
    each frequency, where it reaches the level; none in mode `switched`.
    """

    drive: Drive
    outcome: Outcome
    frequencies: IntArray
    weights: SingleComplex
    score: Single

    def near(self) -> "Choice":
        """The same with up to NEAR of them that are less than 3 dB behind, the best first.

        None where the best drive is of several frequencies, and so not among them.
        """
        left = np.flatnonzero(self.score > NEARLY_AS_GOOD * self.outcome.score)
        if self.score.max(initial=0.0) < 0.999 * self.outcome.score:
            left = left[:0]
        left = left[np.argsort(-self.score[left])[:NEAR]]
        return Choice(
            self.drive,
            self.outcome,
            frequencies=self.frequencies[left],
            weights=self.weights[left],
            score=self.score[left],
        )


def find_drives(fields: Fields, drive_mode: str) -> Choice | None:
    """The drive of the best robust score in a mode and the poorer ones, with those near it.

    None where none reaches the wanted level.
    """
    best: tuple[Drive, Outcome] | None = None
    open_ = np.arange(fields.frequency_count)
    score = np.zeros(len(open_), dtype=np.float32)
    weights = np.zeros((len(open_), fields.era_count), dtype=np.complex64)
    for name in (drive_mode, *DRIVE_MODES[drive_mode].poorer):
        least = best[1].score if best else 0.0
        coherent = DRIVE_MODES[name].coherent
        if coherent is None:
            # What is there already lets most of the search for something better be left out.
            drive = find_switched(fields, least)
        elif len(open_) > 0:
            some = fields if len(open_) == fields.frequency_count else fields.at(open_)
            found = coherent.search(some, least)
            better = (found.score > score[open_]).nonzero()[0]
            at = open_[better]
            score[at], weights[at] = found.score[better], found.weights[better]
            top = int(score.argmax())
            drive = Drive.at(top, weights[top]) if score[top] > least else None
        else:
            continue
        if drive is not None:
            outcome = judge(fields, drive)
            if best is None or outcome.score > best[1].score:
                best = drive, outcome
        if coherent is not None and best is not None:
            left = found.bound > best[1].score
            if name == "phased" and not found.is_held_back and len(fields.targets) == 1:
                left[:] = False
            open_ = open_[left]
    if best is None:
        return None
    reached = np.flatnonzero(score)
    return Choice(*best, reached, weights[reached], score[reached])


def loudest(fields: Fields, drive_mode: str) -> float:
    """How many times above threshold the targets can be made to feel it in a mode."""
    return max(
        DRIVE_MODES[name].loudest(fields) for name in (*DRIVE_MODES[drive_mode].poorer, drive_mode)
    )


def playable_drive_modes(*, level_step: float, phase_step: float) -> tuple[str, ...]:
    """The modes that an amplifier can play whose levels and phases [degrees] have such steps.

    A level step of 1 is on or off; phase steps above 180 degrees are no phase, 180 a sign.
    """
    if level_step >= 1:
        return ("switched",)
    if phase_step > 180:
        return ("switched", "graded")
    # Ten degrees are wrong by three at random, within what `phased` allows for.
    return ("switched", "graded", "signed", "phased")[: 4 if phase_step <= FINE_PHASE else 3]
