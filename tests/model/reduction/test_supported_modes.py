"""Modes of the plate on its ERAs, and how they are damped."""

from dataclasses import replace

import numpy as np

from model.fem.mesh import Mesh
from model.reduction.reduced_plate import SupportedModes, reduce_plate, supported_modes
from model.rig.rig import Rig
from model.structure.attachments import damping_from_ratio, footprints_of
from paper_plate import make_paper_rig

# Founding paper, in-house column of Table 2 [Hz].
TABLE_2 = ["31.98", "68.50", "76.62", "107.84", "160.77"]


def modes_of(rig: Rig, *, frequency_max: float) -> SupportedModes:
    """Those of a rig's plate on its mesh."""
    attached = footprints_of(rig.eras)
    reduced = reduce_plate(rig.plate, rig.mesh, attached, frequency_max=frequency_max)
    return supported_modes(reduced, rig.eras, frequency_max=frequency_max)


def test_supported_modes_reproduce_table_2(coarse_rig: Rig) -> None:
    """On the paper's mesh its Table 2 comes out, every printed digit, and nothing beyond it."""
    found = modes_of(coarse_rig, frequency_max=170.0).natural_frequencies
    assert [f"{frequency:.2f}" for frequency in found] == TABLE_2


def test_damping_ratio_of_a_rigid_plate_as_by_hand() -> None:
    """Bouncing has the ratio zeta, tilting nearly sqrt(3) times that.

    Mass m on four corners of k and c = 2 zeta sqrt(k m / 4): bouncing 4 c / (2 sqrt(4 k m)).
    Tilting along a side b has the inertia m (b² + h²) / 12, and k b², c b².
    """
    rig = make_paper_rig(12, 9)
    plate = replace(rig.plate, thickness=0.03, loss_factor=0.0)  # bends at a thousand hertz
    damping = damping_from_ratio(0.05, stiffness=17000.0, plate_mass=plate.mass, era_count=4)
    eras = tuple(replace(era, damping=damping) for era in rig.eras)
    mesh = Mesh.accurate(plate, frequency_max=100.0)
    found = modes_of(replace(rig, plate=plate, eras=eras, mesh=mesh), frequency_max=100.0)
    tilting = [
        0.05 * np.sqrt(3 / (1 + (plate.thickness / side) ** 2))
        for side in (plate.width, plate.length)
    ]
    np.testing.assert_allclose(found.damping_ratios, [0.05, *tilting], rtol=2e-3)
    bouncing = np.sqrt(4 * 17000.0 / plate.mass) / (2 * np.pi)
    np.testing.assert_allclose(found.natural_frequencies[0], bouncing, rtol=1e-3)


def test_supported_mode_shapes_have_unit_modal_mass() -> None:
    """Of a rigid plate that bounces, mass 1 is a deflection of 1 / sqrt(m) everywhere."""
    rig = make_paper_rig(12, 9)
    plate = replace(rig.plate, thickness=0.03)
    mesh = Mesh.accurate(plate, frequency_max=100.0)
    found = modes_of(replace(rig, plate=plate, mesh=mesh), frequency_max=100.0)
    bouncing = found.at(np.array([[0.0, 0.0], [0.1, 0.05], [0.3, 0.2]]))[:, 0]
    np.testing.assert_allclose(np.abs(bouncing), 1 / np.sqrt(plate.mass), rtol=5e-3)
