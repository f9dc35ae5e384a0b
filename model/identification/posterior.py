"""Covariance of identified parameters, and what it leaves unknown of what answers depend on.

The scale of mass, springs and dampers together changes no response to a moving base, that of all
drives no contrast. What counts is each natural frequency, each spring and damper relative to the
plate's mass, each gain relative to the others, and for levels all gains together: a response tells
only their product with those of the sensors.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import linalg

from model.arrays import FloatArray
from model.identification.least_squares import Linearization
from model.identification.parameters import KINDS, Space
from model.rig.uncertainty import Uncertainty

_THEORY = {
    "frequency": KINDS["mode_shifts"].theory / 2,
    "stiffness": KINDS["stiffness"].theory,
    "damping": KINDS["damping_each"].theory,
    "place": KINDS["place"].theory,
}


@dataclass(frozen=True, eq=False)
class Posterior:
    """Normal distribution of x (p,) with a covariance (p, p)."""

    space: Space
    x: FloatArray
    covariance: FloatArray

    @classmethod
    def of(cls, space: Space, best: Linearization) -> "Posterior":
        """That about the most likely parameters: (J^T J + 1)^-1, known ones without variance."""
        free = np.flatnonzero(space.uncertain)
        covariance = np.zeros((space.size, space.size))
        covariance[np.ix_(free, free)] = linalg.inv(best.information[np.ix_(free, free)])
        return cls(space, best.x, covariance)

    def within(self, space: Space) -> "Posterior":
        """The same in a space with further parameters, which are 0 and without variance."""
        own = [space.index(name) for name in self.space.names]
        x, covariance = np.zeros(space.size), np.zeros((space.size, space.size))
        x[own] = self.x
        covariance[np.ix_(own, own)] = self.covariance
        return Posterior(space, x, covariance)

    @cached_property
    def std(self) -> FloatArray:
        """Standard deviation of each parameter in its unit (p,)."""
        return np.asarray(self.space.std * np.sqrt(np.diagonal(self.covariance)))

    def std_of(self, combinations: FloatArray) -> FloatArray:
        """Standard deviations of linear combinations (m, p) of parameters in their units, (m,)."""
        scaled = combinations * self.space.std
        return np.asarray(np.sqrt(np.einsum("mp,pq,mq->m", scaled, self.covariance, scaled)))

    def stds(self) -> dict[str, FloatArray]:
        """Standard deviations of what answers depend on, with those of the theory, by kind."""
        own = {kind: self.std_of(rows) for kind, rows in relevant(self.space).items()}
        own["place"] = self.std[self.space.groups["place"]]
        return {
            kind: np.where(std > 0, np.hypot(std, _THEORY.get(kind, 0.0)), 0.0)
            for kind, std in own.items()
        }

    def uncertainty(
        self, before: Uncertainty, *, gain: float, phase_deg: float, field: float
    ) -> Uncertainty:
        """What a rig states of itself after it was identified.

        before: its own, of which fingers and harmonics stay; its common_gain, which no fit narrows,
        counts beside what is unknown of the gains' mean. gain, phase_deg: how far drives repeat;
        field: what the model leaves unexplained of fields, relative.
        """
        mean = _rows(self.space, "gain").mean(axis=0, keepdims=True)
        rms = {kind: _rms(std) for kind, std in self.stds().items()}
        damping = max(rms["damping"], rms["loss"])
        return Uncertainty.clipped(
            gain=math.hypot(rms["gain"], gain),
            phase_deg=math.hypot(math.degrees(rms["phase"]), phase_deg),
            **Uncertainty.of_frequency(rms["frequency"]),
            stiffness=rms["stiffness"],
            damping=math.exp(damping),
            fingertip=before.fingertip,
            common_gain=math.hypot(before.common_gain, self.std_of(mean)[0]),
            field=field,
            place=rms["place"],
            harmonic=before.harmonic,
            supports=_rms(self.std[self.space.groups["supports"]]),
        )


def relevant(space: Space) -> dict[str, FloatArray]:
    """Combinations (m, p) of the parameters that answers depend on, by name."""
    mass = _rows(space, "thickness")
    by_rigidity = mass + _rows(space, "modulus") / 2
    gain, phase = _rows(space, "gain"), _rows(space, "phase")
    damping = _rows(space, "damping_each") + _rows(space, "damping") - mass
    factor = space.groups["force_factor"]
    if factor.stop > factor.start:
        # An exciter damps and pushes by its coil: the share of its suspension shows little alone.
        damping = damping[space.std[factor] == 0]
        gain = gain + _rows(space, "force_factor")
    return {
        "frequency": by_rigidity + _rows(space, "mode_shifts") / 2,
        "stiffness": _rows(space, "stiffness") - mass,
        "damping": damping,
        "loss": _rows(space, "loss") + _rows(space, "mode_losses"),
        "gain": gain - gain.mean(axis=0),
        "phase": phase - phase.mean(axis=0),
    }


def _rows(space: Space, kind: str) -> FloatArray:
    """One row for each parameter of a kind, (m, p)."""
    return np.eye(space.size)[space.groups[kind]]


def _rms(values: FloatArray) -> float:
    return float(np.sqrt((values**2).mean())) if len(values) else 0.0
