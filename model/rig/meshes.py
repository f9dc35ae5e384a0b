"""The text of a mesh, in a rig's and in a table's file."""

import re

from model.config.fields import LENGTH, RATIO, Quantity, quantity
from model.errors import InputError
from model.fem import MITC4, Mesh, element_of
from model.spectral.mesh import MAX_DEGREE, MAX_POLYNOMIALS, POLYNOMIALS, PlateMesh, SpectralMesh
from model.structure.plate import Plate

_MAX_ELEMENTS_PER_SIDE = 1000
_ACCURACY = Quantity(RATIO, at_least=0.0005, at_most=0.1)
_DEFAULT_ACCURACY = 0.01  # places within 0.1 mm of an ERA's change the response as much
_MAX_NODES = 300_000  # a million degrees of freedom: minutes, and most of a machine's memory

_STRIPS = " with strips of "


def mesh_of(
    text: str, plate: Plate, *, frequency_max: float, stiffness: float = 0.0, foot: float = 0.0
) -> PlateMesh:
    """The mesh `auto` or `auto A %`, accurate up to a frequency [Hz], or that of `parse_mesh`.

    Those are of polynomials over the plate for an error of the response of A %, by default 1 %.
    stiffness [N/m]: of the stiffest ERA; foot [m]: radius of the smallest, 0 for a point.
    """
    words = text.split()
    if words[:1] != ["auto"]:
        mesh = parse_mesh(text, plate)
        if isinstance(mesh, Mesh) and max(mesh.nx, mesh.ny) > _MAX_ELEMENTS_PER_SIDE:
            raise InputError(
                f"mesh must have 1 to {_MAX_ELEMENTS_PER_SIDE} elements a side, got {mesh}"
            )
        if isinstance(mesh, Mesh) and mesh.node_count > _MAX_NODES:
            raise InputError(f"mesh must have at most {_MAX_NODES} nodes, got {mesh}")
        return mesh
    asked = " ".join(words[1:]) or _DEFAULT_ACCURACY
    try:
        accuracy = _ACCURACY.read(asked)
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


def parse_mesh(text: str, plate: Plate) -> PlateMesh:
    """The mesh `NXxNY`, or `NXxNY ELEMENT`, over a plate; with Legendre the numbers are degrees.

    Elements may be `with strips of` a length, as a mesh is printed. Raises InputError for other
    text, an unknown element, and no elements.
    """
    match = re.fullmatch(
        rf"\s*(\d{{1,6}})\s*[xX×]\s*(\d{{1,6}})(?:\s+(\S{{1,40}}))?(?:{_STRIPS}(.{{1,40}}))?\s*",
        text,
        re.ASCII,
    )
    if match is None:
        raise InputError(
            f"mesh must be auto, auto 1 %, or NXxNY with an optional element, for example 48x36 "
            f"or 12x9 Q3, got {text[:40]!r}"
        )
    nx, ny = int(match[1]), int(match[2])
    strip = quantity(match[4], LENGTH) if match[4] else 0.0
    if match[3] == POLYNOMIALS:
        if strip:
            raise InputError(f"mesh of polynomials must be without strips, got {text[:40]!r}")
        return SpectralMesh(nx, ny, plate.length, plate.width)
    element = element_of(match[3]) if match[3] else MITC4
    return Mesh(nx=nx, ny=ny, length=plate.length, width=plate.width, element=element, strip=strip)
