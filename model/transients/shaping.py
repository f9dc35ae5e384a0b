"""Shaped onsets and endings: envelopes that keep quiet fingers quiet, and that stop the plate.

Onset. Least squares over the knots of every ERA: each target follows its steady vibration times a
raised cosine, each quiet fingertip stays still, from the first millisecond until the plate has
settled.

Ending. The plate's mean square over the time after the last knot is a quadratic form of its state
then, and so of the knots; the ending minimises it. It depends neither on the contacts nor on the
carrier's phase at that moment. Known quiet fingers are kept quiet during the ending, too: stopping
the plate takes other vibrations than the pattern's.

Both are robust against errors of the ERAs (`model.transients.knots`), and no knot ever exceeds the
stroke (`model.transients.knots`), nor moves a magnet further than it may
(`model.transients.excursions`).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from typing import TypeAlias

import numpy as np

from model.arrays import ComplexArray, FloatArray, IntArray
from model.finger import FIVE_POINTS, Grid, fingertips_on, is_background
from model.transients.base_motion import BaseEnvelope, Envelopes
from model.transients.excursions import MagnetMotions
from model.transients.knots import Carrier, FingerResponses, mean_square, solve_carrier
from model.transients.knots_kernel import ending_knots, onset_knots
from model.transients.measures import ENDING_WINDOW
from model.transients.time_response import PlateInTime
from model.vibration import Excitation, base_amplitudes

_SURROUNDINGS = Grid(8, 6)  # twice as fine changes the contrast by 0.1 dB
_KEPT = 16  # readings; of an onset and its ending, and of fingers that rest

# Least combinations of ERAs in an onset; more for more than six quiet fingers. With all of sixteen
# its contrast is lower, with six of eight 1 dB lower in one of ten cases.
_COMBINATIONS = 8

_COMBINATIONS_ALONE = 6  # in the onset of fingers that are alone

Position = tuple[float, float]

Fingertips: TypeAlias = Callable[[Sequence[Position]], tuple[FloatArray, FloatArray]]
"""Weights (k, p) of points under fingertips at positions (k,) [m], and their shapes (k, p, r)."""


class Shaper:
    """Shaping of onsets and endings for a plate on its ERAs.

    Everything that does not depend on the contacts is computed once for each frequency.
    """

    def __init__(
        self, plate: PlateInTime, *, gain_variance: float, fingertips: Fingertips | None = None
    ) -> None:
        """Prepare; gain_variance: of the ERAs' complex gains (`Uncertainty.gain_variance`).

        fingertips: None for a reading point by point.
        """
        self._plate = plate
        self._read_fingertips = fingertips or partial(_fingertips_on, plate)
        self._gain_variance = gain_variance
        self._names = [era.name for era in plate.eras]
        self._strokes = np.array([era.full_level for era in plate.eras])
        self._magnets = MagnetMotions.of(plate)
        self._full = lru_cache(_KEPT)(self._full_share)
        self._residual_form = mean_square(plate, ENDING_WINDOW)
        self._carriers: dict[float, Carrier] = {}
        self._centres = _SURROUNDINGS.centres(plate.reduced.plate)
        self._shapes = plate.shapes_at(self._centres)
        # Of fingers, the last ones: contents that begin together have each other's.
        self._fingers: dict[Position, tuple[FloatArray, FloatArray]] = {}
        self._felt = lru_cache(_KEPT)(self._read)
        self._resting = lru_cache(_KEPT)(self._quiet_rows)

    def prepare(self, frequency: float) -> Carrier:
        """Everything for a frequency [Hz] that does not depend on contacts, computed once."""
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
        targets: Sequence[Position],
        quiet: Sequence[Position] = (),
    ) -> Envelopes:
        """Envelopes that lead from rest to an excitation and keep quiet fingers [m] quiet.

        targets [m] follow their steady vibration along a raised cosine of RISE. Without quiet
        fingers the plate beyond 50 mm of the targets takes their place. An ERA that the excitation
        leaves silent helps where there is one frequency only.
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
        targets: Sequence[Position] = (),
        quiet: Sequence[Position] = (),
    ) -> Envelopes:
        """Envelopes that lead from an excitation to silence and bring the whole plate to rest.

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
        """From start and knots (n, active) in strokes, as far as magnets allow."""
        every = np.zeros((len(knots), len(self._strokes)), dtype=complex)
        every[:, active] = knots
        knots = self._magnets.within(frequency, every, full=self._full(frequency))[:, active]
        by_era = zip(active.tolist(), (knots * self._strokes[active]).T.tolist(), strict=True)
        return {
            self._names[era]: BaseEnvelope(frequency, start, tuple(rest))
            for era, (start, *rest) in by_era
        }

    def _full_share(self, frequency: float) -> float:
        return float(self._magnets.shares(np.array([frequency]))[0])

    def _groups(
        self, excitation: Excitation, *, helped: bool
    ) -> list[tuple[float, ComplexArray, IntArray]]:
        """Per frequency [Hz]: amplitudes (eras,) in strokes, and the indices of ERAs that play it.

        helped: silent ERAs play too where there is one frequency.
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
        self, frequency: float, targets: tuple[Position, ...], quiet: tuple[Position, ...]
    ) -> FingerResponses:
        weights, shapes = self._fingertips(targets)
        means = (weights[:, None] @ shapes)[:, 0]
        others = self._resting(quiet) if quiet else self._surroundings(targets)
        return responses_at(self.prepare(frequency), means, others, is_alone=not quiet)

    def _quiet_rows(self, positions: tuple[Position, ...]) -> FloatArray:
        """Rows (d, r) whose sum of squares is the mean square under the fingertips, summed."""
        weights, shapes = self._fingertips(positions)
        return np.asarray((np.sqrt(weights)[..., None] * shapes).reshape(-1, shapes.shape[-1]))

    def _fingertips(self, positions: tuple[Position, ...]) -> tuple[FloatArray, FloatArray]:
        """Weights (k, p) of points under fingertips, and their shapes (k, p, r)."""
        known = self._fingers
        found = dict(zip(positions, map(known.get, positions), strict=True))  # others drop some
        if new := [each for each, one in found.items() if one is None]:
            weights, shapes = self._read_fingertips(new)
            made = dict(zip(new, zip(weights, shapes, strict=True), strict=True))
            found.update(made)
            known.update(made)
        for each in [*known][:-_KEPT]:
            known.pop(each, None)
        weights, shapes = map(np.stack, zip(*map(found.__getitem__, positions), strict=True))
        return weights, self._plate.with_far_ends(shapes)

    def _surroundings(self, targets: Sequence[Position]) -> FloatArray:
        """The same for the plate beyond 50 mm of all targets; all of a plate too small for it."""
        shapes = self._shapes[is_background(self._centres, targets)]
        return np.asarray(shapes / math.sqrt(len(shapes)))


