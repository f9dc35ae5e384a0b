"""Derivatives of a plate's responses by all of its parameters, and by a mass at any point.

With L = 1 - T Z, a change dA of the free receptance and dZ of what is attached change the
receptance T of the plate on its attachments by L dA L^T - T dZ T. For a mode, a place or an
attachment that is a change of rank one or two (symbols as in `model.estimate.forward`). A
sensor of mass m that is on the plate while it measures adds l² w² m T_sj dT_ss to l dT_sj."""

from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from model.arrays import ComplexArray, FloatArray, IntArray
from model.estimate.forward import MIN_LOSS_FACTOR, PlateAt
from model.estimate.space import EXCITER_KINDS
from model.reduction.free_plate import TERMS, combined
from model.structure.plate import LOSS_FREQUENCY

AnyArray: TypeAlias = NDArray[np.floating[Any]] | NDArray[np.complexfloating[Any, Any]]


def jacobian(plate: PlateAt, searched: NDArray[np.bool_] | None = None) -> ComplexArray:
    """Derivatives of the responses of a plate by x, (f, s, n, p).

    searched (p,): those of interest; of kinds without any they may be zero. By default all.
    """
    space = plate.model.space
    found = np.zeros((*plate.responses.shape, space.size), dtype=complex)
    for group, kinds in _GROUPS.items():
        wanted = space.of(*kinds)
        if not (wanted if searched is None else wanted & searched).any():
            continue
        for kind, columns in group(plate).items():
            found[..., space.groups[kind]] = columns * space.std[space.groups[kind]]
    return found


def by_mass_at(plate: PlateAt, points: FloatArray) -> ComplexArray:
    """Derivatives of the responses by a mass [kg] at points (p, 2) [m], (f, s, n, p)."""
    reach = reach_to(plate, points)
    return _outer(plate, reach, reach, _per_frequency(plate, len(points)))


def reach_to(plate: PlateAt, points: FloatArray) -> ComplexArray:
    """Motion of what is attached by forces at points (p, 2) [m], (f, a, p)."""
    modes, functions = plate.model.modes, plate.functions
    truncated = modes.truncated_terms(plate.located.footprints, points)
    by_modes = plate.reach @ modes.shapes_at(points).T
    return np.asarray(by_modes + plate.left @ combined(functions.truncated(TERMS), truncated))


Columns: TypeAlias = dict[str, ComplexArray]
"""Derivatives (f, s, n, m) by the m parameters of a kind, in the units of `Values`."""


def _by_plate(plate: PlateAt) -> Columns:
    """Derivatives by thickness, modulus and loss factor of the whole plate."""
    functions, reach = plate.functions, plate.reach
    seen, driven = reach[:, plate.model.observed], reach[:, _pushed(plate)].swapaxes(1, 2)

    def responses(of_modes: ComplexArray | float, of_rest: ComplexArray | float) -> ComplexArray:
        """Derivatives by a change of the log stiffness of modes (f, r) and of all else (f,)."""
        change = (seen * (of_modes * functions.elastic)[:, None]) @ driven
        if plate.bending is not None:
            change += seen @ (plate.bending * np.reshape(of_rest, (-1, 1, 1))) @ driven
        rest = np.asarray(of_rest)[..., None] * functions.truncated_by_log_q
        further = _attached(plate, combined(rest, plate.located.truncated))
        return _responses(plate, further - functions.thickness**3 * change)[..., None]

    by_stiffness = responses(1.0, 1.0)
    by_loss = responses(plate.by_loss, plate.by_loss_of_rest)
    by_mass = _responses(plate, _attached(plate, plate.free_receptance))
    powers = np.log(plate.model.frequencies / LOSS_FREQUENCY)[:, None, None, None]
    return {
        "thickness": 2 * by_stiffness - by_mass[..., None],
        "modulus": by_stiffness,
        "loss": by_loss,
        "loss_added": by_loss / max(plate.values.loss_factor, MIN_LOSS_FACTOR),
        "loss_exponent": powers * by_loss,
    }


def _attached(plate: PlateAt, change: ComplexArray) -> ComplexArray:
    """Change of T as `_responses` takes it, by one of the free receptance (f, a, a)."""
    left = plate.left
    return np.asarray(
        left[:, plate.model.observed] @ change @ left[:, _pushed(plate)].swapaxes(1, 2)
    )


def _by_modes(plate: PlateAt) -> Columns:
    modes, functions = plate.model.shifted_modes, plate.functions
    reach = plate.reach[:, :, modes]
    by_stiffness = -(functions.thickness**3) * functions.elastic[:, modes]
    return {
        "mode_shifts": _outer(plate, reach, reach, by_stiffness),
        "mode_losses": _outer(plate, reach, reach, plate.by_mode_loss[:, modes] * by_stiffness),
    }


def _by_form(plate: PlateAt) -> Columns:
    """Derivatives by form errors: foreign mass and sides, which couple modes, and the loss law."""
    model, functions = plate.model, plate.functions
    if model.form is None:
        return {}
    reach = plate.reach @ model.form.cells.T
    share = model.rig.plate.mass * functions.thickness
    by_mass = _outer(plate, reach, reach, share * _per_frequency(plate, reach.shape[-1]))
    seen, driven = plate.reach[:, model.observed], plate.reach[:, _pushed(plate)].swapaxes(1, 2)
    factor = -(functions.q * functions.thickness)[:, None, None]
    stretched = [
        _responses(plate, factor * (seen @ slope @ driven)) for slope in model.form.stiffening
    ]
    sides = np.array([model.rig.plate.length, model.rig.plate.width])
    law = np.zeros(plate.scale.shape) if model.law is None else plate.scale * model.law
    return {
        "foreign_mass": by_mass - by_mass.mean(axis=-1, keepdims=True),
        "loss_law": law[..., None],
        "side": np.stack(stretched[:2], axis=-1) / sides,
        "poisson": stretched[2][..., None],
    }


