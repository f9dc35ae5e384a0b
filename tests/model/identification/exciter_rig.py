"""A board on foam with four exciters: the values of common 25 mm ones, and of what they drive."""

from dataclasses import replace

import numpy as np

from model.rig.file import example_rig_path, load_rig
from model.rig.meshes import mesh_of
from model.rig.rig import Rig
from model.rig.uncertainty import Uncertainty
from model.structure.attachments import PointLoad
from model.structure.exciter import Exciter
from model.structure.plate import Material

AT = ((0.18, 0.24), (0.79, 0.17), (0.84, 0.78), (0.27, 0.81))  # of the sides
BY_PARTS = Uncertainty(
    gain=0.2, phase_deg=10.0, stiffness=0.2, thickness=0.03, modulus=0.05, damping=1.5
)
"""Of exciters as they are sold on a board as it is cut."""


def exciter_rig() -> Rig:
    """Acrylic of 300 x 230 x 5 mm on feet of foam, each 2 kN/m with a loss factor of 0.15."""
    rig, width, length = load_rig(example_rig_path()), 0.23, 0.3
    acrylic = Material("acrylic", E=4.5e9, rho=1190.0, nu=0.37)
    plate = replace(
        rig.plate, length=length, width=width, thickness=5e-3, material=acrylic, loss_factor=0.05
    )
    sources = tuple(
        Exciter(
            era.name,
            x * length,
            y * width,
            stiffness=3189.2,
            damping=0.7553,
            magnet_mass=0.10929,
            coil_mass=1.61e-3,
            force_factor=3.63,
            resistance=4.3,
            voltage=3.0,
            source_resistance=0.1,
            inductance=1e-4,
            foot=0.0125,
        )
        for era, (x, y) in zip(rig.eras, AT, strict=True)
    )
    feet = tuple(
        PointLoad(x, y, stiffness=2000.0, damping=0.15 * 2000 / (2 * np.pi * 20), foot=5e-3)
        for x in (0.01, length - 0.01)
        for y in (0.01, width - 0.01)
    )
    mesh = mesh_of("auto", plate, frequency_max=500.0, stiffness=4000.0, foot=5e-3)
    limits = replace(rig.limits, frequency_min=40.0, frequency_max=300.0)
    return replace(
        rig, plate=plate, eras=sources, masses=feet, mesh=mesh, uncertainty=BY_PARTS, limits=limits
    )
