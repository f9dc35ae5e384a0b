"""Streams of touches with known places, played by a chain, and what was felt at every place.

Fingers are at every place of the stream, so that their vibration can be read for any window
afterwards; those that do not touch have no weight.
"""

import random
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np

from controller.daemon.plate_view import PlateView
from controller.effects.layout import SurfaceLayout, default_effects
from controller.effects.player import EffectPlayer
from controller.play.reports import PlayReport
from kit.chain import Chain
from kit.clock import run_virtual
from kit.host_rules import ChannelLimits, RuleViolation
from model.answer.answer_report import Timing
from model.arrays import ComplexArray, FloatArray
from model.rig.rig import Rig
from model.table.table import LocalizationTable
from registry import threads
from sim.amplifier.readings import AmplifierSummary
from sim.far_ends.wire_assignment import SimulatedWire
from sim.plant.fingers import FeltVibration
from sim.plant.imperfections import draw_imperfections

Place = tuple[float, float]


@dataclass(frozen=True)
class Situation:
    """What is so from one change of the fingers to the next [s] of the stream.

    fingers: places by id, in order of arrival; target: the id of the one to feel it, None where
    no finger is there.
    """

    begin: float
    end: float
    fingers: Mapping[int, str]
    target: int | None

    @property
    def quiet(self) -> tuple[str, ...]:
        """Where nothing may be felt."""
        return tuple(place for id, place in self.fingers.items() if id != self.target)

    @property
    def felt_at(self) -> str:
        """Where it is to be felt."""
        assert self.target is not None
        return self.fingers[self.target]


@dataclass(frozen=True)
class Stream:
    """Places [m] by name, and who is where from when [s] on; the last change ends it."""

    places: Mapping[str, Place]
    changes: Sequence[tuple[float, Mapping[int, str]]]

    @property
    def situations(self) -> list[Situation]:
        """Each change with what it asks for: the finger that came last feels it."""
        situations = []
        for (begin, fingers), (end, _) in pairwise(self.changes):
            target = max(fingers, default=None)  # ids are given in order of arrival
            situations.append(Situation(begin, end, fingers, target))
        return situations


LEVEL_DB_SL = 30.0
LEVEL_LIMIT = 1.0  # of the example's rig, written by hand
SPEEDS = {"serial": 921_600, "modbus-rtu": 115_200, "slcan": 500_000, "socketcand": 500_000}
"""Default speeds of the wires that have one [bit/s]."""
SENSORS: Mapping[str, Place] = {
    "P1": (0.03, 0.05),
    "P2": (0.20, 0.11),
    "P3": (0.29, 0.20),
    "P4": (0.08, 0.19),
    "P5": (0.15, 0.04),
    "P6": (0.26, 0.09),
}
STEADY = 0.3  # s; the end of each situation, when its transients have decayed


@dataclass(frozen=True)
class Recording:
    """Accelerations of all sensors: times (n,) [s], samples (n, s) [m/s²]."""

    times: FloatArray
    samples: FloatArray


@dataclass(frozen=True)
class Heard:
    """A situation as it was on the plate, from start to end [s].

    patterns: as a daemon would report them; clocks: errors of the amplifiers' clocks, rms [s] by
    name, as the last of them counts them, empty for one amplifier; steady: what fingertips felt in
    the end, by place; phasors (f, s) [m/s²]: at the sensors in the end, at the frequencies of the
    drive; fading: what sensors read where nobody touched.
    """

    situation: Situation
    begin: float
    end: float
    patterns: tuple[Mapping[str, Any], ...] = ()
    clocks: Mapping[str, float] = field(default_factory=dict)
    steady: Mapping[str, FeltVibration] = field(default_factory=dict)
    phasors: ComplexArray | None = None
    fading: Recording | None = None


@dataclass(frozen=True)
class Played:
    """Results of a stream; violations: broken rules."""

    heard: list[Heard]
    summaries: Sequence[AmplifierSummary]
    violations: Sequence[RuleViolation]


