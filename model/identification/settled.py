"""One settled pattern as a measurement of the plate that plays it, with the fingers on it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from model.arrays import ComplexArray, FloatArray
from model.identification.derivatives import jacobian
from model.identification.forward import ForwardModel, RestingFinger
from model.identification.parameters import FINGER_PARTS, Space

_NOISE, _FLOOR = 0.01, 0.1


@dataclass(frozen=True, eq=False)
class SettledPattern:
    """A tone that has settled: time [s], frequency [Hz], and what it was played and measured with.

    bases (n,): amplitude of each ERA's base as commanded [m]; values (s,): acceleration at each
    sensor [m/s²], phases as exp(+i omega t); fingers: on the plate, as far as they are known.
    """

    time: float
    frequency: float
    bases: ComplexArray
    values: ComplexArray
    fingers: tuple[RestingFinger, ...] = ()

    @property
    def std(self) -> FloatArray:
        """Error of each real number of `numbers`, (2 s,)."""
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


@dataclass(frozen=True, eq=False)
class Touched:
    """The plate of a forward model under the fingers of one pattern.

    space: of the model, which has no fingers of its own; touched: the model with the fingers.
    """

    pattern: SettledPattern
    space: Space
    touched: ForwardModel

    @classmethod
    def of(cls, model: ForwardModel, pattern: SettledPattern, finger_std: float) -> "Touched":
        """A model under the fingers of a pattern, of loads known to finger_std (of logarithms)."""
        count = len(FINGER_PARTS) * len(pattern.fingers)
        names = tuple(f"finger part {number}" for number in range(count))
        bounds = np.full(count, np.inf)
        space, size = model.space, model.space.size
        wider = replace(
            space,
            names=space.names + names,
            std=np.concatenate([space.std, np.full(count, finger_std)]),
            lower=np.concatenate([space.lower, -bounds]),
            upper=np.concatenate([space.upper, bounds]),
            groups=space.groups | {"fingers": slice(size, size + count)},
        )
        touched = replace(
            model,
            frequencies=np.array([pattern.frequency]),
            fingers=pattern.fingers,
            space=wider,
            last_places={},
        )
        return cls(pattern, space, touched)

    def predicted(self, x: FloatArray, fingers: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Numbers that a pattern is expected to give (2 s,), and their derivatives (2 s, p + q).

        x (p,): of the plate; fingers (q,): of theirs.
        """
        plate = self.touched.at(np.concatenate([x, fingers]))
        values = plate.responses[0] @ self.pattern.bases
        J = np.einsum("snp,n->sp", jacobian(plate)[0], self.pattern.bases)
        return (
            np.concatenate([values.real, values.imag]),
            np.concatenate([J.real, J.imag]),
        )
