"""`era study`: from a rig file to a recommended one."""

import csv
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from model.commands.study_cli import study_app
from model.config.document import read_document
from model.config.editing import data_text
from model.errors import InputError
from model.rig.file import example_rig_path, load_rig
from model.studies import finalists, solve
from model.table import table

pytestmark = pytest.mark.usefixtures("plain_pictures")

RUNNER = CliRunner()
RIG = str(example_rig_path())
QUICK = ["--mesh", "12x9", "--frequencies", "60,110,250", "--candidates", "7x5"]
FEW = ["--finalists", "2"]
PNG = b"\x89PNG\r\n\x1a\n"


@pytest.fixture(autouse=True)
def few_sets(monkeypatch: pytest.MonkeyPatch) -> None:
    """Contrast of few contact sets and frequencies."""
    monkeypatch.setattr(table, "DEFAULT_FREQUENCIES", np.array([60.0, 110.0, 180.0, 250.0]))
    monkeypatch.setattr(finalists, "JUDGED_SETS", 3)
    monkeypatch.setattr(solve, "SEARCH_FINGERS", 6)


def study(what: str, folder: Path, *more: str, rig: str = RIG) -> dict[str, Any]:
    """Run a study as JSON, and read its answer."""
    result = RUNNER.invoke(study_app, [what, rig, "-o", str(folder), "--json", *QUICK, *FEW, *more])
    if result.exception is not None:
        raise result.exception
    answer: dict[str, Any] = json.loads(result.stdout)
    return answer


def check_recommendation(answer: dict[str, Any]) -> None:
    """The new rig has exactly the ERAs of the recommendation, on the same plate."""
    recommended = answer["recommended"]
    rig = load_rig(answer["files"][0])
    assert rig.plate == load_rig(RIG).plate
    assert {era.name: [era.x, era.y] for era in rig.eras} == recommended["at_m"]
    assert {era.name: era.stiffness for era in rig.eras} == recommended["stiffness_n_m"]
    assert set(recommended["active"]) <= {era.name for era in rig.eras}
    assert all(name in recommended["words"] for name in recommended["at_m"])
    assert len(set(rig.wiring.values())) == len(rig.eras)
    for name in answer["files"]:
        assert Path(name).is_file()
        assert not name.endswith(".png") or Path(name).read_bytes().startswith(PNG)


def test_placement_study_ranks_recommends_and_resumes(tmp_path: Path) -> None:
    """Three CSV rows per layout, the best contrast first; the same command solves nothing again."""
    first = study("placement", tmp_path, "--layouts", "20")
    check_recommendation(first)
    with (tmp_path / "placement.csv").open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == 60
    (best,) = [row for row in rows if row["driven"] == "2" and row["rank"] == "1"]
    assert best["layout"] == first["ranking"][0]["layout"] == first["recommended"]["layout"]
    judged = [float(row["contrast_db"]) for row in rows if row["contrast_db"]]
    assert float(best["contrast_db"]) == max(judged)
    # six digits in a CSV
    contrast = pytest.approx(first["ranking"][0]["contrast_db"]["mean"], rel=1e-5)
    assert float(best["contrast_db"]) == contrast
    expected = [
        case["expected_contrast_db"]
        for case in first["ranking"][:10]
        if case["supported"] and case["contrast_db"] is None
    ]
    assert expected == sorted(expected, reverse=True)
    unsupported = {row["layout"] for row in rows if row["supported"] == "no"}
    assert len(unsupported) == first["tipping"] + first["too_low"]
    assert "own" in {case["layout"] for case in first["ranking"]}
    second = study("placement", tmp_path, "--layouts", "20")
    assert (first["solved"], first["from_cache"]) == (20, 0)
    assert (second["solved"], second["from_cache"]) == (0, 20)
    assert second["ranking"] == first["ranking"]


def test_placement_study_keeps_what_it_does_not_vary(tmp_path: Path) -> None:
    """Bolt mass, stroke and measured gains of the ERAs are in the recommended rig."""
    data = read_document(Path(RIG)).data
    for era in data["eras"].values():
        era |= {
            "bolt_mass": "4 g",
            "stroke": "80 um",
            "gains": [[60, 0.9, -2], [320, 1, 3]],
        }
    path = tmp_path / "rig.yaml"
    path.write_text(data_text(data), encoding="utf-8")
    study("placement", tmp_path / "out", "--layouts", "2", rig=str(path))
    rig = load_rig(tmp_path / "out" / "recommended.yaml")
    before = load_rig(path).eras[0]
    assert len(before.gains) == 2
    for era in rig.eras:
        assert (era.bolt_mass, era.stroke, era.gains) == (0.004, 80e-6, before.gains)
        assert (era.stiffness, era.damping) == (before.stiffness, before.damping)