def _by_places(plate: PlateAt) -> Columns:
    """Derivatives by the places of ERAs and sensors, and by additional masses and their places.

    A place changes the receptance in its row and its column.
    """
    model = plate.model
    n, moved = plate.force.shape[1], np.repeat(model.movable, 2)
    located, functions = plate.located, plate.functions
    rows = located.shape_slopes @ plate.moved
    rows = rows + combined(functions.truncated(TERMS), located.truncated_slopes)
    reach, own = plate.left @ rows.swapaxes(1, 2), plate.left[:, :, moved]
    ones = np.ones((len(model.omega), len(moved)))
    by_place = _outer(plate, own, reach, ones)
    by_place += _outer(plate, reach, own, ones)
    places, of_masses, of_sensors = np.split(by_place, [2 * n, 2 * (n + model.mass_count)], axis=-1)
    masses = np.empty((*by_place.shape[:-1], model.mass_count, 3), dtype=complex)
    masses[..., 1:] = of_masses.reshape(masses[..., 1:].shape)
    by_mass = _per_frequency(plate, model.mass_count)
    masses[..., 0] = _held(plate, model.movable[n : n + model.mass_count], -by_mass)
    return {
        "place": places,
        "sensor_place": of_sensors,
        "masses": masses.reshape(*by_place.shape[:-1], -1),
    }


def _by_attachments(plate: PlateAt) -> Columns:
    """Derivatives by the values of ERAs, which also drive through them, by feet and by fingers."""
    model, values, Y = plate.model, plate.values, plate.responses
    n = plate.force.shape[1]
    eras, slopes = np.arange(n), [each.slopes(model.omega) for each in plate.sources]
    none = np.zeros((2, len(model.omega)), dtype=complex)
    found: Columns = {}
    for kind in ("stiffness", "damping", "bolt_mass", *EXCITER_KINDS):
        change, of_force = np.array([each.get(kind, none) for each in slopes]).transpose(1, 2, 0)
        found[kind] = _held(plate, eras, change)
        found[kind][:, :, eras, eras] += Y * (of_force / plate.full_levels / plate.force)[:, None]
    for kind in EXCITER_KINDS:
        found[kind] = found[kind][..., : len(model.space.indices(kind))]
    found["damping_added"] = found["damping"]
    found["damping_each"] = found["damping"] * values.damping
    found["damping"] = found["damping_each"].sum(axis=-1, keepdims=True)
    feet = np.array([n + number for number in model.rig.feet], dtype=int)
    found["supports"] = _held(plate, feet, values.supports * model.springs)
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
    count = len(plate.values.delays)
    lateness = plate.model.lateness if count else np.zeros((*Y.shape[1:], 0))
    return {
        "gain": by_drive,
        "phase": 1j * by_drive,
        "inertia": by_drive * by_inertia[:, None, None],
        "drag": by_drive * by_drag[:, None, None],
        "delay": -1j * plate.model.omega[:, None, None, None] * Y[..., None] * lateness,
        "sensor_gain": by_sensor,
        "sensor_phase": 1j * by_sensor,
        "sensor_scale": _by_scale(plate),
    }


def _by_scale(plate: PlateAt) -> ComplexArray:
    """Derivatives by the scale of each sensor, which may be zero."""
    count = len(plate.values.sensor_scales)
    plain = plate.values.sensor_gains[:, None] * plate.drive[:, None] * plate.late
    return np.asarray(
        (plain * plate.seen)[..., None] * np.eye(len(plate.model.observed), count)[:, None]
    )


_GROUPS: dict[Callable[[PlateAt], Columns], tuple[str, ...]] = {
    _by_plate: ("thickness", "modulus", "loss", "loss_added", "loss_exponent"),
    _by_modes: ("mode_shifts", "mode_losses"),
    _by_places: ("place", "masses", "sensor_place"),
    _by_form: ("foreign_mass", "loss_law", "side", "poisson"),
    _by_attachments: (
        "stiffness",
        "damping",
        "damping_each",
        "damping_added",
        "bolt_mass",
        *EXCITER_KINDS,
        "supports",
        "fingers",
    ),
    _by_gains: (
        "gain",
        "phase",
        "inertia",
        "drag",
        "delay",
        "sensor_gain",
        "sensor_phase",
        "sensor_scale",
    ),
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
    return _responses(plate, np.asarray(left[:, :, None] * v[:, None, _pushed(plate)]))


def _pushed(plate: PlateAt) -> slice | IntArray:
    """Columns of T whose changes count: those of ERAs, then of sensors that load the plate."""
    n = plate.force.shape[1]
    if plate.lightness is None:
        return slice(n)
    return np.concatenate([np.arange(n), plate.model.observed])


def _responses(plate: PlateAt, change: AnyArray) -> ComplexArray:
    """Change of the responses (f, s, n, ...) by one of T (f, s, columns of `_pushed`, ...)."""
    further = (1,) * (change.ndim - 3)
    n, at = plate.force.shape[1], np.arange(change.shape[1])
    found = change[:, :, :n]
    if plate.lightness is not None:
        assert plate.model.sensor_inertia is not None  # noqa: S101  there is a mass
        loaded = plate.model.sensor_inertia[:, :, None] * plate.loaded
        own = change[:, at, n + at][:, :, None]
        found = found + loaded.reshape(*loaded.shape, *further) * own
        found = found * plate.lightness.reshape(*plate.lightness.shape, 1, *further)
    return np.asarray(found * plate.scale.reshape(*plate.scale.shape, *further))
