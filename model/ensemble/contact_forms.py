"""Fields of the ERAs at fingertips that load the plate, and their expected power.

Attachments a are the fixed ones and then the fingers, points p those under the fingertips:

    z = k + i w c,  Z = diag(z - w² m, D of the fingers),  K = (1 + Z A)^-1
    F = K z stroke,   u = A F                                forces of each ERA, and what they move
    h_p = -w² A_pa F,   t_p = -w² A_pa K                     field, and force -> point
    dh_p / dZ_j = t_pj r_j^T,   r_j = stroke e_j - u_j of an ERA, -u_j of a finger

The expected power of weights w at a fingertip is w^H R w to first order,

    R = mean_p { h* h^T + dh* dh^T + dc* dc^T + sum_j |s_j t_pj|² r_j* r_j^T + sigma² diag |h|² },

each change d by one standard deviation, s_j that of Z_j: the ERAs' damping c together, stiffness of
each ERA and load of each finger j on their own, gains as sigma: exact derivatives of the loaded
plate, but for what a finger deflects locally. For the thickness, half the sum of dh* dh^T of the
plates thicker and thinner by it, exactly: it moves resonances. The loss factor changes next to
nothing.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from model.arrays import Complex64Array, Float32Array
from model.compiled.kernels import kernels
from model.ensemble.attached_plate import AttachedPlate, Attachments
from model.ensemble.contact_forms_kernel import FoundForms, contact_forms

RIDGE = 1e-6
"""Share of a form's trace that is added to its diagonal: keeps it definite."""


@dataclass(frozen=True, eq=False)
class LoadedContacts:
    """The plate with k fingers on it, a = b + k attachments.

    - shapes: (a, r); attachments: of dynamic stiffness (f, a) Z
    - inverse: (f, a, a) K; forces: (f, a, n) F; motion: (f, a, n) r
    - fields: (f, k, p, n) h [m/s²] at each finger's points; power: (f, k, n, n) R
    """

    shapes: Float32Array
    attachments: Attachments
    inverse: Complex64Array
    forces: Complex64Array
    motion: Complex64Array
    fields: Complex64Array
    power: Complex64Array


def load_contacts(
    plate: AttachedPlate,
    points: Float32Array,
    weights: Float32Array,
    error_power: Float32Array,
    loads: Sequence[float] = (),
) -> LoadedContacts:
    """Put fingers on a plate.

    points (k, p, r): shapes under each finger, its centre first; weights (k, p): of its points,
    sum 1; error_power (f, n): mean square of the discretisation error of each ERA's field; loads
    (k,): of each finger relative to the rig's fingertip, empty for 1.
    """
    k, _, r = points.shape
    by, attachments = kernels(), plate.with_fingers(k, loads)
    shapes = np.concatenate([plate.shapes, points[:, 0]])
    found = (
        _forms_by_numpy(plate, attachments, shapes, points, weights, error_power)
        if by is None
        else contact_forms(
            by,
            gain_variance=plate.gain_variance,
            ridge=RIDGE,
            shapes=shapes,
            points=points.reshape(-1, r),
            weights=weights,
            receptance=plate.receptance,
            others=_others(plate),
            minus_omega2=plate.minus_omega2,
            error=error_power,
            stiffness=attachments.stiffness,
            drives=plate.forces,
            strokes=plate.strokes,
            by_damping=plate.by_damping,
            changes=attachments.changes,
        )
    )
    return LoadedContacts(shapes=shapes, attachments=attachments, **vars(found))


