"""Print how far plates of layers and air gaps are from independent solutions.

Layered strips and waves are solved in plane strain, independent of every plate theory in `model`:
displacements vary freely through the thickness. Both solutions use the same 9-node rectangles, or
their three nodes through the thickness times exp(ikx).

Air in a gap is solved by finite differences of its pressure, without shapes or modes: lap p +
omega² rho b / B p = -omega² rho b w / d over the plate, p = 0 at open edges and no slope across
sealed ones, on cells with the pressure in their middles.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy import linalg, sparse
from scipy.sparse.linalg import eigsh, spsolve

from benchmarks.direct_plate import direct_responder
from benchmarks.setting import RIG
from model.arrays import ComplexArray, FloatArray
from model.reduction.free_plate import solve_free_plate
from model.rig.rig import Rig
from model.rig.rig_file import load_rig
from model.spectral.modes import MaterialBand, SpectralPlate
from model.spectral.polynomials import CLASSES
from model.structure.material import Material
from model.structure.plate import (
    AirGap,
    Laminate,
    LaminateLayer,
    Plate,
    bending,
    equivalent_plate,
    wavenumber_of,
)
from model.vibration import natural_modes

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


PANEL = load_rig(RIG.parent / "glass_panel.yaml")
GLASS = Material("glass", E=70e9, rho=2500.0, nu=0.2)
ADHESIVE = Material("adhesive", E=1e6, rho=1000.0, nu=0.49)
THIN = (LaminateLayer(GLASS, 0.7e-3), LaminateLayer(ADHESIVE, 0.1e-3), LaminateLayer(GLASS, 0.7e-3))
LENGTH, MODES, AT = 0.375, 6, 150.0
FREE_BEAM = np.array([4.730041, 7.853205, 10.995608, 14.137165, 17.278760, 20.420352])
BY_FREQUENCY = ((10.0, 0.5, 0.3), (100.0, 1.0, 0.4), (1000.0, 2.0, 0.5))
FREQUENCIES = np.array([40.0, 60.0, 80.0, 100.0, 150.0, 200.0, 250.0, 300.0, 400.0, 500.0])


def main() -> None:
    """Print all tables."""
    layers = _layers()
    print("free strips of 375 mm, error of modes 1 to 6 against elasticity")
    print("| layers | solved as | 1 | 2 | 3 | 4 | 5 | 6 |\n|---|---|---|---|---|---|---|---|")
    for name, each in (("glass_panel", layers), ("0.7/0.1/0.7 mm", THIN)):
        exact = strip_frequencies(each, LENGTH, MODES)
        _row(name, "layers", 100 * (_strip(each) / exact - 1))
        _row(name, f"one rigidity, {AT:g} Hz", 100 * (_one_rigidity(each) / exact - 1))
    print(f"\nwaves, largest error of the frequency: {_waves(layers):.3f} %")
    print("\nresponse by modes against each frequency solved, percent of its norm")
    names = " | ".join(f"{f:g} Hz" for f in FREQUENCIES)
    print(f"| adhesive | {names} |\n|---|{'---|' * len(FREQUENCIES)}")
    for what, core in (
        ("loss factor 0.3", replace(layers[1], loss_factor=0.3)),
        ("loss factor 1", replace(layers[1], loss_factor=1.0)),
        ("G by f^0.3, 0.3 to 0.5", replace(layers[1], by_frequency=BY_FREQUENCY)),
    ):
        errors = _errors(_plate((layers[0], core, layers[2])))
        print(f"| {what} | {' | '.join(f'{each:.1f} %' for each in errors)} |")
    print("\nthe example over air, modes on its ERAs, and response by modes as above")
    print("| gap | modes 1 to 4 | 40 to 100 Hz | 150 to 500 Hz |\n|---|---|---|---|")
    for depth, closed in (
        (None, False),
        (10e-3, False),
        (5e-3, False),
        (2e-3, False),
        (1e-3, False),
        (0.5e-3, False),
        (10e-3, True),
        (2e-3, True),
    ):
        gap = None if depth is None else AirGap(depth, closed=closed)
        rig = replace(PANEL, plate=replace(PANEL.plate, air_gap=gap))
        errors = _errors(rig.plate)
        name = "none" if gap is None else f"{1e3 * gap.depth:g} mm {'sealed' if closed else 'open'}"
        print(f"| {name} | {_modes(rig)} | {errors[:4].max():.1f} % | {errors[4:].max():.1f} % |")


def _row(*cells: object) -> None:
    values = [
        " | ".join(f"{each:+.2f} %" if each < 0 else f"{each:.2f} %" for each in cell)
        if isinstance(cell, np.ndarray)
        else str(cell)
        for cell in cells
    ]
    print(f"| {' | '.join(values)} |")


def _layers() -> tuple[LaminateLayer, ...]:
    assert PANEL.laminate is not None
    return PANEL.laminate.layers


def _plate(layers: tuple[LaminateLayer, ...], *, width: float = 0.225) -> Plate:
    return equivalent_plate(
        Laminate(layers), length=LENGTH, width=width, frequency=500.0, loss_factor=0.01
    )


def _strip(layers: tuple[LaminateLayer, ...]) -> FloatArray:
    """Natural frequencies [Hz] of a strip of infinite width."""
    solved = SpectralPlate(_plate(layers, width=1.0), (16, 0), AT)
    found = [
        solved.modes(each, shift=1e4, cut=1e10, band=MaterialBand(AT, AT)).eigenvalues
        for each in CLASSES
        if each[1] == 1
    ]
    squares = np.sort(np.concatenate(found))
    return np.asarray(np.sqrt(squares[squares > 1][:MODES]) / (2 * np.pi))


def _one_rigidity(layers: tuple[LaminateLayer, ...]) -> FloatArray:
    """Of a thin strip with the rigidity of a wave of one frequency."""
    laminate = Laminate(layers)
    speed = np.sqrt(bending(laminate, AT).rigidity / laminate.surface_density)
    return np.asarray((FREE_BEAM / LENGTH) ** 2 * speed / (2 * np.pi))


def _waves(layers: tuple[LaminateLayer, ...]) -> float:
    """Largest error [%] of the frequency of a wave of given length."""
    worst = 0.0
    for modulus in (0.1e6, 1e6, 10e6, 1e9):
        core = replace(layers[1], material=replace(layers[1].material, E=modulus))
        several = (layers[0], core, layers[2])
        for frequency in (40.0, 150.0, 500.0):
            ratio = wavenumber_of(Laminate(several), frequency).real
            worst = max(worst, 200 * abs(ratio / wave_number(several, frequency) - 1))
    return worst


def _errors(plate: Plate) -> FloatArray:
    """Difference [%] of the responses to the first two ERAs, the larger, (f,)."""
    x, y = np.meshgrid(np.linspace(0, plate.length, 13), np.linspace(0, plate.width, 9))
    points = np.column_stack([x.ravel(), y.ravel()])
    eras, loads = PANEL.eras[:2], PANEL.masses
    free = solve_free_plate(plate, PANEL.mesh, frequency_max=float(FREQUENCIES.max()))
    found = free.acceleration(eras, FREQUENCIES, points, loads=loads)
    exact = direct_responder(plate, PANEL.mesh)(eras, FREQUENCIES, points, loads=loads)
    difference = np.linalg.norm(found - exact, axis=2) / np.linalg.norm(exact, axis=2)
    return np.asarray(100 * difference.max(axis=1))


def _modes(rig: Rig) -> str:
    found = natural_modes(rig, 4, support="eras").frequencies
    return ", ".join(f"{each:.1f}" for each in found) + " Hz"


def cell_middles(length: float, width: float, cells: tuple[int, int]) -> tuple[FloatArray, ...]:
    """Coordinates x and y [m] of the middles of cells, each (nx, ny)."""
    x, y = (
        (np.arange(count) + 0.5) * side / count
        for count, side in zip(cells, (length, width), strict=True)
    )
    return tuple(np.meshgrid(x, y, indexing="ij"))


def air_pressure(
    gap: AirGap, deflection: FloatArray, frequency: float, *, length: float, width: float
) -> ComplexArray:
    """Pressure [Pa] against a deflection (nx, ny) [m] away from the gap, (nx, ny)."""
    nx, ny = deflection.shape
    omega2 = (2 * np.pi * frequency) ** 2
    inertia = gap.inertia(frequency)
    along_x = sparse.kron(_second(nx, length / nx, gap.closed), sparse.csr_array(np.eye(ny)))
    along_y = sparse.kron(sparse.csr_array(np.eye(nx)), _second(ny, width / ny, gap.closed))
    compressed = omega2 * inertia / gap.bulk_modulus(frequency) * np.ones(nx * ny)
    matrix = sparse.csc_array(along_x) + sparse.csc_array(along_y)
    matrix = sparse.csc_array(matrix + sparse.diags_array(compressed))
    source = -omega2 * inertia / gap.depth * deflection.ravel()
    return np.asarray(spsolve(matrix, source.astype(complex))).reshape(nx, ny)


def _second(count: int, step: float, closed: bool) -> sparse.csr_array:
    """Second difference [1/m²] between the middles of cells."""
    diagonal = np.full(count, -2.0)
    diagonal[[0, -1]] = -1.0 if closed else -3.0  # the edge is half a cell away
    off = np.ones(count - 1)
    whole = np.diag(off, -1) + np.diag(diagonal) + np.diag(off, 1)
    return sparse.csr_array(whole / step**2)


if __name__ == "__main__":
    main()
