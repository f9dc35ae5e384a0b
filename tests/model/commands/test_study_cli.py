"""`era study`: from a rig file to a recommended one."""

import csv
import json
import os
import re
import signal
import subprocess
import sys
import time
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
from model.studies.run import CHUNK

RUNNER = CliRunner()
RIG = str(example_rig_path())
ERA = str(Path(sys.executable).with_name("era"))
QUICK = ["--mesh", "12x9", "--frequencies", "60,110,250", "--candidates", "7x5"]
PNG = b"\x89PNG\r\n\x1a\n"


def study(what: str, folder: Path, *more: str, rig: str = RIG) -> dict[str, Any]:
    """Run a study as JSON, and read its answer."""
    result = RUNNER.invoke(study_app, [what, rig, "-o", str(folder), "--json", *QUICK, *more])
    if result.exception is not None:
        raise result.exception
    answer: dict[str, Any] = json.loads(result.stdout)
    return answer


@pytest.mark.parametrize("what", ["placement", "count", "stiffness"])
def test_study_recommends_a_rig_that_loads(tmp_path: Path, what: str) -> None:
    """The new rig has exactly the ERAs of the recommendation, on the same plate."""
    answer = study(what, tmp_path, "--layouts", "12")
    recommended = answer["recommended"]
    rig = load_rig(tmp_path / "recommended.yaml")
    assert rig.plate == load_rig(RIG).plate
    assert {era.name: [era.x, era.y] for era in rig.eras} == recommended["at_m"]
    assert {era.name: era.stiffness for era in rig.eras} == recommended["stiffness_n_m"]
    assert set(recommended["active"]) <= {era.name for era in rig.eras}
    assert all(name in recommended["words"] for name in recommended["at_m"])
    for name in answer["files"]:
        assert Path(name).is_file()
        assert not name.endswith(".png") or Path(name).read_bytes().startswith(PNG)


def test_study_keeps_what_it_does_not_vary(tmp_path: Path) -> None:
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
    study("placement", tmp_path / "out", "--layouts", "12", rig=str(path))
    rig = load_rig(tmp_path / "out" / "recommended.yaml")
    before = load_rig(path).eras[0]
    assert len(before.gains) == 2
    for era in rig.eras:
        assert (era.bolt_mass, era.stroke, era.gains) == (0.004, 80e-6, before.gains)
        assert era.stiffness == before.stiffness
        assert era.damping == before.damping


def test_study_of_the_recommended_rig_finds_the_same_statistics(tmp_path: Path) -> None:
    """A study of the recommended rig finds its own layout with the same statistics."""
    first = study("placement", tmp_path / "a", "--layouts", "12")
    again = study("placement", tmp_path / "b", "--layouts", "1", rig=first["files"][0])
    (own,) = again["ranking"]
    assert own["layout"] == "own"
    for key in ("minimum_m_s2", "median_m_s2", "maximum_m_s2"):
        assert own[key] == pytest.approx(first["recommended"][key], rel=1e-9)


def test_study_csv_has_every_case_and_drive(tmp_path: Path) -> None:
    """Three rows per layout; the best by median leads the ranking."""
    answer = study("placement", tmp_path, "--layouts", "20")
    with (tmp_path / "placement.csv").open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == 60
    pairs = [row for row in rows if row["driven"] == "2"]
    best = max(pairs, key=lambda row: float(row["median_m_s2"]))
    assert best["layout"] == answer["ranking"][0]["layout"] == answer["recommended"]["layout"]
    assert float(best["median_m_s2"]) == answer["ranking"][0]["median_m_s2"]
    medians = [case["median_m_s2"] for case in answer["ranking"][:10]]
    assert medians == sorted(medians, reverse=True)
    assert "own" in {case["layout"] for case in answer["ranking"]}


def test_study_reuses_the_cases_of_an_earlier_one(tmp_path: Path) -> None:
    """Nothing is solved and the answer is the same; with another seed, random layouts are new."""
    first = study("placement", tmp_path, "--layouts", "20")
    second = study("placement", tmp_path, "--layouts", "20")
    assert (first["solved"], first["from_cache"]) == (20, 0)
    assert (second["solved"], second["from_cache"]) == (0, 20)
    assert second["ranking"] == first["ranking"]
    other = study("placement", tmp_path, "--layouts", "20", "--seed", "1")
    assert 0 < other["from_cache"] < 20  # the layouts that have a name
    assert other["ranking"] != first["ranking"]


