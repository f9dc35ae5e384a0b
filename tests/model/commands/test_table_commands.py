"""Commands on tables, designs, figures, plates and configuration files, as typed by a user.

What they write and print: files and pictures, progress and next lines.
"""

import csv
import json
import os
import re
import shlex
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from click.testing import Result
from typer.testing import CliRunner

import era_haptics as api
from controller.cli.main import run
from era_haptics.lab.cli import app as lab_app
from era_haptics.lab.cli import figure_app
from era_haptics.lab.design import problem, score
from model.cli import app, config_app
from model.commands import options
from model.commands.options import next_line, progress_bar
from model.compiled.kernels import WITHOUT_KERNELS
from model.config.document import read_document
from model.errors import InputError
from model.rig.rig_file import example_rig_path, load_rig
from model.study import overview
from model.table.table_file import load_table, save_table
from model.vibration import study_convergence
from plates import write_rig

pytestmark = pytest.mark.usefixtures("plain_pictures")

RIG = str(example_rig_path())
ERA = str(Path(sys.executable).with_name("era"))
QUICK = ["--mesh", "12x9", "--frequencies", "60,110,250", "--grid", "4x3"]
PNG = b"\x89PNG\r\n\x1a\n"


def table(*arguments: str | Path) -> Result:
    """Run `era table`; what it raises is raised here."""
    result = CliRunner().invoke(app, ["table", *map(str, arguments)])
    if isinstance(result.exception, Exception):
        raise result.exception
    return result


def as_json(*arguments: str | Path) -> dict[str, Any]:
    """The one object that it prints."""
    answer: dict[str, Any] = json.loads(table(*arguments, "--json").stdout)
    return answer


@pytest.fixture(autouse=True, scope="module")
def few_sets() -> Iterator[None]:
    """Distributions of few contact sets."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(overview, "CONTACT_SETS", 12)
        yield


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small table of the example rig."""
    path = tmp_path_factory.mktemp("built") / "t.npz"
    table("build", RIG, "-o", path, *QUICK)
    return path


def test_build_writes_a_table_and_what_made_it(tmp_path: Path) -> None:
    """66 patterns, 4 * 3 alone and 6 * 3² in pairs, for 12 cells; no other file is left."""
    path = tmp_path / "t.npz"
    lines = table("build", RIG, "-o", path, *QUICK).stdout.splitlines()
    assert lines[-1] == f"Next: era table show {path}"
    answer = as_json("build", RIG, "-o", path, "--mode", "phased", *QUICK)
    assert answer["drive_frequencies_hz"] == [60.0, 110.0, 250.0]
    assert (answer["patterns"], answer["cells"], answer["mode"]) == (66, 12, "phased")
    assert (answer["mesh"], answer["element"]) == ([12, 9], "MITC4")
    assert 10 < answer["discretisation_error_percent"] < 100  # the paper's mesh is a coarse one
    assert answer["files"] == [str(path)]
    assert load_table(path).fingerprint == answer["fingerprint"]
    assert list(tmp_path.iterdir()) == [path]


def test_build_notes_a_coarse_mesh_and_what_is_taken_as_none(tmp_path: Path) -> None:
    """A warning of the error on standard error, and what the rig says is known exactly."""
    rig = tmp_path / "rig.yaml"
    text = Path(RIG).read_text(encoding="utf-8")
    rig.write_text(text + "\nuncertainty: {thickness: 0}\n", encoding="utf-8")
    path = tmp_path / "t.npz"
    coarse = table("build", rig, "-o", path, *QUICK)
    assert "warning: mesh 12x9" in coarse.stderr
    assert any("thickness" in line and "none" in line for line in coarse.stdout.splitlines())
    fine = ["--frequencies", "60", "--grid", "4x3"]
    answer = json.loads(table("build", RIG, "-o", path, *fine, "--json").stdout)
    assert answer["exactly_known"] == []
    assert answer["discretisation_error_percent"] < 5
    assert table("build", RIG, "-o", path, *fine).stderr == ""


