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
    """Five ERAs, one kept: channels are distinct, pictures there, and a second run takes over."""
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
    again = json.loads(design(*arguments).stdout)
    assert again["resumed"] == 1
    assert again["eras"] == found["eras"]


@pytest.mark.parametrize(
    "arguments",
    [
        ("--keep", "XX"),
        ("--keep", "NE,NE"),
        ("--where", "nowhere.png"),
        ("--contacts", "nowhere.yaml"),
        ("--apart", "2 kg"),
        ("--apart", "5 m"),
        ("--eras", "2"),
        ("--lowest", "5000", "--starts", "1"),
    ],
)
def test_design_refuses_what_makes_no_design(small, tmp_path: Path, arguments) -> None:
    """One error each, of ERAs, files, distances and support."""
    result = design("--eras", "4", "-o", str(tmp_path), *arguments)
    assert isinstance(result.exception, InputError)