def _forms_by_numpy(
    plate: AttachedPlate,
    attachments: Attachments,
    shapes: Float32Array,
    points: Float32Array,
    weights: Float32Array,
    error_power: Float32Array,
) -> FoundForms:
    """As the kernel finds; shapes (a, r) of all attachments, the rest as of `load_contacts`."""
    (k, p, r), a, n = points.shape, len(shapes), plate.era_count
    f, b = plate.stiffness.shape
    every = np.concatenate([plate.shapes, points.reshape(-1, r)])
    products = (every[:, None] * shapes).reshape(-1, r)
    between = _between(products, plate.modal_rows, a)  # (f, b + k p, a)
    attached = np.concatenate([np.arange(b), b + p * np.arange(k)])
    A = between.take(attached, axis=1)
    stiffness, uncertain = attachments.stiffness, attachments.uncertain
    inverse = inverse_with(stiffness, A)
    forces = inverse[:, :, :n] * plate.forces[:, None]
    motion = A @ -forces
    motion.reshape(f, -1)[:, : n * n : n + 1] += plate.strokes
    minus_omega2 = plate.minus_omega2[:, None, None]
    to_points = between[:, b:] @ (inverse * minus_omega2)

    # One row for each point and part, then one for each uncertain spring and load.
    others = _others(plate)
    deviating = others.shape[1]
    rows = np.empty((f, 2 + deviating, k * p, n), dtype=np.complex64)
    h = np.matmul(between[:, b:], forces * minus_omega2, out=rows[:, 0])
    damping = plate.by_damping[:, :, None] * motion[:, :n]
    np.matmul(to_points[:, :, :n], damping, out=rows[:, 1])
    for each in range(deviating):
        modal_rows = np.ascontiguousarray(others[:, each].T).view(np.float32)
        other = _between(products, modal_rows, a)
        held = inverse_with(stiffness, other.take(attached, axis=1))
        thicker = other[:, b:] @ (held[:, :, :n] * plate.forces[:, None] * minus_omega2)
        rows[:, 2 + each] = (thicker - h) * np.float32(math.sqrt(1 / deviating))
    by_finger = rows.reshape(f, -1, k, p, n).swapaxes(1, 2)
    scaled = (by_finger * np.sqrt(weights)[:, None, :, None]).reshape(f, k, -1, n)
    power = gram(scaled)
    moved = motion.take(uncertain, axis=1) * attachments.changes[:, :, None]
    reach = power_of(to_points.take(uncertain, axis=2))
    mean = weights[:, None]
    shares = (mean @ reach.reshape(f, k, p, -1))[:, :, 0]
    outer = _outer(moved).reshape(f, len(uncertain), -1).view(np.float32)
    power += (shares @ outer).view(np.complex64).reshape(f, k, n, n)
    size = (mean @ power_of(h).reshape(f, k, p, n))[:, :, 0]
    _add_diagonal(power, plate.gain_variance * size + error_power[:, None])
    return FoundForms(inverse, forces, motion, h.reshape(f, k, p, n), power)


def _others(plate: AttachedPlate) -> Complex64Array:
    """Receptance of plates of other thickness, none where it is certain: (f, d, r)."""
    return plate.deviating if plate.thickness > 0 else plate.deviating[:, :0]


def modal_fields(
    plate: AttachedPlate, fingers: Float32Array, loads: Sequence[float] = ()
) -> Complex64Array:
    """Accelerations of the reduced coordinates by each ERA alone at full stroke, (f, r, n).

    fingers (k, r): shapes under the centres of those on the plate; loads (k,): of each relative to
    the rig's fingertip, empty for 1.
    """
    shapes = np.concatenate([plate.shapes, fingers])
    A = (plate.receptance[:, None] * shapes) @ shapes.T
    inverse = inverse_with(plate.with_fingers(len(fingers), loads).stiffness, A)
    forces = inverse[:, :, : plate.era_count] * plate.forces[:, None]
    scale = plate.receptance * plate.minus_omega2[:, None]
    return np.asarray((shapes.T @ forces) * scale[:, :, None])


def _between(products: Float32Array, modal_rows: Float32Array, attachments: int) -> Complex64Array:
    """Receptance of the free plate between points and attachments, (f, points, attachments).

    products (points attachments, r): of the shapes at both; modal_rows: as of `AttachedPlate`.
    """
    found = (products @ modal_rows).view(np.complex64)
    found = found.reshape(-1, attachments, found.shape[1])
    return np.ascontiguousarray(found.transpose(2, 0, 1))


def inverse_with(stiffness: Complex64Array, receptance: Complex64Array) -> Complex64Array:
    """K = (1 + Z A)^-1 of stiffness Z (f, a) and receptance A (f, a, a)."""
    system = stiffness[:, :, None] * receptance
    system.reshape(len(system), -1)[:, :: system.shape[1] + 1] += 1
    return np.asarray(np.linalg.inv(system))


def _outer(rows: Complex64Array) -> Complex64Array:
    """Forms conj(h) h^T of rows h (..., n): (..., n, n)."""
    return np.asarray(rows.conj()[..., :, None] * rows[..., None, :])


def gram(rows: Complex64Array) -> Complex64Array:
    """Forms of the sum over rows (..., rows, n): (..., n, n)."""
    return np.asarray(rows.conj().swapaxes(-1, -2) @ rows)


def power_of(values: Complex64Array) -> Float32Array:
    """Squared magnitude."""
    return np.asarray(values.real * values.real + values.imag * values.imag)


def _add_diagonal(forms: Complex64Array, values: Float32Array) -> None:
    """Add values (..., n) and a ridge to the diagonals of forms (..., n, n)."""
    n = values.shape[-1]
    diagonal = forms.reshape(*values.shape[:-1], -1)[..., :: n + 1]
    size = diagonal.real + values
    diagonal[:] = size + size @ np.full((n, n), RIDGE / n, dtype=np.float32)
