"""Stiffness of the free Reissner-Mindlin plate in the functions of both directions."""

import numpy as np

from model.arrays import FloatArray
from model.fem.elements.element import rigidities
from model.spectral.functions import EVEN, ODD, Direction
from model.structure.plate import Plate


def class_stiffness(
    plate: Plate, x: Direction, y: Direction, parity: tuple[int, int]
) -> FloatArray:
    """Stiffness K (n, n) [rad²/s²] of one symmetry class, scaled so that its mass is the identity.

    Unknowns: w, beta_x, beta_y, each the products of functions of x and functions of y, y running
    first. w has the class's parity along x and y and polynomials only; beta_x has the other parity
    along x, beta_y along y. Energy, with C_b, S and H of `rigidities`:

        (beta_x,x, beta_y,y, beta_x,y + beta_y,x) C_b (...) + S (w,x - beta_x)² + S (w,y - beta_y)²
    """
    bending, shear, inertia = rigidities(plate)
    D, coupled, twist = bending[0, 0], bending[0, 1], bending[2, 2]
    a, b = parity
    nx, ny = x.polynomial_count(a), y.polynomial_count(b)
    unit_x = {each: np.eye(x.count(each)) for each in (EVEN, ODD)}
    unit_y = {each: np.eye(y.count(each)) for each in (EVEN, ODD)}
    squares_x, squares_y = x.slope_squares, y.slope_squares
    products_x, products_y = x.slope_products, y.slope_products
    ww = shear * (
        np.kron(squares_x[a][:nx, :nx], np.eye(ny)) + np.kron(np.eye(nx), squares_y[b][:ny, :ny])
    )
    wx = -shear * np.kron(products_x[a][:nx], unit_y[b][:ny])
    wy = -shear * np.kron(unit_x[a][:nx], products_y[b][:ny])
    xx = D * np.kron(squares_x[-a], unit_y[b]) + twist * np.kron(unit_x[-a], squares_y[b])
    yy = D * np.kron(unit_x[a], squares_y[-b]) + twist * np.kron(squares_x[a], unit_y[-b])
    for rotation in (xx, yy):
        rotation[np.diag_indices_from(rotation)] += shear
    xy = coupled * np.kron(products_x[-a], products_y[-b].T)
    xy += twist * np.kron(products_x[a].T, products_y[b])
    K = np.block([[ww, wx, wy], [wx.T, xx, xy], [wy.T, xy.T, yy]])
    scale = np.repeat(1 / np.sqrt(np.diag(inertia)), [len(ww), len(xx), len(yy)])
    return np.asarray(K * scale[:, None] * scale)
