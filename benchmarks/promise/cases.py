"""What is compared: cases of what a rig says of itself and what its plate does."""

from dataclasses import dataclass

import numpy as np

from benchmarks.promise.optimum import Drive, contrasts_db, optimum
from benchmarks.promise.plate import (
    LENGTH,
    WIDTH,
    Fingers,
    FreePlate,
    Plates,
    Spread,
    fingers_on,
)
from benchmarks.promise.product import FREQUENCIES, answer, table_for
from benchmarks.setting import random_contacts
from model.arrays import FloatArray
from model.finger.perception import detection_threshold

SCENARIOS, JUDGES = 240, 200
"""Plates that the optimum is climbed on, and fresh ones that both answers are judged on."""

ANY_LEVEL = 0.0  # dB SL
RADIUS = 0.013  # m, of a fingertip


@dataclass(frozen=True)
class Case:
    """A case of figures: spread of the rig and its plates, fingers, ERAs.

    level_db_sl: that the target must reach in nine of ten plates.
    """

    name: str
    spread: Spread
    loaded: bool
    eras: int = 4
    level_db_sl: float = ANY_LEVEL


ALL = Spread(gain=0.05, phase_deg=5, thickness=0.02, stiffness=0.1, damping=1.5, fingertip=0.5)
CASES = {
    "A": Case("drives 5 %, 5°; weightless fingers", Spread(0.05, 5), loaded=False),
    "B": Case("drives 1 %, 1°; weightless fingers", Spread(0.01, 1), loaded=False),
    "C": Case("drives 1 %, 1°; loaded fingers", Spread(0.01, 1), loaded=True),
    "D": Case("all defaults", ALL, loaded=True),
    "D8": Case(
        "all defaults, eight ERAs, 20 dB SL",
        ALL,
        loaded=True,
        eras=8,
        level_db_sl=20,
    ),
}


@dataclass(frozen=True)
class Outcome:
    """One contact set: contrast [dB] of the model's answer and of optima, and the promise.

    Median and tenth percentile over the judging plates, each optimum climbed on its own; kept:
    share of them that give at least the promise; answer_level, optimum_level [dB SL]: the tenth
    percentile at full stroke.
    """

    answer_median: float
    optimum_median: float
    answer_tenth: float
    optimum_tenth: float
    promise: float
    kept: float
    answer_level: float
    optimum_level: float


def outcomes(key: str, quiet: int, sets: int, seed: int) -> list[Outcome]:
    """Judge contact sets of a case with a number of quiet fingers."""
    case, free = CASES[key], FreePlate()
    table = table_for(case.eras, case.spread, loaded=case.loaded)
    least = detection_threshold(FREQUENCIES) * 10 ** (case.level_db_sl / 20)
    if case.level_db_sl == ANY_LEVEL:
        least = np.zeros_like(least)
    found = []
    for number in range(sets):
        rng = np.random.default_rng([seed, quiet, number])
        places = random_contacts(rng, quiet + 1, (LENGTH, WIDTH))
        fingers = fingers_on(free, places, eras=case.eras, loaded=case.loaded, radius=RADIUS)
        scenarios, judges = (
            Plates.draw(case.spread, count, eras=case.eras, fingers=len(places), rng=rng)
            for count in (SCENARIOS, JUDGES)
        )
        drive, pattern = answer(table, places, level_db_sl=case.level_db_sl)
        ours, level = _judged(fingers, drive, judges)
        best = {
            percentile: optimum(fingers, FREQUENCIES, scenarios, percentile=percentile, least=least)
            for percentile in (50, 10)
        }
        typical, _ = _judged(fingers, best[50], judges)
        safe, optimum_level = _judged(fingers, best[10], judges)
        promise = pattern.robust_contrast_db
        promised = np.nan if promise is None else promise
        found.append(
            Outcome(
                answer_median=float(np.percentile(ours, 50)),
                optimum_median=float(np.percentile(typical, 50)),
                answer_tenth=float(np.percentile(ours, 10)),
                optimum_tenth=float(np.percentile(safe, 10)),
                promise=promised,
                kept=float((ours >= promised).mean()),
                answer_level=level,
                optimum_level=optimum_level,
            )
        )
    return found


def _judged(fingers: Fingers, drive: Drive, plates: Plates) -> tuple[FloatArray, float]:
    """Contrast [dB] of a drive on each plate, and its level [dB SL] on nine of ten."""
    fields = fingers.accelerations(drive.frequency, plates)
    contrast, target = contrasts_db(fingers, fields, drive.weights)
    threshold = float(detection_threshold(np.array([drive.frequency]))[0])
    return contrast, float(20 * np.log10(np.percentile(target, 10) / threshold))
