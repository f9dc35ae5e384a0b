"""Input of a search for drives: amplitudes at the targets, expected power at quiet fingertips.

Symbols, here and in `model.table`: f frequencies, p points under fingers, q quiet fingertips, r
reduced modal coordinates; h field of an ERA at a point, R Hermitian form of the expected power at
the quiet fingertips, c right-hand side from the targets, w complex weights of the ERAs. In
`model.transients`, q are the modal coordinates, and z the coordinates of the eigenvectors in time.

A drive is a complex weight of each ERA at each frequency. Its score is the amplitude at the target
over the root of the expected power at the loudest quiet fingertip, over all plates within the rig's
uncertainty (`model.ensemble.touched_plate`). The optimum for the nominal plate relies on
cancellation and is 10 dB worse on a real one. Tones of different frequencies are felt together as
the root of the sum of their squares over the detection thresholds, so the powers of a score are in
units of their frequencies' thresholds.
"""

from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from model.arrays import Complex64Array, Float32Array, IntArray

WeightedTones: TypeAlias = list[tuple[int, Complex64Array]]
"""Tones: the index of a frequency, and the weights (eras,) at it in full strokes."""

LEVEL_MARGIN = 1.0
"""Reserve of a drive at its targets, in standard deviations of their amplitude.

About the reserve that 90 % of plates need; the draws of an answer decide.
"""

LEAST_POWER, LEAST_AMPLITUDE = np.float32(1e-30), np.float32(1e-20)
"""Lower bounds of divisors."""


@dataclass(frozen=True, eq=False)
class Forms:
    """Amplitudes at the targets, and expected power at targets and quiet fingertips."""

    targets: Complex64Array
    """Field (t, f, eras) of each ERA alone at full stroke [m/s²], mean over a target."""
    target_power: Complex64Array
    """Form (t, f, eras, eras) of the expected power there: w^H R w of weights w."""
    quiet: Complex64Array
    """The same (f, q, eras, eras) at each quiet fingertip.

    Without quiet fingertips there is one form, for the rest of the plate.
    """
    threshold: Float32Array
    """Detection threshold (f,) [m/s²]."""
    wanted: float
    """Wanted amplitude to threshold at every target."""
    level_margin: float = LEVEL_MARGIN
    few: Complex64Array | None = None
    """Field (f, q, p, eras) at few points of quiet fingertips, times the root of their weights.

    `quiet` contains their mean on the nominal plate. None, like `fine`, if the mean is accurate
    enough.
    """
    fine: Complex64Array | None = None
    """Field (f, q, p, eras) at many points of quiet fingertips; the loudest point counts."""
    driven: NDArray[np.bool_] | None = None
    """Mask (eras,) of the ERAs that may have weights, None for all; see `among`."""

    @property
    def era_count(self) -> int:
        """Number of ERAs."""
        return int(self.quiet.shape[-1])

    def at(self, frequencies: IntArray) -> "Forms":
        """Select some of the frequencies, by index (n,)."""
        return replace(
            self,
            targets=self.targets.take(frequencies, axis=1),
            target_power=self.target_power.take(frequencies, axis=1),
            quiet=self.quiet.take(frequencies, axis=0),
            threshold=self.threshold.take(frequencies),
            few=None if self.few is None else self.few.take(frequencies, axis=0),
            fine=None if self.fine is None else self.fine.take(frequencies, axis=0),
        )

    def among(self, is_driven: NDArray[np.bool_]) -> "Forms":
        """Return the forms for weights of some ERAs (eras,); the others have no effect.

        The others keep their own power, so that the forms can be inverted.
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
        """Return `amplitude`, and whether all targets have the wanted level, both (..., f)."""
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
            self.wanted * self.threshold / np.maximum(least, 0.1 * amplitude + LEAST_AMPLITUDE)
        )

    def quiet_power(self, weights: Complex64Array) -> Float32Array:
        """Expected power [m²/s⁴] at each quiet fingertip of weights (f, eras), (f, q)."""
        power = _expected_power(self.quiet.swapaxes(0, 1), weights).T
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
        """Amplitudes (..., t, f) minus the margin."""
        if not self.level_margin:
            return amplitudes
        variance = _expected_power(self.target_power, weights) - amplitudes * amplitudes
        std = np.sqrt(np.maximum(variance, 0))
        return np.asarray(amplitudes - np.float32(self.level_margin) * std)


def _powers(fields: Complex64Array, weights: Complex64Array) -> Float32Array:
    """Squared magnitudes (f, q, p) of fields (f, q, p, eras) for weights (f, eras)."""
    amplitudes = np.matvec(fields, weights[:, None])
    return np.asarray(amplitudes.real * amplitudes.real + amplitudes.imag * amplitudes.imag)


def _expected_power(forms: Complex64Array, weights: Complex64Array) -> Float32Array:
    """w^H R w of forms (q, f, eras, eras) and weights (..., f, eras): (..., q, f)."""
    by_form = weights[..., None, :, :]
    products = np.matvec(forms, by_form)
    return np.asarray(np.vecdot(by_form, products).real)
