"""The commands that show materials and a rig's plate."""

import json
import re
from pathlib import Path

import pytest
from typer.testing import CliRunner

from model.cli import app

EXAMPLES = Path(__file__).parents[3] / "examples"
RUNNER = CliRunner()


def shown(*arguments):
    """What `era plate ...` prints."""
    result = RUNNER.invoke(app, ["plate", *map(str, arguments)])
    assert result.exit_code == 0, result.output
    return result.stdout


def test_materials_are_listed_with_numbers_and_sources():
    """As text and as JSON, every material with its standard or data sheet."""
    text = shown("materials")
    assert "soda-lime-glass: E 70 GPa, rho 2500 kg/m³, nu 0.2\n    source  EN 572-1" in text
    entries = json.loads(shown("materials", "--json"))["materials"]
    glass = next(entry for entry in entries if entry["name"] == "soda-lime-glass")
    assert (glass["E_pa"], glass["rho_kg_m3"], glass["nu"]) == (70e9, 2500, 0.2)
    assert len(entries) == 6
    assert all(entry["source"] for entry in entries)


def test_a_single_plate_is_shown_by_hand_calculation():
    """The paper's plate: D = 70e9 * 0.0015³ / 12 (1 - 0.33²) = 22.0935 N m, 282.19 g."""
    summary = json.loads(shown("show", EXAMPLES / "paper_plate.yaml", "--json"))
    assert summary["flexural_rigidity_n_m"] == pytest.approx(22.0935, abs=5e-5)
    assert summary["mass_kg"] == pytest.approx(0.28219, abs=5e-6)
    assert summary["surface_density_kg_m2"] == pytest.approx(4.05)
    assert summary["bending_wavelength_m"]["500_hz"] == pytest.approx(0.17132, abs=5e-6)
    assert summary["laminate"] is None
    assert summary["point_masses"] == []
    assert "1.5 mm of aluminium" in shown("show", EXAMPLES / "paper_plate.yaml")


def test_a_laminate_is_shown_with_both_bounds():
    """The panel's bounds by hand, the rigidity taken between them, lower at higher frequencies.

    Sliding: (71.5e9 * 1.8e-3³ / 0.9559 + 70e9 * 0.7e-3³ / 0.96) / 12 = 38.436 N m.
    """
    summary = json.loads(shown("show", EXAMPLES / "glass_panel.yaml", "--json"))
    laminate = summary["laminate"]
    sliding, bonded = (
        laminate[f"rigidity_{bond}_n_m"] for bond in ("freely_sliding", "perfectly_bonded")
    )
    by_hand = (71.5e9 * 1.8e-3**3 / (1 - 0.21**2) + 70e9 * 0.7e-3**3 / 0.96) / 12
    assert sliding == pytest.approx(by_hand, rel=1e-4)
    by_frequency = laminate["rigidity_by_frequency_n_m"]
    assert sliding < by_frequency["500_hz"] < laminate["rigidity_n_m"] < by_frequency["40_hz"]
    assert by_frequency["40_hz"] < bonded
    assert summary["flexural_rigidity_n_m"] == pytest.approx(laminate["rigidity_n_m"], rel=1e-9)
    assert [layer["thickness_m"] for layer in laminate["layers"]] == [1.8e-3, 0.2e-3, 0.7e-3]
    assert summary["point_masses"][0] == {"at_m": [0.23, 0.217], "mass_kg": 0.008}


def test_the_text_says_how_uncertain_a_laminate_is():
    """Ratios of natural frequencies go with the root of the rigidities printed beside them."""
    text = shown("show", EXAMPLES / "glass_panel.yaml")
    taken = float(re.search(r"rigidity used  ([\d.]+) N m", text)[1])
    for bound in ("perfectly bonded", "freely sliding"):
        rigidity, ratio = re.search(rf"{bound}  ([\d.]+) N m: .* x ([\d.]+)", text).groups()
        assert float(ratio) == pytest.approx((float(rigidity) / taken) ** 0.5, abs=2e-3)
    assert "carries 8 g at (0.23, 0.217) m" in text


def test_check_names_the_layers_and_what_is_carried():
    """`era config check` sums a laminate up in its line."""
    result = RUNNER.invoke(app, ["config", "check", str(EXAMPLES / "glass_panel.yaml")])
    assert result.exit_code == 0
    assert (
        "375 x 225 x 2.7 mm of laminate (chemically-strengthened-glass, adhesive" in result.stdout
    )
    assert "carries 13 g" in result.stdout
