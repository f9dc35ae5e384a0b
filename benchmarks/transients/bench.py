"""Onsets and endings of many patterns on one rig, and how long shaping them takes."""

import math
import time
from collections import defaultdict
from collections.abc import Callable
from functools import partial
from typing import TypeVar

import numpy as np

from benchmarks.transients.cases import (
    FREQUENCIES,
    Case,
    case_of,
    quantised,
    with_errors,
)
from model.answer.plan import query
from model.answer.stimulus import Placement
from model.arrays import ComplexArray
from model.finger import contrast_db, fingertip_points, fingertip_weights
from model.reduction.reduced_plate import reduce_plate
from model.rig.rig import Rig, Uncertainty
from model.structure.attachments import footprints_of
from model.table.table_file import build_table
from model.transients.base_motion import Bases, ramped_ending, ramped_onset, shaped
from model.transients.knots import steady_states
from model.transients.shaping import ENDING_WINDOW, Shaper, Transients
from model.transients.time_response import PlateInTime, plate_in_time
from model.vibration import Excitation, base_amplitudes

T = TypeVar("T")
Columns = dict[str, list[float]]


class Stopwatch:
    """Processor times [s] of calls by what was called, which other work does not lengthen."""

    def __init__(self) -> None:
        self.times: dict[str, list[float]] = defaultdict(list)

    def __call__(self, name: str, call: Callable[[], T]) -> T:
        started = time.thread_time()
        result = call()
        self.times[name].append(time.thread_time() - started)
        return result

    def show(self) -> None:
        print("\nprocessor time of one thread, median and 99th percentile")
        for name, times in sorted(self.times.items()):
            middle, most = 1e3 * np.median(times), 1e3 * np.percentile(times, 99)
            print(f"  {name:34s} {middle:6.2f} ms {most:6.2f} ms  ({len(times)} calls)")


