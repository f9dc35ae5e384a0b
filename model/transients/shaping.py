"""Shaped onsets and endings, and their measures: transient contrast and residual vibration.

Onset: least squares over the knots of every ERA. Each target follows its steady vibration times a
raised cosine and each quiet fingertip stays still, from the first millisecond until the plate has
settled.

Ending: the plate's mean square over the time after the last knot is a quadratic form of its state
then, and so of the knots; the ending minimizes it. It depends neither on the contacts nor on the
phase of the carrier at that moment. Known quiet fingers are kept quiet during the ending, too:
stopping the plate takes other vibrations than the pattern's.

Both are robust against errors of the ERAs; no knot exceeds the stroke (`model.transients.knots`),
and none moves a magnet further than it may (`model.transients.excursions`).
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cached_property, lru_cache, partial
from itertools import pairwise
from typing import NamedTuple, TypeAlias

import numpy as np

from model.arrays import ComplexArray, FloatArray, IntArray, Point
from model.finger import (
    FIVE_POINTS,
    Grid,
    contrast_db,
    felt_part,
    fingertip_points,
    fingertip_weights,
    fingertips_on,
    is_background,
)
from model.transients.base_motion import BaseEnvelope, BaseMotions, Bases, Envelopes
from model.transients.excursions import MagnetMotions
from model.transients.knots import (
    Carrier,
    FingerResponses,
    ending_knots,
    mean_square,
    onset_knots,
    solve_carrier,
    steady_states,
)
from model.transients.time_response import ForcedVibration, PlateInTime
from model.vibration import Excitation, base_amplitudes

ONSET_WINDOW = 0.100
"""Time [s] from the first motion over which an onset is measured."""

ENDING_WINDOW = 0.100
"""Time [s] after the last motion of a base over which an ending is measured."""

SAMPLE_RATE = 8000.0
"""Rate [Hz] of sixteen samples per period of 500 Hz, so that a peak is found within 2 %."""

_FINE = 32  # samples; about the square root of their number in an onset


class _Piece(NamedTuple):
    """An interval [s] without changes of the drives."""

    since: float
    until: float
    forced: ForcedVibration
    number: int  # of its forced solution
    free: ComplexArray  # z of the free part at its start
    last: ComplexArray  # z at its end


class Transients:
    """Predictions of onsets and endings of a plate on its ERAs."""

    def __init__(self, plate: PlateInTime) -> None:
        self._plate = plate
        times = np.arange(round(ONSET_WINDOW * SAMPLE_RATE)) / SAMPLE_RATE
        # Products of a coarse and a fine step: an exponential costs ten times as much.
        coarse, fine = (
            np.exp(np.outer(part, plate.eigenvalues)) for part in (times[::_FINE], times[:_FINE])
        )
        exponentials = (coarse[:, None] * fine).reshape(-1, len(plate.eigenvalues))
        self._exponentials = np.hstack([exponentials.real, exponentials.imag])[: len(times)]

    @cached_property
    def _mean_square(self) -> ComplexArray:
        return mean_square(self._plate, ENDING_WINDOW)

    def contrast_db(
        self,
        bases: Bases,
        *,
        targets: Sequence[tuple[float, float]],
        quiet: Sequence[tuple[float, float]],
    ) -> float:
        """Contrast [dB] of the peaks over the first 100 ms of bases that start from rest.

        For the part that skin can feel (`model.finger`): mean over the points of the weakest target
        to the loudest quiet point; positions in m.
        """
        plate = self._plate.reduced.plate
        discs = [fingertip_points(*each, plate) for each in (*targets, *quiet)]
        acceleration = felt_part(self.acceleration(bases, np.concatenate(discs)), SAMPLE_RATE)
        ends = np.cumsum([len(disc) for disc in discs])[:-1]
        peaks = np.split(np.abs(acceleration).max(axis=0), ends)
        weights = [fingertip_weights(*each, plate) for each in targets]
        count = len(targets)
        return float(contrast_db(peaks[:count], np.concatenate(peaks[count:]), weights))

    def acceleration(
        self,
        bases: Bases,
        points: FloatArray,
        *,
        duration: float = ONSET_WINDOW,
        after: Excitation | None = None,
    ) -> FloatArray:
        """Acceleration (n, p) [m/s²] at points (p, 2) [m] from time 0 on, every 1 / SAMPLE_RATE.

        after: the excitation that was steady before, None for rest.
        """
        plate = self._plate
        shapes = plate.shapes_at(points)
        times = np.arange(round(duration * SAMPLE_RATE)) / SAMPLE_RATE
        acceleration = np.empty((len(times), len(shapes)))
        free_shapes = (shapes @ plate.acceleration).T
        forced_shapes = (shapes @ plate.displacement).T
        for piece in self._pieces(bases, self._steady(after or {}), duration):
            first, last = np.searchsorted(times, [piece.since, piece.until]).tolist()
            acceleration[first:last] = piece.forced.acceleration(
                piece.number, times[first:last], forced_shapes
            )
            for start in range(first, last, len(self._exponentials)):
                stop = min(last, start + len(self._exponentials))
                now = piece.free * np.exp(plate.eigenvalues * (times[start] - piece.since))
                free = now[:, None] * free_shapes
                acceleration[start:stop] += self._exponentials[: stop - start] @ np.vstack(
                    [free.imag, free.real]
                )
        return acceleration

    def residual_db(self, excitation: Excitation, ending: Bases) -> float:
        """Residual vibration [dB] in the 100 ms after an ending that begins at time 0.

        Root mean square acceleration over the whole plate relative to the steady one, mean over the
        phase at which the ending begins. The bases must come to rest, and each ERA must keep its
        frequency.
        """
        end_time = max((term.end for base in ending for term in base), default=0.0)
        frequencies = sorted({tone.frequency for tone in excitation.values()})
        played = [
            excitation[era.name].frequency if era.name in excitation else frequencies[0]
            for era in self._plate.eras
        ]
        remaining = power = 0.0
        for frequency in frequencies:
            own = {name: tone for name, tone in excitation.items() if tone.frequency == frequency}
            bases = tuple(
                base if each == frequency else () for each, base in zip(played, ending, strict=True)
            )
            left = steady = self._steady(own)
            for piece in self._pieces(bases, steady, end_time):
                left = piece.last
            remaining += float((left.conj() @ self._mean_square @ left).real)
            moved = (self._plate.displacement @ steady)[: len(self._plate.reduced.omega)]
            size = float(np.linalg.norm(moved))
            power += (2 * math.pi * frequency) ** 4 * size**2
        return 10 * math.log10(remaining / power)

    def _pieces(self, bases: Bases, total: ComplexArray, duration: float) -> Iterator[_Piece]:
        """Yield the intervals between changes of the bases, from a state z (2 r,) at time 0."""
        motions = BaseMotions(bases)
        edges = sorted({0.0, *motions.moments(0, 0.0, duration), duration})
        forced = self._plate.driven(motions, [0] * len(edges), edges)
        for number, (since, until) in enumerate(pairwise(edges)):
            before, after = forced.modal([number, number], [since, until])
            free = total - before
            total = after + free * np.exp(self._plate.eigenvalues * (until - since))
            yield _Piece(since, until, forced, number, free, total)

    def _steady(self, excitation: Excitation) -> ComplexArray:
        """Return the steady state z (2 r,) at time 0, the reference of phases."""
        state = np.zeros(len(self._plate.eigenvalues), dtype=complex)
        for number, era in enumerate(self._plate.eras):
            tone = excitation.get(era.name)
            if tone is not None:
                unit = steady_states(self._plate, 2 * math.pi * tone.frequency)[number]
                state += unit * (tone.phasor / era.full_level)
        return state


_SURROUNDINGS = Grid(8, 6)  # twice as fine changes the contrast by 0.1 dB
_KEPT = 16  # sizes of caches: an onset and its ending share readings, as do resting fingers

# Least number of combinations of ERAs in an onset; there are more for more than six quiet fingers.
# With all of sixteen the contrast is lower, with six of eight 1 dB lower in one of ten cases.
_COMBINATIONS = 8

_COMBINATIONS_ALONE = 6  # the same without quiet fingers

Fingertips: TypeAlias = Callable[[Sequence[Point]], tuple[FloatArray, FloatArray]]
"""Weights (k, p) of points under fingertips at positions (k,) [m], and their shapes (k, p, r)."""


class Shaper:
    """Shaping of onsets and endings for a plate on its ERAs.

    Everything independent of the contacts is computed once per frequency.
    """

    def __init__(
        self,
        plate: PlateInTime,
        *,
        gain_variance: float,
        fingertips: Fingertips | None = None,
        magnets: MagnetMotions | None = None,
    ) -> None:
        """Prepare for a plate.

        gain_variance: of the ERAs' complex gains (`Uncertainty.gain_variance`); fingertips: reads
        shapes under fingertips, None to read them point by point; magnets: of its exciters, None
        for those of the plate as modeled.
        """
        self._plate = plate
        self._read_fingertips = fingertips or partial(_fingertips_on, plate)
        self._gain_variance = gain_variance
        self._names = [era.name for era in plate.eras]
        self._strokes = np.array([era.full_level for era in plate.eras])
        self._magnets = magnets or MagnetMotions.of(plate)
        self._full = lru_cache(_KEPT)(
            lambda hertz: float(self._magnets.shares(np.array([hertz]))[0])
        )
        self._residual_form = mean_square(plate, ENDING_WINDOW)
        self._carriers: dict[float, Carrier] = {}
        self._centres = _SURROUNDINGS.centres(plate.reduced.plate)
        self._shapes = plate.shapes_at(self._centres)
        # Readings of the last fingers: contents that begin together have each other's.
        self._fingers: dict[Point, tuple[FloatArray, FloatArray]] = {}
        self._felt = lru_cache(_KEPT)(self._read)
        self._resting = lru_cache(_KEPT)(self._quiet_rows)

    def prepare(self, frequency: float) -> Carrier:
        """Return what does not depend on the contacts at a frequency [Hz], computed once."""
        if frequency not in self._carriers:
            self._carriers[frequency] = solve_carrier(
                self._plate,
                frequency,
                residual_form=self._residual_form,
                gain_variance=self._gain_variance,
            )
        return self._carriers[frequency]

    def onset(
        self,
        excitation: Excitation,
        *,
        targets: Sequence[Point],
        quiet: Sequence[Point] = (),
    ) -> Envelopes:
        """Shape envelopes from rest to an excitation that keep quiet fingers [m] quiet.

        targets [m] follow their steady vibration along a raised cosine of RISE. Without quiet
        fingers the plate beyond 50 mm of the targets takes their place. ERAs that the excitation
        leaves silent help if there is only one frequency.
        """
        envelopes: dict[str, BaseEnvelope] = {}
        for frequency, amplitudes, active in self._groups(excitation, helped=True):
            found = of_eras(self._felt(frequency, tuple(targets), tuple(quiet)), active)
            knots = onset_knots(amplitudes[active], found, self._gain_variance)
            envelopes.update(self._envelopes(frequency, knots, active))
        return envelopes

    def ending(
        self,
        excitation: Excitation,
        *,
        targets: Sequence[Point] = (),
        quiet: Sequence[Point] = (),
    ) -> Envelopes:
        """Shape envelopes from an excitation to silence that bring the whole plate to rest.

        With targets and quiet fingers [m] the quiet ones are kept quiet meanwhile. Silent ERAs stay
        silent.
        """
        envelopes: dict[str, BaseEnvelope] = {}
        for frequency, amplitudes, active in self._groups(excitation, helped=False):
            found = None
            if targets and quiet:
                found = of_eras(self._felt(frequency, tuple(targets), tuple(quiet)), active)
            knots = ending_knots(self.prepare(frequency), amplitudes, active, found)
            envelopes.update(self._envelopes(frequency, knots, active))
        return envelopes

    def _envelopes(self, frequency: float, knots: ComplexArray, active: IntArray) -> Envelopes:
        """Make envelopes from start and knots (n, active) in strokes, as far as magnets allow."""
        every = np.zeros((len(knots), len(self._strokes)), dtype=complex)
        every[:, active] = knots
        knots = self._magnets.within(frequency, every, full=self._full(frequency))[:, active]
        by_era = zip(active.tolist(), (knots * self._strokes[active]).T.tolist(), strict=True)
        return {
            self._names[era]: BaseEnvelope(frequency, start, tuple(rest))
            for era, (start, *rest) in by_era
        }

    def _groups(
        self, excitation: Excitation, *, helped: bool
    ) -> list[tuple[float, ComplexArray, IntArray]]:
        """Return each frequency [Hz], amplitudes (eras,) in strokes, and indices of its ERAs.

        helped: whether silent ERAs play, too, if there is only one frequency.
        """
        frequencies, phasors = base_amplitudes(excitation, self._plate.eras)
        helped = helped and len(frequencies) == 1
        return [
            (frequency, amplitudes, np.flatnonzero((amplitudes != 0) | helped))
            for frequency, amplitudes in zip(
                frequencies.tolist(), phasors / self._strokes, strict=True
            )
        ]

    def _read(
        self, frequency: float, targets: tuple[Point, ...], quiet: tuple[Point, ...]
    ) -> FingerResponses:
        """Read the responses of all ERAs at targets and quiet fingers [m], else over the plate."""
        weights, shapes = self._fingertips(targets)
        means = (weights[:, None] @ shapes)[:, 0]
        if quiet:
            others = self._resting(quiet)
        else:  # the plate beyond 50 mm of all targets, or all of a small plate
            around = self._shapes[is_background(self._centres, targets)]
            others = around / math.sqrt(len(around))
        return responses_at(self.prepare(frequency), means, others, is_alone=not quiet)

    def _quiet_rows(self, positions: tuple[Point, ...]) -> FloatArray:
        """Return rows (d, r) whose sum of squares is the sum of the fingertips' mean squares."""
        weights, shapes = self._fingertips(positions)
        return (np.sqrt(weights)[..., None] * shapes).reshape(-1, shapes.shape[-1])

    def _fingertips(self, positions: tuple[Point, ...]) -> tuple[FloatArray, FloatArray]:
        """Return weights (k, p) of points under fingertips and their shapes (k, p, r)."""
        known = self._fingers
        # Looked up first, since other threads drop some.
        found = dict(zip(positions, map(known.get, positions), strict=True))
        if new := [each for each, one in found.items() if one is None]:
            weights, shapes = self._read_fingertips(new)
            made = dict(zip(new, zip(weights, shapes, strict=True), strict=True))
            found.update(made)
            known.update(made)
        for each in [*known][:-_KEPT]:
            known.pop(each, None)
        weights, shapes = map(np.stack, zip(*map(found.__getitem__, positions), strict=True))
        return weights, self._plate.with_far_ends(shapes)


