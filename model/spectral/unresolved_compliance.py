"""Compliance of the plate in waves too short for its polynomials, under points and discs.

At a point, Legendre polynomials up to degree p resolve waves along x up to the wavenumber a = 2 (p
- 0.9) / (L s), s = sqrt(1 - (2 x / L - 1)²), and b along y. The compliance missing under a point
force is the infinite plate's in all shorter waves, the mean over all directions phi of

    1 / (4 pi D k²) + ln(k_max / k) / (2 pi S),    k = min(a / |cos phi|, b / |sin phi|),

with flexural rigidity D (for a board, in direction phi) and shear rigidity S. The square of a
Legendre polynomial oscillates along the plate, and so does the compliance missing in all higher
ones: at x = L (1 - cos t) / 2 it is 1 + o times as large in all waves that end at a, so a is
divided by sqrt(1 + o),

    o = cos(2 (p - 1) t) / ((p - 1) sin t).

It follows from P_n(cos t)² ~ (1 + sin((2 n + 1) t)) / (pi n sin t) for large n (Laplace's formula;
Szegő, Orthogonal Polynomials, 4th ed., section 8.21), summed with the weight n^-3 over n > p - 2,
since the curvature of a polynomial of degree p has degree p - 2.

At a free edge the compliance is larger. In a half-plane, the bending waves of wavenumber k along
the edge, under a force at a distance d from the edge, have

    1 + exp(-2 q) (F - 1 + G (q + q²)),    q = k d,
    F = 8 / ((1 - nu) (3 + nu)),    G = 2 (1 - nu) / (3 + nu),

times the infinite plate's compliance. This is the solution (A + B y) exp(-k y) of Kirchhoff's plate
equation without bending moment and Kirchhoff's shear force at the edge (Timoshenko and
Woinowsky-Krieger, Theory of Plates and Shells, 2nd ed., art. 22, free edge), added to the infinite
plate's (1 + |y - d| k) exp(-k |y - d|). Here it is averaged over all k above a or b. In shear an
edge is a mirror and doubles the compliance. A corner has images in both edges.

The shear part has no limit for a point and is cut off at k_max = 1 / h: plate theory does not hold
on a shorter scale. A disc limits it by itself.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.polynomial.legendre import leggauss
from scipy import special

from model.arrays import FloatArray, IntArray
from model.structure.footprints import as_footprints, mean_over
from model.structure.plate import Plate

# How far below its degree a polynomial resolves, against 1/2 for a string of free ends: fitted to
# the compliance of polynomials of degree 72 at 40 points of the paper's plate, within 10 %.
_UNRESOLVED = 0.9
_CURVATURE = 1  # the missing compliance oscillates as a polynomial this many degrees lower

# Bending at a corner, times the infinite plate's: there is no closed form, so the plate and its
# three images are counted like in shear. The error hardly matters, because polynomials resolve
# corners best: from degree 24 to 40, the compliance at a corner of the paper's plate grows by 2e-5.
_CORNER = 4.0
# Where a disc that is cut by an edge acts, from its center to the centroid of its part on the
# plate: the middle, chosen for the accuracy of `test_response_on_feet_is_that_of_fine_elements`.
_TO_CENTROID = 0.5
_LEAST_SINE = 1.5  # times 1 / p: nearer to its end a polynomial does not resolve ever finer
_DIRECTIONS = (np.arange(32) + 0.5) * np.pi / 64
_COS2, _SIN2 = np.cos(_DIRECTIONS) ** 2, np.sin(_DIRECTIONS) ** 2
_UNCERTAIN = 0.2  # relative; twice the error of the estimate
_ON_FOOT = 0.5  # lowest compliance of a disc, which an edge may cut, relative to a point's
# k d beyond which forces share no unresolved wave: the fourth zero of `_decay`. The shared
# compliance fades toward it, since a field with a step or a kink cannot be interpolated.
_FAR = 13.603179753989906

# Gauss points of ln t, t = 1 to 100, for integrals over dt / t: footprints leave little beyond.
_POINTS, _WEIGHTS = leggauss(48)
_LOG_T = math.log(100) / 2 * (1 + _POINTS)
_LOG_WEIGHTS = math.log(100) / 2 * _WEIGHTS


@dataclass(frozen=True, eq=False)
class UnresolvedCompliance:
    """Compliance under a force at n footprints [m] (n, 3), in bending and in shear [m/N] (n,).

    bending and shear are valid for points. wavenumber [1/m] (n,): lower limit of unresolved waves;
    decade [m/N] (n,): shear compliance of ten times shorter waves.
    """

    footprints: FloatArray
    bending: FloatArray
    shear: FloatArray
    wavenumber: FloatArray
    decade: FloatArray

    def shared_with(self, other: "UnresolvedCompliance") -> FloatArray:
        """Compliance [m/N] between these footprints and others of the plate, (n, m).

        Between two points it falls with their distance d as 2 ∫ J0(k d t) / t³ dt from t = 1 on; a
        footprint of radius a multiplies the integrand by 2 J1(k a t) / (k a t). Between points,
        shear is taken to fall as bending does: with its own ∫ J0(k d t) / t dt, the error stays at
        2 to 7 % of what higher degrees add up to 12 mm away.
        """
        offsets = self.footprints[:, None, :2] - other.footprints[:, :2]
        distances = np.hypot(*offsets.transpose(2, 0, 1))
        wavenumbers = np.sqrt(np.multiply.outer(self.wavenumber, other.wavenumber))
        compliance = np.zeros(distances.shape)
        i, j = np.nonzero(distances * wavenumbers < _FAR)
        k = wavenumbers[i, j]
        d = distances[i, j]
        bending = np.sqrt(self.bending[i] * other.bending[j])
        shear = np.sqrt(self.shear[i] * other.shear[j])
        near = (bending + shear) * _decay(k * d)
        radius = self.footprints[i, 2]
        other_radius = other.footprints[j, 2]
        on_discs = (radius > 0) | (other_radius > 0)
        if on_discs.any():
            factor, decades = _disc_factors(
                k[on_discs], d[on_discs], radius[on_discs], other_radius[on_discs]
            )
            decade = np.sqrt(self.decade[i] * other.decade[j])[on_discs]
            near[on_discs] = bending[on_discs] * factor + decade * decades
        compliance[i, j] = near * (1 - (k * d / _FAR) ** 4)
        return compliance

    def uncertainty(self, other: "UnresolvedCompliance") -> FloatArray:
        """Possible error [m/N] of the compliance between these footprints and others, (n, m).

        A fraction of the compliance. For a point (unlimited in shear), ten times shorter waves as
        well.
        """
        is_same = (self.footprints[:, None] == other.footprints).all(axis=2)
        is_same_point = is_same & (self.footprints[:, 2] == 0)[:, None]
        decade = np.sqrt(np.multiply.outer(self.decade, other.decade))
        return _UNCERTAIN * self.shared_with(other) + np.where(is_same_point, decade, 0.0)


def unresolved_at(
    plate: Plate, degrees: tuple[int, int], places: FloatArray
) -> UnresolvedCompliance:
    """Return the compliance of a plate that polynomials up to two degrees leave unresolved.

    places: footprints (n, 3) or points (n, 2).
    """
    footprints = as_footprints(places)
    points = footprints[:, :2]
    if footprints[:, 2].any():
        centroids = mean_over(np.asarray, footprints, length=plate.length, width=plate.width)
        points = points + _TO_CENTROID * (centroids - points)
    D = plate.flexural_rigidity
    sides = np.array([plate.length, plate.width])
    p = np.array(degrees)
    cosine = np.clip(1 - 2 * points / sides, -1, 1)
    sine = np.sqrt(np.maximum(1 - cosine**2, (_LEAST_SINE / p) ** 2))
    resolved = 2 * (p - _UNRESOLVED) / (sides * sine)  # a and b
    wave = p - _CURVATURE
    oscillation = np.cos(2 * wave * np.arccos(cosine)) / (wave * sine)
    missing = (1 + oscillation) / resolved**2
    inverse_wavenumbers2 = np.maximum(_COS2 * missing[:, :1], _SIN2 * missing[:, 1:])  # 1 / k²
    softness = D / plate.rigidity_towards(_COS2)  # 1 for isotropic materials
    mean_bending = (inverse_wavenumbers2 * softness).mean(axis=1)
    logarithm = np.log(np.maximum(1, inverse_wavenumbers2 / plate.thickness**2)).mean(axis=1) / 2
    # The edges across x are followed by waves along y.
    to_edge = np.maximum(np.minimum(points, sides - points), 0)
    nu = plate.material.nu
    F_less_1 = 8 / ((1 - nu) * (3 + nu)) - 1
    G = 2 * (1 - nu) / (3 + nu)
    edge = _edge_excess(2 * to_edge * resolved[:, ::-1], F_less_1, G)
    at_corner = edge.prod(axis=1) / F_less_1**2
    bending = 1 + edge.sum(axis=1) + (_CORNER - 1 - 2 * F_less_1) * at_corner
    images = (1 + edge / F_less_1).prod(axis=1)
    return UnresolvedCompliance(
        footprints=footprints,
        bending=bending * mean_bending / (4 * np.pi * D),
        shear=images * logarithm / (2 * np.pi * plate.shear_rigidity),
        wavenumber=inverse_wavenumbers2.mean(axis=1) ** -0.5,
        decade=images * math.log(10) / (2 * np.pi * plate.shear_rigidity),
    )


def edge_compliance(plate: Plate, side: float, degrees: IntArray, foot: float) -> FloatArray:
    """Unresolved compliance [m/N] in the middle of a free edge of a length, by degree, (n,).

    side [m]; degrees (n,): along it, odd and even ones alike; foot [m]: radius of a disc there.
    """
    nu = plate.material.nu
    resolved = 2 * (degrees - _UNRESOLVED) / side  # of directions phi, over |cos phi|
    bending = 1 / ((1 - nu) * (3 + nu) * np.pi * plate.flexural_rigidity * resolved**2)
    decade = math.log(10) / (np.pi * plate.shear_rigidity)
    decades = np.log10(np.maximum(1, 1 / (2 * plate.thickness * resolved)))
    at_point = bending + decade * decades
    if not foot:
        return at_point
    radii = np.full(len(degrees), foot)
    factor, decades = _disc_factors(
        np.asarray(math.sqrt(2) * resolved), np.zeros(len(degrees)), radii, radii
    )
    return np.maximum(bending * factor + decade * decades, _ON_FOOT * at_point)


def _disc_factors(
    k: FloatArray, d: FloatArray, radius: FloatArray, other_radius: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the factor of two discs (n,) on the compliance in bending, and the decades in shear.

    k (n,): lower limit of unresolved waves [1/m]; d (n,): distance of the discs, with radii [m].
    """
    t = np.exp(_LOG_T)
    waves = special.j0(np.multiply.outer(k * d, t))
    for a in (radius, other_radius):
        z = np.maximum(np.multiply.outer(k * a, t), 1e-9)
        waves *= 2 * special.j1(z) / z
    return waves @ (2 * _LOG_WEIGHTS / t**2), waves @ _LOG_WEIGHTS / math.log(10)


def _edge_excess(z: FloatArray, F_less_1: float, G: float) -> FloatArray:
    """Mean of exp(-2 q) (F - 1 + G (q + q²)) over q = z t / 2, t >= 1, with the weight 2 / t³."""
    z = np.maximum(z, 1e-9)
    e1, e2, e3 = (special.expn(order, z) for order in (1, 2, 3))
    return 2 * (F_less_1 * e3 + G * (z / 2 * e2 + z**2 / 4 * e1))


def _decay(z: FloatArray) -> FloatArray:
    """2 ∫ J0(z t) / t³ dt from 1 to infinity."""
    z = np.maximum(z, 1e-9)
    first = special.it2j0y0(z)[0] - np.euler_gamma - np.log(z / 2)  # of J0(z t) / t
    return special.j0(z) - z / 2 * (special.j1(z) + z * first)
