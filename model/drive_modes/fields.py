"""What a drive mode works on: fields of each ERA at the fingertips, and how a drive is judged.

A drive is a tone for each ERA. It is judged by its robust score: the target's peak acceleration to
that at the quiet points, where each ERA's share is wrong by 10 % of itself at random (gains by 5 %,
phases by 5 degrees: 0.05² + 0.087² = 0.1²). A naive optimum cancels to nothing what cannot be
cancelled, and is 10 dB worse on the real plate than this one.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from model.arrays import FloatArray

SILENT = -1
"""Stands for the frequency of an ERA that is not driven."""

ERROR_SHARE = 0.1
"""How wrong an ERA's share of a field is, relative to itself, root mean square (sigma).

Of GAIN_ERROR and PHASE_ERROR of `model.vibration.excitation` together.
"""

_TINY, _LEAST = np.float32(1e-7), np.float32(1e-20)

SingleComplex = NDArray[np.complex64]
Single = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Drive:
    """A tone for each ERA: index of its frequency, or SILENT, and its weight.

    index (eras,); weight (eras,) complex, 1 is full stroke at phase zero.
    """

    index: NDArray[np.int64]
    weight: SingleComplex

    @classmethod
    def at(cls, frequency: int, weight: SingleComplex) -> "Drive":
        """All ERAs at one frequency."""
        return cls(np.where(weight == 0, SILENT, frequency), weight)

    def tones(self) -> list[tuple[int, SingleComplex]]:
        """Index of each distinct frequency, and the weights (eras,) at it."""
        frequencies = sorted({*self.index.tolist()} - {SILENT})
        return [
            (index, np.where(self.index == index, self.weight, 0).astype(np.complex64))
            for index in frequencies
        ]


@dataclass(frozen=True, eq=False)
class Fields:
    """Acceleration [m/s²] of each ERA alone at full stroke, and what is asked for.

    targets: (f, eras, p) each; quiet: (f, eras, q). Where is_alone, the quiet points stand for the
    rest of the plate and count by their root mean square, or else by their maximum. threshold (f,)
    [m/s²]; wanted: how many times above it every target shall feel, mean over its points.
    """

    targets: tuple[SingleComplex, ...]
    quiet: SingleComplex
    is_alone: bool
    threshold: Single
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
        """The same at some of the frequencies, by index (n,)."""
        some = Fields(
            targets=tuple(field.take(frequencies, axis=0) for field in self.targets),
            quiet=self.quiet.take(frequencies, axis=0),
            is_alone=self.is_alone,
            threshold=self.threshold.take(frequencies),
            wanted=self.wanted,
        )
        # What was worked out already is not worked out anew, round by round.
        known, also = vars(self), vars(some)
        if "quiet_power" in known:
            also["quiet_power"] = self.quiet_power.take(frequencies, axis=0)
        if "quiet_forms" in known:
            also["quiet_forms"] = self.quiet_forms.take(frequencies, axis=0)
        if "mean_targets" in known:
            also["mean_targets"] = self.mean_targets.take(frequencies, axis=1)
        return some

    @cached_property
    def quiet_power(self) -> Single:
        """Squared magnitude at the quiet points, (f, eras, q)."""
        return np.asarray(np.abs(self.quiet) ** 2)

    @cached_property
    def quiet_forms(self) -> Single:
        """Power at each quiet point, errors included, as a form w^H R w of weights w.

        R = conj(h) h^T, (eras, eras), with the errors on its diagonal; of every element the real
        and the imaginary part, (f, 2 eras², q).
        """
        f, eras, q = self.quiet.shape
        products = self.quiet.conj()[:, :, None] * self.quiet[:, None]
        forms = np.empty((f, eras * eras, 2, q), dtype=np.float32)
        forms[:, :, 0] = products.real.reshape(f, -1, q)
        forms[:, :, 1] = products.imag.reshape(f, -1, q)
        diagonal = forms[:, :: eras + 1, 0]
        diagonal += added_by_errors(diagonal, sigma=ERROR_SHARE)
        return forms.reshape(f, -1, q)

    @cached_property
    def mean_targets(self) -> SingleComplex:
        """Each ERA's field, mean over the points of each target, (targets, f, eras)."""
        return np.stack([field.mean(axis=-1) for field in self.targets])


def added_by_errors(power: Single, *, sigma: float) -> Single:
    """What errors of a share sigma of each ERA add to its own power (f, eras, ...).

    An ERA that does not move the quiet points must still have a weight that is a number.
    """
    floor = _TINY * np.maximum.reduce(power, axis=1, keepdims=True) + _LEAST
    return np.asarray(np.float32(sigma**2) * power + floor)


@dataclass(frozen=True)
class Outcome:
    """What a drive does at full level.

    peak [m/s²], sensation (times above threshold): at the lesser target; quiet_peak,
    quiet_sensation: at the loudest quiet point; score: see `robust_score`.
    """

    peak: float
    sensation: float
    quiet_peak: float
    quiet_sensation: float
    score: float

    @property
    def contrast(self) -> float:
        """Peak acceleration at the lesser target to that at the loudest quiet point, a ratio."""
        return max(self.peak, 1e-30) / max(self.quiet_peak, 1e-30)


def judge(fields: Fields, drive: Drive) -> Outcome:
    """What a drive does; tones of different frequencies add as magnitudes (paper Eq. 28)."""
    tones = drive.tones()
    at = [index for index, _ in tones]
    rows = np.array([weight for _, weight in tones])[:, None]
    threshold = fields.threshold[at][:, None]
    peaks, sensations = [], []
    for target in fields.targets:
        amplitudes = np.abs(rows @ target.take(at, axis=0))[:, 0]
        peaks.append(float(amplitudes.sum()) / target.shape[-1])
        felt = np.sqrt(((amplitudes / threshold) ** 2).sum(axis=0))
        sensations.append(float(felt.sum()) / target.shape[-1])
    quiet = np.abs(rows @ fields.quiet.take(at, axis=0))[:, 0]
    wrong = (np.abs(rows) ** 2 @ fields.quiet_power.take(at, axis=0))[:, 0]
    likely = np.sqrt(quiet**2 + ERROR_SHARE**2 * wrong).sum(axis=0)
    return Outcome(
        peak=min(peaks),
        sensation=min(sensations),
        quiet_peak=quietness(quiet.sum(axis=0), fields),
        quiet_sensation=float(np.sqrt(((quiet / threshold) ** 2).sum(axis=0)).max()),
        score=min(peaks) / quietness(likely, fields),
    )


def quietness(magnitude: Single | FloatArray, fields: Fields) -> float:
    """What the quiet points (q,) count as: their maximum, or around a lone finger their rms."""
    if fields.is_alone:
        return float(np.sqrt((magnitude.astype(float) ** 2).mean()))
    return float(magnitude.max())
