"""Problem for all programs: a free plate on four ERAs, 27 frequencies, each ERA driven alone."""

from dataclasses import dataclass

import numpy as np

from model.arrays import ComplexArray, FloatArray
from model.structure.material import Material
from model.structure.plate import Plate

ALUMINIUM = Material("aluminium", E=70e9, rho=2700.0, nu=0.33)
GLASS = Material("glass", E=72e9, rho=2500.0, nu=0.23)

STIFFNESS, DAMPING, STROKE = 17000.0, 3.4631, 1e-4
"""Values of each ERA on the paper's plate [N/m, N s/m, m]."""

CORNERS = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)])
"""Positions as fractions of the plate's sides."""

OTHERS = (
    np.array([(0.25, 0.25), (0.75, 0.25), (0.5, 0.5), (0.0, 0.75)]),
    np.array([(0.3, 0.0), (0.61, 1.0), (0.0, 0.44), (1.0, 0.72)]),
    np.array([(0.13, 0.18), (0.82, 0.31), (0.57, 0.86), (0.22, 0.66)]),
)
"""Further layouts, with positions inside and on edges, for errors."""


@dataclass(frozen=True)
class Case:
    """A plate on four ERAs up to a frequency [Hz], each on a disc of radius foot [m] or a point."""

    name: str
    plate: Plate
    highest: float
    foot: float = 0.0

    @property
    def frequencies(self) -> FloatArray:
        """27 frequencies [Hz]."""
        return np.linspace(60.0, self.highest, 27)

    @property
    def omega(self) -> FloatArray:
        """The same in rad/s."""
        return 2 * np.pi * self.frequencies

    @property
    def points(self) -> FloatArray:
        """Twenty points (20, 2) [m] at which the acceleration is computed."""
        shares = np.random.default_rng(1).uniform(0.03, 0.97, (20, 2))
        return np.asarray(shares * [self.plate.length, self.plate.width])

    def footprints(self, shares: FloatArray) -> FloatArray:
        """Footprints x, y, radius [m] (n, 3) of ERAs at shares (n, 2) of the sides."""
        places = shares * [self.plate.length, self.plate.width]
        return np.column_stack([places, np.full(len(places), self.foot)])


PAPER = Case("paper's plate", Plate(0.3048, 0.2286, 0.0015, ALUMINIUM), 320.0)
PAPER_ON_FEET = Case("paper's plate on feet of 5 mm", PAPER.plate, 320.0, foot=0.005)
CAR = Case("car cover glass, 530 x 300 x 1.1 mm", Plate(0.53, 0.30, 0.0011, GLASS), 320.0)
TABLE = Case("table, 1200 x 800 x 4 mm glass", Plate(1.2, 0.8, 0.004, GLASS), 500.0)


def accelerations(case: Case, between: ComplexArray, to_points: ComplexArray) -> ComplexArray:
    """Acceleration (f, eras, p) [m/s²] on ERAs from receptances of the free plate.

    between (f, n, n) and to_points (f, n, p) [m/N]: of n places, the ERAs'.
    """
    omega = case.omega[:, None, None]
    stiffness = STIFFNESS + 1j * omega * DAMPING
    one = np.eye(between.shape[1])
    forces = np.linalg.solve(one + stiffness * between, stiffness * STROKE * one)
    return np.asarray(-(omega**2) * (forces.swapaxes(1, 2) @ to_points))


def difference(found: ComplexArray, expected: ComplexArray) -> float:
    """Relative L2 error over frequencies, ERAs and points."""
    return float(np.linalg.norm(found - expected) / np.linalg.norm(expected))
