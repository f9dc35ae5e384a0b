"""The plate in time: modal equations of motion, solved exactly between changes of the drive.

    M q'' + C q' + K q = sum over ERAs of phi (k_b y + c y')

q are the coordinates of the reduced free plate, phi its shapes at an ERA, y the motion of the
ERA's base. M = I + sum m_b phi phi^T, K = diag(omega²) + sum k_b phi phi^T, C = C_s + sum c phi
phi^T. The first-order system is diagonalised once; the base moves in terms with closed-form
particular solutions (`sim.base_motion`), so no step size enters and no error grows with time.

Structural damping. The frequency domain uses a hysteretic stiffness (1 + i eta) diag(omega²),
which no causal equation in time has. C_s is its viscous equivalent: in the modes psi_j, omega_j of
the plate *on its ERAs*, C_s,jk = eta psi_j^T diag(omega²) psi_k / sqrt(omega_j omega_k). That is
positive semidefinite, and at every resonance of the supported plate it takes exactly the power that
the hysteretic one takes; a ratio eta/2 on the modes of the *free* plate would not, because the
springs' share of a mode's energy has no loss. What is left differs off resonance: with eta = 1 %
the steady accelerations of the paper's plate differ by at most 0.5 % (relative L2 over the plate,
40 to 500 Hz), in proportion to eta; deep nulls are moved a little, not filled.

Not modelled: large deflections, air, the ERAs' own dynamics beyond spring, damper and bolt mass,
rocking and drag at the bolts, and the impulse c times the jump that the damper would pass on if a
base jumped (ramp 0): displacement and velocity of the plate are continuous through every change.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import linalg

from model.actuator import Era
from model.arrays import ComplexArray, FloatArray
from model.assembly import era_positions
from model.errors import InputError
from model.reduction import ReducedPlate
from sim.base_motion import Term

_BLOCK = 256  # samples; the table of exponentials for one block is computed once
_NEGLIGIBLE = 1e-60  # modal amplitude far below anything measurable, above slow subnormal numbers


@dataclass(frozen=True, slots=True, eq=False)
class _Answer:
    """The particular solution q(t) = Im[(b0 + b1 tau) exp(i omega tau)], tau = t - term.start."""

    term: Term
    b0: ComplexArray
    b1: ComplexArray

    def state(self, time: float) -> FloatArray:
        """Displacement and velocity (2 r,) at a time [s]."""
        tau = time - self.term.start
        turn = np.exp(1j * self.term.omega * tau)
        q = self.b0 + self.b1 * tau
        return np.concatenate([q * turn, (self.b1 + 1j * self.term.omega * q) * turn]).imag


class Plant:
    """A reduced plate on its ERAs, vibrating in time.

    time [s] starts at rest where it is told to. Raises InputError for ERAs that do not hold the
    plate (fewer than three, or all in one line).
    """

    def __init__(self, reduced: ReducedPlate, eras: Sequence[Era], *, time: float = 0.0) -> None:
        self.time = time
        self._eras = tuple(eras)
        M, C, K = modal_matrices(reduced, eras)
        r = len(K)
        inverse = linalg.inv(M)
        A = np.block([[np.zeros((r, r)), np.eye(r)], [-inverse @ K, -inverse @ C]])
        eigenvalues, vectors = linalg.eig(A)
        inverse_vectors = linalg.inv(vectors)
        residual = np.abs((vectors * eigenvalues) @ inverse_vectors - A).max()
        if not residual < 1e-6 * np.abs(A).max():
            raise InputError(
                "the plate's equations of motion cannot be separated into modes: a mode is damped "
                "critically; change an ERA's damping by a per mille"
            )
        self._eigenvalues = eigenvalues
        self._vectors = vectors[:r]
        # (2r, n_eras): how a unit force at each ERA drives each eigenvector
        push = np.vstack([np.zeros((r, len(eras))), inverse @ reduced.at(era_positions(eras)).T])
        self._participation = inverse_vectors @ push
        # Eigenvectors come in conjugate pairs: one of a pair, twice, is both.
        half = eigenvalues.imag >= 0
        weight = np.where(eigenvalues[half].imag > 0, 2.0, 1.0)
        self._decay = eigenvalues[half]
        self._free_state = vectors[:, half] * weight
        self._free_acceleration = self._free_state[:r] * self._decay**2
        self._to_free = inverse_vectors[half]
        self._free = np.zeros(len(self._decay), dtype=complex)
        self._answers: list[list[_Answer]] = [[] for _ in eras]
        self._table_rate = 0.0
        self._table = np.zeros((0, 0))

    @property
    def state(self) -> tuple[FloatArray, FloatArray]:
        """Modal displacement and velocity (r,) each, now."""
        x = (self._free_state @ self._free).real
        for answer in self._active():
            x = x + answer.state(self.time)
        r = len(x) // 2
        return x[:r], x[r:]

    def set_input(self, era: int, terms: Sequence[Term]) -> None:
        """From now on the base of this ERA moves as these terms say; terms may start later."""
        before = [answer for answer in self._active() if answer in self._answers[era]]
        self._answers[era] = [self._solve(era, term) for term in terms if term.end > self.time]
        after = [answer for answer in self._active() if answer in self._answers[era]]
        self._exchange(before, after)

    def advance(
        self, to_time: float, *, sample_rate: float, shapes: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Let the plate vibrate until to_time [s]; times (n,) [s], accelerations (n, p) [m/s²].

        shapes (p, r): the reduced shapes at the points to measure at. Samples lie on the fixed grid
        k / sample_rate [Hz], those after the present time up to and including to_time.
        """
        first = np.floor(self.time * sample_rate) + 1
        last = np.floor(to_time * sample_rate)
        times = np.arange(first, last + 1) / sample_rate
        modal = np.empty((len(times), shapes.shape[1]))
        done = 0
        for boundary in self._boundaries(to_time):
            upto = int(np.searchsorted(times, boundary))
            self._sample(times[done:upto], modal[done:upto], sample_rate)
            done = upto
            self._pass(boundary)
        self._sample(times[done:], modal[done:], sample_rate)
        self._coast(to_time)
        return times, modal @ shapes.T

    def skip(self, to_time: float) -> None:
        """Let the plate vibrate until to_time [s] without looking at it."""
        for boundary in self._boundaries(to_time):
            self._pass(boundary)
        self._coast(to_time)

    def _active(self) -> list[_Answer]:
        return [
            answer
            for answers in self._answers
            for answer in answers
            if answer.term.start <= self.time < answer.term.end
        ]

    def _boundaries(self, to_time: float) -> list[float]:
        moments = {
            moment
            for answers in self._answers
            for answer in answers
            for moment in (answer.term.start, answer.term.end)
        }
        return sorted(moment for moment in moments if self.time < moment <= to_time)

    def _solve(self, era: int, term: Term) -> _Answer:
        """The particular solution for one term, by the eigenvectors."""
        k, c = self._eras[era].stiffness, self._eras[era].damping
        s = 1j * term.omega
        force0 = k * term.c0 + c * (term.c1 + s * term.c0)
        force1 = (k + c * s) * term.c1
        gap = s - self._eigenvalues
        a1 = self._participation[:, era] * force1 / gap
        a0 = (self._participation[:, era] * force0 - a1) / gap
        return _Answer(term, self._vectors @ a0, self._vectors @ a1)

    def _exchange(self, before: Sequence[_Answer], after: Sequence[_Answer]) -> None:
        """Replace particular solutions, and keep displacement and velocity as they are."""
        if before or after:
            jump = np.zeros(self._free_state.shape[0])
            for answer in before:
                jump += answer.state(self.time)
            for answer in after:
                jump -= answer.state(self.time)
            self._free = self._free + self._to_free @ jump

    def _coast(self, to_time: float) -> None:
        self._free = self._free * np.exp(self._decay * (to_time - self.time))
        self._free[np.abs(self._free) < _NEGLIGIBLE] = 0
        self.time = to_time

    def _pass(self, boundary: float) -> None:
        """Go to a moment at which terms start or end."""
        before = self._active()
        self._coast(boundary)
        after = self._active()
        self._exchange(
            [answer for answer in before if answer not in after],
            [answer for answer in after if answer not in before],
        )
        self._answers = [
            [answer for answer in answers if answer.term.end > boundary]
            for answers in self._answers
        ]

    def _sample(self, times: FloatArray, out: FloatArray, sample_rate: float) -> None:
        """Write modal accelerations (n, r) at times on the grid, the drive being what it is now."""
        if not len(times):
            return
        out[:] = 0
        if self._free.any():
            table = self._exponentials(sample_rate)
            for start in range(0, len(times), _BLOCK):
                block = times[start : start + _BLOCK]
                free = self._free * np.exp(self._decay * (block[0] - self.time))
                shapes = (self._free_acceleration * free).T
                out[start : start + _BLOCK] += table[: len(block)] @ np.vstack(
                    [shapes.real, shapes.imag]
                )
        active = self._active()
        if active:
            tau = times[:, None] - np.array([answer.term.start for answer in active])
            omega = np.array([answer.term.omega for answer in active])
            turn = np.exp(1j * omega * tau)
            b0 = np.array([answer.b0 for answer in active])
            b1 = np.array([answer.b1 for answer in active])
            s = 1j * omega[:, None]
            constant = s**2 * b0 + 2 * s * b1
            out += turn.real @ constant.imag + turn.imag @ constant.real
            if b1.any():
                rising = turn * tau
                growth = s**2 * b1
                out += rising.real @ growth.imag + rising.imag @ growth.real

    def _exponentials(self, sample_rate: float) -> FloatArray:
        """Re and -Im of exp(eigenvalue k / sample_rate) for k up to a block, (block, 2 m)."""
        if sample_rate != self._table_rate:
            grid = np.exp(np.outer(np.arange(_BLOCK) / sample_rate, self._decay))
            self._table = np.hstack([grid.real, -grid.imag])
            self._table_rate = sample_rate
        return self._table


def modal_matrices(
    reduced: ReducedPlate, eras: Sequence[Era]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """M, C, K (r, r) of the plate on its ERAs, in the coordinates of the reduced free plate."""
    phi = reduced.at(era_positions(eras))
    elastic = np.diag(reduced.omega**2)
    M = np.eye(len(reduced.omega)) + (phi.T * [era.bolt_mass for era in eras]) @ phi
    K = elastic + (phi.T * [era.stiffness for era in eras]) @ phi
    squares, psi = linalg.eigh(K, M)
    if squares[0] < 1.0:  # (rad/s)²: slower than one sway in six seconds is not held at all
        raise InputError(
            f"the plate does not stand on its {len(eras)} ERAs and would tip over; put at least "
            "three under it that do not lie in one line"
        )
    omega = np.sqrt(squares)
    viscous = reduced.plate.loss_factor * (psi.T @ elastic @ psi) / np.sqrt(np.outer(omega, omega))
    back = M @ psi
    C = back @ viscous @ back.T + (phi.T * [era.damping for era in eras]) @ phi
    return M, C, K
