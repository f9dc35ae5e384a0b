"""How a vibration starts and ends: abruptly, along a ramp, shaped; and what shaping takes.

    python -m benchmarks.transients [--sets 60] [--draws 16] [--seed 1] [--picture FILE.png]

On the paper's plate: random contact sets, one target and one to three quiet fingers at least 5 cm
apart, robust phased patterns at the best of 27 frequencies from 40 to 500 Hz that reach 1 m/s².
Realised: gains wrong by 5 % and phases by 5 degrees (standard deviations, normal); of each set the
median of its draws counts. Printed: the median over the sets, in brackets the tenth percentile (for
endings, where less is better, the ninetieth).
"""

import argparse
import math
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np
from matplotlib.figure import Figure

from benchmarks.setting import RIG, random_contacts
from model.answer.plan import query
from model.answer.stimulus import ONSET_RAMP, Placement
from model.arrays import ComplexArray, FloatArray
from model.finger import (
    FINGERTIP_RADIUS,
    STRONG_DB_SL,
    contrast_db,
    detection_threshold,
    fingertip_points,
    fingertip_weights,
)
from model.reduction.free_plate import solve_free_plate
from model.reduction.reduced_plate import reduce_plate
from model.rig.rig import Rig, Uncertainty
from model.rig.rig_file import load_rig
from model.structure.attachments import footprints_of
from model.table.table_file import build_table
from model.transients.base_motion import Bases, Envelopes, ramped_ending, ramped_onset, shaped
from model.transients.knots import steady_states
from model.transients.shaping import ENDING_WINDOW, SAMPLE_RATE, Shaper, Transients
from model.transients.time_response import PlateInTime, plate_in_time
from model.vibration import Excitation, Tone, base_amplitudes

LOW = 150.0  # Hz; below it an ending has fewer periods in which to stop the plate


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.transients", description=__doc__)
    parser.add_argument("--sets", type=int, default=60)
    parser.add_argument("--draws", type=int, default=16)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--picture", type=Path)
    options = parser.parse_args()

    rng = np.random.default_rng(options.seed)
    rig = load_rig(RIG)
    print(f"{options.sets} contact sets for each count, {options.draws} draws, seed {options.seed}")
    bench = Bench(rig, draws=options.draws, rng=rng)
    everything = []
    for others in (1, 2, 3):
        cases = find_cases(rig, others=others, count=options.sets, rng=rng)
        everything += [patterns[0] for patterns in cases]
        title = f"contrast of the peaks over the first 100 ms, {others} quiet, full stroke"
        print_columns(title, bench.onsets(cases), worse=10)
        if others == 1 and options.picture:
            draw(bench.plate, rig, cases, options.picture)
    for full in (True, False):
        how = "full stroke" if full else "at 20 dB SL"
        for title, chosen in (
            (f"below {LOW:g} Hz", [case for case in everything if case.frequency < LOW]),
            (f"{LOW:g} Hz and above", [case for case in everything if case.frequency >= LOW]),
        ):
            left, contrast = bench.endings(chosen, full=full)
            name = f"{title}, {len(chosen)} patterns, {how}"
            print_columns(f"left in the 100 ms after the end, {name}", left, worse=90)
            if not full:
                print_columns(f"contrast from the end on, {title}, {how}", contrast, worse=10)
    bench.clock.show()


FREQUENCIES = np.linspace(40, 500, 27)
WANTED = 1.0  # m/s²


@dataclass(frozen=True)
class Case:
    """One contact set with its pattern at full stroke; contacts[0] is the target."""

    contacts: list[tuple[float, float]]
    frequency: float
    weights: ComplexArray
    at_target: ComplexArray  # acceleration of each ERA at full stroke (eras, p)
    at_quiet: ComplexArray

    @property
    def targets(self) -> list[tuple[float, float]]:
        return self.contacts[:1]

    @property
    def quiet(self) -> list[tuple[float, float]]:
        return self.contacts[1:]

    @property
    def felt_level(self) -> float:
        """Level 0..1 at which the target feels 20 dB SL."""
        full = np.abs(self.weights @ self.at_target).mean()
        felt = detection_threshold(np.array([self.frequency]))[0] * 10 ** (STRONG_DB_SL / 20)
        return float(min(1.0, felt / full))

    def steady_db(self, weights: ComplexArray) -> float:
        target, quiet = np.abs(weights @ self.at_target), np.abs(weights @ self.at_quiet)
        return float(contrast_db([target], quiet, [np.full(len(target), 1 / len(target))]))

    def excitation(
        self, rig: Rig, level: float = 1.0, errors: ComplexArray | None = None
    ) -> Excitation:
        weights = level * self.weights * (1 if errors is None else errors)
        return {
            era.name: Tone.from_phasor(self.frequency, era.full_level * complex(w))
            for era, w in zip(rig.eras, weights, strict=True)
        }