def test_show_prints_summary_map_and_a_query_that_has_an_answer(
    built: Path, tmp_path: Path
) -> None:
    """The map is 4 by 3, each star of it is in the list, and the next command is quoted."""
    spaced = tmp_path / "my table.npz"
    spaced.write_bytes(built.read_bytes())
    lines = table("show", spaced, "--weak").stdout.splitlines()
    rows = {line[:20].strip(): line[20:].strip() for line in lines}
    assert rows["dead zones"].startswith("0 %")
    for name in ("feasible cells", "contrast to 3 others", "mesh", "fingerprint"):
        assert rows[name]
    start = next(
        number for number, line in enumerate(lines) if line.startswith("promised felt contrast")
    )
    errors = re.findall(r"± ([\d.]+) dB", lines[start + 1])
    assert [0 < float(error) < 10 for error in errors] == [True, True]
    cells = lines[start + 2 : start + 5]
    assert [len(line.split()) for line in cells] == [4, 4, 4]
    stars = sum(line.count("*") for line in cells)
    assert sum(line.startswith("(0.") for line in lines) == stars > 0
    era, group, *words = shlex.split(lines[-1])[1:]
    assert (era, group, words[1]) == ("era", "table", str(spaced))
    assert as_json(*words)["promised_worst_db"] > 0


def test_verify_passes_a_true_table_and_fails_a_false_one(built: Path, tmp_path: Path) -> None:
    """Modes of a tenth higher frequencies, the checksum right: status 1, as text and as JSON."""
    result = table("verify", built, RIG, "--samples", "3")
    assert result.exit_code == 0
    assert sum(line.endswith("passed") for line in result.stdout.splitlines()) == 6
    true = load_table(built)
    false = tmp_path / "false.npz"
    save_table(replace(true, omega=1.1 * true.omega), false)
    result = table("verify", false, RIG, "--samples", "3")
    assert result.exit_code == 1
    assert result.stdout.splitlines()[-1].startswith("Next: era table build")
    result = table("verify", false, RIG, "--samples", "3", "--json")
    assert result.exit_code == 1
    assert json.loads(result.stdout)["failed"] > 0


def test_query_prints_levels_and_contrast(built: Path) -> None:
    """One row per driven ERA, then one per finger; that 99 dB SL is out of reach is said."""
    contacts = ["--target", "0.08,0.06", "--quiet", "0.22,0.16"]
    answer = as_json("query", built, *contacts)
    lines = table("query", built, *contacts).stdout.splitlines()
    drive, felt = answer["layers"][0]["drive"], answer["fingers"][0]
    assert [line.split()[0] for line in lines[: len(drive)]] == list(drive)
    assert lines[len(drive) + 1].split()[:2] == ["(0.08,", "0.06)"]
    assert f"{felt['promised_contrast_db']:.1f} dB" in lines[len(drive) + 1]
    assert "cm²" in table("query", built, "--target", "0.08,0.06").stdout
    assert "is lowered to" in table("query", built, "--target", "0.1,0.1", "--level", "60").stdout


def test_plot_writes_its_pictures(built: Path, tmp_path: Path) -> None:
    """Four of them in a new folder, named; a command comes last."""
    folder = tmp_path / "new" / "pictures"
    lines = table("plot", built, "-o", folder).stdout.splitlines()
    files = [line.strip() for line in lines[1:5]]
    names = ["weak_cells", "levels", "contrast", "answer"]
    assert files == [str(folder / f"{name}.png") for name in names]
    assert all(Path(file).read_bytes().startswith(PNG) for file in files)
    assert lines[5:] == [f"Next: era table show {built} --weak"]


def test_export_writes_both_formats(built: Path, tmp_path: Path) -> None:
    """A .mat file, and .csv files of patterns or fields; --content is for .csv only."""
    table("export", built, "--format", "mat", "-o", tmp_path / "t.mat")
    table("export", built, "--format", "csv", "-o", tmp_path / "t.csv")
    table("export", built, "--format", "csv", "--content", "fields", "-o", tmp_path / "f.csv")
    heads = [(tmp_path / name).read_text().split(",")[0] for name in ("t.csv", "f.csv")]
    assert heads == ["target_x_m", "x_m"]
    assert (tmp_path / "t.mat").read_bytes().startswith(b"MATLAB 5.0")
    with pytest.raises(InputError, match="--content"):
        table("export", built, "--format", "mat", "--content", "fields", "-o", tmp_path / "t.mat")


