"""A table whose answers a test sets, and rigs of a few ERAs for which nothing has to be solved."""

from collections import defaultdict
from collections.abc import Sequence

import numpy as np

from model.arrays import FloatArray
from model.fem.mesh import Mesh
from model.rig.rig import Channel, Rig
from model.structure.attachments import Era
from model.structure.plate import Material, Plate
from model.table.pattern import Pattern
from model.table.question import Question
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
