"""Numbers printed in the founding paper, for comparison."""

from model.rig.rig import Rig
from model.structure.plate import Plate

ELEMENT_SIDE = 0.0254
"""Side of an element in the paper's mesh [m], one inch: 12 x 9 elements, 390 degrees of freedom."""

PAPER_STIFFNESS = 17_000.0
"""ERA stiffness [N/m], recovered: with it the paper's Table 2 comes out to the last digit."""

TABLE_1_PAPER = (110.95, 234.16, 337.90, 454.29, 459.69)
TABLE_1_COMSOL = (109.6, 228.02, 320.29, 425.6, 438.6)
"""Natural frequencies [Hz], simply supported: the paper's own model, and its COMSOL model."""

TABLE_2_PAPER = (31.98, 68.50, 76.62, 107.84, 160.77)
TABLE_2_COMSOL = (31.67, 68.07, 75.62, 106.53, 157.14)
"""The same on four ERAs at the corners."""

FIGURE_11_FREQUENCY = 110.0
FIGURE_12_FREQUENCIES = (
    (320.0, 320.0),
    (300.0, 100.0),
    (100.0, 300.0),
    (170.0, 170.0),
    (250.0, 220.0),
    (150.0, 150.0),
)
"""Frequencies [Hz] of the two diagonal ERAs in Figure 12 (a) to (f)."""

FIGURE_13_FREQUENCY = 250.0
FIGURE_13_STIFFNESS = (8_000.0, 16_000.0)
"""ERA stiffness [N/m] of the two maps in Figure 13."""


def is_paper_plate(plate: Plate) -> bool:
    """Whether a plate is the paper's: 12 in x 9 in x 1.5 mm of its aluminium."""
    sizes = (round(plate.length, 6), round(plate.width, 6), round(plate.thickness, 6))
    material = plate.material
    return sizes == (0.3048, 0.2286, 0.0015) and (material.E, material.rho, material.nu) == (
        70e9,
        2700.0,
        0.33,
    )


def is_paper_rig(rig: Rig) -> bool:
    """Whether a rig is that of the paper's Table 2: its plate on four such ERAs at the corners."""
    corners = {(x, y) for x in (0.0, rig.plate.length) for y in (0.0, rig.plate.width)}
    return (
        is_paper_plate(rig.plate)
        and {(era.x, era.y) for era in rig.eras} == corners
        and all((era.stiffness, era.bolt_mass) == (PAPER_STIFFNESS, 0.0) for era in rig.eras)
    )
