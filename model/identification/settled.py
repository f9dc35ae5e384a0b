"""One settled pattern as a measurement of the plate that plays it, with the fingers on it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from model.arrays import ComplexArray, FloatArray
from model.identification.derivatives import by_mass_at, jacobian
from model.identification.forward import ForwardModel, PlateAt, RestingFinger
from model.identification.parameters import FINGER_PARTS, Space

_OWN = 0.5  # of a finger's deviation as a whole
_NOISE, _FLOOR = 0.01, 0.1
"""Of a reading at most, relative to its size; of those near zero, to the mean of all sensors."""


@dataclass(frozen=True, eq=False)
class SettledPattern:
    """A tone that has settled: time [s], frequency [Hz], and what it was played and measured with.

    bases (n,): amplitude of each ERA's base as commanded [m]; values (s,): acceleration at each
    sensor [m/s²], phases as exp(+i omega t); fingers: on the plate, as far as they are known.
    has_phase: whether phases of values count from those of bases; otherwise one phase is unknown,
    the same for all sensors, and no update depends on it.
    """

    time: float
    frequency: float
    bases: ComplexArray
    values: ComplexArray
    fingers: tuple[RestingFinger, ...] = ()
    has_phase: bool = True

    @property
    def std(self) -> FloatArray:
        """Largest error of each real number of `numbers`, one standard deviation (2 s,)."""
        rms2 = (np.abs(self.values) ** 2).mean()
        own = _NOISE * np.sqrt(np.abs(self.values) ** 2 + _FLOOR**2 * rms2)
        return np.concatenate([own, own])

    @property
    def numbers(self) -> FloatArray:
        """Real parts and imaginary parts of the values, (2 s,)."""
        return np.concatenate([self.values.real, self.values.imag])


def finger_count(patterns: Sequence[SettledPattern]) -> int:
    """Number of parameters of all fingers of some patterns."""
    return len(FINGER_PARTS) * sum(len(pattern.fingers) for pattern in patterns)


def finger_covariance(patterns: Sequence[SettledPattern]) -> FloatArray:
    """Covariance (q, q) of the parameters of all fingers of some patterns before any of them.

    A finger loads a plate more or less as a whole, and each of its parts differs half as much
    beside that: parts that varied on their own only would make a heavy finger as unlikely as four.
    """
    parts = len(FINGER_PARTS)
    own = _OWN**2 * np.eye(parts) + np.ones((parts, parts))
    return np.asarray(np.kron(np.eye(finger_count(patterns) // parts), own), dtype=float)


@dataclass(frozen=True, eq=False)
class PatternModel:
    """The plate of a forward model under the fingers of one pattern.

    space: of the model, which has no fingers of its own; forward: the model with the fingers;
    noise: of the pattern's readings, relative to its largest.
    """

    pattern: SettledPattern
    space: Space
    forward: ForwardModel
    noise: float = 1.0

    @classmethod
    def of(
        cls,
        model: ForwardModel,
        pattern: SettledPattern,
        finger_std: float,
        *,
        noise: float = 1.0,
    ) -> "PatternModel":
        """A model under the fingers of a pattern, of loads known to finger_std (of logarithms)."""
        count, space = len(FINGER_PARTS) * len(pattern.fingers), model.space
        names = [f"finger part {number}" for number in range(count)]
        wider = space.and_further("fingers", names, finger_std)
        forward = replace(
            model,
            frequencies=np.array([pattern.frequency]),
            fingers=pattern.fingers,
            space=wider,
            last_places={},
        )
        return cls(pattern, space, forward, noise)

    @property
    def std(self) -> FloatArray:
        """Error of each number of the pattern, (2 s,)."""
        return self.noise * self.pattern.std

    def predicted(self, x: FloatArray, fingers: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Numbers that a pattern is expected to give (2 s,), and their derivatives (2 s, p + q).

        x (p,): of the plate; fingers (q,): of theirs.
        """
        plate = self.forward.at(np.concatenate([x, fingers]))
        values = plate.responses[0] @ self.pattern.bases
        changes = np.einsum("snp,n->sp", jacobian(plate)[0], self.pattern.bases)
        return self._as_numbers(values, changes)

    def by_mass_at(self, plate: PlateAt, points: FloatArray) -> FloatArray:
        """Change of the numbers of the pattern by a mass [kg] at points (m, 2) [m], (2 s, m)."""
        changes = np.einsum("snp,n->sp", by_mass_at(plate, points)[0], self.pattern.bases)
        return self._as_numbers(plate.responses[0] @ self.pattern.bases, changes)[1]

    def _as_numbers(
        self, values: ComplexArray, changes: ComplexArray
    ) -> tuple[FloatArray, FloatArray]:
        """Real and imaginary parts of values at the sensors (s,) and their changes (s, q).

        Without a known phase the values are turned to that of the pattern's own, v: a exp(-i phi)
        with phi = arg(v^H a), which changes by d phi = Im(v^H da / v^H a).
        """
        if not self.pattern.has_phase:
            measured = self.pattern.values.conj()
            along = measured @ values
            turned = (measured @ changes / along).imag
            phase_factor = abs(along) / along
            changes = phase_factor * (changes - 1j * np.outer(values, turned))
            values = phase_factor * values
        return (
            np.concatenate([values.real, values.imag]),
            np.concatenate([changes.real, changes.imag]),
        )
