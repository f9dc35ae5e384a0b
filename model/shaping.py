"""Shaped onsets and brakes: envelopes that keep quiet fingers quiet, and that stop the plate.

Onset. Least squares over the knots of every ERA: each target follows its steady vibration times a
raised cosine, each quiet fingertip stays still, from the first millisecond until the plate has
settled. Gains and phases of the ERAs are known to a few percent and degrees only; if those of ERA e
are off by a complex factor 1 + d_e, the mean square at a quiet finger grows by var(d) times the sum
over e of what ERA e does there alone. That sum stands in the form as well, so what is found does
not rest on a cancellation that no amplifier can keep.

Ending. The plate's mean square over the time after the last knot is a quadratic form of its state
then, so of the knots; its least value, robust as above, is the brake. Neither contacts nor the
carrier's phase at the moment of the end matter.

No knot ever exceeds the stroke (`model.bounded_solution`).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from model.arrays import ComplexArray, FloatArray, IntArray
from model.bounded_solution import bounded_solution
from model.envelope import KNOT_STEP, Envelope, Envelopes
from model.excitation import Excitation
from model.fingertip import FINGERTIP_RADIUS, fingertip_points
from model.hats import ending_states, hat_accelerations, mean_square, raised_cosine, steady_states
from model.localization import SURROUNDINGS_RADIUS, Grid
from model.time_response import PlateInTime
from model.transient import AFTER

ONSET_KNOTS = 21
"""Knots of an onset; the last, after 105 ms, is the pattern itself."""

RISE = 0.040
"""How long [s] a target takes to full vibration along its raised cosine."""

ENDING_KNOTS = 8
"""Knots of an ending; the last, after 40 ms, is silence."""

# Standard deviations of what an ERA does against what it was told.
GAIN_ERROR = 0.05
PHASE_ERROR = math.radians(5)
_ERROR_VARIANCE = GAIN_ERROR**2 + PHASE_ERROR**2

# What a target's straying from its ramp costs against a quiet finger's moving, relative to the
# robust ratio of the two in the steady state: a pattern that leaves the quiet finger 20 dB below
# the target must not trade the target's ramp for more than that. From a third of it to thrice it
# contrast changes by 1 dB.
_TARGET_WEIGHT = 2.0

_SAMPLES = 5  # to a step; a demodulated answer changes little within a millisecond
_SETTLING_STEPS = 9  # watched after the last knot

# Relative to the mean of the form's diagonal: keeps it definite, costs no contrast.
_RIDGE = 1e-6

_SURROUNDINGS = Grid(12, 9)


@dataclass(frozen=True, eq=False)
class _Carrier:
    """What one frequency does whoever touches the plate, each ERA at full stroke.

    hats (n, eras, r) and steady (eras, r): accelerations of the reduced coordinates; left: form
    (knots * eras)² of what is left after an ending, its first block the tone that ends.
    """

    frequency: float
    hats: ComplexArray
    steady: ComplexArray
    left: ComplexArray


class Shaper:
    """Finds onsets and endings for a plate on its ERAs.

    What does not depend on the contacts is worked out once for each frequency and kept.
    """

    def __init__(self, plate: PlateInTime) -> None:
        self._plate = plate
        self._mean_square = mean_square(plate, AFTER)
        self._carriers: dict[float, _Carrier] = {}

    def onset(
        self,
        excitation: Excitation,
        *,
        targets: Sequence[tuple[float, float]],
        quiet: Sequence[tuple[float, float]] = (),
        rise: float = RISE,
    ) -> Envelopes:
        """Envelopes that lead from rest to an excitation and keep quiet fingers [m] quiet.

        targets [m] follow their steady vibration along a raised cosine of rise [s]. Without quiet
        fingers the plate beyond 50 mm of the targets takes their place. An ERA that the excitation
        leaves silent helps where there is one frequency only.
        """
        felt = np.concatenate([self._directions(*position) for position in targets])
        still = (
            np.concatenate([self._directions(*position) for position in quiet])
            if quiet
            else self._surroundings(targets)
        )
        envelopes = {}
        for frequency, amplitudes, active in self._groups(excitation):
            carrier = self.prepare(frequency)
            knots = _onset(carrier, amplitudes, active, felt=felt, still=still, rise=rise)
            for column, era in enumerate(active):
                envelopes[self._plate.eras[era].name] = Envelope(
                    frequency, 0j, self._metres(knots[:, column], era)
                )
        return envelopes

    def ending(self, excitation: Excitation) -> Envelopes:
        """Envelopes that lead from an excitation to silence and bring the whole plate to rest."""
        envelopes = {}
        for frequency, amplitudes, active in self._groups(excitation):
            knots = _ending(self.prepare(frequency), amplitudes, active)
            for column, era in enumerate(active):
                start, *rest = self._metres(knots[:, column], era)
                envelopes[self._plate.eras[era].name] = Envelope(frequency, start, tuple(rest))
        return envelopes

    def prepare(self, frequency: float) -> _Carrier:
        """Work out what belongs to a frequency [Hz], if that has not been done."""
        carrier = self._carriers.get(frequency)
        if carrier is None:
            omega = 2 * math.pi * frequency
            steady = steady_states(self._plate, omega) @ self._plate.displacement.T
            states = ending_states(self._plate, omega, step=KNOT_STEP, steps=ENDING_KNOTS)
            flat = states.reshape(len(states), -1)
            form = flat.conj().T @ self._mean_square @ flat
            carrier = _Carrier(
                frequency,
                hat_accelerations(
                    self._plate,
                    omega,
                    step=KNOT_STEP,
                    steps=ONSET_KNOTS + _SETTLING_STEPS,
                    samples=_SAMPLES,
                ),
                -(omega**2) * steady,
                form,
            )
            self._carriers[frequency] = carrier
        return carrier

    def _groups(self, excitation: Excitation) -> list[tuple[float, ComplexArray, IntArray]]:
        """Per frequency [Hz]: amplitudes (eras,) in strokes, and which ERAs play it."""
        eras = self._plate.eras
        frequencies = sorted({tone.frequency for tone in excitation.values()})
        groups = []
        for frequency in frequencies:
            amplitudes = np.zeros(len(eras), dtype=complex)
            for number, era in enumerate(eras):
                tone = excitation.get(era.name)
                if tone is not None and tone.frequency == frequency:
                    amplitudes[number] = tone.amplitude / era.stroke * np.exp(1j * tone.phase)
            plays = np.array(
                [
                    len(frequencies) == 1
                    or (era.name in excitation and excitation[era.name].frequency == frequency)
                    for era in eras
                ]
            )
            groups.append((frequency, amplitudes, np.flatnonzero(plays)))
        return groups

    def _metres(self, knots: ComplexArray, era: int) -> tuple[complex, ...]:
        return tuple((knots * self._plate.eras[era].stroke).tolist())

    def _directions(self, x: float, y: float) -> FloatArray:
        """Few rows (d, r) that a vibration under a fingertip comes down to.

        The sum of their squares is the mean square over its points: polynomials of second order,
        orthonormal there, hold all that a bending wave much longer than the fingertip does.
        """
        points = fingertip_points(x, y, self._plate.reduced.plate)
        u, v = ((points - [x, y]) / FINGERTIP_RADIUS).T
        basis, _ = np.linalg.qr(np.column_stack([np.ones(len(u)), u, v, u * u, u * v, v * v]))
        return np.asarray(basis.T @ self._plate.reduced.at(points) / math.sqrt(len(points)))

    def _surroundings(self, targets: Sequence[tuple[float, float]]) -> FloatArray:
        """The same for the plate beyond 50 mm of all targets, or all of it where that is none."""
        centres = _SURROUNDINGS.centres(self._plate.reduced.plate)
        distance = np.linalg.norm(centres[:, None] - np.array(targets), axis=-1).min(axis=1)
        far = distance > SURROUNDINGS_RADIUS
        shapes = self._plate.reduced.at(centres[far] if far.any() else centres)
        return np.asarray(np.linalg.qr(shapes, mode="r")) / math.sqrt(len(shapes))


def _onset(
    carrier: _Carrier,
    amplitudes: ComplexArray,
    active: IntArray,
    *,
    felt: FloatArray,
    still: FloatArray,
    rise: float,
) -> ComplexArray:
    """Knots (ONSET_KNOTS, active) in strokes; the last are the amplitudes."""
    steps = ONSET_KNOTS + _SETTLING_STEPS
    eras = len(active)
    at_felt = _by_step(carrier.hats[:, active], felt)
    at_still = _by_step(carrier.hats[:, active], still)
    loud = _over_time(at_felt.conj().T @ at_felt, steps)
    noise = _over_time(at_still.conj().T @ at_still, steps)
    times = KNOT_STEP * (np.arange(steps * _SAMPLES) + 0.5) / _SAMPLES
    wanted = raised_cosine(times, rise)[:, None] * (felt @ (amplitudes @ carrier.steady))
    wanted = wanted.reshape(steps, -1).T
    match = (at_felt.conj().T @ wanted).reshape(steps, eras, steps)
    aim = np.stack([np.trace(match[:, :, knot:], axis1=0, axis2=2) for knot in range(steps)])

    steady = amplitudes[active, None] * carrier.steady[active]
    weight = _TARGET_WEIGHT**2 * _robust_power(still @ steady.T) / _robust_power(felt @ steady.T)
    form = _robust(noise, eras) + weight * loud
    free = (ONSET_KNOTS - 1) * eras
    settled = np.tile(amplitudes[active], steps - ONSET_KNOTS + 1)
    right = weight * aim.ravel()[:free] - form[:free, free:] @ settled
    knots = _bounded(form[:free, :free], right)
    return np.vstack([knots.reshape(-1, eras), amplitudes[active]])


def _ending(carrier: _Carrier, amplitudes: ComplexArray, active: IntArray) -> ComplexArray:
    """Start and knots (1 + ENDING_KNOTS, active) in strokes; the last are zero."""
    total = len(amplitudes)
    eras = len(active)
    rows = (np.arange(ENDING_KNOTS)[:, None] * total + active).ravel()
    form = _robust(carrier.left[np.ix_(rows, rows)], eras)
    start = amplitudes[active]
    knots = _bounded(form[eras:, eras:], -form[eras:, :eras] @ start)
    return np.vstack([start, knots.reshape(-1, eras), np.zeros(eras)])


def _bounded(form: ComplexArray, right: ComplexArray) -> ComplexArray:
    ridge = _RIDGE * float(np.trace(form).real) / len(form)
    return bounded_solution(form + ridge * np.eye(len(form)), right, np.ones(len(form)))


def _robust_power(seen: ComplexArray) -> float:
    """Mean sum of squares of what all ERAs do together (d, eras) when they are off as they are."""
    together = np.linalg.norm(seen.sum(axis=1)) ** 2
    return float(together + _ERROR_VARIANCE * np.linalg.norm(seen) ** 2)


def _robust(form: ComplexArray, eras: int) -> ComplexArray:
    """The mean of a form over knots and ERAs (k * eras)² when ERAs are off by their errors."""
    own = np.tile(np.eye(eras), (len(form) // eras,) * 2)
    return np.asarray(form * (1 + _ERROR_VARIANCE * own))


def _by_step(hats: ComplexArray, rows: FloatArray) -> ComplexArray:
    """Hats seen at d rows (d, r): (samples * d, steps * eras), the steps side by side."""
    seen = hats @ rows.T
    count, eras, d = seen.shape
    by_step = seen.reshape(count // _SAMPLES, _SAMPLES, eras, d).transpose(1, 3, 0, 2)
    return by_step.reshape(_SAMPLES * d, -1)


def _over_time(products: ComplexArray, steps: int) -> ComplexArray:
    """From products of steps i and j of two hats, the form over all knots, summed over time.

    Hats of knots k and l meet in step t with their own steps t - k and t - l: sums along the
    diagonals of products, so no product is ever made twice.
    """
    eras = len(products) // steps
    sums = products.reshape(steps, eras, steps, eras).transpose(0, 2, 1, 3).copy()
    for step in range(1, steps):
        sums[step, 1:] += sums[step - 1, :-1]
    return sums[::-1, ::-1].transpose(0, 2, 1, 3).reshape(products.shape)