def responses_at(
    carrier: Carrier, target_rows: FloatArray, quiet_rows: FloatArray, *, is_alone: bool = False
) -> FingerResponses:
    """Read all ERAs at rows (t, r) and (d, r) of shapes.

    target_rows: means under targets; quiet_rows: whose sum of squares is the mean square under
    quiet fingers, or over the plate where the targets are alone.
    """
    rows = np.vstack([target_rows, quiet_rows])
    samples, r, knots, eras = carrier.hats.shape
    flat = carrier.hats.reshape(samples, r, -1).view(np.float32)
    hats = (rows.astype(np.float32) @ flat).view(np.complex64)
    hats = hats.reshape(samples, len(rows), knots, eras)
    combinations = _COMBINATIONS_ALONE if is_alone else max(_COMBINATIONS, len(rows) // 4)
    return FingerResponses(len(target_rows), hats, rows @ carrier.steady.T, combinations)


def of_eras(found: FingerResponses, active: IntArray) -> FingerResponses:
    """Responses of active ERAs only."""
    if len(active) == found.steady.shape[1]:
        return found
    hats, steady = map(np.ascontiguousarray, (found.hats[..., active], found.steady[:, active]))
    return replace(found, hats=hats, steady=steady)


def _fingertips_on(
    plate: PlateInTime, positions: Sequence[Position]
) -> tuple[FloatArray, FloatArray]:
    """Read the shapes of a plate under fingertips, as `Fingertips`."""
    on = plate.reduced.plate
    points, weights = fingertips_on(
        np.array(positions), length=on.length, width=on.width, rule=FIVE_POINTS
    )
    return weights, plate.shapes_at(points.reshape(-1, 2)).reshape(*weights.shape, -1)
