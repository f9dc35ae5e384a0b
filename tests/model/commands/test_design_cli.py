"""`era design` as it is typed."""

import csv
import json
from pathlib import Path

import pytest
import yaml
from typer.testing import CliRunner

import era_haptics as era
from era_haptics.lab.cli import app as lab_app
from era_haptics.lab.design import problem, score
from model.cli import app
from model.config.document import read_document
from model.errors import InputError
from model.rig.rig_file import example_rig_path, load_rig

pytestmark = pytest.mark.usefixtures("plain_pictures")

RIG = str(example_rig_path())


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
    assert weight == pytest.approx(9.81 * rig.plate.mass)
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
    found = era.design(
        load_rig(RIG), layouts="random:10", finalists=1, keep=["NE"], stiffness=[8e3, 30e3],
        progress=lambda *done: steps.append(done),
    )  # fmt: skip
    era.save_rig(found.best.rig, tmp_path / "best.yaml")
    assert load_rig(tmp_path / "best.yaml") == load_rig(tmp_path / "rig.yaml")
    assert steps[-1][0] == steps[-1][1] > 0
