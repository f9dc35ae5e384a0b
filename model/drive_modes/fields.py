"""Input of the drive modes: each ERA's field at the fingertips, and the evaluation of a drive.

A drive is ranked by its robust score: the target's peak acceleration to the expected one at the
quiet points, where each ERA's contribution has a random error of 10 % (gain 5 %, phase 5 degrees:
0.05² + 0.087² = 0.1²). The optimum without errors relies on cancellation and is 10 dB worse on a
real plate.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from model.arrays import Complex64Array, Float32Array, FloatArray

SILENT = -1
"""Frequency index of an ERA that is not driven."""

ERROR_SHARE = 0.1
"""Rms error of an ERA's contribution to a field, relative (sigma).

GAIN_ERROR and PHASE_ERROR of `model.vibration.excitation` together.
"""

_TINY, _LEAST = np.float32(1e-7), np.float32(1e-20)


@dataclass(frozen=True, eq=False)
class Weights:
    """Complex weight of each ERA in full strokes, values (eras,), and its frequency.

    frequencies (eras,): by index, or SILENT.
    """

    frequencies: NDArray[np.int64]
    values: Complex64Array

    @classmethod
    def at(cls, frequency: int, values: Complex64Array) -> "Weights":
        """Drive all ERAs at one frequency."""
        return cls(np.where(values == 0, SILENT, frequency), values)

    def tones(self) -> list[tuple[int, Complex64Array]]:
        """Index of each distinct frequency, and the weights (eras,) at it."""
        frequencies = sorted({*self.frequencies.tolist()} - {SILENT})
        return [
            (index, np.where(self.frequencies == index, self.values, 0).astype(np.complex64))
            for index in frequencies
        ]


@dataclass(frozen=True, eq=False)
class Fields:
    """Acceleration [m/s²] of each ERA alone at full stroke at the contacts, and the wanted level.

    targets: (f, eras, p) each; quiet: (f, eras, q). has_no_quiet_contacts: the quiet points are the
    rest of the plate and count by their root mean square; else by their maximum. threshold (f,)
    [m/s²]; wanted: amplitude to threshold for every target, mean over its points.
    """

    targets: tuple[Complex64Array, ...]
    quiet: Complex64Array
    has_no_quiet_contacts: bool
    threshold: Float32Array
    wanted: float

    @property
    def frequency_count(self) -> int:
        """Number of frequencies."""
        return len(self.quiet)

    @property
    def era_count(self) -> int:
        """Number of ERAs."""
        return int(self.quiet.shape[1])

    def at(self, frequencies: NDArray[np.int64]) -> "Fields":
        """Select some of the frequencies, by index (n,)."""
        some = Fields(
            targets=tuple(field.take(frequencies, axis=0) for field in self.targets),
            quiet=self.quiet.take(frequencies, axis=0),
            has_no_quiet_contacts=self.has_no_quiet_contacts,
            threshold=self.threshold.take(frequencies),
            wanted=self.wanted,
        )
        # Cached values are selected too, not computed again.
        cached, selected = vars(self), vars(some)
        if "quiet_power" in cached:
            selected["quiet_power"] = self.quiet_power.take(frequencies, axis=0)
        if "quiet_forms" in cached:
            selected["quiet_forms"] = self.quiet_forms.take(frequencies, axis=0)
        if "mean_targets" in cached:
            selected["mean_targets"] = self.mean_targets.take(frequencies, axis=1)
        return some

    @cached_property
    def quiet_power(self) -> Float32Array:
        """Squared magnitude at the quiet points, (f, eras, q)."""
        return np.asarray(np.abs(self.quiet) ** 2)

    @cached_property
    def quiet_forms(self) -> Float32Array:
        """Expected power at each quiet point as a Hermitian form w^H R w of weights w.

        R = conj(h) h^T + sigma² diag |h|²; real and imaginary part of every element, (f, 2 eras²,
        q).
        """
        f, eras, q = self.quiet.shape
        products = self.quiet.conj()[:, :, None] * self.quiet[:, None]
        forms = np.empty((f, eras * eras, 2, q), dtype=np.float32)
        forms[:, :, 0] = products.real.reshape(f, -1, q)
        forms[:, :, 1] = products.imag.reshape(f, -1, q)
        diagonal = forms[:, :: eras + 1, 0]
        diagonal += error_power(diagonal, sigma=ERROR_SHARE)
        return forms.reshape(f, -1, q)

    @cached_property
    def mean_targets(self) -> Complex64Array:
        """Each ERA's field, mean over the points of each target, (targets, f, eras)."""
        return np.stack([field.mean(axis=-1) for field in self.targets])


def error_power(power: Float32Array, *, sigma: float) -> Float32Array:
    """Expected power that errors of sigma add to each ERA's own power (f, eras, ...).

    With a floor, so that R stays definite for an ERA that does not move the quiet points.
    """
    floor = _TINY * np.maximum.reduce(power, axis=1, keepdims=True) + _LEAST
    return np.asarray(np.float32(sigma**2) * power + floor)


@dataclass(frozen=True)
class Evaluation:
    """Measures of a drive at full level.

    peak [m/s²], sensation (amplitude to threshold): at the weakest target; quiet_peak,
    quiet_sensation: at the loudest quiet point; score: the robust score.
    """

    peak: float
    sensation: float
    quiet_peak: float
    quiet_sensation: float
    score: float

    @property
    def contrast(self) -> float:
        """Peak acceleration at the weakest target to that at the loudest quiet point, a ratio."""
        return max(self.peak, 1e-30) / max(self.quiet_peak, 1e-30)


def evaluate(fields: Fields, drive: Weights) -> Evaluation:
    """Evaluate a drive; tones of different frequencies add as magnitudes (paper Eq. 28)."""
    tones = drive.tones()
    at = [index for index, _ in tones]
    rows = np.array([weight for _, weight in tones])[:, None]
    threshold = fields.threshold[at][:, None]
    peaks, sensations = [], []
    for target in fields.targets:
        amplitudes = np.abs(rows @ target.take(at, axis=0))[:, 0]
        peaks.append(float(amplitudes.sum()) / target.shape[-1])
        sensation = np.sqrt(((amplitudes / threshold) ** 2).sum(axis=0))
        sensations.append(float(sensation.sum()) / target.shape[-1])
    quiet = np.abs(rows @ fields.quiet.take(at, axis=0))[:, 0]
    error = (np.abs(rows) ** 2 @ fields.quiet_power.take(at, axis=0))[:, 0]
    expected = np.sqrt(quiet**2 + ERROR_SHARE**2 * error).sum(axis=0)
    return Evaluation(
        peak=min(peaks),
        sensation=min(sensations),
        quiet_peak=quiet_amplitude(quiet.sum(axis=0), fields),
        quiet_sensation=float(np.sqrt(((quiet / threshold) ** 2).sum(axis=0)).max()),
        score=min(peaks) / quiet_amplitude(expected, fields),
    )


def quiet_amplitude(magnitude: Float32Array | FloatArray, fields: Fields) -> float:
    """Norm of the quiet points (q,): their maximum, or without quiet contacts their rms."""
    if fields.has_no_quiet_contacts:
        return float(np.sqrt((magnitude.astype(float) ** 2).mean()))
    return float(magnitude.max())
