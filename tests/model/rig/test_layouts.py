"""Layouts as fractions of the plate, and the pairs that the paper drives."""

import numpy as np
import pytest

from model.errors import InputError
from model.rig.layouts import (
    FOUR_ERA_LAYOUTS,
    alike,
    diagonal_pair,
    edge_pair,
)
from model.structure.attachments import Era
from paper_plate import LENGTH, WIDTH, make_paper_rig


def test_corners_layout_is_that_of_the_paper():
    """The layout `corners` on the paper's plate is the paper's own rig."""
    rig = make_paper_rig(12, 9)
    corners = next(layout for layout in FOUR_ERA_LAYOUTS if layout.name == "corners")
    expected = [(era.x, era.y) for era in rig.eras]
    np.testing.assert_allclose(corners.positions(rig.plate), expected)


def test_edge_and_diagonal_pairs_of_the_paper():
    """On the paper's rig: SW and SE share the long edge, SW and NE are diagonal."""
    eras = make_paper_rig(12, 9).eras
    assert [eras[era].name for era in edge_pair(eras)] == ["SW", "SE"]
    assert [eras[era].name for era in diagonal_pair(eras)] == ["SW", "NE"]


def test_pairs_need_two_eras():
    """One ERA alone makes no pair."""
    single = alike(Era("A", 0, 0, 17000.0, 1.0, 0.0, 1e-4), np.array([[LENGTH, WIDTH]]))
    for find in (edge_pair, diagonal_pair):
        with pytest.raises(InputError, match="at least two"):
            find(single)
