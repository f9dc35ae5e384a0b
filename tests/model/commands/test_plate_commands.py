"""`era plate` as a user types it."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from controller.cli.main import run
from model.rig.file import example_rig_path
from model.vibration.convergence import study_convergence
from rig_files import write_rig

RIG = str(example_rig_path())
EXAMPLES = Path(__file__).parents[3] / "examples"


@pytest.fixture
def era(capsys):
    """Run one command line in this process; returns its exit status and what it printed."""

    def call(*arguments):
        status = run([str(a) for a in arguments])
        printed = capsys.readouterr()
        return status, printed.out, printed.err

    return call


@pytest.fixture
def answer(era):
    """Run `era plate ... --json`, with status 0; returns its object."""

    def call(*arguments):
        status, text, _ = era("plate", *arguments, "--json")
        assert status == 0
        return json.loads(text)

    return call


@pytest.mark.parametrize(
    ("support", "expected"),
    [
        ("simply-supported", ["110.95", "234.16", "337.90", "454.29", "459.69"]),
        ("eras", ["31.98", "68.50", "76.62", "107.84", "160.77"]),
    ],
)
def test_modes_prints_the_papers_tables(era, answer, support, expected):
    """Both tables of the founding paper, digit by digit, as text and as JSON."""
    arguments = ("modes", RIG, "--mesh", "12x9", "--support", support, "-n", "5")
    _, text, _ = era("plate", *arguments)
    assert [line.split()[2] for line in text.splitlines() if line.startswith("mode")] == expected
    result = answer(*arguments)
    assert (result["mesh"], result["dof"], result["element"]) == ([12, 9], 390, "MITC4")
    assert [round(f, 2) for f in result["frequencies_hz"]] == [float(f) for f in expected]


def test_modes_marks_those_that_the_mesh_does_not_carry(era, answer):
    """Elements of 76.2 mm carry waves of 457.2 mm, 70.2 Hz: mode 1 but not 2; 12x9 carries all."""
    coarse = ("modes", RIG, "--mesh", "4x3", "-n", "3")
    for command, marks in ((coarse, [False, True, True]), (("modes", RIG), [False] * 12)):
        _, text, _ = era("plate", *command)
        rows = [line for line in text.splitlines() if line.startswith("mode")]
        assert [len(row.split()) > 4 for row in rows] == marks
    assert round(answer(*coarse)["mesh_carries_up_to_hz"], 1) == 70.2


def test_map_has_numbers_and_a_picture(answer, tmp_path):
    """A raster row per y, its maximum named, and a picture on request; half the level is half."""
    picture = tmp_path / "map.png"
    options = ("map", RIG, "--mesh", "24x18", "--points", "13x10")
    result = answer(*options, "-o", picture, "--drive", "SW=110", "--drive", "NE=110@0.5:90")
    peak = np.array(result["peak_acceleration_m_s2"])
    assert peak.shape == (10, 13)
    assert (result["x_m"][-1], result["y_m"][-1]) == (0.3048, 0.2286)
    assert result["max_m_s2"] == peak.max()
    x, y = result["max_at_m"]
    assert peak[result["y_m"].index(y), result["x_m"].index(x)] == peak.max()
    assert result["files"] == [str(picture)]
    assert picture.read_bytes().startswith(b"\x89PNG")
    half = answer(*options, "--drive", "SW=110@0.5", "--drive", "NE=110@0.25:90")
    np.testing.assert_allclose(half["peak_acceleration_m_s2"], peak / 2, rtol=1e-12)


def test_map_warns_of_frequencies_outside_the_limits(era):
    """40 and 500 Hz are the example's own limits; each ERA outside is named in one line."""
    options = ("plate", "map", RIG, "--mesh", "24x18")
    status, text, said = era(*options, "--drive", "SW=600", "--drive", "NE=110", "--drive", "NW=39")
    assert status == 0
    assert re.search(r"^median .* g$", text, re.MULTILINE)
    assert said.count("\n") == 1
    for named in ("SW", "600 Hz", "NW", "39 Hz", "limits.frequency"):
        assert named in said
    assert "NE" not in said
    assert era(*options, "--drive", "SW=500", "--drive", "NE=40")[2] == ""


