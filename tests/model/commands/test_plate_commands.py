"""`era plate` and `era table` as a user types them."""

import json
import re
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


def test_modes_beyond_what_the_mesh_carries_are_marked(era):
    """Elements of 76.2 mm carry waves of 457.2 mm, 70.2 Hz: mode 1 but not 2; 12x9 carries all."""
    status, text, _ = era("plate", "modes", RIG, "--mesh", "4x3", "-n", "3")
    assert status == 0
    marked = ["beyond" in line for line in text.splitlines() if line.startswith("mode")]
    assert marked == [False, True, True]
    assert "above 70 Hz a bending wavelength has fewer than six nodes" in text
    _, text, _ = era("plate", "modes", RIG, "--mesh", "4x3", "-n", "3", "--json")
    assert round(json.loads(text)["mesh_carries_up_to_hz"], 1) == 70.2
    _, text, _ = era("plate", "modes", RIG, "--mesh", "12x9")
    assert "beyond" not in text


def test_map_answers_in_numbers_and_as_a_picture(era, tmp_path):
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


def test_a_map_beyond_the_limits_is_drawn_with_a_warning(era):
    """40 and 500 Hz are the example's own limits; what lies outside is named in one line."""
    asked = ("plate", "map", RIG, "--mesh", "24x18", "--json")
    status, text, said = era(*asked, "--drive", "SW=600", "--drive", "NE=110", "--drive", "NW=39")
    assert status == 0
    assert json.loads(text)["max_m_s2"] > 0
    assert said == (
        "era: warning: SW at 600 Hz, NW at 39 Hz: the rig's limits.frequency is 40 to 500 Hz, and "
        "no amplifier is asked for anything else\n"
    )
    assert era(*asked, "--drive", "SW=500", "--drive", "NE=40")[2] == ""


def test_level_scales_a_map(era):
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
    ("drive", "says"),
    [
        ("SW", "is not ERA=HZ"),
        ("XX=110", "no ERA 'XX'"),
        ("SW=fast", "frequency 'fast' is not a number"),
        ("SW=110hz", "without a unit"),
        ("SW=nan", "not a finite number"),
        ("SW=-110", "above zero"),
        ("SW=110@1.5", "between 0 and 1"),
        ("SW=110@0.5:x", "phase 'x' is not a number"),
        ("SW=90000", "elements in a bending wavelength"),
    ],
)
def test_a_drive_that_makes_no_sense_is_bad_input(era, drive, says):
    """Status 2 and one line that says what and where."""
    status, text, said = era("plate", "map", RIG, "--mesh", "12x9", "--drive", drive)
    assert (status, text) == (2, "")
    assert says in said
    assert said.count("\n") == 1


def test_one_era_is_driven_once(era):
    """Two tones on one ERA are refused."""
    status, _, said = era("plate", "map", RIG, "--drive", "SW=110", "--drive", "SW=120")
    assert status == 2
    assert "driven twice" in said


@pytest.mark.parametrize("name", ["map.xyz", "map"])
def test_a_picture_of_no_known_kind_is_bad_input(era, tmp_path, name):
    """The kind follows from the name's end; one that is none is said so, and nothing is written."""
    status, _, said = era(
        *("plate", "map", RIG, "--mesh", "12x9", "--drive", "SW=110", "-o", tmp_path / name)
    )
    assert status == 2
    assert "must end in .png, .svg or .pdf, for instance map.png" in said
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("points", ["13", "0x5", "1x1", "axb", "99999x99999"])
def test_a_raster_that_is_none_is_bad_input(era, points):
    """The raster needs two points each way, and must fit into memory."""
    status, _, said = era(
        *("plate", "map", RIG, "--mesh", "12x9", "--drive", "SW=110", "--points", points)
    )
    assert status == 2
    assert "points" in said


