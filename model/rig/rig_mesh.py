"""Mesh of a rig from the text of its `mesh` key."""

import re

from model.config.fields import Quantity
from model.config.units import LENGTH, RATIO, quantity
from model.errors import InputError
from model.fem import MITC4, Mesh, element_of
from model.spectral.plate_mesh import (
    MAX_DEGREE,
    MAX_POLYNOMIALS,
    POLYNOMIALS,
    KnownModes,
    PlateMesh,
    SpectralMesh,
)
from model.structure.plate import Plate

_MAX_ELEMENTS_PER_SIDE = 1000

_MAX_NODES = 300_000  # a million degrees of freedom: minutes, and most of the memory

_ACCURACY = Quantity(RATIO, at_least=0.0005, at_most=0.1)

_DEFAULT_ACCURACY = 0.01  # changes the response as much as 0.1 mm of an ERA's position

_MESH = re.compile(
    r"\s*(?P<nx>\d{1,6})\s*[xX×]\s*(?P<ny>\d{1,6})(?:\s+(?P<element>\S{1,40}))?"
    r"(?: with strips of (?P<strip>.{1,40}))?\s*",
    re.ASCII,
)


def mesh_of(
    text: str, plate: Plate, *, frequency_max: float, stiffness: float = 0.0, foot: float = 0.0
) -> PlateMesh:
    """Return the mesh `auto` or `auto A %`, accurate up to a frequency [Hz], or the mesh of
    `parse_mesh`.

    `auto` uses polynomials over the plate for a response error of A %, default 1 %. stiffness
    [N/m]: of the stiffest ERA; foot [m]: smallest contact radius, 0 for a point.
    """
    words = text.split()
    is_automatic = words[:1] == ["auto"]
    if plate.surface is not None:
        if words != ["auto"]:
            raise InputError(
                f"mesh must not be given for a surface, whose modes are known, got {text[:40]!r}"
            )
        return KnownModes.of(plate, plate.surface)
    if not is_automatic:
        mesh = parse_mesh(text, plate)
        if isinstance(mesh, Mesh):
            _check_size(mesh)
        return mesh
    try:
        accuracy = _ACCURACY.read(" ".join(words[1:]) or _DEFAULT_ACCURACY)
    except ValueError as error:
        raise InputError(f"mesh: the accuracy of auto {error}; for example auto 1 %") from None
    polynomials = SpectralMesh.accurate(
        plate, frequency_max=frequency_max, accuracy=accuracy, stiffness=stiffness, foot=foot
    )
    if polynomials is None:
        raise InputError(
            f"mesh: {text} must need at most {MAX_POLYNOMIALS} polynomials up to degree "
            f"{MAX_DEGREE}, got more up to {frequency_max:g} Hz; check the plate's sizes, lower "
            "limits.frequency, or ask for less accuracy"
        )
    return polynomials


def _check_size(mesh: Mesh) -> None:
    """Raise InputError for a mesh of too many elements or nodes."""
    if max(mesh.nx, mesh.ny) > _MAX_ELEMENTS_PER_SIDE:
        raise InputError(
            f"mesh must have 1 to {_MAX_ELEMENTS_PER_SIDE} elements a side, got {mesh}"
        )
    if mesh.node_count > _MAX_NODES:
        raise InputError(f"mesh must have at most {_MAX_NODES} nodes, got {mesh}")


def parse_mesh(text: str, plate: Plate) -> PlateMesh:
    """Parse the mesh `NXxNY`, or `NXxNY ELEMENT`, over a plate; Legendre numbers are degrees.

    Elements can have `with strips of` a length, as a mesh is printed. Raises InputError for other
    text, an unknown element, and zero elements.
    """
    if plate.surface is not None:
        return KnownModes.of(plate, plate.surface)
    match = _MESH.fullmatch(text)
    if match is None:
        raise InputError(
            f"mesh must be auto, auto 1 %, or NXxNY with an optional element, for example 48x36 "
            f"or 12x9 Q3, got {text[:40]!r}"
        )
    nx, ny = int(match["nx"]), int(match["ny"])
    strip = quantity(match["strip"], LENGTH) if match["strip"] else 0.0
    if match["element"] == POLYNOMIALS:
        if strip:
            raise InputError(f"mesh of polynomials must be without strips, got {text[:40]!r}")
        return SpectralMesh(nx, ny, plate.length, plate.width)
    element = element_of(match["element"]) if match["element"] else MITC4
    return Mesh(nx=nx, ny=ny, length=plate.length, width=plate.width, element=element, strip=strip)
