"""A board whose moduli differ each by itself, found from its responses."""

from dataclasses import replace

import numpy as np
import pytest

from model.config.document import parse_document
from model.identification.forward import Sensor
from model.identification.identify import fit_rows, identify
from model.identification.least_squares import Measurement
from model.reduction.free_plate import solve_free_plate
from model.rig.rig_file import rig_of
from model.rig.rig_writing import rewritten_text
from model.spectral.modes import SpectralMesh
from model.structure.plate import Orthotropy

TEXT = """\
plate: {length: 400 mm, width: 300 mm, thickness: 6.4 mm, material: plywood}
eras:
  A: {at: [72 mm, 72 mm], stiffness: 10 kN/m, amplifier: card, channel: 0}
  B: {at: [316 mm, 51 mm], stiffness: 10 kN/m, amplifier: card, channel: 1}
  C: {at: [336 mm, 234 mm], stiffness: 10 kN/m, amplifier: card, channel: 2}
  D: {at: [108 mm, 243 mm], stiffness: 10 kN/m, amplifier: card, channel: 3}
amplifiers: {card: {url: "sim://"}}
uncertainty: {modulus: 10 %}
limits: {frequency: [60, 300]}
"""
HIDDEN = {"E1": 1.01, "E2": 0.98, "G12": 1.07}
"""Factors on the moduli of the rig's plywood, of which no single one on all gives its modes."""


def test_moduli_along_across_and_of_shear_are_found() -> None:
    """Each within 3 % from responses of a finer solution, and written into the rig's file.

    The thickness weighs the board and is known; all else of the board is that of the rig.
    """
    document = parse_document("board.yaml", TEXT)
    rig = rig_of(document)
    own = rig.plate.material
    moduli = {key: HIDDEN.get(key, 1.0) * each for key, each in own.moduli.items()}
    E = moduli.pop("E1")
    material = replace(own, E=E, orthotropy=Orthotropy(*(each / E for each in moduli.values())))
    mesh = SpectralMesh(18, 15, 0.4, 0.3)
    free = solve_free_plate(replace(rig.plate, material=material), mesh, frequency_max=300.0)
    tones, places = np.linspace(60.0, 300.0, 41), [[era.x, era.y] for era in rig.eras]
    responses = free.acceleration(rig.eras, tones, np.array(places)).swapaxes(1, 2)
    noise = np.random.default_rng(1).standard_normal((*responses.shape, 2)) @ [1, 1j]
    responses = responses * (1 + 0.005 * noise) / rig.eras[0].stroke
    sensors = [Sensor(era.name, era.name) for era in rig.eras]
    found = identify(rig, Measurement.of(sensors, tones, responses), seed=1)
    assert found.is_explained
    known = found.rig.plate
    # A thicker board of a smaller modulus has the same modes: rigidities are what is found.
    for key, factor in HIDDEN.items():
        rigidity = known.material.moduli[key] * known.thickness**3
        before = own.moduli[key] * rig.plate.thickness**3
        assert rigidity / before == pytest.approx(factor, rel=0.03)
    assert any("E2" in row for row in fit_rows(found))
    back = rig_of(parse_document("b.yaml", rewritten_text(document, rig, found.rig, comment="")))
    assert back.plate.material.moduli == pytest.approx(known.material.moduli, rel=1e-5)
