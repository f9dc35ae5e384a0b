"""How much of its contrast a drive has while it starts along a plain ramp, worked out ahead.

A ramp of one frequency is answered by the plate's own modes too, and their ringing knows nothing
of the balance at a quiet finger. The answer to the ramp of each ERA alone is known in closed form;
what a drive does is a weighted sum of these. Peaks are those of its envelope, the magnitude of the
answer to the complex exponential, at moments a few milliseconds apart: within some tenths of a
decibel of what `model.transients.measures` finds sample by sample, at a hundredth of the work.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from model.arrays import ComplexArray, FloatArray, IntArray
from model.finger.contrast import contrast_ratio
from model.transients.measures import FIRST
from model.transients.time_response import PlateInTime

MOMENTS = 12
"""How often an onset is looked at; not evenly, so that no beat goes unseen at all of them."""

AT_ONCE = 32  # frequencies that are solved together: some ten megabytes


class RampedOnsets:
    """Onsets of a plate at each of some frequencies, along a raised cosine."""

    def __init__(self, plate: PlateInTime, frequencies: FloatArray, *, ramp: float) -> None:
        """Solve them: frequencies (f,) [Hz], ramp [s]."""
        # Towards the end, where the target has its full level; the first is half way up the ramp.
        times = FIRST - (FIRST - ramp / 2) * np.linspace(1, 0, MOMENTS) ** 1.2
        self._eras = len(plate.eras)
        shares = np.split(2 * np.pi * frequencies, range(AT_ONCE, len(frequencies), AT_ONCE))
        parts = [_ramp_answers(plate, omega, times, ramp) for omega in shares]
        self._parts = np.concatenate(parts, dtype=np.complex64, casting="same_kind")

    def contrast(
        self,
        frequencies: IntArray,
        weights: NDArray[np.complex64],
        *,
        targets: Sequence[NDArray[np.float32]],
        quiet: NDArray[np.float32],
    ) -> FloatArray:
        """Contrast (n,) as a ratio of drives at frequencies (n,), by index, of weights (n, eras).

        targets, quiet: shapes (p, r) of the reduced plate at their points.
        """
        n = len(frequencies)
        parts = self._parts.take(frequencies, axis=0).reshape(n, self._eras, -1)
        answers = (weights[:, None, :] @ parts).reshape(n * MOMENTS, -1)
        rows = np.concatenate([answers.real, answers.imag])
        real, imaginary = (rows @ np.concatenate([*targets, quiet]).T).reshape(2, n, MOMENTS, -1)
        peaks = np.sqrt(np.maximum.reduce(real * real + imaginary * imaginary, axis=1))
        *felt, loudest = np.split(peaks, np.cumsum([len(shapes) for shapes in targets]), axis=1)
        return contrast_ratio(felt, loudest).astype(float)


def _ramp_answers(
    plate: PlateInTime, omega: FloatArray, times: FloatArray, ramp: float
) -> ComplexArray:
    """Acceleration of the reduced coordinates to each ERA's ramp alone, (f, eras, n, r).

    Demodulated: without the factor exp(i omega t). Before the ramp is over the base moves as the
    sum of three exponentials, see `model.transients.base_motion.fade`.
    """
    f, eras = len(omega), len(plate.eras)
    side = np.pi / ramp
    share = np.array([0.5, -0.25, -0.25])
    omegas = omega[:, None] + [0, side, -side]
    rows = np.broadcast_to(np.arange(eras)[:, None], (f, eras, 3)).ravel()
    s = np.broadcast_to(1j * omegas[:, None, :], (f, eras, 3)).ravel()
    strokes = np.array([plate.eras[row].stroke + 0j for row in rows])
    states = plate.particular(rows.tolist(), s, strokes, 0 * strokes)[0].reshape(f, eras, 3, -1)
    accelerations = states @ plate.displacement.T * (s**2).reshape(f, eras, 3, 1)

    rising = times < ramp
    turns = share * np.exp(1j * np.outer(times, [0, side, -side]))  # (n, 3)
    turns[~rising] = [1, 0, 0]
    forced = turns @ accelerations
    # What the plate's own modes have at the begin of the ramp, and anew at its end.
    begin = -(share @ states)
    left = (share * [1, -1, -1]) @ states - states[:, :, 0]
    rates = plate.eigenvalues - 1j * omega[:, None]
    decay = np.exp(times[:, None] * rates[:, None, :])[:, None]
    later = np.exp((times[:, None] - ramp) * rates[:, None, :])[:, None]
    free = begin[:, :, None] * decay
    free[:, :, ~rising] += left[:, :, None] * later[:, :, ~rising]
    return np.asarray(forced + free @ plate.acceleration.T)
