"""Whether springs support a plate: whether they hold all of its rigid-body modes."""

from collections.abc import Sequence

import numpy as np

from model.arrays import FloatArray
from model.errors import InputError
from model.structure.actuator import Era
from model.structure.plate import Plate
from model.structure.point_load import PointLoad

MIN_RIGID_BODY_FREQUENCY = 1.0
"""Hz. Under its own weight a plate moves by g / omega²: 25 cm in a mode of this frequency."""


def rigid_body_frequencies(
    plate: Plate, eras: Sequence[Era], *, loads: Sequence[PointLoad] = ()
) -> FloatArray:
    """Natural frequencies (3,) [Hz] of the rigid plate on its springs, ascending.

    Heave and two tilts: w = q0 + q1 (x - L/2) + q2 (y - W/2). K = sum k p p', M = plate + sum m
    p p' with p = (1, x - L/2, y - W/2). A mode that no spring holds has frequency 0.
    """
    attached = [*(PointLoad.of_era(era) for era in eras), *loads]
    mounts = [(at.x, at.y, at.stiffness, at.mass) for at in attached]
    x, y, stiffness, mass = np.array(mounts, dtype=float).reshape(-1, 4).T
    return rigid_body_frequencies_of(plate, np.stack([x, y], axis=-1), stiffness, mass)


def rigid_body_frequencies_of(
    plate: Plate, places: FloatArray, stiffness: FloatArray, mass: FloatArray
) -> FloatArray:
    """As `rigid_body_frequencies`, (..., 3), of many layouts at once.

    places [m] (..., n, 2), stiffness [N/m] and mass [kg] (..., n) of what is attached.
    """
    # In units of the plate's sides both tilts have the size of the heave.
    tilts = places / [plate.length, plate.width] - 0.5
    p = np.concatenate([np.ones_like(tilts[..., :1]), tilts], axis=-1)
    K = (p * stiffness[..., None]).swapaxes(-1, -2) @ p
    M = (p * mass[..., None]).swapaxes(-1, -2) @ p
    M += plate.mass * np.diag([1.0, 1 / 12, 1 / 12])
    inverse = np.linalg.inv(np.linalg.cholesky(M))
    eigenvalues = np.linalg.eigvalsh(inverse @ K @ inverse.swapaxes(-1, -2))
    return np.asarray(np.sqrt(np.maximum(eigenvalues, 0.0)) / (2 * np.pi))


def support_problem(
    plate: Plate, eras: Sequence[Era], *, loads: Sequence[PointLoad] = ()
) -> str | None:
    """Why ERAs and loads do not support a plate, with the remedy; None if they do."""
    lowest = rigid_body_frequencies(plate, eras, loads=loads)[0]
    if lowest >= MIN_RIGID_BODY_FREQUENCY:
        return None
    return (
        f"the plate is not supported: its lowest rigid-body frequency must be at least "
        f"{MIN_RIGID_BODY_FREQUENCY:g} Hz, got {lowest:.2g} Hz; put at least three ERAs under it, "
        "stiff enough and not in one line"
    )


def check_supported(plate: Plate, eras: Sequence[Era], *, loads: Sequence[PointLoad] = ()) -> None:
    """Raise InputError for a plate that its ERAs and loads do not support."""
    problem = support_problem(plate, eras, loads=loads)
    if problem is not None:
        raise InputError(problem)