def test_map_marks_a_plate_that_is_not_supported(era, answer, tmp_path):
    """On two ERAs it would tip over; the map is drawn, with a warning and a mark."""
    others = ("NE:", "NW:")
    lines = Path(RIG).read_text(encoding="utf-8").splitlines(keepends=True)
    rig = tmp_path / "rig.yaml"
    rig.write_text("".join(line for line in lines if not line.strip().startswith(others)))
    options = ("map", rig, "--mesh", "24x18", "--drive", "SW=110")
    assert answer(*options)["is_supported"] is False
    status, _, said = era("plate", *options)
    assert status == 0
    assert "not supported" in said
    assert answer("map", RIG, *options[2:])["is_supported"] is True


def test_convergence_lists_errors_of_finer_and_finer_meshes(era, answer, monkeypatch, tmp_path):
    """Errors fall from mesh to mesh, and the rig's own is marked; text and JSON agree."""
    studied = []

    def study_once(*args, **keywords):
        studied.append(studied[0] if studied else study_convergence(*args, **keywords))
        return studied[0]

    monkeypatch.setattr("model.vibration.convergence.study_convergence", study_once)
    monkeypatch.setattr("model.vibration.convergence._DOUBLINGS", 1)
    rig = write_rig(tmp_path / "rig.yaml", ("[40 Hz, 500 Hz]", "[40 Hz, 125 Hz]"))
    arguments = ("convergence", rig, "--mesh", "6x5", "--frequencies", "110")
    found = answer(*arguments)
    errors = [row["response_error_percent"][0] for row in found["meshes"]]
    mitc4, accurate = errors[:-2], errors[-2:]
    assert mitc4 == sorted(mitc4, reverse=True)
    assert max(accurate) < mitc4[-1]
    assert found["drive_frequencies_hz"] == [110.0]
    assert [row["is_the_rigs"] for row in found["meshes"]] == [True] + 3 * [False]
    assert found["meshes"][0]["dof"] == 126
    assert [row["element"] for row in found["meshes"][-2:]] == ["Legendre", "Q5"]
    estimates = [row["estimated_response_error_percent"] for row in found["meshes"]]
    assert [each is None for each in estimates] == 2 * [True] + [False, True]
    _, text, _ = era("plate", *arguments)
    assert all(f"{error:.3f} %" in text for error in [*errors, *estimates[-2]])


def test_materials_are_listed_with_numbers_and_sources(era, answer):
    """As text and as JSON, every material with its standard or data sheet."""
    entries = answer("materials")["materials"]
    glass = next(entry for entry in entries if entry["name"] == "soda-lime-glass")
    assert (glass["E_pa"], glass["rho_kg_m3"], glass["nu"]) == (70e9, 2500, 0.2)
    assert len(entries) == 6
    assert all(entry["source"] for entry in entries)
    text = era("plate", "materials")[1]
    assert all(entry["source"] in text for entry in entries)


def test_show_agrees_with_hand_calculation(era, answer):
    """The paper's plate: D = 70e9 * 0.0015³ / 12 (1 - 0.33²) = 22.0935 N m, 282.19 g."""
    summary = answer("show", EXAMPLES / "paper_plate.yaml")
    assert summary["flexural_rigidity_n_m"] == pytest.approx(22.0935, abs=5e-5)
    assert summary["mass_kg"] == pytest.approx(0.28219, abs=5e-6)
    assert summary["surface_density_kg_m2"] == pytest.approx(4.05)
    assert summary["bending_wavelength_m"]["500_hz"] == pytest.approx(0.17132, abs=5e-6)
    assert summary["laminate"] is None
    assert summary["point_masses"] == []
    assert "1.5 mm of aluminium" in era("plate", "show", EXAMPLES / "paper_plate.yaml")[1]
