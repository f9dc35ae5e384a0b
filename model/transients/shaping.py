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
from model.transients.base_motion import BaseEnvelope, BaseMotions, Bases, Envelopes, Term
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
from model.transients.plate_in_time import ForcedVibration, PlateInTime
from model.vibration import Excitation, Tone, base_amplitudes

ONSET_WINDOW = 0.100
"""Time [s] from the first motion over which an onset is measured."""

ENDING_WINDOW = 0.100
"""Time [s] after the last motion of a base over which an ending is measured."""

SAMPLE_RATE = 8000.0
"""Rate [Hz] of sixteen samples per period of 500 Hz, so that a peak is found within 2 %."""

_FINE = 32  # samples; about the square root of their number in an onset


class _Piece(NamedTuple):
    """An interval without changes of the drives."""

    start: float  # s
    end: float  # s
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
        coarse = np.exp(np.outer(times[::_FINE], plate.eigenvalues))
        fine = np.exp(np.outer(times[:_FINE], plate.eigenvalues))
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
        discs = [fingertip_points(*position, plate) for position in (*targets, *quiet)]
        acceleration = self.acceleration(bases, np.concatenate(discs))
        felt = felt_part(acceleration, SAMPLE_RATE)
        ends = np.cumsum([len(disc) for disc in discs])[:-1]
        peaks = np.split(np.abs(felt).max(axis=0), ends)
        weights = [fingertip_weights(*target, plate) for target in targets]
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
            first, last = np.searchsorted(times, [piece.start, piece.end]).tolist()
            acceleration[first:last] = piece.forced.acceleration(
                piece.number, times[first:last], forced_shapes
            )
            for start in range(first, last, len(self._exponentials)):
                stop = min(last, start + len(self._exponentials))
                elapsed = times[start] - piece.start
                state = piece.free * np.exp(plate.eigenvalues * elapsed)
                free = state[:, None] * free_shapes
                parts = np.vstack([free.imag, free.real])
                acceleration[start:stop] += self._exponentials[: stop - start] @ parts
        return acceleration

    def residual_db(self, excitation: Excitation, ending: Bases) -> float:
        """Residual vibration [dB] in the 100 ms after an ending that begins at time 0.

        Root mean square acceleration over the whole plate relative to the steady one, mean over the
        phase at which the ending begins. The bases must come to rest, and each ERA must keep its
        frequency.
        """
        end_time = max((term.end for base in ending for term in base), default=0.0)
        frequencies = sorted({tone.frequency for tone in excitation.values()})
        plate_size = len(self._plate.reduced.omega)
        remaining = power = 0.0
        for frequency in frequencies:
            tones: dict[str, Tone] = {}
            bases = list[tuple[Term, ...]]()
            for era, base in zip(self._plate.eras, ending, strict=True):
                tone = excitation.get(era.name)
                era_frequency = frequencies[0] if tone is None else tone.frequency
                if tone is not None and tone.frequency == frequency:
                    tones[era.name] = tone
                bases.append(base if era_frequency == frequency else ())
            steady = self._steady(tones)
            last = steady
            for piece in self._pieces(tuple(bases), steady, end_time):
                last = piece.last
            remaining += float((last.conj() @ self._mean_square @ last).real)
            displacement = (self._plate.displacement @ steady)[:plate_size]
            size = float(np.linalg.norm(displacement))
            power += (2 * math.pi * frequency) ** 4 * size**2
        return 10 * math.log10(remaining / power)

    def _pieces(self, bases: Bases, total: ComplexArray, duration: float) -> Iterator[_Piece]:
        """Yield the intervals between changes of the bases, from a state z (2 r,) at time 0."""
        motions = BaseMotions(bases)
        edges = sorted({0.0, *motions.moments(0, 0.0, duration), duration})
        forced = self._plate.driven(motions, [0] * len(edges), edges)
        for number, (start, end) in enumerate(pairwise(edges)):
            forced_at_start, forced_at_end = forced.modal([number, number], [start, end])
            free = total - forced_at_start
            total = forced_at_end + free * np.exp(self._plate.eigenvalues * (end - start))
            yield _Piece(start, end, forced, number, free, last=total)

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

