"""Stiffness of the free Reissner-Mindlin plate in the functions of both directions."""

import math
from itertools import pairwise

import numpy as np

from model.arrays import FloatArray
from model.fem.elements.element import rigidities
from model.spectral.functions import Direction
from model.structure.plate import Plate


def class_stiffness(
    plate: Plate, x: Direction, y: Direction, parity: tuple[int, int]
) -> FloatArray:
    """Stiffness K (n, n) [rad²/s²] of one symmetry class, scaled so that its mass is the identity.

    Only the upper triangle is filled in; below there are zeros in part.

    Unknowns: w, beta_x, beta_y, each the products of functions of x and functions of y, y running
    first. w has the class's parity along x and y and polynomials only; beta_x has the other parity
    along x, beta_y along y. Energy, with C_b, S and H of `rigidities`:

        (beta_x,x, beta_y,y, beta_x,y + beta_y,x) C_b (...) + S (w,x - beta_x)² + S (w,y - beta_y)²
    """
    bending, shear, inertia = rigidities(plate)
    D, coupled, twist = bending[0, 0], bending[0, 1], bending[2, 2]
    a, b = parity
    of_w = x.polynomial_count(a), y.polynomial_count(b)
    of_x, of_y = (x.count(-a), y.count(b)), (x.count(a), y.count(-b))
    squares_x, squares_y = x.slope_squares, y.slope_squares
    products_x, products_y = x.slope_products, y.slope_products
    w, beta_x, beta_y = _blocks(of_w, of_x, of_y)
    K = np.zeros((beta_y.stop, beta_y.stop))

    # Products with the unit matrix along y fill the diagonals of blocks of y, and so on.
    deflection, rotation = inertia[0, 0], inertia[1, 1]
    ww, xx, yy = (
        K[block, block].reshape(*shape, *shape)
        for block, shape in ((w, of_w), (beta_x, of_x), (beta_y, of_y))
    )
    nx, ny = of_w
    _along_x(ww)[:] += shear / deflection * squares_x[a][:nx, :nx, None]
    _along_y(ww)[:] += shear / deflection * squares_y[b][:ny, :ny]
    _along_x(xx)[:] += D / rotation * squares_x[-a][:, :, None]
    _along_y(xx)[:] += twist / rotation * squares_y[b]
    _along_x(yy)[:] += twist / rotation * squares_x[a][:, :, None]
    _along_y(yy)[:] += D / rotation * squares_y[-b]
    diagonal = K.reshape(-1, copy=False)[:: len(K) + 1]
    diagonal[w.stop :] += shear / rotation

    mixed = -shear / math.sqrt(deflection * rotation)
    wx = K[w, beta_x].reshape(*of_w, *of_x)
    _along_x(wx[..., :ny])[:] = mixed * products_x[a][:nx, :, None]
    wy = K[w, beta_y].reshape(*of_w, *of_y)
    _along_y(wy[:, :, :nx])[:] = mixed * products_y[b][:ny]
    xy = K[beta_x, beta_y].reshape(*of_x, *of_y)
    along_x = coupled / rotation * products_x[-a], twist / rotation * products_x[a].T
    along_y = products_y[-b].T, products_y[b]
    np.multiply(along_x[0][:, None, :, None], along_y[0][None, :, None, :], out=xy)
    xy += along_x[1][:, None, :, None] * along_y[1][None, :, None, :]
    return K


def _blocks(*shapes: tuple[int, int]) -> list[slice]:
    """Rows of the unknowns with these numbers of functions along x and y."""
    ends = np.cumsum([0, *(nx * ny for nx, ny in shapes)]).tolist()
    return [slice(*each) for each in pairwise(ends)]


def _along_x(block: FloatArray) -> FloatArray:
    """View of a block (nx, ny, mx, ny) between the same functions of y, (nx, mx, ny)."""
    return np.asarray(np.einsum("ijkj->ikj", block))


def _along_y(block: FloatArray) -> FloatArray:
    """View of a block (nx, ny, nx, my) between the same functions of x, (nx, ny, my)."""
    return np.asarray(np.einsum("ijik->ijk", block))
