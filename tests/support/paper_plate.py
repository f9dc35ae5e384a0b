"""The founding paper's plate, for tests that need a rig without a file."""

from model.fem import Mesh
from model.rig.rig import Channel, Rig
from model.structure.attachments import Era, damping_from_ratio
from model.structure.plate import Material, Plate
from registry.limits import GuardLimits

# Section 3 of the founding paper; stiffness recovered from its Table 2, damping and stroke assumed.
ALUMINIUM = Material("aluminium", E=70e9, rho=2700.0, nu=0.33)
LENGTH, WIDTH = 0.3048, 0.2286


def make_paper_rig(nx: int, ny: int, *, damping_ratio: float = 0.05) -> Rig:
    """The paper's plate with ERAs at its corners, on a mesh of nx by ny."""
    plate = Plate(LENGTH, WIDTH, 0.0015, ALUMINIUM, loss_factor=0.01)
    damping = damping_from_ratio(
        damping_ratio, stiffness=17000.0, plate_mass=plate.mass, era_count=4
    )
    corners = {"SW": (0.0, 0.0), "SE": (LENGTH, 0.0), "NE": (LENGTH, WIDTH), "NW": (0.0, WIDTH)}
    eras = tuple(
        Era(name, x, y, stiffness=17000.0, damping=damping, bolt_mass=0.0, stroke=100e-6)
        for name, (x, y) in corners.items()
    )
    wiring = {era.name: Channel("main", number) for number, era in enumerate(eras)}
    limits = GuardLimits(frequency_min=40.0, frequency_max=500.0, level=1.0)
    return Rig(plate, Mesh(nx, ny, LENGTH, WIDTH), eras, wiring, {"main": "sim://"}, limits)
