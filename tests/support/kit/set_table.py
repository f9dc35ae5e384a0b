"""Tables whose answers a test sets, with their timing, and rigs for which nothing is solved.

The control loop asks a table that has `answer` by that, once this is imported, and any other as it
does without. Without a layout the newest finger feels a buzz until it lifts; of an only vibration
the layer and the first sensation are at hand.
"""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any

import numpy as np

from controller.play import joint_answers, planner
from model.answer.adjustments import scaled
from model.answer.answer import NO_LIMITS, Answer, Layer, Limits, Sensation
from model.answer.plan import answer, prepare_answers, query
from model.answer.question import Contents, Stream, Tones
from model.answer.stimulus import ANY, ANY_BAND, BY_NAME, Finger, Placement, Stimulus, together
from model.arrays import FloatArray, Point
from model.ensemble.draws import ClockErrors
from model.fem import Mesh
from model.rig.rig import Channel, Rig
from model.structure.material import Material
from model.structure.plate import Plate
from model.structure.sources import Era
from model.table.table import LocalizationTable
from model.vibration import Excitation
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


class SetDrives:
    """Drives of ERAs of one stroke, which have no magnets."""

    def __init__(self) -> None:
        self.full_levels = defaultdict[str, float](lambda: STROKE)

    def excursion_of(self, drives: Sequence[Any]) -> float:
        """None."""
        return 0.0


