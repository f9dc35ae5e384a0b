"""Whether springs support a plate: whether they hold all of its rigid-body modes."""

from collections.abc import Sequence

import numpy as np
from scipy.linalg import eigh

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
    # In units of the plate's sides both tilts have the size of the heave.
    p = np.array([[1.0, at.x / plate.length - 0.5, at.y / plate.width - 0.5] for at in attached])
    p = p.reshape(-1, 3)
    K = (p.T * [at.stiffness for at in attached]) @ p
    M = plate.mass * np.diag([1.0, 1 / 12, 1 / 12]) + (p.T * [at.mass for at in attached]) @ p
    eigenvalues = eigh(K, M, eigvals_only=True)
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
