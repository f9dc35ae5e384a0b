"""The text of a rig's mesh, and a mesh in a table's file."""

import re
from collections.abc import Mapping
from typing import Any

from model.errors import InputError
from model.fem.element_registry import element_of
from model.fem.mesh import PAPER_ELEMENT, Mesh
from model.fem.plate_mesh import PlateMesh
from model.spectral.mesh import POLYNOMIALS, SpectralMesh
from model.structure.plate import Plate

_MAX_ELEMENTS_PER_SIDE = 1000
_MIN_PERCENT, _MAX_PERCENT = 0.05, 10.0
_MAX_AUTO_NODES = 300_000  # a million degrees of freedom: minutes, and most of a machine's memory


def mesh_of(text: str, plate: Plate, *, frequency_max: float, stiffness: float = 0.0) -> PlateMesh:
    """The mesh `auto` or `auto A %`, accurate up to a frequency [Hz], or that of `parse_mesh`.

    `auto` is of finite elements, `auto A %` of polynomials over the plate for an error of the
    response of A %. stiffness [N/m]: of the stiffest ERA.
    """
    words = text.split()
    if words[:1] != ["auto"]:
        return parse_mesh(text, plate)
    if len(words) > 1:
        accuracy = _accuracy(" ".join(words[1:]))
        return SpectralMesh.accurate(
            plate, frequency_max=frequency_max, accuracy=accuracy, stiffness=stiffness
        )
    mesh = Mesh.accurate(plate, frequency_max=frequency_max)
    if mesh.node_count > _MAX_AUTO_NODES:
        raise InputError(
            f"auto must have at most {_MAX_AUTO_NODES} nodes, got {mesh} elements up to "
            f"{frequency_max:g} Hz; check the plate's sizes, or lower limits.frequency"
        )
    return mesh


def _accuracy(text: str) -> float:
    """The share that a percentage names."""
    match = re.fullmatch(r"(\d{1,3}(?:\.\d{1,6})?) ?%", text, re.ASCII)
    percent = float(match[1]) if match else 0.0
    if not _MIN_PERCENT <= percent <= _MAX_PERCENT:
        raise InputError(
            f"mesh: the accuracy of auto must be {_MIN_PERCENT:g} % to {_MAX_PERCENT:g} %, for "
            f"example auto 1 %, got {text[:40]!r}"
        )
    return percent / 100


def parse_mesh(text: str, plate: Plate) -> PlateMesh:
    """The mesh `NXxNY`, or `NXxNY ELEMENT`, over a plate; with Legendre the numbers are degrees.

    Raises InputError for other text, an unknown element, and too many elements.
    """
    match = re.fullmatch(r"\s*(\d{1,6})\s*[xX×]\s*(\d{1,6})(?:\s+(\S{1,40}))?\s*", text, re.ASCII)
    if match is None:
        raise InputError(
            f"mesh must be auto, auto 1 %, or NXxNY with an optional element, for example 48x36 "
            f"or 12x9 Q3, got {text[:40]!r}"
        )
    nx, ny = int(match[1]), int(match[2])
    if match[3] == POLYNOMIALS:
        return SpectralMesh(nx, ny, plate.length, plate.width)
    if not 1 <= min(nx, ny) <= max(nx, ny) <= _MAX_ELEMENTS_PER_SIDE:
        raise InputError(
            f"mesh must have 1 to {_MAX_ELEMENTS_PER_SIDE} elements a side, got {nx}x{ny}"
        )
    element = element_of(match[3]) if match[3] else PAPER_ELEMENT
    return Mesh(nx=nx, ny=ny, length=plate.length, width=plate.width, element=element)


def mesh_from_dict(values: Mapping[str, Any]) -> PlateMesh:
    """Make the mesh of its `to_dict`; raises InputError for an unknown element."""
    if values["element"] == POLYNOMIALS:
        return SpectralMesh(*(values[key] for key in ("nx", "ny", "length", "width")))
    return Mesh(**{**values, "element": element_of(values["element"])})
