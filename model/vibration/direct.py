"""Response of a plate solved directly at each frequency, whatever it is solved with."""

from collections.abc import Sequence
from functools import partial
from typing import Protocol

from model.arrays import ComplexArray, FloatArray
from model.fem.mesh import Mesh
from model.fem.plate import assemble, direct_acceleration
from model.spectral.direct import direct_spectral_acceleration
from model.spectral.mesh import PlateMesh, SpectralMesh
from model.structure.actuator import Era
from model.structure.plate import Plate
from model.structure.point_load import Load


class Responder(Protocol):
    """Acceleration [m/s²] at points per frequency [Hz] and driven ERA: (f, eras, p)."""

    def __call__(
        self,
        eras: Sequence[Era],
        frequencies: FloatArray,
        points: FloatArray,
        *,
        loads: Sequence[Load] = (),
    ) -> ComplexArray:
        """Solve for one tone of each ERA alone at full stroke."""


def direct_responder(plate: Plate, mesh: PlateMesh) -> Responder:
    """Direct solution of a plate on a mesh, the check of its reduction."""
    match mesh:
        case SpectralMesh():
            return partial(direct_spectral_acceleration, plate, mesh)
        case Mesh():
            return partial(direct_acceleration, assemble(plate, mesh))
        case _:
            raise TypeError(f"mesh must be a Mesh or SpectralMesh, got {type(mesh).__name__}")