class Bench:
    """One rig, what shapes for it and what predicts."""

    def __init__(self, rig: Rig, *, draws: int, rng: np.random.Generator) -> None:
        self.rig = rig
        self.plate = in_time(rig)
        self.shaper = Shaper(self.plate, gain_variance=rig.uncertainty.gain_variance)
        self.transients = Transients(self.plate)
        self.clock = Stopwatch()
        self.table = build_table(rig, frequencies=FREQUENCIES)
        self._draws, self._rng = draws, rng
        self._prepared: set[float] = set()

    def onsets(self, cases: list[list[Case]]) -> Columns:
        columns: Columns = defaultdict(list)
        for patterns in cases:
            case = patterns[0]
            excitation = case.excitation(self.rig)
            errors = random_gains(
                self._rng, self.rig.uncertainty, draws=self._draws, eras=len(self.rig.eras)
            )
            columns["steady"].append(case.steady_db(case.weights))
            columns["steady, realised"].append(
                float(np.median([case.steady_db(case.weights * each) for each in errors]))
            )
            for name, ramp in (("abrupt", 0.0), ("20 ms ramp", 0.02), ("40 ms ramp", 0.04)):
                bases = ramped_onset(excitation, self.rig.eras, ramp=ramp)
                columns[name].append(self._contrast(case, bases))
            placed = Placement(tuple(case.targets), tuple(case.quiet))
            (chosen,) = query(self.table, placed, 12.0, drive_mode="phased").layers
            bases = ramped_onset(chosen.excitation, self.rig.eras, ramp=chosen.ramp)
            columns["the table's pattern and ramp"].append(self._contrast(case, bases))
            played = case_of(chosen.excitation, patterns, self.rig)
            columns["the same, steady, realised"].append(
                float(np.median([played.steady_db(played.weights * each) for each in errors]))
            )
            if case.frequency not in self._prepared:
                self._prepared.add(case.frequency)
                self.clock("a frequency's first use", partial(self.shaper.prepare, case.frequency))
            envelopes = self.clock(
                f"onset, {len(case.quiet)} quiet",
                partial(self.shaper.onset, excitation, targets=case.targets, quiet=case.quiet),
            )
            columns["shaped"].append(self._contrast(case, shaped(envelopes, self.rig.eras)))
            columns["shaped, as a wire carries it"].append(
                self._contrast(case, shaped(quantised(envelopes, self.rig), self.rig.eras))
            )
            realised = [
                self._contrast(case, shaped(with_errors(envelopes, self.rig, each), self.rig.eras))
                for each in errors
            ]
            columns["shaped, realised"].append(float(np.median(realised)))
            columns["largest level"].append(
                max(
                    each.largest / self.rig.era(name).full_level for name, each in envelopes.items()
                )
            )
        return columns

    def endings(self, cases: list[Case], *, full: bool) -> tuple[Columns, Columns]:
        left: Columns = defaultdict(list)
        contrast: Columns = defaultdict(list)
        eras = self.rig.eras
        for case in cases:
            level = 1.0 if full else case.felt_level
            excitation = case.excitation(self.rig, level)
            errors = random_gains(
                self._rng, self.rig.uncertainty, draws=self._draws, eras=len(eras)
            )
            for name, ramp in (("stopped", 0.0), ("20 ms ramp", 0.02), ("40 ms ramp", 0.04)):
                bases = ramped_ending(excitation, eras, ramp=ramp)
                left[name].append(self._left(excitation, bases))
                contrast[name].append(self._end_contrast(case, excitation, bases))
            ending = self.clock("ending", partial(self.shaper.ending, excitation))
            quiet_ending = self.clock(
                f"ending, {len(case.quiet)} quiet",
                partial(self.shaper.ending, excitation, targets=case.targets, quiet=case.quiet),
            )
            for name, envelopes in (("shaped", ending), ("shaped, quietly", quiet_ending)):
                bases = shaped(envelopes, eras)
                left[name].append(self._left(excitation, bases))
                contrast[name].append(self._end_contrast(case, excitation, bases))
                realised = [
                    (
                        case.excitation(self.rig, level, each),
                        shaped(with_errors(envelopes, self.rig, each), eras),
                    )
                    for each in errors
                ]
                left[f"{name}, realised"].append(
                    float(np.median([self._left(*each) for each in realised]))
                )
                contrast[f"{name}, realised"].append(
                    float(np.median([self._end_contrast(case, *each) for each in realised]))
                )
                left[f"{name}, largest level"].append(
                    max(
                        each.largest / self.rig.era(era).full_level
                        for era, each in envelopes.items()
                    )
                )
        return left, contrast

    def _end_contrast(self, case: Case, excitation: Excitation, bases: Bases) -> float:
        """Steady peak at the weakest target to the loudest at a quiet finger from the end on [dB].

        From time 0, when the bases begin the ending, until 100 ms after it.
        """
        discs = [fingertip_points(*each, self.rig.plate) for each in (*case.targets, *case.quiet)]
        steady = np.zeros(sum(len(disc) for disc in discs))
        frequencies, phasors = base_amplitudes(excitation, self.rig.eras)
        for omega, amplitudes in zip(2 * np.pi * frequencies, phasors, strict=True):
            weights = amplitudes / [era.full_level for era in self.rig.eras]
            state = weights @ steady_states(self.plate, omega)
            shapes = self.plate.reduced.at(np.concatenate(discs)) @ self.plate.displacement
            steady += omega**2 * np.abs(shapes @ state)
        ends = np.cumsum([len(disc) for disc in discs])
        *targets, _ = np.split(steady, ends[: len(case.targets)])
        last = max((term.end for base in bases for term in base), default=0.0)
        quiet = self.transients.acceleration(
            bases,
            np.concatenate(discs[len(case.targets) :]),
            duration=last + ENDING_WINDOW,
            after=excitation,
        )
        tips = [fingertip_weights(*each, self.rig.plate) for each in case.targets]
        return float(contrast_db(targets, np.abs(quiet).max(axis=0), tips))

    def _left(self, excitation: Excitation, bases: Bases) -> float:
        return self.clock("level left", lambda: self.transients.residual_db(excitation, bases))

    def _contrast(self, case: Case, bases: Bases) -> float:
        return self.clock(
            f"transient contrast, {len(case.quiet)} quiet",
            lambda: self.transients.contrast_db(bases, targets=case.targets, quiet=case.quiet),
        )


def in_time(rig: Rig) -> PlateInTime:
    """The rig's plate on its ERAs in time."""
    attachments = footprints_of(rig.eras, rig.masses)
    reduced = reduce_plate(rig.plate, rig.mesh, attachments, frequency_max=rig.limits.frequency_max)
    return plate_in_time(reduced, rig.eras, loads=rig.masses)


def print_columns(title: str, columns: Columns, *, worse: float) -> None:
    print(f"\n{title}")
    for name, values in columns.items():
        unit = "" if name.endswith("largest level") else " dB"
        print(f"  {name:34s} {np.median(values):6.1f} ({np.percentile(values, worse):6.1f}){unit}")


def random_gains(
    rng: np.random.Generator, uncertainty: Uncertainty, *, draws: int, eras: int
) -> ComplexArray:
    """Draw complex gains of ERAs, normal in size and phase, (draws, eras)."""
    gain = 1 + uncertainty.gain * rng.standard_normal((draws, eras))
    phase = math.radians(uncertainty.phase_deg) * rng.standard_normal((draws, eras))
    return np.asarray(gain * np.exp(1j * phase))
