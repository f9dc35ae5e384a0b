"""`era plate` as a user types it."""

import json
from importlib.metadata import entry_points

import numpy as np
import pytest

from controller.cli.main import run
from model.rig.file import example_rig_path
from model.vibration import convergence

RIG = str(example_rig_path())


@pytest.fixture
def era(capsys):
    """Run one command line in this process; returns its exit status and what it printed."""

    def call(*arguments):
        status = run([str(a) for a in arguments], entry_points(group="era_haptics.commands"))
        printed = capsys.readouterr()
        return status, printed.out, printed.err

    return call


@pytest.mark.parametrize(
    ("support", "expected"),
    [
        ("simply-supported", ["110.95", "234.16", "337.90", "454.29", "459.69"]),
        ("eras", ["31.98", "68.50", "76.62", "107.84", "160.77"]),
    ],
)
def test_modes_prints_the_papers_tables(era, support, expected):
    """Both tables of the founding paper, digit by digit, as text and as JSON."""
    arguments = ("plate", "modes", RIG, "--mesh", "12x9", "--support", support, "-n", "5")
    status, text, _ = era(*arguments)
    assert status == 0
    assert [line.split()[2] for line in text.splitlines() if line.startswith("mode")] == expected
    status, text, _ = era(*arguments, "--json")
    result = json.loads(text)
    assert (status, result["mesh"], result["dof"], result["element"]) == (
        0, [12, 9], 390, "MITC4",
    )  # fmt: skip
    assert [round(f, 2) for f in result["frequencies_hz"]] == [float(f) for f in expected]


def test_modes_that_the_mesh_does_not_carry_are_marked(era):
    """Elements of 76.2 mm carry waves of 457.2 mm, 70.2 Hz: mode 1 but not 2; 12x9 carries all."""
    status, text, _ = era("plate", "modes", RIG, "--mesh", "4x3", "-n", "3")
    assert status == 0
    assert [len(line.split()) > 4 for line in text.splitlines() if line.startswith("mode")] == [
        False, True, True,
    ]  # fmt: skip
    _, text, _ = era("plate", "modes", RIG, "--mesh", "4x3", "-n", "3", "--json")
    assert round(json.loads(text)["mesh_carries_up_to_hz"], 1) == 70.2
    _, text, _ = era("plate", "modes", RIG, "--mesh", "12x9")
    assert all(len(line.split()) == 4 for line in text.splitlines() if line.startswith("mode"))


def test_map_has_numbers_and_a_picture(era, tmp_path):
    """A raster row per y, its maximum named, and a picture on request."""
    picture = tmp_path / "map.png"
    status, text, _ = era(
        *("plate", "map", RIG, "--mesh", "24x18", "--points", "13x10", "-o", picture, "--json"),
        *("--drive", "SW=110", "--drive", "NE=110@0.5:90"),
    )
    result = json.loads(text)
    peak = np.array(result["peak_acceleration_m_s2"])
    assert status == 0
    assert peak.shape == (10, 13)
    assert (result["x_m"][-1], result["y_m"][-1]) == (0.3048, 0.2286)
    assert result["max_m_s2"] == peak.max()
    x, y = result["max_at_m"]
    assert peak[result["y_m"].index(y), result["x_m"].index(x)] == peak.max()
    assert result["files"] == [str(picture)]
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_map_warns_of_frequencies_outside_the_limits(era):
    """40 and 500 Hz are the example's own limits; each ERA outside is named in one line."""
    options = ("plate", "map", RIG, "--mesh", "24x18", "--json")
    status, text, said = era(*options, "--drive", "SW=600", "--drive", "NE=110", "--drive", "NW=39")
    assert status == 0
    assert json.loads(text)["max_m_s2"] > 0
    assert said.count("\n") == 1
    for named in ("SW", "600 Hz", "NW", "39 Hz", "limits.frequency"):
        assert named in said
    assert "NE" not in said
    assert era(*options, "--drive", "SW=500", "--drive", "NE=40")[2] == ""


