"""An hour on a simulated plate that warms, loosens a bolt and gains a sticker.

The plate is that of the simulation, in time, on another mesh than the model's and with errors
within the rig's uncertainty; the host reaches it over its amplifier only, in virtual time. Every
sixth touch is followed by one that answers as identified, in service and for the plate as it is
play in turn.

Warming: Young's modulus of aluminium falls by 0.037 GPa/K from 70.4 GPa at 293 K, the slope of the
polynomial of NIST's cryogenic material properties for 6061-T6 (UNS A96061, 2 to 295 K, to 1 %).
Mounts of rubber stiffen as their absolute temperature, by the entropy of its network (L. R. G.
Treloar, The Physics of Rubber Elasticity), which is found to decide the stiffness of a preloaded
rubber cylinder from -60 to 60 °C (J. Strain Analysis, doi:10.1243/030932402760074517, abstract).
That none of it softens near a glass transition, and that the plate's thickness stays, is assumed.
"""

import asyncio
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from controller.demo.far_end import SimulatedPlate, simulated_plate
from controller.demo.settled_player import SettledPlayer, base_of, tones_of
from controller.demo.touch_row import steady_contrast_db
from controller.diagnosis.interleaved_tones import interleaved
from controller.diagnosis.plate_measurement import LEVEL
from drivers import clock
from drivers.amplifier import Amplifier
from drivers.registry import open_backend
from model.arrays import ComplexArray, FloatArray
from model.identification.forward import RestingFinger
from model.identification.identify import Identification, identify
from model.identification.in_service import Known
from model.identification.learned_table import LearnedTable
from model.identification.measurement import Measurement
from model.identification.settled import SettledPattern
from model.rig.file import load_rig
from model.rig.rig import Rig
from model.structure.point_load import PointLoad
from model.table.build import build_table
from model.table.live_table import table_following
from model.table.question import Question
from model.table.table import DEFAULT_FREQUENCIES, LocalizationTable
from model.vibration.excitation import Excitation, Tone

WARMING, AT = 15.0, 293.0  # K
MODULUS_PER_KELVIN = -0.0372 / 70.36  # relative
WAYS = ("identified", "in service", "known")

_STEP = 60.0  # s; between changes of the plate by its temperature
_END = 600.0  # s
_FELT = 0.25  # s
_APART, _MARGIN = 0.05, 0.013  # m
NAMED_WITHIN = 120.0  # s


@dataclass(frozen=True)
class Course:
    """The course of an hour: times [s], factor of the stiffness of a mount, mass [kg].

    compared_every: touches between comparisons; fresh_sets: contacts by which answers are compared
    to those of a plate identified anew at the end, 0 for no such comparison.
    """

    duration: float = 3600.0
    interval: float = 15.0
    loosened_at: float = 1200.0
    loosened: float = 0.8
    sticker_at: float = 2400.0
    sticker: float = 3e-3
    compared_every: int = 6
    fresh_sets: int = 12


@dataclass(frozen=True)
class Event:
    """Something that happened at a time [s] to the plate, or was said of it.

    kind: plate, alarm, explained or unexplained; name: of what changed, as explanations begin.
    """

    time_s: float
    kind: str
    text: str
    name: str = ""


@dataclass
class Hour:
    """What an hour of a course gave.

    contrasts: by way, times [s] and contrasts [dB]; fresh: contrasts [dB] at the end of answers
    identified anew, and of those in service at the same touches.
    """

    course: Course = Course()
    contrasts: dict[str, list[tuple[float, float]]] = field(
        default_factory=lambda: {way: [] for way in WAYS}
    )
    events: list[Event] = field(default_factory=list)
    fresh: dict[str, list[float]] = field(default_factory=dict)
    chi2: float = np.nan

    def median(self, way: str, since: float, until: float) -> float:
        """Median contrast [dB] of a way over a time [s]."""
        return float(np.median([c for at, c in self.contrasts[way] if since <= at < until]))

    @property
    def named(self) -> dict[str, float | None]:
        """By change, time [s] until it was named right for the first time; None if it was not."""
        found: dict[str, float | None] = {}
        for change in (each for each in self.events if each.kind == "plate"):
            said = (
                each.time_s - change.time_s
                for each in self.events
                if each.kind == "explained"
                and each.time_s >= change.time_s
                and each.text.startswith(change.name)
            )
            found[change.name] = min(said, default=None)
        return found

    @property
    def false_alarms(self) -> int:
        """Alarms later than two minutes after any change of the plate, or before all of them."""
        changes = [each.time_s for each in self.events if each.kind == "plate"]
        return sum(
            not any(0 <= each.time_s - at <= NAMED_WITHIN for at in changes)
            for each in self.events
            if each.kind == "alarm"
        )

    def as_json(self) -> dict[str, Any]:
        """The keys of `era demo --drift --json`, without files."""
        end = {
            way: self.median(way, self.course.duration - _END, self.course.duration) for way in WAYS
        }
        return {
            "wire": "sim",
            "events": [vars(each) for each in self.events],
            "named_after_s": self.named,
            "false_alarms": self.false_alarms,
            "contrast_db": {
                way: [{"time_s": at, "contrast_db": c} for at, c in several]
                for way, several in self.contrasts.items()
            },
            "last_ten_minutes_db": end,
            "end_of_hour_db": {way: float(np.median(each)) for way, each in self.fresh.items()},
            "chi2": self.chi2,
        }