def loaded_weights(target: ComplexArray, quiet: ComplexArray) -> tuple[float, ComplexArray]:
    """Score and weights (eras,) at one frequency from fields (eras, p): R w = conj(h).

    The loudest quiet points are given more weight in a few rounds.
    """
    sigma = math.sqrt(Uncertainty().gain_variance)
    shares = np.full(quiet.shape[1], 1 / quiet.shape[1])
    power = np.abs(quiet) ** 2
    best, kept = 0.0, np.zeros(len(target), dtype=complex)
    for _ in range(6):
        R = (quiet.conj() * shares) @ quiet.T + sigma**2 * np.diag(power @ shares)
        w = np.linalg.solve(R, target.mean(axis=1).conj())
        w /= np.abs(w).max()
        reached = np.abs(w @ target).mean()
        likely = np.abs(w @ quiet) ** 2 + sigma**2 * np.abs(w) ** 2 @ power
        score = reached / math.sqrt(likely.max())
        if score > best and reached >= WANTED:
            best, kept = float(score), w
        shares = shares * likely / (shares @ likely)
    return best, kept


def find_cases(rig: Rig, *, others: int, count: int, rng: np.random.Generator) -> list[list[Case]]:
    """For each contact set its patterns, the best first."""
    free = solve_free_plate(rig.plate, rig.mesh, frequency_max=float(FREQUENCIES[-1]))
    size = (rig.plate.length, rig.plate.width)
    cases: list[list[Case]] = []
    while len(cases) < count:
        places = random_contacts(rng, 1 + others, size, margin=FINGERTIP_RADIUS)
        contacts = [(float(x), float(y)) for x, y in places]
        fields = [
            free.acceleration(
                rig.eras, FREQUENCIES, fingertip_points(*each, rig.plate), loads=rig.masses
            )
            for each in contacts
        ]
        target, quiet = fields[0], np.concatenate(fields[1:], axis=-1)
        found = [loaded_weights(target[f], quiet[f]) for f in range(len(FREQUENCIES))]
        order = np.argsort([-score for score, _ in found])
        cases.append(
            [
                Case(contacts, float(FREQUENCIES[f]), found[f][1], target[f], quiet[f])
                for f in order
                if found[f][0] > 0
            ]
        )
    return cases


def case_of(excitation: Excitation, patterns: list[Case], rig: Rig) -> Case:
    """The case of another excitation of one frequency, for the same contacts."""
    weights = np.zeros(len(rig.eras), dtype=complex)
    for number, era in enumerate(rig.eras):
        tone = excitation.get(era.name)
        if tone is not None:
            weights[number] = tone.phasor / era.full_level
    (frequency,) = {tone.frequency for tone in excitation.values()}
    same = min(patterns, key=lambda each: abs(each.frequency - frequency))
    return replace(same, weights=weights)


def with_errors(envelopes: Envelopes, rig: Rig, errors: ComplexArray) -> Envelopes:
    return {
        era.name: replace(
            envelopes[era.name],
            start=complex(envelopes[era.name].start * error),
            knots=tuple(complex(knot * error) for knot in envelopes[era.name].knots),
        )
        for era, error in zip(rig.eras, errors, strict=True)
    }