def test_build_show_and_query_follow_each_other(era, tmp_path):
    """A table is built, shown and asked, each step naming the next."""
    table = tmp_path / "t.npz"
    few = ("--frequencies", "60:320:20", "--grid", "6x4")
    status, text, _ = era("table", "build", RIG, "-o", table, *few)
    assert status == 0
    assert text.splitlines()[-1] == f"Next: era table show {table}"
    status, text, _ = era("table", "show", table)
    assert status == 0
    assert "1232" in text  # four ERAs and six pairs at 14 frequencies each: 4·14 + 6·14²
    status, text, _ = era("table", "show", table, "--json")
    assert json.loads(text)["patterns"] == 1232
    arguments = ("table", "query", table, "--target", "0.08,0.06", "--quiet", "0.22,0.16")
    status, text, _ = era(*arguments, "--level", "15", "--json")
    result = json.loads(text)
    assert status == 0
    assert result["level_db_sl"] == 15
    assert result["contrast_db"] > 5
    assert 1 <= len(result["drive"]) <= 2
    status, text, _ = era(*arguments)
    assert status == 0
    assert "dB SL" in text


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (("--frequencies", "60:30:10"), "--frequencies"),
        (("--frequencies", "60:320"), "--frequencies"),
        (("--frequencies", "60:320:1e-9"), "--frequencies"),
        (("--frequencies", "sixty"), "--frequencies"),
        (("--frequencies", "20,60"), "limits"),
        (("--grid", "12"), "--grid"),
        (("--grid", "0x9"), "grid"),
        (("--mesh", "big"), "mesh"),
        (("--mode", "loud"), "unknown drive mode"),
    ],
)
def test_a_table_that_cannot_be_built_leaves_no_file(era, tmp_path, options, says):
    """Bad options: status 2, the option named, nothing written."""
    status, _, said = era(
        *("table", "build", RIG, "-o", tmp_path / "t.npz"),
        *(() if "--mesh" in options else ("--mesh", "12x9")),
        *options,
    )
    assert status == 2
    assert says in said
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_is_not_there_is_bad_input(era, tmp_path):
    """The error names the path."""
    missing = tmp_path / "no" / "t.npz"
    status, _, said = era("table", "build", RIG, "-o", missing, "--mesh", "12x9")
    assert status == 2
    assert str(missing.parent) in said


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (("--target", "0.1"), "X,Y"),
        (("--target", "0.1,nan"), "finite"),
        (("--target", "0.9,0.1"), "not on the plate"),
        (("--target", "0.1,0.1", "--quiet", "0.1,0.1"), "within the quiet fingertip"),
        (("--target", "0.1,0.1", "--level", "99"), "most that can be had"),
        (("--target", "0.1,0.1", "--mode", "loud"), "unknown drive mode"),
    ],
)
def test_a_question_without_an_answer_is_bad_input(era, small_table, options, says):
    """Status 2 and what is wrong."""
    status, text, said = era("table", "query", small_table, *options)
    assert (status, text) == (2, "")
    assert says in said


@pytest.fixture(scope="module")
def small_table(tmp_path_factory):
    """A table that is quick to build."""
    path = tmp_path_factory.mktemp("table") / "t.npz"
    arguments = ["table", "build", RIG, "-o", str(path), "--mesh", "12x9"]
    assert run(arguments, entry_points(group="era_haptics.commands")) == 0
    return path


def test_convergence_compares_meshes_as_text_and_as_json(era, monkeypatch):
    """Errors fall from mesh to mesh, and the rig's own is marked; both forms say the same.

    They are forms of one study, which takes seconds, tells of each mesh when it is solved, and how
    long it took.
    """
    solve, solved, told = convergence.study_convergence, [], []

    def study(rig, meshes, *, frequencies, progress):
        if not solved:

            def hear(done, of):
                told.append((done, of))
                progress(done, of)

            solved.append(solve(rig, meshes, frequencies=frequencies, progress=hear))
        return solved[0]

    monkeypatch.setattr(convergence, "study_convergence", study)
    arguments = ("plate", "convergence", RIG, "--mesh", "12x9", "--frequencies", "110")
    status, text, _ = era(*arguments, "--json")
    assert status == 0
    answer = json.loads(text)
    errors = [row["response_error_percent"][0] for row in answer["meshes"]]
    assert errors == sorted(errors, reverse=True)
    assert [row["is_the_rigs"] for row in answer["meshes"]] == [True] + 4 * [False]
    assert answer["meshes"][0]["dof"] == 390
    assert answer["meshes"][-1]["element"] == "Q5"
    assert answer["solve_time_s"] > 0
    assert told == [(done, 6) for done in range(1, 7)]
    status, text, _ = era(*arguments)
    assert status == 0
    assert re.search(r", found in \d+\.\d s$", text.splitlines()[0])
    assert [f"{error:.3f} %" in text for error in errors] == 5 * [True]


def test_convergence_above_the_rigs_limit_is_bad_input(era):
    """The meshes are made for the rig's highest frequency, and say nothing above it."""
    status, text, said = era("plate", "convergence", RIG, "--frequencies", "110,900")
    assert (status, text) == (2, "")
    assert "limits.frequency of 500 Hz, got 900 Hz" in said