# Minimum number of combinations of ERAs in an onset; more than six quiet fingers get more. With all
# of sixteen the contrast is lower. Six of eight lower it by 1 dB in 10 % of the cases.
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
        for the magnets of the modeled plate.
        """
        self._plate = plate
        self._read_fingertips = fingertips or partial(_fingertips_on, plate)
        self._gain_variance = gain_variance
        self._names = [era.name for era in plate.eras]
        self._strokes = np.array([era.full_level for era in plate.eras])
        self._magnets = magnets or MagnetMotions.of(plate)
        self._full_share = lru_cache(_KEPT)(self._magnet_share)
        self._residual_form = mean_square(plate, ENDING_WINDOW)
        self._carriers: dict[float, Carrier] = {}
        self._centers = _SURROUNDINGS.centers(plate.reduced.plate)
        self._shapes = plate.shapes_at(self._centers)
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
            felt = self._felt(frequency, tuple(targets), tuple(quiet))
            responses = of_eras(felt, active)
            knots = onset_knots(amplitudes[active], responses, self._gain_variance)
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
            responses = None
            if targets and quiet:
                felt = self._felt(frequency, tuple(targets), tuple(quiet))
                responses = of_eras(felt, active)
            knots = ending_knots(self.prepare(frequency), amplitudes, active, responses)
            envelopes.update(self._envelopes(frequency, knots, active))
        return envelopes

    def _envelopes(self, frequency: float, knots: ComplexArray, active: IntArray) -> Envelopes:
        """Make envelopes from start and knots (n, active) in strokes, as far as magnets allow."""
        all_knots = np.zeros((len(knots), len(self._strokes)), dtype=complex)
        all_knots[:, active] = knots
        full = self._full_share(frequency)
        limited = self._magnets.within(frequency, all_knots, full=full)
        bases = limited * self._strokes
        envelopes: dict[str, BaseEnvelope] = {}
        for era in active.tolist():
            start, *later = bases[:, era].tolist()
            envelopes[self._names[era]] = BaseEnvelope(frequency, start, tuple(later))
        return envelopes

    def _magnet_share(self, frequency: float) -> float:
        """Return the share of full level to which drives may jump at a frequency [Hz]."""
        return float(self._magnets.shares(np.array([frequency]))[0])

    def _groups(
        self, excitation: Excitation, *, helped: bool
    ) -> list[tuple[float, ComplexArray, IntArray]]:
        """Return each frequency [Hz], amplitudes (eras,) in strokes, and indices of its ERAs.

        helped: whether silent ERAs play, too, if there is only one frequency.
        """
        frequencies, phasors = base_amplitudes(excitation, self._plate.eras)
        all_play = helped and len(frequencies) == 1
        groups = list[tuple[float, ComplexArray, IntArray]]()
        for frequency, amplitudes in zip(
            frequencies.tolist(), phasors / self._strokes, strict=True
        ):
            is_active = (amplitudes != 0) | all_play
            groups.append((frequency, amplitudes, np.flatnonzero(is_active)))
        return groups

    def _read(
        self, frequency: float, targets: tuple[Point, ...], quiet: tuple[Point, ...]
    ) -> FingerResponses:
        """Read the responses of all ERAs at targets and quiet fingers [m], else over the plate."""
        weights, shapes = self._fingertips(targets)
        means = (weights[:, None] @ shapes)[:, 0]
        if quiet:
            quiet_rows = self._resting(quiet)
        else:  # the plate beyond 50 mm of all targets, or all of a small plate
            background = self._shapes[is_background(self._centers, targets)]
            quiet_rows = background / math.sqrt(len(background))
        return responses_at(self.prepare(frequency), means, quiet_rows, is_alone=not quiet)

    def _quiet_rows(self, positions: tuple[Point, ...]) -> FloatArray:
        """Return rows (d, r) whose sum of squares is the sum of the fingertips' mean squares."""
        weights, shapes = self._fingertips(positions)
        return (np.sqrt(weights)[..., None] * shapes).reshape(-1, shapes.shape[-1])

    def _fingertips(self, positions: tuple[Point, ...]) -> tuple[FloatArray, FloatArray]:
        """Return weights (k, p) of points under fingertips and their shapes (k, p, r)."""
        cache = self._fingers
        # Looked up first, since other threads drop some.
        readings = {position: cache.get(position) for position in positions}
        missing = [position for position, reading in readings.items() if reading is None]
        if missing:
            weights, shapes = self._read_fingertips(missing)
            new = dict(zip(missing, zip(weights, shapes, strict=True), strict=True))
            readings.update(new)
            cache.update(new)
        for position in [*cache][:-_KEPT]:
            cache.pop(position, None)
        weights, shapes = map(np.stack, zip(*map(readings.__getitem__, positions), strict=True))
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
    reals = carrier.hats.reshape(samples, r, -1).view(np.float32)
    hats = (rows.astype(np.float32) @ reals).view(np.complex64)
    return FingerResponses(
        targets=len(target_rows),
        hats=hats.reshape(samples, len(rows), knots, eras),
        steady=rows @ carrier.steady.T,
        combinations=_COMBINATIONS_ALONE if is_alone else max(_COMBINATIONS, len(rows) // 4),
    )


def of_eras(responses: FingerResponses, active: IntArray) -> FingerResponses:
    """Select the responses of active ERAs."""
    if len(active) == responses.steady.shape[1]:
        return responses
    return replace(
        responses,
        hats=np.ascontiguousarray(responses.hats[..., active]),
        steady=np.ascontiguousarray(responses.steady[:, active]),
    )


def _fingertips_on(plate: PlateInTime, positions: Sequence[Point]) -> tuple[FloatArray, FloatArray]:
    """Read the shapes of a plate under fingertips point by point, as `Fingertips`."""
    sides = plate.reduced.plate
    points, weights = fingertips_on(
        np.array(positions), length=sides.length, width=sides.width, rule=FIVE_POINTS
    )
    shapes = plate.shapes_at(points.reshape(-1, 2))
    return weights, shapes.reshape(*weights.shape, -1)
