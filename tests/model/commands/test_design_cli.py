"""`era design` as it is typed."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from model.cli import app
from model.config.document import read_document
from model.design import run, search
from model.errors import InputError
from model.rig.file import example_rig_path, load_rig
from model.rig.uncertainty import Uncertainty

pytestmark = pytest.mark.usefixtures("plain_pictures")

RIG = str(example_rig_path())


@pytest.fixture
def small(monkeypatch):
    """A design of few candidates, frequencies and contact sets."""
    monkeypatch.setitem(search.CANDIDATES, True, 12)
    monkeypatch.setattr(search, "SEARCH_FINGERS", 6)
    monkeypatch.setattr(search, "SEARCH_FREQUENCIES", 3)
    monkeypatch.setattr(search, "FINEST_STEP", 0.02)
    monkeypatch.setattr(run, "JUDGED_SETS", 3)


def design(*arguments: str):
    """Run `era design` in this process."""
    return CliRunner().invoke(app, ["design", RIG, "--workers", "1", *arguments])


def test_design_writes_a_rig_that_loads_and_resumes(small, tmp_path: Path) -> None:
    """Five ERAs, one kept: channels are distinct, pictures there, a second run takes over."""
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
        "rig.yaml", "contrast.png", "count.png",
    }  # fmt: skip
    weight = sum(era["static_load_n"] for era in found["eras"].values())
    assert weight == pytest.approx(9.81 * rig.plate.mass)
    assert list(found["by_count_db"]) == ["3", "4", "5", "6"]
    assert found["resumed"] == 0
    again = design(*arguments[:-1]).stdout
    assert "1 starts kept" in again
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


@pytest.mark.long
def test_a_design_for_better_drives_says_so_in_its_rig(small, tmp_path: Path) -> None:
    """Drives good to 1 %, all else as in the rig's file; more contrast than without."""
    arguments = ("--eras", "4", "--starts", "1", "--json", "-o")
    usual = design(*arguments, str(tmp_path / "usual"))
    known = "gain=0.01, phase_deg=1, thickness=0.1 %, damping=1.05, fingertip=0.1"
    better = design(*arguments, str(tmp_path / "better"), "--uncertainty", known)
    assert better.exit_code == 0, better.output
    rig = load_rig(tmp_path / "better" / "rig.yaml")
    assert rig.uncertainty == Uncertainty(0.01, 1.0, 0.001, 0.1, 1.05, 0.1)
    means = [json.loads(each.stdout)["contrast_db"]["mean"] for each in (usual, better)]
    assert means[1] > means[0] + 3


@pytest.mark.long
def test_eras_that_buy_too_little_are_left_out(small, tmp_path: Path) -> None:
    """Of at most four, where no ERA beyond those that support the plate buys 40 dB."""
    result = design("--eras", "4", "--worth", "40", "--starts", "1", "-o", str(tmp_path), "--json")
    assert result.exit_code == 0, result.output
    assert len(json.loads(result.stdout)["eras"]) == 3


@pytest.mark.long
def test_a_cluster_finds_what_processes_find(tmp_path: Path) -> None:
    """Three ERAs from two starts on a Dask worker of its own, at the same places."""
    import dask  # takes a second
    from distributed import LocalCluster

    arguments = ["design", RIG, "--eras", "3", "--starts", "2", "--json"]
    here = CliRunner().invoke(app, [*arguments, "-o", str(tmp_path / "here")])
    with (
        dask.config.set({"distributed.worker.multiprocessing-method": "forkserver"}),
        LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=":0") as running,
    ):
        address = running.scheduler_address
        there = CliRunner().invoke(
            app, [*arguments, "-o", str(tmp_path / "there"), "--cluster", address]
        )
    assert json.loads(there.stdout)["eras"] == json.loads(here.stdout)["eras"]


def test_a_plate_that_sags_is_no_design(small, tmp_path: Path) -> None:
    """No layout has its lowest rigid-body frequency above a bound out of reach."""
    result = design("--eras", "4", "--lowest", "5000", "--starts", "1", "-o", str(tmp_path))
    assert isinstance(result.exception, InputError)
