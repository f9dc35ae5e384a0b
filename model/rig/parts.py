"""From the sections of a rig file to the values that the model computes with."""

import math
import re

from model.errors import InputError
from model.fem.elements import element_of
from model.fem.mesh import PAPER_ELEMENT, Mesh
from model.rig.rig import Limits
from model.rig.sections import EraSection, LimitsSection, MassSection, MaterialSection, PlateSection
from model.structure.actuator import Era, damping_from_ratio
from model.structure.laminate import Laminate, Layer, equivalent_plate
from model.structure.plate import Material, Plate
from model.structure.point_mass import PointMass

_MOST_ELEMENTS_PER_SIDE = 1000
_MOST_AUTO_NODES = 300_000  # a million degrees of freedom: minutes, and most of a machine's memory


def plate_of(section: PlateSection) -> Plate:
    """The plate, of a laminate the equivalent one."""
    laminate = laminate_of(section)
    if laminate is not None:
        return equivalent_plate(
            laminate, length=section.length, width=section.width, loss_factor=section.loss_factor
        )
    assert section.thickness is not None  # noqa: S101  model.rig.checks has seen to both
    assert section.material is not None  # noqa: S101
    return Plate(
        length=section.length,
        width=section.width,
        thickness=section.thickness,
        material=_material(section.material),
        loss_factor=section.loss_factor,
    )


def laminate_of(section: PlateSection) -> Laminate | None:
    """What the plate is made of, if of layers."""
    if section.layers is None:
        return None
    layers = (Layer(_material(layer.material), layer.thickness) for layer in section.layers)
    return Laminate(tuple(layers), bond=section.bond, bond_frequency=section.bond_frequency)


def era_of(name: str, section: EraSection, plate: Plate, *, era_count: int) -> Era:
    """An ERA under the plate, which it shares with others."""
    damping = section.damping
    if damping is None:
        damping = damping_from_ratio(
            section.damping_ratio,
            stiffness=section.stiffness,
            plate_mass=plate.mass,
            era_count=era_count,
        )
    x, y = _onto(plate, section.at)
    return Era(
        name=name,
        x=x,
        y=y,
        stiffness=section.stiffness,
        damping=damping,
        bolt_mass=section.bolt_mass,
        stroke=section.stroke,
        gains=tuple((f, size, math.radians(phase)) for f, size, phase in section.gains or ()),
    )


def mass_of(section: MassSection, plate: Plate) -> PointMass:
    """A mass on the plate."""
    x, y = _onto(plate, section.at)
    return PointMass(x, y, section.mass)


def limits_of(section: LimitsSection) -> Limits:
    """What no command may exceed; no limit where none is given."""
    low, high = section.frequency
    given = section.model_dump(exclude={"frequency"}, exclude_none=True)
    return Limits(frequency_min=low, frequency_max=high, **given)


def mesh_of(text: str, plate: Plate, *, frequency_max: float) -> Mesh:
    """The mesh `auto`, good up to a frequency [Hz], or one as parse_mesh reads it."""
    if text != "auto":
        return parse_mesh(text, plate)
    mesh = Mesh.auto(plate, frequency_max=frequency_max)
    if mesh.node_count > _MOST_AUTO_NODES:
        raise InputError(
            f"auto: this plate would need {mesh} elements up to {frequency_max:g} Hz, more than "
            f"{_MOST_AUTO_NODES} nodes; check its sizes, or lower limits.frequency"
        )
    return mesh


def parse_mesh(text: str, plate: Plate) -> Mesh:
    """The mesh `NXxNY`, or `NXxNY ELEMENT`, over a plate.

    Raises InputError for what is none, for an element that nobody knows, and beyond all reason.
    """
    match = re.fullmatch(r"\s*(\d{1,6})\s*[xX×]\s*(\d{1,6})(?:\s+(\S{1,40}))?\s*", text, re.ASCII)
    if match is None:
        raise InputError(
            f"mesh {text[:40]!r} is not understood; write the number of elements along x and y, "
            "for example 48x36, and if wanted an element's name after them: 12x9 Q3"
        )
    nx, ny = int(match[1]), int(match[2])
    if not 1 <= min(nx, ny) <= max(nx, ny) <= _MOST_ELEMENTS_PER_SIDE:
        raise InputError(
            f"mesh {nx}x{ny} cannot be used; each side takes 1 to {_MOST_ELEMENTS_PER_SIDE}"
            " elements"
        )
    element = element_of(match[3]) if match[3] else PAPER_ELEMENT
    return Mesh(nx=nx, ny=ny, length=plate.length, width=plate.width, element=element)


def _material(section: MaterialSection) -> Material:
    return Material(section.name, E=section.E, rho=section.rho, nu=section.nu)


def _onto(plate: Plate, place: tuple[float, float]) -> tuple[float, float]:
    """A place on the plate's edge, off which rounding may have put it."""
    x, y = place
    return min(max(x, 0.0), plate.length), min(max(y, 0.0), plate.width)
