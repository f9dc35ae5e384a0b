"""What a finger feels of its own content and of all others, each above its threshold.

Everything that moved the bases in a session is played once more on the same plate under the same
fingers: only the voices of a finger's own layers, or only those of all others. Voices are divided
by the threshold at their frequency, by each set of thresholds by which the rig's promises hold, so
that accelerations are levels of sensation.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from drivers.playing import Voice
from model.arrays import FloatArray
from model.finger import detection_threshold
from model.rig.rig import Rig
from sim.amplifier.readings import StraightClock
from sim.bench.bench import Bench
from sim.plant import imperfections
from sim.plant.imperfections import Imperfections, motion_of, realised
from sim.plant.plant import FingerPlacement

STRONGEST = 0.040  # s

Span = tuple[float, float]


class _Part(Bench):
    """A bench whose ERAs play only some voices; owners: fingers by layer.

    threshold: name of the set by which voices are divided.
    """

    def __init__(
        self,
        rig: Rig,
        drawn: Imperfections,
        now: float,
        is_heard: Callable[[int | None], bool],
        threshold: str,
    ) -> None:
        super().__init__(rig, now=now, imperfections=drawn)
        self.is_heard, self.threshold = is_heard, threshold
        self.owners: Mapping[int, int] = {}

    def _motion(self, index: int, playing: Sequence[Voice], clock: StraightClock) -> Any:
        errors, terms = self._errors[index], []
        for voice in (*playing, *imperfections.of_voices(playing, errors.harmonic)):
            if self.is_heard(self.owners.get(voice.layer)):
                at = np.array([voice.frequency])
                threshold = float(detection_threshold(at, self.threshold)[0])
                motion = motion_of(
                    [voice],
                    clock,
                    stroke=self.rig.eras[index].full_level,
                    delay=self._delays[index],
                )
                terms += realised(motion, replace(errors, gain=errors.gain / threshold))
        return tuple(terms)


@dataclass
class Log:
    """What happened on a bench, by time [s]: fingers, voices, and whose layers are whose."""

    rig: Rig
    drawn: Imperfections
    start: float
    steps: list[tuple[float, Callable[[_Part], None]]] = field(default_factory=list)

    def watch(self, bench: Any) -> None:
        """Note the voices of a bench from now on, and its fingers, with the plate under them."""
        apply, place = bench._apply, bench._place

        def applied(index: int, playing: tuple[Voice, ...], clock: StraightClock) -> None:
            self.steps.append((bench.time, lambda part: part._apply(index, playing, clock)))
            apply(index, playing, clock)

        def placed(placement: FingerPlacement) -> None:
            self.steps.append((placement.time, lambda part: part._place(placement)))
            place(placement)

        bench._apply, bench._place = applied, placed

    def own(self, owners: Mapping[int, int], time: float) -> None:
        """Note whose content each layer has from a time [s] on."""
        self.steps.append((time, lambda part: setattr(part, "owners", {**part.owners, **owners})))

    def replayed(self, is_heard: Callable[[int | None], bool], until: float) -> list[Bench]:
        """Benches on which some voices have been played up to a time [s], by set of thresholds."""
        found: list[Bench] = []
        for name in dict.fromkeys((self.rig.threshold, *self.rig.promised_thresholds)):
            part = _Part(self.rig, self.drawn, self.start, is_heard, name)
            for time, change in sorted(self.steps, key=lambda each: each[0]):
                part.advance(time)
                change(part)
            part.advance(until)
            found.append(part)
        return found


@dataclass(frozen=True)
class Heard:
    """What a finger felt in a session, of its own and of others', by set of thresholds."""

    finger: int
    own: list[Bench]
    foreign: list[Bench]

    @classmethod
    def by(cls, finger: int, log: Log, until: float) -> "Heard":
        """By a finger up to a time [s]; its clicks, of the complement, are neither."""
        own = log.replayed(lambda owner: owner == finger, until)
        return cls(finger, own, log.replayed(lambda o: o not in (finger, ~finger), until))

    def own_db_sl(self, *spans: Span, strongest: bool = False) -> FloatArray:
        """Levels of its own content, mean over the fingertip, in spans of time [s] together."""
        return np.array([self._level(each, spans, strongest, is_mean=True) for each in self.own])

    def foreign_db_sl(self, *spans: Span, strongest: bool = False) -> FloatArray:
        """Levels of all others' at the loudest point; strongest: of 40 ms."""
        levels = [self._level(each, spans, strongest, is_mean=False) for each in self.foreign]
        return np.array(levels)

    def contrast_db(self, *spans: Span, strongest: bool = False) -> float:
        """Own above foreign level in spans of time [s], the least over the sets."""
        own, foreign = (
            each(*spans, strongest=strongest) for each in (self.own_db_sl, self.foreign_db_sl)
        )
        return float((own - foreign).min())

    def short_until(self, least_db: float, time: float) -> float:
        """How long [ms] after a time [s] it first feels a contrast over 40 ms; a second at most.

        In steps of 5 ms.
        """
        for after in range(0, 1000, 5):
            start = time + after / 1000
            if self.contrast_db((start, start + STRONGEST)) >= least_db:
                return float(after)
        return 1000.0

    def _level(self, bench: Bench, spans: Sequence[Span], strongest: bool, is_mean: bool) -> float:
        records = [bench.fingers.felt(*span)[str(self.finger)] for span in spans]
        squares = np.cumsum(np.concatenate([each.accelerations for each in records]) ** 2, axis=0)
        count = round(STRONGEST * bench.sample_rate) if strongest else len(squares) - 1
        powers: FloatArray = 2 * (squares[count:] - squares[:-count]) / count
        if not is_mean:
            return float(10 * np.log10(powers.max() + 1e-12))
        return float(20 * np.log10((np.sqrt(powers) @ records[0].weights).max() + 1e-6))