def test_map_scales_with_level(era):
    """Half the level is half the acceleration everywhere: the plate is linear."""
    full, half = (
        np.array(
            json.loads(era("plate", "map", RIG, "--mesh", "12x9", "--drive", drive, "--json")[1])[
                "peak_acceleration_m_s2"
            ]
        )
        for drive in ("SW=110", "SW=110@0.5")
    )
    np.testing.assert_allclose(half, full / 2, rtol=1e-12)


@pytest.mark.parametrize(
    ("drives", "named"),
    [
        (["SW"], "ERA=HZ"),
        (["XX=110"], "'XX'"),
        (["SW=fast"], "'fast'"),
        (["SW=110hz"], "'110hz'"),
        (["SW=nan"], "'nan'"),
        (["SW=-110"], "-110 Hz"),
        (["SW=110@1.5"], "1.5"),
        (["SW=110@0.5:x"], "'x'"),
        (["SW=90000"], "elements"),
        (["SW=110", "SW=120"], "SW"),
    ],
)
def test_map_refuses_bad_drives(era, drives, named):
    """Status 2 and one line that names what is wrong."""
    options = [option for drive in drives for option in ("--drive", drive)]
    status, text, said = era("plate", "map", RIG, "--mesh", "12x9", *options)
    assert (status, text) == (2, "")
    assert named in said
    assert said.count("\n") == 1


@pytest.mark.parametrize("name", ["map.xyz", "map"])
def test_map_refuses_pictures_of_unknown_kind(era, tmp_path, name):
    """The endings that are known are named, and nothing is written."""
    status, _, said = era(
        *("plate", "map", RIG, "--mesh", "12x9", "--drive", "SW=110", "-o", tmp_path / name)
    )
    assert status == 2
    assert ".png, .svg or .pdf" in said
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("points", ["13", "0x5", "1x1", "axb", "99999x99999"])
def test_a_raster_that_is_none_is_bad_input(era, points):
    """The raster needs two points each way, and must fit into memory."""
    status, _, said = era(
        *("plate", "map", RIG, "--mesh", "12x9", "--drive", "SW=110", "--points", points)
    )
    assert status == 2
    assert "points" in said


def test_convergence_lists_errors_of_finer_and_finer_meshes(era, monkeypatch):
    """Errors fall from mesh to mesh, and the rig's own is marked; text and JSON agree."""
    solve, solved, progressed = convergence.study_convergence, [], []

    def study(rig, meshes, *, frequencies, progress):
        if not solved:  # once for text and JSON, since it takes seconds

            def recorded(done, total):
                progressed.append((done, total))
                progress(done, total)

            solved.append(solve(rig, meshes, frequencies=frequencies, progress=recorded))
        return solved[0]

    monkeypatch.setattr(convergence, "study_convergence", study)
    arguments = ("plate", "convergence", RIG, "--mesh", "12x9", "--frequencies", "110")
    status, text, _ = era(*arguments, "--json")
    assert status == 0
    answer = json.loads(text)
    errors = [row["response_error_percent"][0] for row in answer["meshes"]]
    assert errors == sorted(errors, reverse=True)
    assert answer["drive_frequencies_hz"] == [110.0]
    assert [row["is_the_rigs"] for row in answer["meshes"]] == [True] + 4 * [False]
    assert answer["meshes"][0]["dof"] == 390
    assert answer["meshes"][-1]["element"] == "Q5"
    assert answer["solve_time_s"] > 0
    assert progressed == [(done, 6) for done in range(1, 7)]
    status, text, _ = era(*arguments)
    assert status == 0
    assert [f"{error:.3f} %" in text for error in errors] == 5 * [True]


def test_convergence_refuses_frequencies_above_the_limit(era):
    """Meshes are made for the rig's highest frequency."""
    status, text, said = era("plate", "convergence", RIG, "--frequencies", "110,900")
    assert (status, text) == (2, "")
    assert "900 Hz" in said
    assert "limits.frequency" in said
