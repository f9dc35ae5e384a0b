import math
from dataclasses import replace

import numpy as np
import pytest

from model.errors import InputError
from model.reduction.reduced_plate import reduce_plate, supported_modes
from model.rig.file import example_rig_path, load_rig
from model.structure.attachments import Era, PointLoad
from model.structure.plate import Material, Plate
from model.structure.support import check_supported, rigid_body_frequencies, support_problem

PLATE = Plate(0.3, 0.2, 0.002, Material("aluminium", E=70e9, rho=2700.0, nu=0.33))


def era(name: str, x: float, y: float, stiffness: float = 17e3, bolt_mass: float = 0.0) -> Era:
    """An ERA at x, y [m]."""
    return Era(name, x, y, stiffness, damping=1.0, bolt_mass=bolt_mass, stroke=1e-4)


CORNERS = [era("SW", 0, 0), era("SE", 0.3, 0), era("NE", 0.3, 0.2), era("NW", 0, 0.2)]


def test_rigid_body_frequencies_are_those_of_the_textbook() -> None:
    """Heave sqrt(4k/m); each tilt of four corner springs sqrt(12 k/m)."""
    heave = math.sqrt(4 * 17e3 / PLATE.mass) / (2 * math.pi)
    expected = [heave, math.sqrt(3) * heave, math.sqrt(3) * heave]
    assert rigid_body_frequencies(PLATE, CORNERS) == pytest.approx(expected, rel=1e-12)


def test_rigid_body_frequencies_count_what_the_plate_carries() -> None:
    """A mass of the plate's own at its centre slows the heave alone, by sqrt(2)."""
    bare = rigid_body_frequencies(PLATE, CORNERS)
    loaded = rigid_body_frequencies(PLATE, CORNERS, loads=[PointLoad(0.15, 0.1, mass=PLATE.mass)])
    assert loaded == pytest.approx(bare / [math.sqrt(2), 1, 1], rel=1e-12)


def test_rigid_body_frequencies_are_those_of_a_very_stiff_plate() -> None:
    """The finite elements' modes of a plate ten thousand times as stiff, within a percent."""
    rig = load_rig(example_rig_path(), mesh="12x9")
    points = np.array([[each.x, each.y] for each in rig.eras])
    stiff = replace(rig.plate, material=replace(rig.plate.material, E=1e4 * rig.plate.material.E))
    modes = supported_modes(reduce_plate(stiff, rig.mesh, points), rig.eras, frequency_max=500.0)
    rigid = rigid_body_frequencies(stiff, rig.eras)
    assert modes.natural_frequencies[:3] == pytest.approx(rigid, rel=0.01)


@pytest.mark.parametrize(
    "eras",
    [
        [],
        CORNERS[:1],
        CORNERS[:2],
        [era("a", 0, 0), era("b", 0.15, 0.1), era("c", 0.3, 0.2)],  # in one line
        [era("a", 0, 0), era("b", 0.15, 0.1001), era("c", 0.3, 0.2)],  # nearly so
        [replace(each, stiffness=0.1) for each in CORNERS],
    ],
)
def test_plate_is_not_supported_when_a_rigid_body_mode_is_free(eras: list[Era]) -> None:
    """Fewer than three springs, all in one line, or too soft."""
    assert support_problem(PLATE, eras) is not None
    with pytest.raises(InputError, match=r"supported.*; put"):
        check_supported(PLATE, eras)


@pytest.mark.parametrize("eras", [CORNERS, CORNERS[:3]])
def test_plate_is_supported_by_three_eras_not_in_line(eras: list[Era]) -> None:
    """Corner ERAs hold heave and both tilts."""
    assert support_problem(PLATE, eras) is None


def test_plate_is_supported_by_two_eras_and_a_spring() -> None:
    """Springs of loads count as those of ERAs do."""
    assert support_problem(PLATE, CORNERS[:2], loads=[PointLoad(0.15, 0.2, 17e3)]) is None
