"""Levels that fingers feel in a session, separately for each content.

A log records all changes on a bench: fingers, voices of the drives, and the owners of layers. It is
replayed on the same plate under the same fingers with the voices of some contents only, which gives
the levels of these contents. Voices are divided by the detection threshold at their frequency, for
each threshold set of the rig, so that accelerations are sensation levels.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from controller.play.intent import CLICK
from drivers.voices import Voice
from model.arrays import FloatArray
from model.finger import detection_threshold
from model.rig.rig import Rig
from sim.amplifier.amplifier_clock import StraightClock
from sim.bench.bench import Bench
from sim.plant.era_motions import harmonics_of_voices, motion_of, realised
from sim.plant.finger_placement import FingerPlacement
from sim.plant.imperfections import Imperfections

STRONGEST = 0.040  # s; of the strongest part of a span
EARLY = 0.020  # s; by which amplifiers can start earlier than others

Span = tuple[float, float]
Owners = Callable[[int | None], bool]
"""Whether the layers of an owner are played."""


def owner_of(layer: Any) -> int:
    """Return the finger that a layer plays for, its complement for a click."""
    finger = int(layer.content.contact.key.id)
    return ~finger if layer.content.key.voice == CLICK else finger


class _PartialBench(Bench):
    """A bench whose ERAs play the voices of some owners, relative to a set of thresholds."""

    def __init__(
        self, rig: Rig, drawn: Imperfections, now: float, is_played: Owners, thresholds: str
    ) -> None:
        super().__init__(rig, now=now, imperfections=drawn)
        self._is_played = is_played
        self._thresholds = thresholds
        self.owners: Mapping[int, int] = {}

    def _motion(self, index: int, playing: Sequence[Voice], clock: StraightClock) -> Any:
        errors = self._errors[index]
        stroke = self.rig.eras[index].full_level
        terms: list[Any] = []
        for voice in (*playing, *harmonics_of_voices(playing, errors.harmonic)):
            if not self._is_played(self.owners.get(voice.layer)):
                continue
            threshold = float(detection_threshold(np.array([voice.frequency]), self._thresholds)[0])
            motion = motion_of([voice], clock, stroke=stroke, delay=self._delays[index])
            terms += realised(motion, replace(errors, gain=errors.gain / threshold))
        return tuple(terms)


@dataclass
class Log:
    """All changes on a bench by time [s]."""

    rig: Rig
    drawn: Imperfections
    start: float
    changes: list[tuple[float, Callable[[_PartialBench], None]]] = field(default_factory=list)

    def watch(self, bench: Any) -> None:
        """Note the voices and fingers of a bench from now on."""
        apply, place = bench._apply, bench._place

        def applied(index: int, playing: tuple[Voice, ...], clock: StraightClock) -> None:
            self.changes.append((bench.time, lambda part: part._apply(index, playing, clock)))
            apply(index, playing, clock)

        def placed(placement: FingerPlacement) -> None:
            self.changes.append((placement.time, lambda part: part._place(placement)))
            place(placement)

        bench._apply, bench._place = applied, placed

    def note_owners(self, reports: Sequence[Any]) -> None:
        """Note the owner of each layer from shortly before its report on."""
        for report in reports:
            owners = {number: owner_of(layer) for number, layer in report.contents.items()}
            self.changes.append((report.time - EARLY, _adding(owners)))

    def replayed(self, is_played: Owners, until: float) -> list[Bench]:
        """Return a bench for each set of thresholds, with the voices of some owners."""
        benches: list[Bench] = []
        for thresholds in dict.fromkeys((self.rig.threshold, *self.rig.promised_thresholds)):
            bench = _PartialBench(self.rig, self.drawn, self.start, is_played, thresholds)
            for time, change in sorted(self.changes, key=lambda change: change[0]):
                bench.advance(time)
                change(bench)
            bench.advance(until)
            benches.append(bench)
        return benches


def _adding(owners: Mapping[int, int]) -> Callable[[_PartialBench], None]:
    def change(bench: _PartialBench) -> None:
        bench.owners = {**bench.owners, **owners}

    return change


@dataclass(frozen=True)
class Heard:
    """Own and foreign contents at a finger: a bench for each set of thresholds."""

    finger: int
    own: list[Bench]
    foreign: list[Bench]

    @classmethod
    def by(cls, finger: int, log: Log, until: float) -> "Heard":
        """Replay a log for a finger; its clicks, of the complement, are neither own nor foreign."""
        own = log.replayed(lambda owner: owner == finger, until)
        foreign = log.replayed(lambda owner: owner not in (finger, ~finger), until)
        return cls(finger, own, foreign)

    def own_db_sl(self, *spans: Span, strongest: bool = False) -> FloatArray:
        """Levels of the own content, averaged over the fingertip, in spans of time [s] together."""
        levels = []
        for bench in self.own:
            powers, weights = self._powers(bench, spans, strongest)
            levels.append(20 * np.log10((np.sqrt(powers) @ weights).max() + 1e-6))
        return np.array(levels)

    def foreign_db_sl(self, *spans: Span, strongest: bool = False) -> FloatArray:
        """Levels of all other contents at the loudest point; strongest: of 40 ms."""
        levels = []
        for bench in self.foreign:
            powers, _ = self._powers(bench, spans, strongest)
            levels.append(10 * np.log10(powers.max() + 1e-12))
        return np.array(levels)

    def contrast_db(self, *spans: Span, strongest: bool = False) -> float:
        """Own above foreign level, the least over the sets of thresholds."""
        own = self.own_db_sl(*spans, strongest=strongest)
        return float((own - self.foreign_db_sl(*spans, strongest=strongest)).min())

    def short_until(self, least_db: float, time: float) -> float:
        """Return the time [ms] after which a contrast is felt over 40 ms, in steps of 5 ms."""
        for delay in range(0, 1000, 5):
            start = time + delay / 1000
            if self.contrast_db((start, start + STRONGEST)) >= least_db:
                return float(delay)
        return 1000.0

    def _powers(
        self, bench: Bench, spans: Sequence[Span], strongest: bool
    ) -> tuple[FloatArray, FloatArray]:
        """Mean powers (n, points) over windows, and the weights of the points."""
        records = [bench.sample_fingers().felt(*span)[str(self.finger)] for span in spans]
        accelerations = np.concatenate([record.accelerations for record in records])
        energy = np.cumsum(accelerations**2, axis=0)
        count = round(STRONGEST * bench.sample_rate) if strongest else len(energy) - 1
        powers = 2 * (energy[count:] - energy[:-count]) / count
        return powers, records[0].weights
