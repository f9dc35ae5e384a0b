"""Every plain key of a plate, also a new one: in both solvers, in a rigid plate, in a summary."""

import json

import numpy as np
import pytest

from key_tables import quantities
from model.reduction.free_plate import solve_free_plate
from model.rig.rig import Rig
from model.rig.rig_file import parse_rig
from model.rig.rig_summary import plate_summary
from model.rig.sections import PlateSection
from model.structure.attachments import rigid_body_frequencies
from model.vibration import natural_modes

PLATE = {"length": 0.3, "width": 0.2, "thickness": 0.002}
GLASS = {"E": 70e9, "rho": 2500.0, "nu": 0.2}
CORNERS = {"SW": [0, 0], "SE": [0.3, 0], "NE": [0.3, 0.2], "NW": [0.01, 0.2]}
FIELDS = PlateSection.model_fields
PLAIN = {key: each for key, field in FIELDS.items() for each in quantities(field)}


def rig_with(key: str, mesh: str, stiffness: float = 17e3, more: float = 0.02) -> Rig:
    """A plate whose key is so much more of one unit than otherwise, on four springs."""
    start = PLATE.get(key) or FIELDS[key].default or 0.0
    data = {
        "plate": {**PLATE, "material": GLASS, key: start + more * min(1.0, PLAIN[key].at_most)},
        "mesh": mesh,
        "eras": {
            name: {
                "at": at,
                "stiffness": stiffness,
                "bolt_mass": 0.01,
                "amplifier": "main",
                "channel": number,
            }
            for number, (name, at) in enumerate(CORNERS.items())
        },
        "amplifiers": {"main": {"url": "sim://"}},
        "limits": {"frequency": [40, 300]},
    }
    return parse_rig("rig.json", json.dumps(data))


@pytest.mark.parametrize("key", [key for key in PLAIN if key != "thickness"])
def test_a_key_is_in_elements_and_polynomials_and_in_the_summary(key: str) -> None:
    """Responses, which it changes, within 1 %; three modes of soft springs as of a rigid plate."""
    polynomials = "14x10 Legendre"
    rigs = (
        rig_with(key, polynomials, more=0.0),
        rig_with(key, "12x8 Q5"),
        rig_with(key, polynomials),
    )
    (before, E, P) = (
        solve_free_plate(rig.plate, rig.mesh).acceleration(
            rig.eras, np.array([60.0, 150.0, 290.0]), np.array([[0.1, 0.05], [0.3, 0.2]])
        )
        for rig in rigs
    )
    assert np.linalg.norm(P - E) < 0.01 * np.linalg.norm(E)
    assert np.linalg.norm(P - before) > 1e-5 * np.linalg.norm(E)
    soft = rig_with(key, polynomials, stiffness=10.0)
    assert natural_modes(soft, 3, support="eras").frequencies == pytest.approx(
        rigid_body_frequencies(soft.plate, soft.eras), rel=1e-3
    )
    summary = plate_summary(soft)
    shown = {**summary, **summary["further"]}
    assert shown[PLAIN[key].dimension.key(key)] == getattr(soft.plate, key)