def test_study_gives_more_eras_than_the_rig_has_their_own_channels(tmp_path: Path) -> None:
    """Six ERAs recommended for a rig of four: no two on one channel."""
    answer = study("count", tmp_path, "--layouts", "6", "--active", "all")
    counts = {len(case["at_m"]) for case in answer["ranking"]}
    assert counts == {1, 2, 3, 4, 5, 6}
    rig = load_rig(tmp_path / "recommended.yaml")
    assert len(rig.eras) == len(answer["recommended"]["at_m"]) > 4
    assert len(set(rig.wiring.values())) == len(rig.eras)


def test_study_prints_ranking_recommendation_and_next_command(tmp_path: Path) -> None:
    """A softer or smaller layout within a tenth of the best is recommended, and why is said."""
    few = ["--layouts", "24", "--seed", "2"]
    result = RUNNER.invoke(study_app, ["count", RIG, "-o", str(tmp_path), *few, *QUICK])
    assert result.exit_code == 0
    lines = result.stdout.splitlines()
    best = next(line.split() for line in lines if line.startswith("   1  "))
    recommendation = re.search(r"^Recommended(.+?): (\d) ERAs", result.stdout, re.MULTILINE)
    assert recommendation is not None
    assert int(recommendation[2]) < int(best[1][0])  # a random layout is named by its count
    recommended = tmp_path / "recommended"
    assert lines[-1] == f"Next: era table build {recommended}.yaml -o {recommended}.npz"


def test_study_of_one_era_needs_active_1(tmp_path: Path) -> None:
    """A rig of one ERA has no pair to rank by; with --active 1 it can be studied."""
    data = read_document(Path(RIG)).data
    data["eras"] = dict([next(iter(data["eras"].items()))])
    rig = str(tmp_path / "one.yaml")
    Path(rig).write_text(data_text(data), encoding="utf-8")
    with pytest.raises(InputError, match="--active 1"):
        study("placement", tmp_path / "out", rig=rig)
    answer = study("placement", tmp_path / "out", "--active", "1", "--layouts", "9", rig=rig)
    assert len(answer["recommended"]["at_m"]) == 1
    (era,) = load_rig(tmp_path / "out" / "recommended.yaml").eras
    assert answer["recommended"]["at_m"] == {era.name: [era.x, era.y]}


@pytest.mark.parametrize(
    "arguments",
    [
        ["loudness"],
        *(["placement", option, "0"] for option in ("--layouts", "--workers", "--active")),
    ],
    ids=" ".join,
)
def test_study_refuses_bad_usage(tmp_path: Path, arguments: list[str]) -> None:
    """An unknown study and numbers out of range end with status 2."""
    what, *options = arguments
    result = RUNNER.invoke(study_app, [what, RIG, "-o", str(tmp_path), *options])
    assert result.exit_code == 2


@pytest.mark.parametrize(
    ("more", "named"),
    [
        (["--frequencies", "0:100:10"], "LO:HI:STEP"),
        (["--frequencies", "60,110,60"], "60"),
        (["--frequencies", "60,9000"], "Hz"),
        (["--candidates", "1x1"], "1x1"),
        (["--candidates", "many"], "many"),
        (["--workers", "2", "--cluster", "tcp://127.0.0.1:1"], "--cluster"),
        (["--cluster", "nowhere"], "--cluster"),
    ],
)
def test_study_refuses_bad_input(tmp_path: Path, more: list[str], named: str) -> None:
    """One clear error, before anything is solved."""
    with pytest.raises(InputError, match=named):
        study("placement", tmp_path, *more)


def test_study_resumes_when_it_was_interrupted(tmp_path: Path) -> None:
    """SIGINT in the middle, with two workers: status 130, and a whole file to resume from."""
    arguments = ["study", "placement", RIG, "-o", str(tmp_path), "--layouts", "30000", *QUICK]
    with subprocess.Popen(
        [ERA, *arguments, "--workers", "2"],
        stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        text=True,
        start_new_session=True,
    ) as running:
        while not list(tmp_path.glob("finished-*.npz")):
            assert running.poll() is None
            time.sleep(0.02)
        os.killpg(running.pid, signal.SIGINT)  # as a terminal does: to the workers as well
        _, said = running.communicate(timeout=60)
    assert running.returncode == 130
    assert "finished-" in said
    assert "Traceback" not in said
    (finished,) = tmp_path.iterdir()  # no half-written file beside it
    with np.load(finished) as arrays:
        assert CHUNK <= len(arrays["cases"]) < 30000
    answer = study("placement", tmp_path, "--layouts", str(2 * CHUNK), "--workers", "1")
    assert answer["from_cache"] >= CHUNK
