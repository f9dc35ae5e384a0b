"""Strips and waves of layers in plane strain, independent of every plate theory in `model`.

Displacements vary freely through the thickness. Strips are solved with rectangles of nine nodes,
waves with their three nodes through the thickness times exp(ikx).
"""

import math
from collections.abc import Sequence

import numpy as np
from scipy import linalg, sparse
from scipy.sparse.linalg import eigsh

from model.arrays import FloatArray
from model.structure.material import Material
from model.structure.plate import LaminateLayer

_GAUSS = [(-math.sqrt(0.6), 5 / 9), (0.0, 8 / 9), (math.sqrt(0.6), 5 / 9)]


def _shape(xi: float) -> tuple[FloatArray, FloatArray]:
    """Quadratic shape functions and derivatives of a side."""
    return (
        np.array([xi * (xi - 1) / 2, 1 - xi**2, xi * (xi + 1) / 2]),
        np.array([xi - 0.5, -2 * xi, xi + 0.5]),
    )


def _elasticity(modulus: float, nu: float) -> FloatArray:
    """Plane-strain stiffness of (e_xx, e_zz, 2 e_xz)."""
    factor = modulus / ((1 + nu) * (1 - 2 * nu))
    whole = np.array([[1 - nu, nu, 0], [nu, 1 - nu, 0], [0, 0, (1 - 2 * nu) / 2]])
    return np.asarray(factor * whole)


def _pieces(layers: Sequence[LaminateLayer], count: int) -> list[tuple[Material, float]]:
    """Material and thickness of the elements through the thickness."""
    return [(layer.material, layer.thickness / count) for layer in layers for _ in range(count)]


def strip_frequencies(
    layers: Sequence[LaminateLayer],
    length: float,
    modes: int,
    *,
    along: int = 100,
    through: int = 2,
) -> FloatArray:
    """Natural frequencies [Hz] of bending of a wide free strip of layers, without rigid motions.

    along: elements along its length, finer towards both ends; through: of each layer.
    """
    t = np.linspace(0, 1, along + 1)
    ends = length * (t - 0.9 * np.sin(2 * np.pi * t) / (2 * np.pi))
    pieces = _pieces(layers, through)
    nz = 2 * len(pieces) + 1
    unit = {material: _unit_matrices(material) for material, _ in pieces}
    rows, columns, stiff, heavy = [], [], [], []
    for i, dx in enumerate(np.diff(ends)):
        for j, (material, dz) in enumerate(pieces):
            xx, xz, zz, mass = unit[material]
            nodes = ((2 * i + np.arange(3))[:, None] * nz + 2 * j + np.arange(3)).ravel()
            dofs = np.stack([2 * nodes, 2 * nodes + 1], axis=1).ravel()
            rows.append(np.repeat(dofs, 18))
            columns.append(np.tile(dofs, 18))
            stiff.append((xx * dz / dx + xz + zz * dx / dz).ravel())
            heavy.append((mass * dx * dz).ravel())
    size = 2 * nz * (2 * along + 1)
    at = (np.concatenate(rows), np.concatenate(columns))
    K, M = (
        sparse.csc_array(sparse.coo_array((np.concatenate(each), at), shape=(size, size)))
        for each in (stiff, heavy)
    )
    shift = -((2 * math.pi * 20) ** 2)
    squares = eigsh(K, modes + 3, M=M, sigma=shift, return_eigenvectors=False)
    return np.asarray(np.sqrt(np.sort(squares)[3:]) / (2 * math.pi))


def _unit_matrices(material: Material) -> tuple[FloatArray, ...]:
    """Of a 9-node unit square: stiffness by slopes along x twice, mixed, along z twice; mass."""
    C = _elasticity(material.E, material.nu)
    xx, xz, zz, mass = (np.zeros((18, 18)) for _ in range(4))
    for xi, wx in _GAUSS:
        for zeta, wz in _GAUSS:
            (nx, ex), (nz, ez) = _shape(xi), _shape(zeta)
            along_x, along_z = np.outer(2 * ex, nz).ravel(), np.outer(nx, 2 * ez).ravel()
            of_x, of_z = np.zeros((3, 18)), np.zeros((3, 18))
            of_x[0, 0::2] = of_x[2, 1::2] = along_x
            of_z[1, 1::2] = of_z[2, 0::2] = along_z
            fields = np.kron(np.outer(nx, nz).ravel(), np.eye(2))
            weight = wx * wz / 4
            xx += weight * of_x.T @ C @ of_x
            xz += weight * (of_x.T @ C @ of_z + of_z.T @ C @ of_x)
            zz += weight * of_z.T @ C @ of_z
            mass += weight * material.rho * fields.T @ fields
    return xx, xz, zz, mass


def wave_number(layers: Sequence[LaminateLayer], frequency: float) -> float:
    """Wavenumber [1/m] of the bending wave of a frequency [Hz] in layers without edges."""
    pieces = _pieces(layers, 4)

    def lowest(k: float) -> float:
        size = 2 * (2 * len(pieces) + 1)
        K, M = np.zeros((size, size)), np.zeros((size, size))
        for number, (material, h) in enumerate(pieces):
            C = _elasticity(material.E, material.nu)
            dofs = slice(4 * number, 4 * number + 6)
            for xi, weight in _GAUSS:
                N, dN = _shape(xi)
                dN = dN * 2 / h
                B = np.zeros((3, 6))  # u = i U exp(ikx): strains -kU, dw/dz, i (dU/dz + k w)
                B[0, 0::2] = -k * N
                B[1, 1::2] = dN
                B[2, 0::2] = dN
                B[2, 1::2] = k * N
                fields = np.kron(N, np.eye(2))
                K[dofs, dofs] += weight * h / 2 * B.T @ C @ B
                M[dofs, dofs] += weight * h / 2 * material.rho * fields.T @ fields
        return float(linalg.eigh(K, M, eigvals_only=True, subset_by_index=[0, 0])[0])

    target = (2 * math.pi * frequency) ** 2
    low, high = 1.0, 500.0
    for _ in range(26):
        middle = math.sqrt(low * high)
        low, high = (middle, high) if lowest(middle) < target else (low, middle)
    return low
