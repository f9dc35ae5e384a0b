"""Response of a plate solved directly at each frequency, whatever it is solved with."""

from collections.abc import Callable
from functools import partial
from typing import TypeAlias

from model.arrays import ComplexArray
from model.fem.mesh import Mesh
from model.fem.plate import assemble, direct_acceleration
from model.spectral.direct import direct_spectral_acceleration
from model.spectral.mesh import PlateMesh
from model.structure.plate import Plate

Responder: TypeAlias = Callable[..., ComplexArray]
"""Acceleration [m/s²] of each ERA alone at full stroke, (f, eras, p).

Of ERAs, frequencies (f,) [Hz], points (p, 2) [m], and loads by name.
"""


def direct_responder(plate: Plate, mesh: PlateMesh) -> Responder:
    """Direct solution of a plate on a mesh, the check of its reduction."""
    if isinstance(mesh, Mesh):
        return partial(direct_acceleration, assemble(plate, mesh))
    return partial(direct_spectral_acceleration, plate, mesh)
