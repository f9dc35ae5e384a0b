"""The curved glass of examples/calculix with ERAs and fingers, solved with CalculiX's equations.

CalculiX stores its stiffness and mass (SOLVER=MATRIXSTORAGE). At each frequency the whole system is
factorized. Forces act along the normals, on the lower face of the glass at ERAs and on the upper
face at fingers. For plates with other parameters, the contribution of each known mode is replaced,
and the contribution of all other modes is scaled.
"""

import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from examples.calculix import curved_glass, from_calculix
from model.answer.stimulus import Placement
from model.arrays import ComplexArray, FloatArray
from model.finger import detection_threshold, fingertip_points, fingertip_weights
from model.rig.rig import Rig
from model.structure.attachments import attached_stiffness
from model.structure.fingertips import fingertip_loads
from model.study.exact_plates import Plates
from model.vibration import Excitation, base_amplitudes

RIG = Path(__file__).parents[1] / "examples" / "calculix" / "curved_glass.yaml"
_STEP = 1e-4  # m, for differences with respect to an ERA's position


class CurvedGlass:
    """Equations and modes of the glass, solved by CalculiX in a folder, and its rig file."""

    def __init__(self, folder: Path) -> None:
        self._numbers = curved_glass.write_model(folder / "glass.inp")
        curved_glass.write_model(folder / "full.inp", solver=", SOLVER=MATRIXSTORAGE")
        for model in ("glass", "full"):
            subprocess.run(["ccx", model], cwd=folder, check=True, stdout=subprocess.DEVNULL)
        self.modes_file = from_calculix.convert(folder / "glass", unroll=True)
        modes = from_calculix.read_frd(folder / "glass.frd").modes
        dof = [each.split(".") for each in (folder / "full.dof").read_text().split()]
        self._column = {(int(node), int(axis)): n for n, (node, axis) in enumerate(dof)}
        self._stiffness, self._mass = (_matrix(folder / f"full.{each}") for each in ("sti", "mas"))
        self.eigenvalues = (2 * np.pi * np.array([mode.frequency for mode in modes])) ** 2
        self._shapes = np.array(
            [[mode.shape[int(node)][int(axis) - 1] for node, axis in dof] for mode in modes]
        ).T

    def rows(self, places: FloatArray, layer: int) -> sparse.csr_array:
        """Return the displacement (p, dof) along normals at positions (p, 2) [m] of a layer."""
        mesh, found = curved_glass, sparse.lil_array((len(places), len(self._column)))
        for row, (u, v) in enumerate(places):
            along, across = u, v / mesh.width_at(u)
            i, j = (
                int(np.clip(np.searchsorted(lines, at, side="right") - 1, 0, len(lines) - 2))
                for lines, at in ((mesh.U, along), (mesh.V, across))
            )
            x = 2 * (along - mesh.U[i]) / (mesh.U[i + 1] - mesh.U[i]) - 1
            y = 2 * (across - mesh.V[j]) / (mesh.V[j + 1] - mesh.V[j]) - 1
            angle = (u - mesh.LENGTH / 2) / mesh.RADIUS
            for (a, b), share in _quadratic(x, y).items():
                node = self._numbers[2 * i + 1 + a, 2 * j + 1 + b, layer]
                for axis, part in ((1, np.sin(angle)), (3, np.cos(angle))):
                    found[row, self._column[node, axis]] += share * part
        return found.tocsr()

    def receptances(
        self,
        forced: sparse.csr_array,
        observed: sparse.csr_array,
        frequency: float,
        loss_factor: float,
    ) -> ComplexArray:
        """Return displacements (o, n) [m/N] of rows (o, dof) due to forces along rows (n, dof)."""
        omega = 2 * np.pi * frequency
        system = (1 + 1j * loss_factor) * self._stiffness - omega**2 * self._mass
        factors = splu(
            system.tocsc(),
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.01,
            options={"SymmetricMode": True},
        )
        return np.asarray(observed @ factors.solve(forced.toarray().T.astype(complex)))

    def at(self, rows: sparse.csr_array) -> FloatArray:
        """Return mode shapes (p, r) of unit modal mass at rows."""
        return np.asarray(rows @ self._shapes)