def play_stream(
    stream: Stream,
    wires: Mapping[str, str],
    rig: Rig,
    table: LocalizationTable,
    *,
    plate: Rig | None = None,
    drive_mode: str | None = None,
) -> Played:
    """Play a stream from arming to closing; wires: kinds by amplifier.

    rig, table: of the controller; plate: its rig, which the controller does not know.
    """

    async def run() -> Played:
        async with Streamed.on(
            {name: SimulatedWire(kind, speed=SPEEDS.get(kind)) for name, kind in wires.items()},
            rig,
            table,
            plate=plate,
            imperfections=draw_imperfections(plate or rig),
            intent_source=EffectPlayer(SurfaceLayout(effects=default_effects(LEVEL_DB_SL))),
            timing=Timing(table),
            drive_mode=drive_mode,
            limits=ChannelLimits(level=LEVEL_LIMIT),
        ) as chain:
            await chain.open()
            await chain.operate("arm")
            times = await chain.send(stream)
            heard = [
                chain.hear(situation, begin, end)
                for situation, begin, end in zip(stream.situations, times, times[1:], strict=False)
            ]
            await chain.close()
            summaries = [chain.far.summary(name) for name in chain.far.devices]
            return Played(heard, summaries, chain.host_rules.finish())

    return run_virtual(run(), rng=random.Random(1))


@dataclass
class Streamed(Chain):
    """A chain with sensors, to which a stream is sent; sensors are fingers that load nothing."""

    def __post_init__(self) -> None:
        """Note how far off the clocks are."""
        super().__post_init__()
        self.is_felt = False
        self._counted: list[tuple[float, Mapping[str, float]]] = []
        self.controller.cycle.observers.reported.append(self._note_clocks)

    async def send(self, stream: Stream) -> list[float]:
        """Deliver a stream at its pace; return the times of its changes [s]."""
        times = []
        for (begin, fingers), (end, _) in pairwise([(0.0, {}), *stream.changes]):
            times.append(threads.now())
            self._touch(stream, fingers)
            await self.hold(end - begin)
        return [*times[1:], threads.now()]

    def hear(self, situation: Situation, begin: float, end: float) -> Heard:
        """Read what was felt in a situation between two times [s]."""
        bench = self.far.bench
        bench.advance(threads.now())
        heard = Heard(situation, begin, end)
        if situation.target is None:
            return replace(heard, fading=self._recorded(begin, end))
        applied = [report for report in self.applied if begin <= report.time < end]
        clocks: Mapping[str, float] = {}
        for time, errors in self._counted:
            if time < end:
                clocks = errors
        steady = self._felt(end - STEADY, end)
        frequencies = np.array(next(iter(steady.values())).frequencies)
        return replace(
            heard,
            patterns=tuple(map(_pattern, applied)),
            clocks=clocks,
            steady=steady,
            phasors=_phasors(self._recorded(end - STEADY, end), frequencies),
        )

    def _felt(self, since: float, until: float) -> dict[str, FeltVibration]:
        """Vibration at each finger in a window [s], by place."""
        vibrations = self.far.bench.felt(since, until)
        return {place: felt for place, felt in vibrations.items() if place not in SENSORS}

    def _recorded(self, since: float, until: float) -> Recording:
        """Readings of the sensors in a window [s]."""
        records = self.far.bench.sample_fingers().felt(since, until)
        centers = [records[name].accelerations[:, 0] for name in SENSORS]
        return Recording(records["P1"].times, np.stack(centers, axis=1))

    def _note_clocks(self, applied: PlayReport) -> None:
        """Keep how far off clocks are counted in what has just begun to play."""
        planner = self.controller.cycle.planner
        self._counted.append((applied.time, planner.clocks.errors))

    def _touch(self, stream: Stream, fingers: Mapping[int, str]) -> None:
        """Rest fingers on places; at the others they only feel."""
        self.at = {id: stream.places[name] for id, name in fingers.items()}
        positions = {**stream.places, **SENSORS}
        observers = positions.keys() - {*fingers.values()}
        self.far.bench.place_fingers(positions, now=threads.now(), observers=observers)


def _pattern(applied: PlayReport) -> Mapping[str, Any]:
    event = PlateView(effect_of=lambda key: None, report=applied).pattern_event()
    return event.model_dump()


def _phasors(signals: Recording, frequencies: FloatArray) -> ComplexArray:
    """Complex amplitudes (f, s) of Im[a exp(i omega t)], t from the first sample on.

    Least squares under a Hann window, which keeps out what still rings at other frequencies.
    """
    weights = np.sqrt(np.hanning(len(signals.times)))[:, None]
    angles = 2 * np.pi * np.outer(signals.times - signals.times[0], frequencies)
    basis = np.hstack([np.sin(angles), np.cos(angles)])
    coefficients = np.linalg.lstsq(weights * basis, weights * signals.samples, rcond=None)[0]
    return np.asarray(coefficients[: len(frequencies)] + 1j * coefficients[len(frequencies) :])
