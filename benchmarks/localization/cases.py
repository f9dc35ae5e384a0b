"""Contact sets on the paper's plate, and what a drive does to them when amplifiers err."""

from dataclasses import dataclass
from functools import cache

import numpy as np

from benchmarks.setting import APART, RIG, random_contacts
from model.arrays import Complex64Array, ComplexArray, FloatArray, IntArray
from model.drive_modes.fields import Fields, Weights
from model.finger.contrast import contrast_db
from model.finger.fingertip import fingertip_points
from model.finger.perception import STRONG_DB_SL
from model.rig.file import load_rig
from model.table.build import build_table
from model.table.question import Question
from model.table.table import LocalizationTable
from model.vibration.excitation import random_gains

FREQUENCIES = np.linspace(40.0, 500.0, 27)
LEAST = 1.0  # m/s² at the target


@cache
def paper_table() -> LocalizationTable:
    """The table of the paper's plate that all figures are from."""
    return build_table(load_rig(RIG), frequencies=FREQUENCIES)


def contact_sets(
    count: int, *, fingers: int, rng: np.random.Generator, apart: float = APART
) -> FloatArray:
    """Sets of fingers [m] anywhere on the plate, (count, fingers, 2)."""
    plate = paper_table().plate
    size = (plate.length, plate.width)
    return np.array([random_contacts(rng, fingers, size, apart=apart) for _ in range(count)])


def question_of(
    places: FloatArray,
    *,
    targets: int = 1,
    level_db_sl: float = STRONG_DB_SL,
    drive_mode: str | None = None,
    eras_at_most: int = 2,
    search_time: float = 10.0,
) -> Question:
    """The first ones are targets, the others quiet."""
    points = [(float(x), float(y)) for x, y in places]
    return Question(
        tuple(points[:targets]),
        tuple(points[targets:]),
        level_db_sl=level_db_sl,
        drive_mode=drive_mode,
        eras_at_most=eras_at_most,
        search_time=search_time,
    )


def fields_of(places: FloatArray, *, targets: int = 1) -> Fields:
    """Fields at the fingertips; the wanted level is an acceleration of 1 m/s²."""
    fields = paper_table().fields(question_of(places, targets=targets))
    ones = np.ones_like(fields.threshold)
    return Fields(fields.targets, fields.quiet, fields.has_no_quiet_contacts, ones, LEAST)


def quiet_centres(places: FloatArray, *, targets: int = 1) -> IntArray:
    """Which of the quiet points are centres of fingertips: the first of each one's points."""
    plate = paper_table().plate
    counts = [len(fingertip_points(x, y, plate)) for x, y in places[targets:]]
    return np.concatenate([[0], np.cumsum(counts)[:-1]]).astype(int)


@dataclass(frozen=True)
class Errors:
    """Random errors of amplifiers as complex factors (draws, eras)."""

    factors: ComplexArray

    @classmethod
    def draw(cls, draws: int, *, eras: int, rng: np.random.Generator) -> "Errors":
        return cls(random_gains(rng, draws=draws, eras=eras))

    def contrast_db(self, fields: Fields, weights: ComplexArray) -> FloatArray:
        """Contrast of weights (f, eras) in every draw, (draws,); of several targets the least."""

        def peak(field: Complex64Array) -> FloatArray:
            active = np.flatnonzero(np.abs(weights).any(axis=1))
            tones = [np.abs((self.factors * weights[f]) @ field[f]) for f in active]
            return np.asarray(np.sum(tones, axis=0))

        return contrast_db([peak(target) for target in fields.targets], peak(fields.quiet))


def weights_of(drive: Weights, fields: Fields) -> ComplexArray:
    """A drive as weights (f, eras)."""
    weights = np.zeros((fields.frequency_count, fields.era_count), dtype=complex)
    for frequency, weight in drive.tones():
        weights[frequency] = weight
    return weights


NO_ERRORS = Errors(np.ones((1, 4), dtype=complex))