def responses_at(
    carrier: Carrier, target_rows: FloatArray, quiet_rows: FloatArray, *, is_alone: bool = False
) -> FingerResponses:
    """Read the responses of all ERAs at rows of shapes.

    target_rows (t, r): means under targets; quiet_rows (d, r): rows whose sum of squares is the
    mean square under quiet fingers, or over the plate if the targets are alone.
    """
    rows = np.vstack([target_rows, quiet_rows])
    samples, r, knots, eras = carrier.hats.shape
    flat = carrier.hats.reshape(samples, r, -1).view(np.float32)
    hats = (rows.astype(np.float32) @ flat).view(np.complex64)
    hats = hats.reshape(samples, len(rows), knots, eras)
    combinations = _COMBINATIONS_ALONE if is_alone else max(_COMBINATIONS, len(rows) // 4)
    return FingerResponses(len(target_rows), hats, rows @ carrier.steady.T, combinations)


def of_eras(found: FingerResponses, active: IntArray) -> FingerResponses:
    """Select the responses of active ERAs."""
    if len(active) == found.steady.shape[1]:
        return found
    hats, steady = map(np.ascontiguousarray, (found.hats[..., active], found.steady[:, active]))
    return replace(found, hats=hats, steady=steady)


def _fingertips_on(plate: PlateInTime, positions: Sequence[Point]) -> tuple[FloatArray, FloatArray]:
    """Read the shapes of a plate under fingertips point by point, as `Fingertips`."""
    on = plate.reduced.plate
    points, weights = fingertips_on(
        np.array(positions), length=on.length, width=on.width, rule=FIVE_POINTS
    )
    return weights, plate.shapes_at(points.reshape(-1, 2)).reshape(*weights.shape, -1)