class SetTable(SetDrives):
    """A table with one answer, or an exception to raise; shared: the answer beside quiet fingers.

    prepared, asked: what was asked of it.
    """

    def __init__(
        self, excitation: Excitation | Exception, plate: Plate, shared: Excitation | None = None
    ) -> None:
        super().__init__()
        self.excitation = excitation
        self.plate = plate
        self.eras: tuple[Era, ...] = ()  # whose clocks change nothing
        self.shared = shared
        self.frequencies = np.array([90.0, 110.0, 150.0, 250.0])  # Hz
        self.prepared: list[str] = []
        self.asked: list[list[Finger]] = []

    def prepare(self, drive_mode: str) -> None:
        """Remember it."""
        self.prepared.append(drive_mode)

    def answer(
        self,
        fingers: Sequence[Finger],
        *,
        drive_mode: str,
        shaped: bool,
        limits: Limits,
        avoided_hz: Sequence[float],
    ) -> Answer:
        """The same for every target, 12 dB above others at 20 dB SL."""
        self.asked.append([*fingers])
        has_quiet = any(finger.stimulus is None for finger in fingers)
        drive = self.shared if self.shared and has_quiet else self.excitation
        if isinstance(drive, Exception):
            raise drive
        return set_answer(fingers, drive, drive_mode=drive_mode, limits=limits)

    def with_clocks(self, clocks: ClockErrors) -> "SetTable":
        """Itself: its answers count no clocks."""
        return self

    def levels_by_set(self, level_db_sl: float, excitation: Excitation) -> FloatArray:
        """By its only set of thresholds."""
        return np.array([level_db_sl])

    def amplitudes(
        self, excitation: Excitation, points: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """1 m/s² everywhere."""
        return np.array([110.0]), np.ones((1, len(points)))


@dataclass(frozen=True, eq=False)
class SetTones(Tones):
    """Tones that are all one drive."""

    drive: Excitation = field(default_factory=dict)

    def excitations(self, content: int, *on: Any) -> list[Excitation]:
        """The drive at the content's gain."""
        gain = self.gains[content]
        drive = {}
        for name, tone in self.drive.items():
            drive[name] = replace(tone, amplitude=gain * tone.amplitude)
        return [drive]


class SetAnswer(Answer):
    """An answer whose layers all play one drive."""

    @cached_property
    def layers(self) -> tuple[Layer, ...]:
        """Along ramps of 15 ms."""
        return tuple(replace(layer, ramp=0.015) for layer in Answer.layers.func(self))


def set_answer(
    fingers: Sequence[Finger],
    drive: Excitation,
    *,
    level_db_sl: float = 20.0,
    contrast_db: float = 12.0,
    drive_mode: str = "",
    limits: Limits = NO_LIMITS,
) -> Answer:
    """Each finger with a stimulus feels a layer of its own, within the amplifiers' limits."""
    has_others = len(fingers) > 1
    contrast = contrast_db if has_others else np.nan
    foreign = level_db_sl - contrast_db if has_others else np.nan
    streams = []
    quiet = []
    for number, finger in enumerate(fingers):
        if finger.stimulus is None:
            quiet.append(number)
            continue
        duration = finger.stimulus.duration
        stream = Stream((number,), level_db_sl, ((0, 1),), finger.priority, duration)
        streams.append(stream)
    count = len(streams)
    tones = SetTones(
        [0] * count,
        [[1.0]] * count,
        [1.0] * count,
        range(count),
        [(contrast,) * 3] * len(fingers),
        [(level_db_sl, level_db_sl)] * len(fingers),
        [[foreign]] * len(fingers),
        contrast,
        1.0,
        is_apart=True,
        drive=drive,
    )
    places = tuple(finger.at for finger in fingers)
    contents = Contents(places, (), tuple(streams), tuple(quiet), drive_mode=drive_mode)
    frequencies = np.array([110.0])
    result: Answer = SetAnswer(
        tuple(fingers),
        contents,
        tones,
        (),
        (),
        (),
        frequencies,
        np.ones((1, 0)),
        np.ones(1, np.float32),
    )
    table: Any = SetDrives()
    factor = limits.factor_within(result.layers, table)
    return scaled(result, 20 * np.log10(factor)) if factor < 1 else result


def _answer(table: Any, fingers: Sequence[Finger], **options: Any) -> Answer:
    answer_of_table = getattr(table, "answer", partial(answer, table))
    result: Answer = answer_of_table(fingers, **options)
    return result


def _query(table: Any, placed: Placement, *level: float, **options: Any) -> Answer:
    if isinstance(table, SetTable):
        if isinstance(table.excitation, Exception):
            raise table.excitation
        return set_answer(together(placed, Stimulus()), table.excitation)
    return query(table, placed, *level, **options)


def _prepare(table: Any, drive_mode: str | None) -> None:
    prepare = getattr(table, "prepare", partial(prepare_answers, table))
    prepare(drive_mode)


joint_answers.answer = _answer
planner.prepare_answers, planner.query = _prepare, _query


class SetTiming:
    """A timing that leaves layers along their ramps; prepared [Hz]: what was asked of it."""

    def __init__(self) -> None:
        self.prepared: list[float] = []

    def prepare(self, frequencies: Iterable[float]) -> None:
        """Remember them."""
        self.prepared += frequencies

    def with_envelopes(
        self, layer: Layer, placed: Placement, *, onset: bool, ending: bool
    ) -> Layer:
        """Return it as it is."""
        return layer


def only(
    table: LocalizationTable, placed: Placement, level_db_sl: float = 20.0, **options: Any
) -> tuple[Layer, Sensation]:
    """What is played for fingers, and what the first of them feels."""
    result = query(table, placed, level_db_sl, **options)
    return result.layers[0], result.fingers[0]


def wants(
    at: Point,
    band_hz: tuple[float, float] = ANY_BAND,
    level_db_sl: float = 20.0,
    priority: int = 0,
    *,
    may_share: bool = False,
    name: str | None = None,
    modulation_hz: float | None = None,
    **options: Any,
) -> Finger:
    """A finger that is to feel a stimulus of its own."""
    stimulus = Stimulus(level_db_sl, band_hz, modulation_hz=modulation_hz, name=name)
    sharing = ANY if may_share else BY_NAME
    return Finger(at, stimulus, priority=priority, sharing=sharing, **options)


def phased(
    table: LocalizationTable,
    fingers: Sequence[Finger],
    quiet: Sequence[Finger | Point] = (),
    *,
    drive_mode: str = "phased",
    **options: Any,
) -> Answer:
    """The answer in mode `phased`, whatever the table's own is."""
    return answer(table, fingers, quiet=quiet, drive_mode=drive_mode, **options)


def drives(result: Answer) -> list[Excitation]:
    """What plays for each finger, empty where nothing does."""
    excitations: list[Excitation] = []
    for finger in result.fingers:
        excitation = {} if finger.layer is None else result.layers[finger.layer].excitation
        excitations.append(excitation)
    return excitations
