"""Commands on plates and files of configuration, their progress and next lines."""

import json
import os
import re
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from controller.cli.main import run
from model.cli import config_app
from model.commands import options
from model.commands.options import next_line, progress_bar
from model.errors import InputError
from model.rig.rig_file import example_rig_path, load_rig
from model.vibration import study_convergence
from plates import write_rig

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


@pytest.mark.long
def test_convergence_lists_errors_of_finer_and_finer_meshes(era, answer, monkeypatch, tmp_path):
    """Errors fall from mesh to mesh, and the rig's own is marked; text and JSON agree."""
    studied = []

    def study_once(*args, **keywords):
        studied.append(studied[0] if studied else study_convergence(*args, **keywords))
        return studied[0]

    monkeypatch.setattr("model.vibration.study_convergence", study_once)
    monkeypatch.setattr("model.vibration._DOUBLINGS", 1)
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
    assert len(entries) == 12
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


RUNNER = CliRunner()
EXAMPLE = example_rig_path().read_text(encoding="utf-8")


def test_init_writes_a_rig_and_its_schema(tmp_path: Path) -> None:
    """The new rig is the example's and names its schema."""
    path = tmp_path / "mine.yaml"
    result = RUNNER.invoke(config_app, ["init", str(path)])
    assert result.exit_code == 0
    assert load_rig(path).fingerprint == load_rig(example_rig_path()).fingerprint
    first = path.read_text(encoding="utf-8").splitlines()[0]
    assert first == "# yaml-language-server: $schema=mine.schema.json"
    schema = json.loads((tmp_path / "mine.schema.json").read_text(encoding="utf-8"))
    assert "eras" in schema["else"]["required"]
    assert result.stdout.splitlines()[-1] == f"Next: era config check {path}"


@pytest.mark.parametrize("name", ["kept.yaml", "rig.txt", "no/rig.yaml"])
def test_init_refuses_names_that_it_cannot_write(tmp_path: Path, name: str) -> None:
    """A file that exists is left as it was; another ending or a missing folder is refused."""
    (tmp_path / "kept.yaml").write_text("mine", encoding="utf-8")
    result = RUNNER.invoke(config_app, ["init", str(tmp_path / name)])
    assert isinstance(result.exception, InputError)
    assert name in str(result.exception)
    assert (tmp_path / "kept.yaml").read_text(encoding="utf-8") == "mine"
    assert [path.name for path in tmp_path.iterdir()] == ["kept.yaml"]


def check(path: Path, text: str | None = None) -> tuple[int, list[dict[str, str]], list[str]]:
    """Check a file; returns exit status, errors and warnings of the JSON."""
    if text is not None:
        path.write_text(text, encoding="utf-8")
    result = RUNNER.invoke(config_app, ["check", "--json", str(path)])
    answer = json.loads(result.stdout)
    assert answer["ok"] is (result.exit_code == 0)
    plain = RUNNER.invoke(config_app, ["check", str(path)])
    assert plain.exit_code == result.exit_code
    for named in [*answer["warnings"], *(error["key"] or "" for error in answer["errors"])]:
        assert named in plain.stdout
    return result.exit_code, answer["errors"], answer["warnings"]


def test_check_passes_a_good_rig_with_warnings(tmp_path: Path) -> None:
    """The example has none; two links that cost some of the promise have, as an exact thickness."""
    assert check(example_rig_path()) == (0, [], [])
    links = EXAMPLE.replace(
        'main: {url: "sim://"}',
        "main: {url: 'serial:///dev/ttyUSB0'}\n  two: {url: 'serial:///dev/ttyUSB1'}",
    ).replace("amplifier: main, channel: 3", "amplifier: two, channel: 0")
    status, errors, (warning,) = check(tmp_path / "rig.yaml", links)
    assert (status, errors) == (0, [])
    assert "ftdi-low-latency" in warning
    exact = EXAMPLE + "\nuncertainty: {thickness: 0}\n"
    status, errors, (warning,) = check(tmp_path / "rig.yaml", exact)
    assert (status, errors) == (0, [])
    assert "thickness" in warning


def test_check_lists_all_errors_with_line_and_key(tmp_path: Path) -> None:
    """Units, values and URLs; a missing file is an answer like any other, for scripts."""
    path = tmp_path / "rig.yaml"
    bad = EXAMPLE.replace('"sim://"', '"seriel:///dev/ttyS0"').replace("1.5 mm", "1.5 kg")
    status, errors, _ = check(path, bad.replace("level: 1.0", "level: 2"))
    assert status == 1
    lines = path.read_text().splitlines()
    found = {error["key"]: lines[int(error["line"]) - 1] for error in errors}
    assert found.keys() == {"plate.thickness", "amplifiers.main.url", "limits.level"}
    assert all(key.split(".")[-1] in line for key, line in found.items())
    assert any("serial://" in error["message"] for error in errors)
    status, (missing,), _ = check(tmp_path / "none.yaml")
    assert (status, missing["line"]) == (1, None)


def test_log_gets_a_line_every_two_seconds(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of ten steps of half a second those at 2 and 4 s are printed, without a bar."""
    now = [0.0]
    monkeypatch.setattr(options.time, "monotonic", lambda: now[0])
    with progress_bar("cells") as update:
        for done in range(1, 11):
            now[0] = 0.5 * done
            update(done, 10)
    assert capsys.readouterr().err.splitlines() == ["4 of 10 cells", "8 of 10 cells"]


@pytest.mark.parametrize(
    ("system", "line"),
    [
        ("posix", "Next: era table show 'my $plates/t.npz' --weak"),
        ("nt", 'Next: era table show "my $plates/t.npz" --weak'),
    ],
)
def test_next_line_is_for_the_shell(
    monkeypatch: pytest.MonkeyPatch, system: str, line: str
) -> None:
    """A name with a space is one word to the shells of Unix, and to those of Windows."""
    with monkeypatch.context() as elsewhere:
        elsewhere.setattr(os, "name", system)
        said = next_line("era", "table", "show", "my $plates/t.npz", "--weak")
    assert said == line
