"""Conversion of the sections of a rig file to values of the model."""

import math
import re

from model.errors import InputError
from model.fem.element_registry import element_of
from model.fem.mesh import PAPER_ELEMENT, Mesh
from model.rig.rig import Limits
from model.rig.sections import EraSection, LimitsSection, MassSection, MaterialSection, PlateSection
from model.structure.actuator import Era, damping_from_ratio
from model.structure.laminate import Laminate, Layer, equivalent_plate
from model.structure.plate import Material, Plate
from model.structure.point_mass import PointMass

_MAX_ELEMENTS_PER_SIDE = 1000
_MAX_AUTO_NODES = 300_000  # a million degrees of freedom: minutes, and most of a machine's memory


def plate_of(section: PlateSection) -> Plate:
    """The plate, of a laminate the equivalent one."""
    laminate = laminate_of(section)
    if laminate is not None:
        return equivalent_plate(
            laminate, length=section.length, width=section.width, loss_factor=section.loss_factor
        )
    assert section.thickness is not None  # noqa: S101  see model.rig.checks
    assert section.material is not None  # noqa: S101
    return Plate(
        length=section.length,
        width=section.width,
        thickness=section.thickness,
        material=_material(section.material),
        loss_factor=section.loss_factor,
    )


def laminate_of(section: PlateSection) -> Laminate | None:
    """The laminate of the plate; None without layers."""
    if section.layers is None:
        return None
    layers = (Layer(_material(layer.material), layer.thickness) for layer in section.layers)
    return Laminate(tuple(layers), bond=section.bond, bond_frequency=section.bond_frequency)


def era_of(name: str, section: EraSection, plate: Plate, *, era_count: int) -> Era:
    """An ERA; era_count: of the rig, for the damping from a ratio."""
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
    """The limits of commands; infinite where none is given."""
    low, high = section.frequency
    given = section.model_dump(exclude={"frequency"}, exclude_none=True)
    return Limits(frequency_min=low, frequency_max=high, **given)


def mesh_of(text: str, plate: Plate, *, frequency_max: float) -> Mesh:
    """The mesh `auto`, accurate up to a frequency [Hz], or that of `parse_mesh`."""
    if text != "auto":
        return parse_mesh(text, plate)
    mesh = Mesh.auto(plate, frequency_max=frequency_max)
    if mesh.node_count > _MAX_AUTO_NODES:
        raise InputError(
            f"auto must have at most {_MAX_AUTO_NODES} nodes, got {mesh} elements up to "
            f"{frequency_max:g} Hz; check the plate's sizes, or lower limits.frequency"
        )
    return mesh


def parse_mesh(text: str, plate: Plate) -> Mesh:
    """The mesh `NXxNY`, or `NXxNY ELEMENT`, over a plate.

    Raises InputError for other text, an unknown element, and too many elements.
    """
    match = re.fullmatch(r"\s*(\d{1,6})\s*[xX×]\s*(\d{1,6})(?:\s+(\S{1,40}))?\s*", text, re.ASCII)
    if match is None:
        raise InputError(
            f"mesh must be NXxNY with an optional element, for example 48x36 or 12x9 Q3, got "
            f"{text[:40]!r}"
        )
    nx, ny = int(match[1]), int(match[2])
    if not 1 <= min(nx, ny) <= max(nx, ny) <= _MAX_ELEMENTS_PER_SIDE:
        raise InputError(
            f"mesh must have 1 to {_MAX_ELEMENTS_PER_SIDE} elements a side, got {nx}x{ny}"
        )
    element = element_of(match[3]) if match[3] else PAPER_ELEMENT
    return Mesh(nx=nx, ny=ny, length=plate.length, width=plate.width, element=element)


def _material(section: MaterialSection) -> Material:
    return Material(section.name, E=section.E, rho=section.rho, nu=section.nu)


def _onto(plate: Plate, place: tuple[float, float]) -> tuple[float, float]:
    """A place clipped to the plate, off whose edge rounding may have put it."""
    x, y = place
    return min(max(x, 0.0), plate.length), min(max(y, 0.0), plate.width)
