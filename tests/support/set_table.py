"""A table whose answers a test sets, its timing, and rigs for which nothing has to be solved.

The control loop asks a table that has `query` by that, once this is imported, and any other as it
does without.
"""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from functools import partial

import numpy as np

from controller.play import planner, table_query
from model.answer.effect_level import DriveLimits, RaisedPattern
from model.answer.pattern import Pattern
from model.answer.pattern_query import find_pattern, prepare_patterns
from model.answer.pulse_gains import PulseResponses
from model.answer.question import MIN_LEVEL_DB_SL, Question
from model.arrays import FloatArray, IntArray
from model.fem.mesh import Mesh
from model.rig.rig import Channel, Rig
from model.structure.attachments import Era
from model.structure.plate import Material, Plate
from model.vibration.excitation import Excitation
from registry.limits import GuardLimits

STROKE = 100e-6  # m


def make_rig(amplifiers: Sequence[str], limits: GuardLimits, *, eras: int = 3) -> Rig:
    """So many ERAs on channels 0, 1, 2 of one amplifier, or NE on another."""
    places = {"SW": (0.0, 0.0), "NE": (0.3, 0.2), "SE": (0.3, 0.0)}
    names = [*places][:eras]
    return Rig(
        plate=Plate(0.3, 0.2, 0.0015, Material("aluminium", 70e9, 2700.0, 0.33)),
        mesh=Mesh(4, 4, 0.3, 0.2),
        eras=tuple(Era(name, *places[name], 17_000.0, 1.0, 0.0, STROKE) for name in names),
        wiring={
            name: Channel(amplifiers[-1 if name == "NE" else 0], number)
            for number, name in enumerate(names)
        },
        amplifiers=dict.fromkeys(amplifiers, "memory://"),
        limits=limits,
    )


class SetTable:
    """A table with one answer, or an exception to raise; shared: the answer beside quiet fingers.

    prepared, asked: what was asked of it.
    """

    def __init__(
        self, excitation: Excitation | Exception, plate: Plate, shared: Excitation | None = None
    ) -> None:
        self.excitation = excitation
        self.plate = plate
        self.shared = shared
        self.strokes = defaultdict[str, float](lambda: STROKE)
        self.frequencies = np.array([90.0, 110.0, 150.0, 250.0])  # Hz
        self.prepared: list[str] = []
        self.asked: list[Question] = []

    def prepare(self, drive_mode: str) -> None:
        """Remember it."""
        self.prepared.append(drive_mode)

    def query(self, question: Question, over_effect: object = None) -> Pattern:
        """The same for every target."""
        if question.level_db_sl > MIN_LEVEL_DB_SL:  # else it prepares
            self.asked.append(question)
        answer = self.shared if self.shared and question.quiet else self.excitation
        if isinstance(answer, Exception):
            raise answer
        contrast = 12.0 if question.quiet else None
        return Pattern(answer, 0.015, 20.0, contrast, None, question.drive_mode or "")

    def amplitudes(
        self, excitation: Excitation, points: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """1 m/s² everywhere."""
        return np.array([110.0]), np.ones((1, len(points)))


def _query(table: object, question: Question, over_effect: object = None) -> Pattern:
    return getattr(table, "query", partial(find_pattern, table))(question, over_effect)


def _prepare(table: object, drive_mode: str | None) -> None:
    getattr(table, "prepare", partial(prepare_patterns, table))(drive_mode)


planner.find_pattern = table_query.find_pattern = _query
planner.prepare_patterns = _prepare


class SetLevels:
    """Levels over durations that are the steady ones."""

    def raised(
        self,
        pattern: Pattern,
        question: Question,
        *,
        level_db_sl: float,
        duration: float,
        limits: DriveLimits,
    ) -> RaisedPattern:
        """The pattern as it is."""
        return RaisedPattern(pattern, min(level_db_sl, pattern.level_db_sl), 0.0, None)

    def responses(self, rows: IntArray, *, question: Question, duration: float) -> PulseResponses:
        """Not to be called."""
        raise AssertionError("a table whose answers are set must ask for no responses")


class SetTiming:
    """A timing that leaves patterns along their ramps; prepared [Hz]: what was asked of it."""

    levels = SetLevels()

    def __init__(self) -> None:
        self.prepared: list[float] = []

    def prepare(self, frequencies: Iterable[float]) -> None:
        """Remember them."""
        self.prepared += frequencies

    def with_envelopes(
        self, question: Question, pattern: Pattern, *, onset: bool, ending: bool
    ) -> Pattern:
        """Return it as it is."""
        return pattern

    def with_transient_measures(self, question: Question, pattern: Pattern) -> Pattern:
        """Return it as it is."""
        return pattern