def test_commands_say_that_there_is_no_compiler(
    without_kernels: Callable[[], None], tmp_path: Path
) -> None:
    """`era table build` and `era config check`, with how much longer answers take."""
    without_kernels()
    built = table("build", RIG, "-o", tmp_path / "t.npz", *QUICK)
    checked = CliRunner().invoke(app, ["config", "check", RIG, "--json"])
    assert (built.exit_code, checked.exit_code) == (0, 0)
    assert WITHOUT_KERNELS in built.stderr
    (warning,) = json.loads(checked.stdout)["warnings"]
    assert warning.startswith(WITHOUT_KERNELS)


RUNNER = CliRunner()


def test_figure_writes_a_picture_and_its_numbers(tmp_path: Path) -> None:
    """Figure 7 as PNG and CSV in a new folder, and what is printed of them."""
    folder = tmp_path / "new" / "figures"
    result = RUNNER.invoke(figure_app, ["7", RIG, "-o", str(folder), "--mesh", "12x9", "--json"])
    assert result.exit_code == 0
    assert sorted(path.name for path in folder.iterdir()) == [
        "figure_7.csv",
        "figure_7.png",
        "figure_7_shapes.csv",
    ]
    assert (folder / "figure_7.png").read_bytes().startswith(PNG)
    with (folder / "figure_7.csv").open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    # Table 2 of the paper, on its mesh.
    assert [f"{float(row['model_hz']):.2f}" for row in rows] == [
        "31.98", "68.50", "76.62", "107.84", "160.77",
    ]  # fmt: skip
    answer = json.loads(result.stdout)
    assert "figure_7" in answer["figures"]
    assert all(Path(name).is_file() for name in answer["files"])
    assert len(answer["files"]) == 3


@pytest.fixture
def small(monkeypatch):
    """A design of few candidates, frequencies and contact sets."""
    monkeypatch.setitem(problem.CANDIDATES, True, 12)
    monkeypatch.setattr(problem, "SEARCH_FINGERS", 6)
    monkeypatch.setattr(problem, "SEARCH_FREQUENCIES", 3)
    monkeypatch.setattr(score, "FINEST_STEP", 0.02)
    monkeypatch.setattr(problem, "JUDGED_SETS", 3)


def design(*arguments: str):
    """Run `era design` in this process."""
    return CliRunner().invoke(lab_app, ["design", RIG, "--workers", "1", *arguments])


@pytest.mark.long
def test_design_writes_a_rig_that_loads(small, tmp_path: Path) -> None:
    """Five ERAs, one kept: channels are distinct, pictures there, and what is printed."""
    arguments = ("--eras", "5", "--keep", "NE", "--starts", "1", "-o", str(tmp_path), "--json")
    result = design(*arguments)
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    rig = load_rig(tmp_path / "rig.yaml")
    before = load_rig(RIG)
    assert [era.name for era in rig.eras] == list(found["eras"])
    assert (rig.era("NE").x, rig.era("NE").y) == (before.era("NE").x, before.era("NE").y)
    assert rig.wiring["NE"] == before.wiring["NE"]
    assert [era.damping for era in rig.eras] == pytest.approx([before.eras[0].damping] * 5)
    assert len(set(rig.wiring.values())) == 5
    assert set(read_document(tmp_path / "rig.yaml").data["amplifiers"]) == {"main", "amplifier2"}
    assert {Path(name).name for name in found["files"]} == {
        "rig.yaml", "layouts.csv", "contrast.png", "count.png", "template.svg",
    }  # fmt: skip
    weight = sum(era["static_load_n"] for era in found["eras"].values())
    assert weight == pytest.approx(9.80665 * rig.plate.mass)
    assert list(found["by_count_db"]) == ["3", "4", "5", "6"]
    again = design(*arguments[:-1]).stdout
    assert load_rig(tmp_path / "rig.yaml").eras == rig.eras
    assert f"the rig's own 4 ERAs: mean {found['own_contrast_db']['mean']:.1f} dB" in again