async def run_drift(
    rig_file: Path,
    *,
    course: Course = Course(),
    seed: int = 0,
    on_event: Callable[[Event], None] = lambda event: None,
) -> Hour:
    """Play the hour; on_event: called as it happens. Raises LinkError.

    To be run on a loop in virtual time (`controller.demo.virtual_time`).
    """
    rig = load_rig(rig_file)
    async with simulated_plate(
        rig_file, rig.amplifiers, wire="sim", seed=seed, threshold=rig.threshold
    ) as plate:
        amplifiers = {name: Amplifier(open_backend(url)) for name, url in plate.urls.items()}
        player = SettledPlayer(rig, amplifiers)
        await player.open()
        try:
            return await _Drift(rig, plate, player, course, seed, on_event).run()
        finally:
            await player.close()


class _Drift:
    """The plate as it is made to change, and the tables that answer on it."""

    def __init__(
        self,
        rig: Rig,
        plate: SimulatedPlate,
        player: SettledPlayer,
        course: Course,
        seed: int,
        on_event: Callable[[Event], None],
    ) -> None:
        self._rig, self._plate, self._player = rig, plate, player
        self._rng = np.random.default_rng([seed, 53])
        self._on_event = on_event
        self._course = course
        self._hour = Hour(course)
        self._loose = rig.eras[int(self._rng.integers(len(rig.eras)))].name
        x, y = self._rng.uniform(0.1, 0.9, 2) * (rig.plate.length, rig.plate.width)
        self._sticker = (float(x), float(y), course.sticker)
        self._started_at = 0.0
        self._changed: dict[str, Any] = {}

    async def run(self) -> Hour:
        course = self._course
        found = await self._identified()
        table = _table(found.rig)
        learned = LearnedTable(table, Known.of_rig(found.rig, self._player.sensors))
        self._hour.chi2 = found.chi2
        self._started_at = clock.now()
        for number in range(round(course.duration / course.interval)):
            at = number * course.interval
            await asyncio.sleep(max(0.0, self._started_at + at - clock.now()))
            await self._change(at)
            await self._touch(at, learned, table, found.rig, number % course.compared_every == 0)
        if not course.fresh_sets:
            return self._hour
        anew = await self._identified()
        ways = {"in service": learned.current, "identified anew": _table(anew.rig)}
        for number in range(course.fresh_sets):
            places = self._places(2)
            for way, each in ways.items():
                contrast, _ = await self._played(each, places, touch=f"end {number}")
                self._hour.fresh.setdefault(way, []).append(contrast)
        return self._hour

    def _say(self, at: float, kind: str, text: str, name: str = "") -> None:
        event = Event(at, kind, text, name)
        self._hour.events.append(event)
        self._on_event(event)

    async def _change(self, at: float) -> None:
        """Let the plate be as it is at a time [s] of the hour."""
        if at == self._course.loosened_at:
            self._say(
                at, "plate", f"mount {self._loose} loosens by a fifth", f"stiffness {self._loose}"
            )
        if at == self._course.sticker_at:
            x, y = (100 * each for each in self._sticker[:2])
            self._say(at, "plate", f"a sticker of 3 g at {x:.1f}, {y:.1f} cm", "a mass")
        changes = self._changes(at)
        if changes != self._changed:
            await self._plate.change(**changes)
            self._changed = changes

    def _changes(self, at: float) -> dict[str, Any]:
        warmer = WARMING * (at // _STEP * _STEP) / self._course.duration
        mounts = dict.fromkeys((era.name for era in self._rig.eras), (AT + warmer) / AT)
        if at >= self._course.loosened_at:
            mounts[self._loose] *= self._course.loosened
        return {
            "modulus": 1 + MODULUS_PER_KELVIN * warmer,
            "stiffness": mounts,
            "masses": [list(self._sticker)] if at >= self._course.sticker_at else [],
        }

    def _as_it_is(self, first: Rig, at: float) -> Rig:
        """The rig as identified at first, with the changes since then known."""
        changes = self._changes(at)
        eras = tuple(
            replace(era, stiffness=changes["stiffness"][era.name] * era.stiffness)
            for era in first.eras
        )
        masses = tuple(PointLoad(x, y, mass=kg) for x, y, kg in changes["masses"])
        plate = first.plate.scaled(modulus=changes["modulus"])
        return replace(first, plate=plate, eras=eras, masses=(*first.masses, *masses))

    async def _touch(
        self,
        at: float,
        learned: LearnedTable,
        table: LocalizationTable,
        first: Rig,
        is_compared: bool,
    ) -> None:
        """One touch: the answer in service, what is learned of it, and other answers to it."""
        places = self._places(int(self._rng.integers(2, 5)))
        _, pattern = await self._played(learned.current, places, touch=f"{at:g} s", at=at)
        report = learned.take(pattern).report
        if report.alarm:
            self._say(at, "alarm", "the plate is not as known")
        if report.explanation is not None:
            kind = "explained" if report.explanation.name else "unexplained"
            self._say(at, kind, str(report.explanation))
        if is_compared:
            pair = self._places(2)
            known = table_following(table, self._as_it_is(first, at))
            tables = dict(zip(WAYS, (table, learned.current, known), strict=True))
            for way, each in tables.items():
                contrast, _ = await self._played(each, pair, touch=f"{at:g} s again")
                self._hour.contrasts[way].append((at, contrast))

    async def _played(
        self, table: LocalizationTable, places: FloatArray, *, touch: str, at: float = 0.0
    ) -> tuple[float, SettledPattern]:
        """Contrast [dB] at fingers (k, 2) [m], the first the target, and what sensors read.

        touch: whose fingers; each has loads of its own.
        """
        points = [(float(x), float(y)) for x, y in places]
        ids = [f"{touch} {n}" for n in range(len(points))]
        question = Question((points[0],), tuple(points[1:]), drive_mode="phased")
        await self._plate.place_fingers(dict(zip(ids, points, strict=True)))
        await self._player.arm()
        try:
            excitation = table.query(question).excitation
            plays, values = await self._player.play(excitation, window=_FELT)
            now = clock.now()
            felt = await self._plate.vibration(now - _FELT, now)
        finally:
            await self._player.disarm()
        await self._plate.place_fingers({})
        contrast = steady_contrast_db(felt[ids[0]], [felt[each] for each in ids[1:]])
        assert contrast is not None  # noqa: S101  two fingers at least
        (frequency,) = tones_of(plays)
        tip = self._rig.fingertip
        fingers = tuple(RestingFinger(x, y, tip) for x, y in points) if tip else ()
        bases = np.array(
            [
                base_of(plays[era.name], era.stroke) if era.name in plays else 0j
                for era in self._rig.eras
            ]
        )
        return contrast, SettledPattern(at, frequency, bases, values[:, 0], fingers)

    def _places(self, count: int) -> FloatArray:
        size = np.array([self._rig.plate.length, self._rig.plate.width])
        while True:
            places = self._rng.uniform(_MARGIN, size - _MARGIN, (count, 2))
            gaps = np.linalg.norm(places[:, None] - places, axis=-1)
            if gaps[np.triu_indices(count, 1)].min() > _APART:
                return np.asarray(places)

    async def _identified(self) -> Identification:
        """The rig identified by interleaved tones of all ERAs, without fingers."""
        rig, low, high = self._rig, *DEFAULT_FREQUENCIES[[0, -1]]
        tones = interleaved(rig, (float(low), float(high)))
        sensors = self._player.sensors
        values: dict[float, ComplexArray] = {}
        await self._player.arm()
        for step in tones.steps:
            excitation: Excitation = {
                rig.eras[number].name: Tone(frequency, LEVEL * rig.eras[number].stroke)
                for number, frequency in step
            }
            plays, heard = await self._player.play(excitation, window=tones.window)
            for column, frequency in enumerate(tones_of(plays)):
                (number,) = (
                    n
                    for n, era in enumerate(rig.eras)
                    if era.name in plays and plays[era.name].frequency == frequency
                )
                era = rig.eras[number]
                found = values.setdefault(
                    frequency, np.full((len(sensors), len(rig.eras)), np.nan, dtype=complex)
                )
                found[:, number] = heard[:, column] / base_of(plays[era.name], era.stroke)
        await self._player.disarm()
        frequencies = sorted(values)
        measured = np.array([values[each] for each in frequencies])
        return identify(rig, Measurement.of(sensors, np.array(frequencies), measured))


def _table(rig: Rig) -> LocalizationTable:
    return build_table(rig, drive_mode="phased")