def quantised(envelopes: Envelopes, rig: Rig) -> Envelopes:
    """As a wire carries them: level in 1e-4 of the stroke, phase in 0.01 degrees."""

    def rounded(value: complex, stroke: float) -> complex:
        level = round(abs(value) / stroke * 1e4) / 1e4
        angle = math.radians(round(math.degrees(np.angle(value)) * 100) / 100)
        return complex(level * stroke * np.exp(1j * angle))

    return {
        name: replace(
            each,
            start=rounded(each.start, rig.era(name).full_level),
            knots=tuple(rounded(knot, rig.era(name).full_level) for knot in each.knots),
        )
        for name, each in envelopes.items()
    }


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


LASTS = 0.160  # s
RAMPED = f"{1e3 * ONSET_RAMP:.0f} ms ramp"


def draw(plate: PlateInTime, rig: Rig, cases: list[list[Case]], path: Path) -> None:
    """The pair whose steady contrast is the median one, started and stopped in three ways."""
    by_contrast = sorted(
        (patterns[0] for patterns in cases), key=lambda case: case.steady_db(case.weights)
    )
    case = by_contrast[len(by_contrast) // 2]
    excitation = case.excitation(rig, case.felt_level)
    shaper, transients = (
        Shaper(plate, gain_variance=rig.uncertainty.gain_variance),
        Transients(plate),
    )
    onset = shaper.onset(excitation, targets=case.targets, quiet=case.quiet)
    ending = shaper.ending(excitation, targets=case.targets, quiet=case.quiet)
    rows: list[tuple[str, Bases, str, Bases]] = [
        (
            "abrupt",
            ramped_onset(excitation, rig.eras, ramp=0.0),
            "stopped at once",
            ramped_ending(excitation, rig.eras, ramp=0.0),
        ),
        (
            RAMPED,
            ramped_onset(excitation, rig.eras, ramp=ONSET_RAMP),
            RAMPED,
            ramped_ending(excitation, rig.eras, ramp=ONSET_RAMP),
        ),
        ("shaped", shaped(onset, rig.eras), "shaped, quietly", shaped(ending, rig.eras)),
    ]
    points = [fingertip_points(*each, rig.plate) for each in case.contacts]
    weights = fingertip_weights(*case.contacts[0], rig.plate)
    count = len(weights)
    figure = Figure(figsize=(10, 7), layout="constrained")
    axes = figure.subplots(3, 2, sharex=True, sharey="col")
    for (left, right), (start_name, start, end_name, end) in zip(axes, rows, strict=True):
        for axis, name, felt in (
            (
                left,
                start_name,
                transients.acceleration(start, np.concatenate(points), duration=LASTS),
            ),
            (
                right,
                end_name,
                transients.acceleration(
                    end, np.concatenate(points), duration=LASTS, after=excitation
                ),
            ),
        ):
            times = 1e3 * np.arange(len(felt)) / SAMPLE_RATE
            quiet = felt[:, count:]
            loudest = int(np.abs(quiet).max(axis=0).argmax())
            axis.plot(times, felt[:, 0], color="0.65", linewidth=0.8, label="target")
            axis.plot(times, quiet[:, loudest], color="C3", linewidth=1.0, label="quiet finger")
            axis.set_title(f"{name}: {_remark(felt, weights, start=axis is left)}", fontsize=10)
            axis.grid(alpha=0.3)
        left.set_ylabel("acceleration in m/s²")
    axes[0, 0].legend(loc="upper right", fontsize=9)
    for axis, what in zip(axes[-1], ("start", "end"), strict=True):
        axis.set_xlabel(f"time after the {what} in ms")
    figure.suptitle(
        f"{case.frequency:.0f} Hz at 20 dB SL, steady contrast "
        f"{case.steady_db(case.weights):.0f} dB; quiet finger at its loudest point",
        fontsize=11,
    )
    figure.savefig(path, dpi=110)


def _remark(felt: FloatArray, weights: FloatArray, *, start: bool) -> str:
    if start:
        peak = np.abs(felt[: round(0.1 * SAMPLE_RATE)]).max(axis=0)
        contrast = contrast_db([peak[: len(weights)]], peak[len(weights) :], [weights])
        return f"contrast {contrast:.0f} dB in the first 100 ms"
    late = np.abs(felt[round(0.04 * SAMPLE_RATE) :, : len(weights)]).max()
    return f"target moves up to {late:.2g} m/s² after 40 ms"


if __name__ == "__main__":
    main()
