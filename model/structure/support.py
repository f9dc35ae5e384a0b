"""Whether springs support a plate: whether they hold all of its rigid-body modes."""

from collections.abc import Sequence

import numpy as np

from model.arrays import FloatArray
from model.errors import InputError
from model.structure.attachments import PointLoad, Source
from model.structure.plate import Plate

GRAVITY = 9.81  # m/s²

MIN_RIGID_BODY_FREQUENCY = 1.0
"""Hz. Under its own weight a plate moves by g / omega²: 25 cm in a mode of this frequency."""


def rigid_body_frequencies(
    plate: Plate, eras: Sequence[Source], *, loads: Sequence[PointLoad] = ()
) -> FloatArray:
    """Natural frequencies (3,) [Hz] of the rigid plate on its springs, ascending.

    Heave and two tilts: w = q0 + q1 (x - L/2) + q2 (y - W/2). K = sum k p p', M = plate + sum m
    p p' with p = (1, x - L/2, y - W/2). A mode that no spring holds has frequency 0.
    """
    p, stiffness, mass = _attached(plate, eras, loads)
    K = (p * stiffness) @ p.T
    M = (p * mass) @ p.T + np.diag(plate.rigid_masses)
    inverse = np.linalg.inv(np.linalg.cholesky(M))
    eigenvalues = np.linalg.eigvalsh(inverse @ K @ inverse.T)
    return np.asarray(np.sqrt(np.maximum(eigenvalues, 0.0)) / (2 * np.pi))


def static_loads(
    plate: Plate, eras: Sequence[Source], *, loads: Sequence[PointLoad] = ()
) -> FloatArray:
    """Weight [N] of the rigid plate on each ERA, and then on each spring among the loads.

    An exciter whose magnet is free carries nothing: it is left out, and weighs.

    At least three springs are not in one line. K q = sum of weights p, reactions k p' q.
    """
    p, stiffness, mass = _attached(plate, eras, loads)
    weight = GRAVITY * (p @ mass + [plate.mass, 0, 0])
    q = np.linalg.solve((p * stiffness) @ p.T, weight)
    return np.asarray((stiffness * (q @ p))[stiffness > 0])


def _attached(
    plate: Plate, eras: Sequence[Source], loads: Sequence[PointLoad]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Factors p (3, n), stiffness [N/m] and mass [kg] (n,) of what is attached.

    In units of the plate's sides, in which both tilts have the size of the heave.
    """
    attached = [*(era.support for era in eras), *loads]
    mounts = [(at.x, at.y, at.stiffness, at.mass) for at in attached]
    x, y, stiffness, mass = np.array(mounts, dtype=float).reshape(-1, 4).T
    p = np.stack([np.ones_like(x), x / plate.length - 0.5, y / plate.width - 0.5])
    return p, stiffness, mass


def support_problem(
    plate: Plate, eras: Sequence[Source], *, loads: Sequence[PointLoad] = ()
) -> str | None:
    """Why ERAs and loads do not support a plate, with the remedy; None if they do."""
    lowest = rigid_body_frequencies(plate, eras, loads=loads)[0]
    if lowest >= MIN_RIGID_BODY_FREQUENCY:
        return None
    return (
        f"the plate is not supported: its lowest rigid-body frequency must be at least "
        f"{MIN_RIGID_BODY_FREQUENCY:g} Hz, got {lowest:.2g} Hz; put at least three ERAs or "
        "supports under it, stiff enough and not in one line; a free exciter holds nothing"
    )


def check_supported(
    plate: Plate, eras: Sequence[Source], *, loads: Sequence[PointLoad] = ()
) -> None:
    """Raise InputError for a plate that its ERAs and loads do not support."""
    if (problem := support_problem(plate, eras, loads=loads)) is not None:
        raise InputError(problem)
