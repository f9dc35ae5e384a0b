"""Input of the drive modes: what the ERAs' weights do at the fingertips, over the ensemble.

A drive is a complex weight for each ERA at each frequency. It is ranked by its robust score: the
amplitude at the target, over the root of the expected power at the loudest quiet fingertip, over
all plates within the rig's uncertainty (`model.ensemble.touched_plate`). The optimum for the
nominal plate relies on cancellation and is 10 dB worse on a real one.

Tones of different frequencies are felt together as the root of the sum of their squares over the
detection thresholds, and so are a score's powers: each in units of its threshold.
"""

from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from model.arrays import Complex64Array, Float32Array, IntArray

Drive: TypeAlias = list[tuple[int, Complex64Array]]
"""Tones: a frequency, by index, and the weights (eras,) at it, in full strokes."""

LEVEL_MARGIN = 1.0
"""Standard deviations of a target's amplitude that a drive must have in reserve.

About what nine of ten plates need; the answer's own draws decide.
"""

_LEAST = np.float32(1e-20)


@dataclass(frozen=True, eq=False)
class Forms:
    """Amplitudes at the targets, and expected power at targets and quiet fingertips.

    - targets: (t, f, eras) field of each ERA alone at full stroke [m/s²], mean over the fingertip
    - target_power: (t, f, eras, eras) expected power there, w^H R w of weights w
    - quiet: (f, q, eras, eras) the same at each quiet fingertip, or without any one form for the
      rest of the plate
    - threshold: (f,) [m/s²]; wanted: amplitude to threshold for every target
    - few, fine: (f, q, p, eras) fields of each ERA at few points of each quiet fingertip, by whose
      mean the expected power counts the nominal plate, each times the root of its weight; and
      at many points, of which the loudest counts. None where the mean is good enough
    - driven: (eras,) which ERAs may have weights, None for all; see `among`
    """

    targets: Complex64Array
    target_power: Complex64Array
    quiet: Complex64Array
    threshold: Float32Array
    wanted: float
    level_margin: float = LEVEL_MARGIN
    few: Complex64Array | None = None
    fine: Complex64Array | None = None
    driven: NDArray[np.bool_] | None = None

    @property
    def era_count(self) -> int:
        """Number of ERAs."""
        return int(self.quiet.shape[-1])

    def at(self, frequencies: IntArray) -> "Forms":
        """Select some of the frequencies, by index (n,)."""
        return Forms(
            self.targets.take(frequencies, axis=1),
            self.target_power.take(frequencies, axis=1),
            self.quiet.take(frequencies, axis=0),
            self.threshold.take(frequencies),
            self.wanted,
            self.level_margin,
            None if self.few is None else self.few.take(frequencies, axis=0),
            None if self.fine is None else self.fine.take(frequencies, axis=0),
            self.driven,
        )

    def among(self, is_driven: NDArray[np.bool_]) -> "Forms":
        """The forms for weights of some ERAs (eras,), all others 0: these do and cost nothing.

        Each keeps its own power, so that a form can be inverted.
        """
        if is_driven.all():
            return self
        pairs = np.outer(is_driven, is_driven) | np.eye(len(is_driven), dtype=bool)
        return replace(
            self,
            targets=self.targets * is_driven,
            target_power=self.target_power * pairs,
            quiet=self.quiet * pairs,
            few=None if self.few is None else self.few * is_driven,
            fine=None if self.fine is None else self.fine * is_driven,
            driven=is_driven,
        )

    def amplitude(self, weights: Complex64Array) -> Float32Array:
        """Amplitude [m/s²] at the weakest target of weights (..., f, eras), (..., f)."""
        return np.asarray(np.minimum.reduce(self._amplitudes(weights), axis=-2))

    def reached(self, weights: Complex64Array) -> tuple[Float32Array, NDArray[np.bool_]]:
        """Amplitude as `amplitude`, and whether all targets have the wanted level, (..., f)."""
        amplitudes = self._amplitudes(weights)
        least = self._least_amplitudes(weights, amplitudes)
        reaches = np.logical_and.reduce(least >= self.wanted * self.threshold, axis=-2)
        return np.asarray(np.minimum.reduce(amplitudes, axis=-2)), np.asarray(reaches)

    def gain_to_level(self, weights: Complex64Array) -> Float32Array:
        """Factor on weights (f, eras) that just reaches the wanted level at all targets, (f,)."""
        amplitudes = self._amplitudes(weights)
        least = np.minimum.reduce(self._least_amplitudes(weights, amplitudes), axis=0)
        amplitude = np.minimum.reduce(amplitudes, axis=0)
        return np.asarray(
            self.wanted * self.threshold / np.maximum(least, 0.1 * amplitude + _LEAST)
        )

    def quiet_power(self, weights: Complex64Array) -> Float32Array:
        """Expected power [m²/s⁴] at each quiet fingertip of weights (f, eras), (f, q)."""
        power = expected_power(self.quiet.swapaxes(0, 1), weights).T
        if self.few is None or self.fine is None:
            return power
        mean = np.add.reduce(_powers(self.few, weights), axis=2)
        loudest = np.maximum.reduce(_powers(self.fine, weights), axis=2)
        return np.asarray(power + np.maximum(loudest - mean, 0))

    def _amplitudes(self, weights: Complex64Array) -> Float32Array:
        """Amplitudes at the targets of weights (..., f, eras), (..., t, f)."""
        fields = np.add.reduce(self.targets * weights[..., None, :, :], axis=-1)
        return np.asarray(np.abs(fields))

    def _least_amplitudes(self, weights: Complex64Array, amplitudes: Float32Array) -> Float32Array:
        """Amplitudes (..., t, f) less the margin."""
        if not self.level_margin:
            return amplitudes
        variance = expected_power(self.target_power, weights) - amplitudes * amplitudes
        deviation = np.sqrt(np.maximum(variance, 0))
        return np.asarray(amplitudes - np.float32(self.level_margin) * deviation)


def _powers(fields: Complex64Array, weights: Complex64Array) -> Float32Array:
    """Squared magnitudes (f, q, p) of fields (f, q, p, eras) for weights (f, eras)."""
    found = np.matvec(fields, weights[:, None])
    return np.asarray(found.real * found.real + found.imag * found.imag)


def expected_power(forms: Complex64Array, weights: Complex64Array) -> Float32Array:
    """w^H R w of forms (q, f, eras, eras) and weights (..., f, eras): (..., q, f)."""
    each = weights[..., None, :, :]
    moved = np.matvec(forms, each)
    return np.asarray(np.vecdot(each, moved).real)