@pytest.mark.long
def test_the_best_of_several_stiffnesses_is_written(small, tmp_path: Path) -> None:
    """Two are designed; the rig has the one whose layout has more contrast, at new ERAs alone."""
    arguments = ("--eras", "4", "--keep", "NE", "--starts", "1", "-o", str(tmp_path), "--json")
    result = design(*arguments, "--stiffness", "8 kN/m,30 kN/m")
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    by_stiffness = found["by_stiffness_db"]
    assert set(by_stiffness) == {"8000", "30000"}
    assert found["contrast_db"]["mean"] == max(by_stiffness.values())
    best = float(max(by_stiffness, key=by_stiffness.get))
    rig = load_rig(tmp_path / "rig.yaml")
    assert {era.name: era.stiffness for era in rig.eras if era.name != "NE"} == {
        era.name: best for era in rig.eras if era.name != "NE"
    }
    assert rig.era("NE").stiffness == load_rig(RIG).era("NE").stiffness


def test_given_layouts_are_ranked_and_the_best_written(small, tmp_path: Path) -> None:
    """Judged ones first, by contrast, others by score; a row each."""
    arguments = ("--layouts", "random:20", "--eras", "3-4", "--finalists", "2", "--json")
    result = design(*arguments, "-o", str(tmp_path))
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    with (tmp_path / "layouts.csv").open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == found["layout_count"]
    assert {len(row["at_m"].split()) for row in rows} == {3, 4}
    judged = [float(row["contrast_db"]) for row in rows if row["contrast_db"]]
    assert len(judged) == 4
    assert judged == sorted(judged, reverse=True)
    assert [row["contrast_db"] != "" for row in rows] == [True] * 4 + [False] * (len(rows) - 4)
    scores = [float(row["expected_contrast_db"]) for row in rows[4:] if row["supported"] == "True"]
    assert scores == sorted(scores, reverse=True)
    assert sum(row["supported"] == "False" for row in rows) == found["unsupported"] > 0
    assert found["contrast_db"] == found["layouts"][0]["contrast_db"]
    places = [[era.x, era.y] for era in load_rig(tmp_path / "rig.yaml").eras]
    best = list(found["layouts"][0]["at_m"].values())
    assert places == [pytest.approx(each, abs=1e-6) for each in best]
    assert set(found["by_count_db"]) == {"3", "4"}


@pytest.mark.parametrize(("depth", "is_light"), [("4.6 in", True), ("9 in", False)])
def test_design_warns_of_a_plate_that_nearly_tips(small, tmp_path: Path, depth, is_light) -> None:
    """An ERA a tenth of an inch behind the centre of mass carries all but 2 % of the weight."""
    layout = f"layouts:\n  tee: [[0, 0], [12 in, 0], [6 in, {depth}]]\n"
    (tmp_path / "layouts.yaml").write_text(layout)
    result = design("--layouts", str(tmp_path / "layouts.yaml"), "-o", str(tmp_path), "--json")
    assert result.exit_code == 0, result.output
    light = [
        name for name, era in json.loads(result.stdout)["eras"].items() if name in result.stderr
    ]
    assert len(light) == 2 * is_light


LAYOUTS = """layouts:
  corners: [[0, 0], [12 in, 0], [12 in, 9 in], [0, 9 in]]
  skew:    [[1 in, 0], [11 in, 0], [9 in, 9 in], [0, 7 in]]
  narrow:  [[4 in, 0], [8 in, 0], [8 in, 9 in], [4 in, 9 in]]
"""
TWO_CONTENTS = """sets:
  - {own: [[3 cm, 3 cm], [26 cm, 18 cm]]}
  - {own: [[5 cm, 18 cm], [20 cm, 4 cm]], quiet: [[14 cm, 11 cm]]}
"""
OWN_LINES = """{"own": [{"at": [0.03, 0.03]}, {"at": [0.26, 0.18]}]}
{"own": [{"at": [0.05, 0.18]}, {"at": [0.2, 0.04]}], "quiet": [[0.14, 0.11]]}
"""


