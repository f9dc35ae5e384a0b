"""Derivatives of the responses of a plate by all of its parameters, and by a mass anywhere.

With L = 1 - T Z, changes dA of the free receptance and dZ of what is attached change the receptance
T of the plate on its attachments by L dA L^T - T dZ T: a mode, a place or an attachment by a rank
of one or two (`model.identification.forward`).
"""

from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from model.arrays import ComplexArray, FloatArray, IntArray
from model.identification.forward import LEAST_LOSS, PlateAt
from model.reduction.receptance import between, combined
from model.structure.plate import LOSS_FREQUENCY

AnyArray: TypeAlias = NDArray[np.floating[Any]] | NDArray[np.complexfloating[Any, Any]]


def jacobian(plate: PlateAt) -> ComplexArray:
    """Derivatives of the responses of a plate by x, (f, s, n, p)."""
    space = plate.model.space
    found = np.zeros((*plate.responses.shape, space.size), dtype=complex)
    for group, kinds in _GROUPS.items():
        if not space.of(*kinds).any():
            continue
        for kind, columns in group(plate).items():
            found[..., space.groups[kind]] = columns * space.std[space.groups[kind]]
    return found


def by_mass_at(plate: PlateAt, points: FloatArray) -> ComplexArray:
    """Derivatives of the responses by a mass [kg] at points (p, 2) [m], (f, s, n, p)."""
    products = between(plate.model.free.modes, plate.located.footprints, points)
    reach = plate.left @ combined(plate.functions.values, products)
    return _outer(plate, reach, reach, _per_frequency(plate, len(points)))


Columns: TypeAlias = dict[str, ComplexArray]
"""Derivatives (f, s, n, m) by the m parameters of a kind, in the units of `Values`."""


def _by_plate(plate: PlateAt) -> Columns:
    """By thickness, modulus and loss factor of the whole plate."""
    functions, products = plate.functions, plate.located.products

    def responses(changed: ComplexArray) -> ComplexArray:
        change = plate.left @ combined(changed, products) @ plate.left.swapaxes(1, 2)
        n = plate.base.shape[1]
        return np.asarray(plate.scale * change[:, plate.model.observed, :n])[..., None]

    by_stiffness = responses(functions.by_logarithms(1.0, 1.0))
    by_loss = responses(functions.by_logarithms(plate.by_loss, plate.by_loss_of_rest))
    powers = np.log(plate.model.frequencies / LOSS_FREQUENCY)[:, None, None, None]
    return {
        "thickness": 2 * by_stiffness - responses(functions.values),
        "modulus": by_stiffness,
        "loss": by_loss,
        "loss_added": by_loss / max(plate.values.loss_factor, LEAST_LOSS),
        "loss_exponent": powers * by_loss,
    }


def _by_modes(plate: PlateAt) -> Columns:
    modes, functions = plate.model.shifted_modes, plate.functions
    reach = plate.left @ plate.located.shapes[:, modes]
    by_stiffness = functions.by_mode[:, modes]
    by_loss = plate.by_mode_loss[:, modes] * by_stiffness
    return {
        "mode_shifts": _outer(plate, reach, reach, by_stiffness),
        "mode_losses": _outer(plate, reach, reach, by_loss),
    }


def _by_places(plate: PlateAt) -> Columns:
    """By the places of ERAs, and by additional masses and theirs.

    A place changes the receptance in its row and its column.
    """
    model = plate.model
    n, moved = plate.base.shape[1], np.repeat(model.movable, 2)
    rows = combined(plate.functions.values, plate.located.slopes)
    reach, own = plate.left @ rows.swapaxes(1, 2), plate.left[:, :, moved]
    ones = np.ones((len(model.omega), len(moved)))
    by_place = _outer(plate, own, reach, ones)
    by_place += _outer(plate, reach, own, ones)
    masses = np.empty((*by_place.shape[:-1], model.mass_count, 3), dtype=complex)
    masses[..., 1:] = by_place[..., 2 * n :].reshape(masses[..., 1:].shape)
    by_mass = _per_frequency(plate, model.mass_count)
    masses[..., 0] = _held(plate, model.movable[n:], -by_mass)
    return {
        "place": by_place[..., : 2 * n],
        "masses": masses.reshape(*by_place.shape[:-1], -1),
    }


def _by_attachments(plate: PlateAt) -> Columns:
    """By stiffness, damping and bolt mass of ERAs, and by the parts of fingers."""
    model, values, Y = plate.model, plate.values, plate.responses
    n, eras = plate.base.shape[1], np.arange(plate.base.shape[1])
    found: Columns = {}
    by_damping = np.broadcast_to(1j * model.omega[:, None], plate.base.shape)
    for kind, change in (
        ("stiffness", np.broadcast_to(values.stiffness, plate.base.shape)),
        ("damping_added", by_damping),
    ):
        found[kind] = _held(plate, eras, change)
        # The base moves through spring and damper.
        found[kind][:, :, eras, eras] += Y * (change / plate.base)[:, None]
    found["damping_each"] = found["damping_added"] * values.damping
    found["damping"] = found["damping_each"].sum(axis=-1, keepdims=True)
    found["bolt_mass"] = _held(plate, eras, -_per_frequency(plate, n))
    first = n + len(model.rig.masses) + model.mass_count
    by_finger = [
        _held(plate, np.full(4, first + number), slopes)
        for number, slopes in enumerate(plate.finger_slopes)
    ]
    found["fingers"] = np.concatenate([np.zeros((*Y.shape, 0)), *by_finger], axis=-1)
    return found


def _by_gains(plate: PlateAt) -> Columns:
    Y = plate.responses
    by_drive = Y[..., None] * np.eye(Y.shape[2])
    by_sensor = Y[..., None] * np.eye(Y.shape[1])[:, None]
    f = 1e-3 * plate.model.frequencies[:, None]
    by_inertia, by_drag = f**2 * plate.lag, -1j * f * plate.lag
    return {
        "gain": by_drive,
        "phase": 1j * by_drive,
        "inertia": by_drive * by_inertia[:, None, None],
        "drag": by_drive * by_drag[:, None, None],
        "sensor_gain": by_sensor,
        "sensor_phase": 1j * by_sensor,
    }


_GROUPS: dict[Callable[[PlateAt], Columns], tuple[str, ...]] = {
    _by_plate: ("thickness", "modulus", "loss", "loss_added", "loss_exponent"),
    _by_modes: ("mode_shifts", "mode_losses"),
    _by_places: ("place", "masses"),
    _by_attachments: (
        "stiffness",
        "damping",
        "damping_each",
        "damping_added",
        "bolt_mass",
        "fingers",
    ),
    _by_gains: ("gain", "phase", "inertia", "drag", "sensor_gain", "sensor_phase"),
}


def _per_frequency(plate: PlateAt, count: int) -> FloatArray:
    """omega² for a number of masses, (f, count)."""
    return np.repeat((plate.model.omega**2)[:, None], count, axis=1)


def _held(plate: PlateAt, at: IntArray, change: AnyArray) -> ComplexArray:
    """Responses by changes (f, m) of the dynamic stiffness of attachments (m,)."""
    columns = plate.receptance[:, :, at]
    return _outer(plate, columns, columns, -change)


def _outer(plate: PlateAt, u: AnyArray, v: AnyArray, factor: AnyArray) -> ComplexArray:
    """Responses of T = factor u v^T, (f, s, n, m), of columns (f, a, m) and factors (f, m)."""
    left = u[:, plate.model.observed] * factor[:, None]
    found = left[:, :, None] * v[:, None, : plate.base.shape[1]]
    return np.asarray(found * plate.scale[..., None])
