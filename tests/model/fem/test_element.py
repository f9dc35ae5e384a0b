"""What elements are made of: where their nodes lie, their polynomials, and the plate's section.

What their matrices must keep is in `element_checks`; each of ours is held to it in its tests.
"""

import numpy as np
import pytest

from model.fem.mesh import ELEMENTS, Element, rigidities
from model.structure.plate import Plate
from paper_plate import ALUMINIUM


@pytest.fixture(params=ELEMENTS.values(), ids=ELEMENTS)
def element(request: pytest.FixtureRequest) -> Element:
    """Each element in turn."""
    return request.param


def test_rigidities_equal_hand_calculation():
    """2 mm of E = 70 GPa, rho = 2700 kg/m³, nu = 0.33; the checks of elements stand on these.

    D = E h³ / (12 (1 - nu²)) = 560 / 10.6932 = 52.3697 N m, kappa G h = 5/6 of 70 GPa / 2.66 times
    2 mm = 43.8596 MN/m, rho h = 5.4 kg/m² and rho h³ / 12 = 1.8 mg.
    """
    bending, shear, inertia = rigidities(Plate(1.0, 1.0, 0.002, ALUMINIUM))
    expected = [[52.3697, 17.2820, 0.0], [17.2820, 52.3697, 0.0], [0.0, 0.0, 17.5439]]
    np.testing.assert_allclose(bending, expected, rtol=1e-5)
    assert shear == pytest.approx(43.8596e6, rel=1e-5)
    np.testing.assert_allclose(inertia, np.diag([5.4, 1.8e-6, 1.8e-6]), rtol=1e-12)


def test_shape_functions_are_nodal(element):
    """They are 1 at their own node, 0 at the others, and add up to 1 everywhere."""
    nodes = np.array(element.side)
    np.testing.assert_allclose(element.shape(nodes), np.eye(len(nodes)), atol=1e-12)
    between = element.shape(np.linspace(-1, 1, 17))
    np.testing.assert_allclose(between.sum(axis=1), 1.0, rtol=1e-12)


@pytest.mark.parametrize(("name", "side"), [("Q3", 0.2**0.5), ("Q4", (3 / 7) ** 0.5)])
def test_high_order_nodes_are_gauss_lobatto(name, side):
    """Abramowitz and Stegun, Table 25.6: the outermost inner nodes are 0.2^½ and (3/7)^½."""
    assert ELEMENTS[name].side[-2] == pytest.approx(side, rel=1e-14)