def test_layouts_are_ranked_by_the_promise_of_two_contents(small, tmp_path: Path) -> None:
    """By what tables of all layouts, built and queried as commands, promise at the worst finger."""
    names = {"layouts.yaml": LAYOUTS, "contacts.yaml": TWO_CONTENTS, "own.jsonl": OWN_LINES}
    for name, text in names.items():
        (tmp_path / name).write_text(text)
    rig = read_document(RIG).data
    promised = {}
    for name, places in yaml.safe_load(LAYOUTS)["layouts"].items():
        of, table = tmp_path / f"{name}.yaml", tmp_path / f"{name}.npz"
        eras = zip(rig["eras"].values(), places, strict=True)
        moved = {f"E{n}": {**era, "at": at} for n, (era, at) in enumerate(eras, start=1)}
        of.write_text(json.dumps({**rig, "eras": moved}))
        arguments = ["table", "build", str(of), "-o", str(table), "--mode", "phased"]
        assert CliRunner().invoke(app, arguments).exit_code == 0
        lines = ["table", "query", str(table), "--batch", str(tmp_path / "own.jsonl"), "--json"]
        answers = map(json.loads, CliRunner().invoke(app, lines).stdout.splitlines())
        promised[name] = [each["promised_worst_db"] for each in answers]
    means = {name: sum(each) / 2 for name, each in promised.items()}
    result = design(
        *("--layouts", str(tmp_path / "layouts.yaml"), "--contents", "2", "--json"),
        *("--contacts", str(tmp_path / "contacts.yaml"), "-o", str(tmp_path / "out")),
    )
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    ranked = {each["layout"]: each["contrast_db"] for each in found["layouts"]}
    assert list(ranked) == sorted(means, key=means.get, reverse=True)
    for name, (without, with_quiet) in promised.items():
        expected = {"median_0_quiet": without, "median_1_quiet": with_quiet, "mean": means[name]}
        assert ranked[name] == pytest.approx(expected, abs=0.01)
    assert found["contents"] == 2


@pytest.mark.parametrize("contents", ["0", "3", "7"])
def test_contents_other_than_those_of_the_sets_are_refused(small, tmp_path, contents) -> None:
    """None, one more than the sets have, more than any plate keeps apart."""
    path = tmp_path / "contacts.yaml"
    path.write_text(TWO_CONTENTS)
    result = design("--contents", contents, "--contacts", str(path), "-o", str(tmp_path / "out"))
    assert result.exit_code == 2 or isinstance(result.exception, InputError)


def test_layouts_of_which_none_supports_the_plate_are_refused(small, tmp_path: Path) -> None:
    """Three ERAs at one side, wherever the plate would tip over them."""
    path = tmp_path / "layouts.yaml"
    path.write_text("layouts: {side: [[0, 0], [0, 10 cm], [5 cm, 0]]}\n")
    result = design("--layouts", str(path), "-o", str(tmp_path / "out"))
    assert isinstance(result.exception, InputError)


def test_a_plate_that_sags_is_no_design(small, tmp_path: Path) -> None:
    """No layout has its lowest rigid-body frequency above a bound out of reach."""
    result = design("--eras", "4", "--lowest", "5000", "--starts", "1", "-o", str(tmp_path))
    assert isinstance(result.exception, InputError)


def test_design_of_python_is_that_of_the_command(small, tmp_path: Path) -> None:
    """The best of ten layouts and two stiffnesses with a kept ERA, saved; what is done is all."""
    names = ("--layouts", "random:10", "--finalists", "1", "--keep", "NE")
    assert design(*names, "--stiffness", "8 kN/m,30 kN/m", "-o", str(tmp_path)).exit_code == 0
    steps: list[tuple[int, int]] = []
    found = api.design(
        load_rig(RIG), layouts="random:10", finalists=1, keep=["NE"], stiffness=[8e3, 30e3],
        progress=lambda *done: steps.append(done),
    )  # fmt: skip
    api.save_rig(found.best.rig, tmp_path / "best.yaml")
    assert load_rig(tmp_path / "best.yaml") == load_rig(tmp_path / "rig.yaml")
    assert steps[-1][0] == steps[-1][1] > 0


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