def _matrix(path: Path) -> sparse.csr_array:
    """Return a symmetric matrix; CalculiX writes one half."""
    row, column, value = np.loadtxt(path).T
    half = sparse.coo_array((value, (row.astype(int) - 1, column.astype(int) - 1))).tocsr()
    whole: sparse.csr_array = (half + half.T - sparse.diags_array(half.diagonal())).tocsr()
    return whole


def _quadratic(x: float, y: float) -> dict[tuple[int, int], float]:
    """Return shape functions of an eight-node quadrilateral at x, y (-1 to 1), by node."""
    found = {}
    for a in (-1, 0, 1):
        for b in (-1, 0, 1):
            if a and b:
                found[a, b] = (1 + a * x) * (1 + b * y) * (a * x + b * y - 1) / 4
            elif a:
                found[a, b] = (1 + a * x) * (1 - y**2) / 2
            elif b:
                found[a, b] = (1 - x**2) * (1 + b * y) / 2
    return found


class GlassOnEras:
    """Responses of the glass with the rig's ERAs at all finger positions, solved together."""

    def __init__(
        self,
        glass: CurvedGlass,
        rig: Rig,
        frequencies: FloatArray,
        places: FloatArray,
        cells: FloatArray,
    ) -> None:
        self.rig, self._frequencies, self._glass = rig, frequencies, glass
        self._eras: Sequence[Any] = rig.eras
        at = np.array([[era.x, era.y] for era in self._eras])
        below = [glass.rows(at, 0)]
        for step in np.eye(2) * _STEP:
            below.append((glass.rows(at + step, 0) - glass.rows(at - step, 0)) / (2 * _STEP))
        discs = np.array([fingertip_points(x, y, rig.plate) for x, y in places])
        self.places, self._points = places, discs.shape[1]
        top = self._glass.rows(places, 2)
        forced = sparse.vstack([*below, top]).tocsr()
        under = sparse.vstack([glass.rows(each, 2) for each in (discs.reshape(-1, 2), cells)])
        observed = sparse.vstack([forced, under]).tocsr()
        self._shapes, self._count = glass.at(observed), forced.shape[0]
        self._by_frequency = [
            glass.receptances(forced, observed, each, rig.plate.loss_factor) for each in frequencies
        ]
        self._cells = slice(observed.shape[0] - len(cells), None)

    @property
    def fields(self) -> ComplexArray:
        """Acceleration (f, n, p) [m/s²] at the cells due to each ERA at full level, no fingers."""
        n, found = len(self._eras), []
        for frequency, whole in zip(self._frequencies, self._by_frequency, strict=True):
            spring, mass = self._springs(frequency)
            system = np.eye(n) + (spring - mass)[:, None] * whole[:n, :n]
            strokes = np.array([era.full_level for era in self._eras])
            forces = np.linalg.solve(system, np.diag(spring * strokes))
            found.append((-((2 * np.pi * frequency) ** 2) * whole[self._cells, :n] @ forces).T)
        return np.array(found)

    def _springs(
        self,
        frequency: float,
        stiffer: FloatArray | float = 1.0,
        damped: FloatArray | float = 1,
    ) -> tuple[ComplexArray, FloatArray]:
        """Return each ERA's stiffness with its damper, and omega² times its mass [N/m]."""
        w = 2 * np.pi * frequency
        k, c, m = np.array([[e.stiffness, e.damping, e.bolt_mass] for e in self._eras]).T
        return stiffer * k + 1j * w * c * damped, w**2 * m

    def contrast_db(self, placed: Placement, excitation: Excitation, plates: Plates) -> FloatArray:
        """Return the felt contrast (d,) [dB] of a target to quiet fingers on glasses."""
        fingers = [
            int(np.argmin(np.linalg.norm(self.places - each, axis=1))) for each in placed.contacts
        ]
        n, count = len(self._eras), len(plates.loss)
        forced = [*range(3 * n), *(3 * n + each for each in fingers)]
        seen = [
            self._count + self._points * each + point
            for each in fingers
            for point in range(self._points)
        ]
        # Responses of ERAs (moved by their errors) and fingers to forces at driven rows.
        chosen = np.zeros((count, n + len(fingers), len(forced)))
        chosen[:, range(n + len(fingers)), [*range(n), *range(3 * n, len(forced))]] = 1
        for axis in range(2):
            chosen[:, range(n), range((1 + axis) * n, (2 + axis) * n)] = plates.places[:, :, axis]
        tips = fingertip_loads(self.rig.fingertip, placed.contacts)
        frequencies, bases = base_amplitudes(excitation, self._eras)
        sensed = np.zeros((count, len(seen)))
        for frequency, base in zip(frequencies, bases, strict=True):
            row = int(np.argmin(np.abs(self._frequencies - frequency)))
            w = 2 * np.pi * frequency
            whole = self._deviating(row, forced, [*forced, *seen], plates)
            between = chosen @ whole[:, : len(forced)] @ chosen.swapaxes(1, 2)
            to_points = whole[:, len(forced) :] @ chosen.swapaxes(1, 2)
            spring, mass = self._springs(frequency, plates.stiffness, plates.damping[:, None])
            load = attached_stiffness(np.array([w]), tips)[0] * plates.load[:, : len(fingers)]
            stiffness = np.concatenate([spring - mass, load], axis=1)
            driven = np.zeros((count, n + len(fingers)), dtype=complex)
            driven[:, :n] = spring * plates.gain * base
            system = np.eye(n + len(fingers)) + stiffness[:, :, None] * between
            forces = np.linalg.solve(system, driven[:, :, None])
            moved = -(w**2) * (to_points @ forces)[:, :, 0]
            threshold = float(detection_threshold(np.array([frequency]), self.rig.threshold)[0])
            sensed += np.abs(moved / threshold) ** 2
        weights = fingertip_weights(*placed.contacts[0], self.rig.plate)
        by_finger = np.sqrt(sensed).reshape(count, len(fingers), -1)
        level = by_finger[:, 0] @ weights
        return np.asarray(20 * np.log10(level / by_finger[:, 1:].max(axis=(1, 2))))

    def _deviating(
        self,
        row: int,
        forced: Sequence[int],
        observed: Sequence[int],
        plates: Plates,
    ) -> ComplexArray:
        """Return receptances (d, o, n) of plates at a frequency, of rows to forces along others."""
        w2 = (2 * np.pi * self._frequencies[row]) ** 2
        eta, own = self.rig.plate.loss_factor, self._glass.eigenvalues
        left, right = self._shapes[observed], self._shapes[forced]
        rest = self._by_frequency[row][np.ix_(observed, forced)]
        rest = rest - (left / ((1 + 1j * eta) * own - w2)) @ right.T
        h, e = plates.thickness[:, None], plates.modulus[:, None]
        rigid, drawn = int((own < (2 * np.pi) ** 2).sum()), plates.modes[:, :, : len(own)]
        around = (0, 0), (0, 0), (rigid, len(own) - rigid - drawn.shape[2])
        of_modes = np.pad(drawn, around, constant_values=1.0)
        lossy = own * of_modes[:, 0] * (1 + 1j * eta * plates.loss[:, None])
        modal = of_modes[:, 1] / (h * (h**2 * e * lossy - w2))
        whole = (left * modal[:, None]) @ right.T
        return np.asarray(whole + rest / (h**3 * e)[:, :, None])
