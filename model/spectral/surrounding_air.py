"""Added mass of the air around a plate, between the Legendre polynomials of its deflection.

Sound waves are much longer than the plate's bending waves, so air flows as if it were
incompressible, and loads the plate as a mass. In front of a plate that is flush with a rigid
surface around it, the pressure is Rayleigh's integral, and the mass between deflections w and w' is

    M = rho / (2 pi) sum w(x) w'(x') / |x - x'|    over all x and x' on the plate.

Around a plate with free edges, air flows from one side to the other. The potential of the flow
jumps by D between the sides, is continuous around the plate, and

    A D = w,    A = 1 / (4 pi) sum grad D(x) grad D(x') / |x - x'|,    M = rho w D

(as for rigid plates in Meyerhoff, J. Ship Res. 14 (1970) 100). D is zero at the edges: a sum of
P_(k+1) - P_(k-1), whose slopes are P_k. Short bending waves of wavenumber k have rho / k on each
side in both cases.

1 / r is 2 / sqrt(pi) times the integral of exp(-r² s²) over s. Only integrals along x and along y
between Legendre polynomials remain. Their product falls as 1 / s², which gives the rest of the
integral over s.

Radiated sound is neglected. Its loss factor is at most 0.5 % for a flush plate of 30 cm at 80 Hz.
"""

import math
from functools import lru_cache

import numpy as np
from numpy.polynomial.legendre import leggauss, legvander

from model.arrays import FloatArray
from model.spectral.polynomials import EVEN, first_degree
from model.structure.plate import AIR_DENSITY, Plate, SurroundingAir

# With these, the error is 1 % of the added mass of the paper's modes.
_LEAST_DEGREE = 36  # of jumps of the potential
_FURTHER_DEGREES = 8  # of these jumps beyond the deflection's
_POINTS_PER_DEGREE = 5
_RATES_PER_STEP, _STEP = 5, 1.7  # Gauss points of s, and ratio of the ends of a step
_HIGHEST_RATE = 0.75  # of s, in points per side


@lru_cache(maxsize=16)
def added_mass(
    air: SurroundingAir,
    sides: tuple[float, float],
    degrees: tuple[int, int],
    parity: tuple[int, int],
) -> FloatArray:
    """Added mass [kg/m²] between the orthonormal polynomials of a symmetry class, (m, m).

    sides [m]; degrees: highest along x and along y.
    """
    highest = max(degrees)
    if air is SurroundingAir.BOTH:
        highest = max(_LEAST_DEGREE, highest + _FURTHER_DEGREES)
    integrals = _integrals(sides, highest)
    of_x, of_y = (
        np.eye(degree + 1, highest + 1)[first_degree(of_side) :: 2]
        for degree, of_side in zip(degrees, parity, strict=True)
    )
    if air is SurroundingAir.FRONT:
        mass = integrals.between(of_x, of_y)
    else:
        jumps_x, slopes_x = _jumps(sides[0], highest, parity[0])
        jumps_y, slopes_y = _jumps(sides[1], highest, parity[1])
        by_jump = integrals.between(slopes_x, jumps_y) + integrals.between(jumps_x, slopes_y)
        moved = np.kron(jumps_x @ of_x.T, jumps_y @ of_y.T)
        mass = np.asarray(moved.T @ np.linalg.solve(by_jump / 2, moved), dtype=float)
    symmetric = AIR_DENSITY * (mass + mass.T) / 2
    symmetric.setflags(write=False)  # cached, and so shared
    return np.asarray(symmetric)


def heave_mass(plate: Plate) -> float:
    """Added mass [kg] of a plate that moves up and down as a rigid body."""
    if plate.air is None:
        return 0.0
    per_area = added_mass(plate.air, (plate.length, plate.width), (0, 0), (EVEN, EVEN))
    return float(per_area[0, 0] * plate.length * plate.width)


def _jumps(length: float, highest: int, parity: int) -> tuple[FloatArray, FloatArray]:
    """Return functions of a parity that are zero at both ends, and their slopes, both (n, degrees).

    In orthonormal polynomials up to the highest degree.
    """
    norms = np.sqrt((2 * np.arange(highest + 1) + 1) / length)
    slope_degrees = np.arange(1 if parity == EVEN else 2, highest, 2)
    rows = np.arange(len(slope_degrees))
    functions = np.zeros((len(rows), highest + 1))
    functions[rows, slope_degrees + 1] = 1 / norms[slope_degrees + 1]
    functions[rows, slope_degrees - 1] = -1 / norms[slope_degrees - 1]
    slopes = np.zeros_like(functions)
    slopes[rows, slope_degrees] = 2 * norms[slope_degrees]
    return functions, slopes


class _Integrals:
    """Integrals of products of polynomials up to a degree over 2 pi |x - x'|, on sides [m]."""

    def __init__(self, sides: tuple[float, float], degree: int) -> None:
        count = _POINTS_PER_DEGREE * max(degree, _LEAST_DEGREE)
        ends = [0.0, 1 / max(sides)]
        last = _HIGHEST_RATE * count / max(sides)
        while ends[-1] < last:
            ends.append(_STEP * ends[-1])
        points, weights = leggauss(_RATES_PER_STEP)
        steps = np.diff(ends)[:, None]
        rates = np.ravel(np.array(ends[:-1])[:, None] + steps * (1 + points) / 2)
        self._last = ends[-1]
        self._weights = np.ravel(steps * weights / 2)
        self._along = [_grams(side, degree, count, [*rates, ends[-1]]) for side in sides]

    def between(self, of_x: FloatArray, of_y: FloatArray) -> FloatArray:
        """Integrals between products of functions (m, degrees) of x and (n, degrees) of y."""
        along_x, along_y = self._along
        total = np.zeros((len(of_x) * len(of_y),) * 2)
        for weight, gram_x, gram_y in zip(self._weights, along_x, along_y, strict=False):
            total += weight * np.kron(of_x @ gram_x @ of_x.T, of_y @ gram_y @ of_y.T)
        at_last = np.kron(of_x @ along_x[-1] @ of_x.T, of_y @ along_y[-1] @ of_y.T)
        # The product tends to pi / s² + c / s³ between orthonormal functions.
        limit = math.pi * np.kron(of_x @ of_x.T, of_y @ of_y.T)
        total += (limit + at_last * self._last**2) / (2 * self._last)
        return np.asarray(total / math.pi**1.5)


_integrals = lru_cache(maxsize=4)(_Integrals)


def _grams(length: float, degree: int, count: int, rates: list[float]) -> list[FloatArray]:
    """Integrals of exp(-s² (x - x')²) between orthonormal polynomials, for rates s [1/m]."""
    points, weights = leggauss(count)
    x = length * (1 + points) / 2
    norms = np.sqrt((2 * np.arange(degree + 1) + 1) / length)
    weighted = legvander(points, degree) * norms * (length * weights / 2)[:, None]
    squares = np.subtract.outer(x, x) ** 2
    return [weighted.T @ np.exp(-(rate**2) * squares) @ weighted for rate in rates]
