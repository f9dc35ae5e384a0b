"""Compliance under a point force that polynomials of limited degree cannot represent.

At a point, Legendre polynomials up to degree p resolve waves along x up to the wavenumber
a = 2 (p - 0.9) / (L s), s = sqrt(1 - (2 x / L - 1)²), and b along y. Missing is the infinite
plate's compliance in all shorter waves, the mean over all directions phi of

    1 / (4 pi D k²) + ln(k_max / k) / (2 pi S),    k = min(a / |cos phi|, b / |sin phi|),

D the flexural rigidity, of a board that towards phi, and S the shear rigidity. The square of a
Legendre polynomial waves along the plate, and so does what is missing in all higher ones: at
x = L (1 - cos t) / 2 there is 1 + o times as much in all waves that end at a, so that a is to be
divided by sqrt(1 + o),

    o = cos(2 (p - 1) t) / ((p - 1) sin t).

It follows from P_n(cos t)² ~ (1 + sin((2 n + 1) t)) / (pi n sin t) for large n, summed with the
weight n^-3 over n > p - 2, since the curvature of a polynomial of degree p has degree p - 2.

At a free edge the compliance is larger. A wave that runs along the
edge with wavenumber k, for a force at a distance d from it, has the closed form of a half-plane,

    1 + exp(-2 q) (F - 1 + G (q + q²)),    q = k d,
    F = 8 / ((1 - nu) (3 + nu)),    G = 2 (1 - nu) / (3 + nu),

times the infinite plate's compliance, averaged here over all k above a or b. The shear part without
limit is cut for a point at k_max = 1 / h: on a shorter scale a plate is no plate. A disc limits it
itself.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.polynomial.legendre import leggauss
from scipy import special

from model.arrays import FloatArray, IntArray
from model.structure.footprint import as_footprints, mean_over
from model.structure.plate import Plate

# How far below its degree a polynomial resolves, against 1/2 for a string of free ends: fitted to
# the compliance of polynomials of degree 72 at 40 places of the paper's plate, within 10 %.
_UNRESOLVED = 0.9
_CURVATURE = 1  # how far below it the wave of what is missing is

_CORNER = 4.0  # bending at a corner, times the infinite plate's
_TO_CENTROID = 0.5  # where a disc that is cut by an edge acts, between its centre and its centroid
_LEAST_SINE = 1.5  # times 1 / p: nearest to its end that a polynomial resolves ever finer
_DIRECTIONS = (np.arange(32) + 0.5) * np.pi / 64
_COS2, _SIN2 = np.cos(_DIRECTIONS) ** 2, np.sin(_DIRECTIONS) ** 2
_UNCERTAIN = 0.2  # share by which it may be higher: twice its error, for the estimate of errors
_ON_FOOT = 0.5  # least share of a point's that is taken for a disc, which an edge may cut
# k d beyond which forces share no unresolved wave: the fourth zero of `_decay`. What they share
# fades towards it, since a field that ends in a step or a kink cannot be interpolated.
_FAR = 13.603179753989906

# Gauss points of ln t, t = 1 to 100, for integrals over dt / t: footprints leave little beyond.
_POINTS, _WEIGHTS = leggauss(48)
_LOG_T = math.log(100) / 2 * (1 + _POINTS)
_LOG_WEIGHTS = math.log(100) / 2 * _WEIGHTS


def local_compliance(
    plate: Plate, degrees: tuple[int, int], places: FloatArray, others: FloatArray
) -> FloatArray:
    """Unresolved compliance [m/N] between footprints [m] (n, 3) and others (m, 3), (n, m).

    Also of points (n, 2). Between two points it falls with their distance d as 2 ∫ J0(k d t) / t³
    dt from t = 1 on; a footprint of radius a multiplies the integrand by 2 J1(k a t) / (k a t).
    """
    own, other = (unresolved_at(plate, degrees, each) for each in (places, others))
    return compliance_between(plate, own, other)


@dataclass(frozen=True, eq=False)
class UnresolvedCompliance:
    """At n footprints [m] (n, 3): compliance of a point force in bending and in shear [m/N] (n,).

    wavenumber [1/m] (n,): where it begins; decade [m/N] (n,): of shear in ten times shorter waves.
    """

    footprints: FloatArray
    bending: FloatArray
    shear: FloatArray
    wavenumber: FloatArray
    decade: FloatArray


def compliance_between(
    plate: Plate, own: UnresolvedCompliance, other: UnresolvedCompliance
) -> FloatArray:
    """Unresolved compliance [m/N] (n, m); see `local_compliance`."""
    places, others = own.footprints, other.footprints
    distance = np.hypot(*(places[:, None, :2] - others[:, :2]).transpose(2, 0, 1))
    wavenumber = np.sqrt(np.multiply.outer(own.wavenumber, other.wavenumber))
    result = np.zeros(distance.shape)
    i, j = np.nonzero(distance * wavenumber < _FAR)
    k, d = wavenumber[i, j], distance[i, j]
    bending = np.sqrt(own.bending[i] * other.bending[j])
    shear = np.sqrt(own.shear[i] * other.shear[j])
    radii = places[i, 2], others[j, 2]
    on_discs = (radii[0] > 0) | (radii[1] > 0)
    result[i, j] = (bending + shear) * _decay(k * d)
    if on_discs.any():
        footprints = [each[on_discs] for each in (k, d, *radii)]
        share, decades = _on_discs(*footprints)
        decade = np.sqrt(own.decade[i] * other.decade[j])[on_discs]
        result[i[on_discs], j[on_discs]] = bending[on_discs] * share + decade * decades
    result[i, j] *= 1 - (k * d / _FAR) ** 4
    return result


def edge_compliance(plate: Plate, side: float, degrees: IntArray, foot: float) -> FloatArray:
    """Unresolved compliance [m/N] in the middle of a free edge of a length, by degree, (n,).

    side [m]; degrees (n,): along it, odd and even ones alike; foot [m]: radius of a disc there.
    """
    D, nu = plate.flexural_rigidity, plate.material.nu
    resolved = 2 * (degrees - _UNRESOLVED) / side  # of directions phi, over |cos phi|
    bending = 1 / ((1 - nu) * (3 + nu) * np.pi * D * resolved**2)
    decade = math.log(10) / (np.pi * plate.shear_rigidity)
    decades = np.log10(np.maximum(1, 1 / (2 * plate.thickness * resolved)))
    at_point = bending + decade * decades
    if not foot:
        return np.asarray(at_point)
    radii = np.full(len(degrees), foot)
    share, decades = _on_discs(
        np.asarray(math.sqrt(2) * resolved), np.zeros(len(degrees)), radii, radii
    )
    return np.asarray(np.maximum(bending * share + decade * decades, _ON_FOOT * at_point))


def uncertain_compliance(
    plate: Plate, own: UnresolvedCompliance, other: UnresolvedCompliance
) -> FloatArray:
    """By how much the unresolved compliance may be too low [m/N] (n, m).

    A share of it, and for a point, of which shear has no limit, ten times shorter waves.
    """
    same = (own.footprints[:, None] == other.footprints).all(axis=2)
    points = same & (own.footprints[:, 2] == 0)[:, None]
    decade = np.where(points, np.sqrt(np.multiply.outer(own.decade, other.decade)), 0.0)
    return np.asarray(_UNCERTAIN * compliance_between(plate, own, other) + decade)


def unresolved_at(
    plate: Plate, degrees: tuple[int, int], places: FloatArray
) -> UnresolvedCompliance:
    """What polynomials of these degrees do not resolve at footprints (n, 3) or points (n, 2)."""
    places = as_footprints(places)
    points = places[:, :2]
    if places[:, 2].any():
        centroids = mean_over(np.asarray, places, length=plate.length, width=plate.width)
        points = points + _TO_CENTROID * (centroids - points)
    D, nu, h = plate.flexural_rigidity, plate.material.nu, plate.thickness
    sides = np.array([plate.length, plate.width])
    p = np.array(degrees)
    cosine = np.clip(1 - 2 * points / sides, -1, 1)
    sine = np.sqrt(np.maximum(1 - cosine**2, (_LEAST_SINE / p) ** 2))
    resolved = 2 * (p - _UNRESOLVED) / (sides * sine)
    wave = p - _CURVATURE
    excess = 1 + np.cos(2 * wave * np.arccos(cosine)) / (wave * sine)
    to_edge = np.maximum(np.minimum(points, sides - points), 0)
    # Of waves along the edge x = 0, whose distance is along x.
    missing = excess / resolved**2
    wavelengths2 = np.maximum(_COS2 * missing[:, :1], _SIN2 * missing[:, 1:])
    ratio_at_edge = 8 / ((1 - nu) * (3 + nu)) - 1
    edge = _edge_excess(2 * to_edge * resolved[:, ::-1], ratio_at_edge, 2 * (1 - nu) / (3 + nu))
    at_corner = edge.prod(axis=1) / ratio_at_edge**2
    bending = 1 + edge.sum(axis=1) + (_CORNER - 1 - 2 * ratio_at_edge) * at_corner
    mean = wavelengths2.mean(axis=1)
    softness = D / plate.rigidity_towards(_COS2)  # 1 of what is the same in all directions
    logarithm = np.log(np.maximum(1, wavelengths2 / h**2)).mean(axis=1) / 2
    images = (1 + edge / ratio_at_edge).prod(axis=1)
    return UnresolvedCompliance(
        places,
        bending * (wavelengths2 * softness).mean(axis=1) / (4 * np.pi * D),
        images * logarithm / (2 * np.pi * plate.shear_rigidity),
        mean**-0.5,
        images * math.log(10) / (2 * np.pi * plate.shear_rigidity),
    )


def _on_discs(
    k: FloatArray, d: FloatArray, a: FloatArray, b: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """What footprints leave (n,): a share of the compliance in bending, and decades in shear.

    k (n,): where it begins [1/m]; d (n,): distance of two footprints with radii a and b [m].
    """
    t = np.exp(_LOG_T)
    discs = special.j0(np.multiply.outer(k * d, t))
    for radius in (a, b):
        z = np.maximum(np.multiply.outer(k * radius, t), 1e-9)
        discs *= 2 * special.j1(z) / z
    return discs @ (2 * _LOG_WEIGHTS / t**2), discs @ _LOG_WEIGHTS / math.log(10)


def _edge_excess(z: FloatArray, ratio: float, further: float) -> FloatArray:
    """Mean of exp(-q) (ratio + further (q/2 + q²/4)) over q = z t, t >= 1, weighted with 2 / t³."""
    z = np.maximum(z, 1e-9)
    e1, e2, e3 = (special.expn(order, z) for order in (1, 2, 3))
    return np.asarray(2 * (ratio * e3 + further * (z / 2 * e2 + z**2 / 4 * e1)))


def _decay(z: FloatArray) -> FloatArray:
    """2 ∫ J0(z t) / t³ dt from 1 to infinity."""
    z = np.maximum(z, 1e-9)
    first = special.it2j0y0(z)[0] - np.euler_gamma - np.log(z / 2)  # of J0(z t) / t
    return np.asarray(special.j0(z) - z / 2 * (special.j1(z) + z * first))
