"""A linear system sampled exactly, many samples by one product of a matrix.

The input is straight between samples (a hold of first order; one of zeroth order would be half a
sample late). In the eigenvectors of the system every mode is advanced exactly. With L samples in a
block one real matrix takes [state, L inputs] to [state, L outputs].
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import linalg

from benchmarks.desk_plate.model_in_time import ModelInTime
from model.arrays import ComplexArray, FloatArray

SAMPLES = 16
"""In a product: larger matrices leave the cache."""


@dataclass(frozen=True, eq=False)
class SampledModel:
    """z[n + 1] = E z[n] + B u[n], a[n] = Re(C z[n]) + D u[n], of the modes with Im >= 0.

    E (m,), B (m, inputs), C (outputs, m), D (outputs, inputs); rate [Hz]. to_modes (m, n): of a
    state x without input; to_state (n, m): x is the real part.
    """

    E: ComplexArray
    B: ComplexArray
    C: ComplexArray
    D: FloatArray
    rate: float
    to_modes: ComplexArray
    to_state: ComplexArray

    def response(self, frequencies: FloatArray) -> ComplexArray:
        """Closed-form response of the samples at frequencies [Hz], (f, outputs, inputs)."""
        z = np.exp(2j * np.pi * np.asarray(frequencies) / self.rate)[:, None, None]
        both = (
            C * (1 / (z - E)) @ B
            for E, B, C in (
                (self.E, self.B, self.C),
                (self.E.conj(), self.B.conj(), self.C.conj()),
            )
        )
        return np.asarray(sum(both) / 2 + self.D)

    def outputs(self, history: FloatArray) -> FloatArray:
        """Accelerations (n, outputs) at the samples of a history (n, state + inputs)."""
        m = len(self.E)
        states = history[:, :m] + 1j * history[:, m : 2 * m]
        return np.asarray((states @ self.C.T).real + history[:, 2 * m :] @ self.D.T)

    @cached_property
    def lifted(self) -> FloatArray:
        """The matrix of a block: (state + SAMPLES outputs, state + SAMPLES inputs)."""
        m, (outputs, inputs) = len(self.E), self.D.shape
        powers = self.E ** np.arange(SAMPLES + 1)[:, None]
        state, n_in, n_out = 2 * m, SAMPLES * inputs, SAMPLES * outputs
        found = np.zeros((state + n_out, state + n_in))
        last = np.diag(powers[SAMPLES])
        found[:state, :state] = np.block([[last.real, -last.imag], [last.imag, last.real]])
        for n in range(SAMPLES):
            column = state + inputs * n
            arriving = powers[SAMPLES - 1 - n][:, None] * self.B
            found[:state, column : column + inputs] = np.vstack([arriving.real, arriving.imag])
            row = state + outputs * n
            leaving = self.C * powers[n]
            found[row : row + outputs, :state] = np.hstack([leaving.real, -leaving.imag])
            for later in range(n, SAMPLES):
                to = state + outputs * later
                pulse = self.D if later == n else ((self.C * powers[later - n - 1]) @ self.B).real
                found[to : to + outputs, column : column + inputs] = pulse
        return found


def sampled(model: ModelInTime, *, rate: float) -> SampledModel:
    """Sample a model at a rate [Hz].

    With phi1 = (e - 1) / s, phi2 = (e - 1 - s T) / (s² T), e = exp(s T), of an eigenvalue s, and
    z[n] less phi2 b u[n] as the state, the sample of u at n + 1 is not needed at n.
    """
    values, vectors = linalg.eig(model.A)
    inverse = linalg.inv(vectors)
    upper = values.imag >= 0
    double = np.where(values.imag > 0, 2.0, 1.0)[upper]
    s, step = values[upper], 1 / rate
    e = np.exp(s * step)
    phi1 = np.expm1(s * step) / s
    phi2 = (phi1 - step) / (s * step)
    b = inverse[upper] @ model.B
    to_state = vectors[:, upper] * double
    c = model.C @ to_state
    B = (e * phi2 + phi1 - phi2)[:, None] * b
    D = ((c * phi2) @ b).real
    return SampledModel(e, B, c, D, rate, inverse[upper], to_state)


class LiftedBlocks:
    """Advances a sampled model from rest, in multiples of SAMPLES samples.

    history: where, if anywhere, the state and the input (state + inputs,) at the first sample of
    each SAMPLES are left from now on.
    """

    def __init__(self, model: SampledModel) -> None:
        self._model = model
        self._lifted = model.lifted
        self._state = np.zeros(2 * len(model.E))
        self.history: list[FloatArray] | None = None

    def advance(self, samples: FloatArray) -> FloatArray:
        """Accelerations (n, outputs) for samples (n, inputs); n a multiple of SAMPLES."""
        size, (outputs, inputs) = len(self._state), self._model.D.shape
        rows = np.ascontiguousarray(samples, dtype=float).reshape(-1, SAMPLES * inputs)
        found = np.empty((len(rows), SAMPLES * outputs))
        for row, into in zip(rows, found, strict=True):
            if self.history is not None:
                self.history.append(np.concatenate([self._state, row[:inputs]]))
            after = self._lifted @ np.concatenate([self._state, row])
            self._state, into[:] = after[:size], after[size:]
        return found.reshape(-1, outputs)

    def carry_on(self, before: "LiftedBlocks", count: int) -> None:
        """Continue from another model whose first states (count,) are the same; the rest is zero.

        What the last sample adds within its interval is left out.
        """
        m = len(before._model.E)
        x = (before._model.to_state @ (before._state[:m] + 1j * before._state[m:])).real
        modes = self._model.to_modes[:, :count] @ x[:count]
        self._state = np.concatenate([modes.real, modes.imag])
