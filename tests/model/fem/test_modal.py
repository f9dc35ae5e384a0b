"""Natural frequencies, against independent solvers; the paper's are tested with its figures."""

import numpy as np
import pytest

from long_form import shortly
from model.errors import InputError
from model.fem.mesh import ELEMENTS, Mesh
from model.fem.plate import assemble, modes
from model.structure.attachments import Era
from model.structure.plate import Plate
from paper_plate import ALUMINIUM, LENGTH, WIDTH, make_paper_rig

# Converged Reissner-Mindlin frequencies [Hz] of the same plate: NGSolve 6.2, order 5; scikit-fem of
# order 4 agrees to 0.0013 %.
CONVERGED = {
    "simply-supported": [
        109.437, 227.636, 319.858, 424.842, 437.58, 634.244,
        670.462, 700.874, 787.866, 909.82, 983.929, 1055.56,
    ],
    "free": [
        70.0349, 84.4211, 158.307, 166.542, 203.446, 249.124,
        319.32, 340.186, 431.064, 477.535, 482.927, 524.087,
    ],
    "eras": [
        31.6186, 67.9034, 75.4567, 106.449, 156.821, 211.972,
        214.733, 248.396, 330.943, 357.949, 388.062, 444.871,
    ],
}  # fmt: skip


def frequencies(rig, count, support):
    """Natural frequencies [Hz] of a rig's plate."""
    matrices = assemble(rig.plate, rig.mesh)
    return modes(matrices, count, support=support, eras=rig.eras).natural_frequencies


@pytest.mark.parametrize("support", shortly(CONVERGED, ["simply-supported"]))
def test_modes_of_the_auto_mesh_are_converged(support):
    """Twelve modes of its 10x8 elements of order 5 are within 0.02 %, for each support."""
    rig = make_paper_rig(12, 9)
    matrices = assemble(rig.plate, Mesh.accurate(rig.plate, frequency_max=500.0))
    solved = modes(matrices, 12, support=support, eras=rig.eras).natural_frequencies
    np.testing.assert_allclose(solved, CONVERGED[support], rtol=2e-4)


@pytest.mark.parametrize("thickness", [1e-3, 1e-4])
def test_high_order_elements_do_not_lock(thickness):
    """Simply supported, 2000 times as long as thick: thin-plate frequencies within 0.1 %."""
    plate = Plate(LENGTH, WIDTH, thickness, ALUMINIUM)
    scale = np.sqrt(plate.flexural_rigidity / (2700 * thickness)) / (2 * np.pi)
    m, n = np.meshgrid(np.arange(1, 9), np.arange(1, 9))
    # Paper Eq. 29.
    thin = np.sort((scale * ((m * np.pi / LENGTH) ** 2 + (n * np.pi / WIDTH) ** 2)).ravel())[:8]
    matrices = assemble(plate, Mesh(6, 5, LENGTH, WIDTH, ELEMENTS["Q5"]))
    solved = modes(matrices, 8, support="simply-supported").natural_frequencies
    np.testing.assert_allclose(solved, thin, rtol=1e-3)


@pytest.mark.parametrize("support", CONVERGED)
def test_refinement_lowers_frequencies(support):
    """Consistent mass and compatible bending leave every frequency too high, ever less so."""
    errors = [
        frequencies(make_paper_rig(nx, ny), 5, support) - CONVERGED[support][:5]
        for nx, ny in [(8, 6), (16, 12), (32, 24)]
    ]
    assert (np.diff(errors, axis=0) < 0).all()
    assert (errors[-1] > 0).all()


def test_mode_shapes_have_unit_modal_mass(coarse_rig):
    """Rigid motion up and down of the plate on very soft ERAs has shape 1 / sqrt(plate mass)."""
    soft = tuple(Era(era.name, era.x, era.y, 1e-3, 0.0, 0.0, era.stroke) for era in coarse_rig.eras)
    shapes = modes(assemble(coarse_rig.plate, coarse_rig.mesh), 3, support="eras", eras=soft)
    up = shapes.mode_shapes[:, np.argmin(shapes.mode_shapes.std(axis=0))]
    np.testing.assert_allclose(np.abs(up), coarse_rig.plate.mass**-0.5, rtol=1e-4)


def test_bolt_mass_lowers_rigid_modes_as_by_hand(coarse_rig):
    """Soft ERAs with heavy bolts: the heave mode is sqrt(4 k / (m_plate + 4 m_bolt)) / 2 pi."""
    heavy = tuple(
        Era(era.name, era.x, era.y, 10.0, 0.0, 0.05, era.stroke) for era in coarse_rig.eras
    )
    solved = modes(assemble(coarse_rig.plate, coarse_rig.mesh), 3, support="eras", eras=heavy)
    heave = np.sqrt(4 * 10.0 / (coarse_rig.plate.mass + 4 * 0.05)) / (2 * np.pi)
    assert np.abs(solved.natural_frequencies / heave - 1).min() < 1e-3


@pytest.mark.parametrize("count", [0, 10_000])
def test_modes_refuses_an_impossible_count(coarse_rig, count):
    """No modes, or more than the mesh has degrees of freedom, is bad input."""
    with pytest.raises(InputError, match=f"^modes .*got {count}"):
        frequencies(coarse_rig, count, "eras")