@pytest.mark.long
def test_count_study_copies_a_driven_era_not_a_support(tmp_path: Path) -> None:
    """The rig's first ERA only supports: the recommended ones have the stroke of a driven one."""
    data = read_document(Path(RIG)).data
    support, *driven = data["eras"].values()
    del support["amplifier"], support["channel"]
    support["at"] = [0.013, 0.017]  # where no layout has an ERA
    for era in driven:
        era["stroke"] = "80 um"
    path = tmp_path / "rig.yaml"
    path.write_text(data_text(data), encoding="utf-8")
    study("count", tmp_path / "out", "--layouts", "6", rig=str(path))
    rig = load_rig(tmp_path / "out" / "recommended.yaml")
    assert len(rig.supports) == 1
    assert {era.stroke for era in rig.eras} == {80e-6}


@pytest.mark.long
def test_stiffness_study_recommends_a_rig_that_loads(tmp_path: Path) -> None:
    """All ERAs of the recommended rig have the stiffness of the best case."""
    check_recommendation(study("stiffness", tmp_path, "--layouts", "2"))


@pytest.mark.long
def test_count_study_gives_each_era_its_own_channel(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One to six ERAs are compared; more than four for a rig of four are all wired apart."""
    monkeypatch.setattr(finalists, "JUDGED_SETS", 12)  # three favour few ERAs by chance
    answer = study("count", tmp_path, "--layouts", "6", "--active", "all")
    assert {len(case["at_m"]) for case in answer["ranking"]} == {1, 2, 3, 4, 5, 6}
    assert [len(case["at_m"]) for case in answer["ranking"] if not case["supported"]] == [2, 1]
    assert len(answer["recommended"]["at_m"]) > 4
    check_recommendation(answer)


def test_count_study_prints_ranking_recommendation_and_next_command(tmp_path: Path) -> None:
    """The recommended layout is described, with its contrast, and what to do with it."""
    few = ["--layouts", "24", "--seed", "2"]
    result = RUNNER.invoke(study_app, ["count", RIG, "-o", str(tmp_path), *few, *QUICK, *FEW])
    assert result.exit_code == 0
    lines = result.stdout.splitlines()
    recommendation = re.search(r"^Recommended.*: (\d) ERAs", result.stdout, re.MULTILINE)
    assert recommendation is not None
    assert 3 <= int(recommendation[1]) <= 6
    recommended = tmp_path / "recommended"
    assert lines[-1] == f"Next: era table build {recommended}.yaml -o {recommended}.npz"


def test_study_takes_contacts_and_the_lowest_mode(tmp_path: Path) -> None:
    """Contacts given replace those anywhere, and a bound above all modes leaves no layout."""
    contacts = tmp_path / "contacts.yaml"
    contacts.write_text("sets:\n  - {target: [5 cm, 5 cm], quiet: [[20 cm, 15 cm]]}\n")
    few = ["--layouts", "3", "--finalists", "1"]
    answer = study("placement", tmp_path / "out", *few, "--contacts", str(contacts))
    assert answer["sets"] == 1
    assert set(answer["recommended"]["contrast_db"]) == {"mean", "median_1_quiet"}
    with pytest.raises(InputError):
        study("placement", tmp_path / "out", *few, "--lowest", "5000")


def test_study_refuses_a_rig_of_which_no_layout_supports_the_plate(tmp_path: Path) -> None:
    """A plate tips over on one ERA wherever it is, so none is recommended; nothing is written."""
    data = read_document(Path(RIG)).data
    data["eras"] = dict([next(iter(data["eras"].items()))])
    rig = str(tmp_path / "one.yaml")
    Path(rig).write_text(data_text(data), encoding="utf-8")
    with pytest.raises(InputError):
        study("placement", tmp_path / "out", "--active", "1", rig=rig)
    assert not (tmp_path / "out").exists()
