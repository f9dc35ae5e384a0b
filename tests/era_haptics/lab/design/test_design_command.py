"""The command `era design`: the rigs that it writes, its ranking, and interruptions."""

import json
from pathlib import Path
from typing import Any

import pytest
import yaml
from typer.testing import CliRunner, Result

import era_haptics as era
from era_haptics.command import run_era
from era_haptics.lab.cli import app
from era_haptics.lab.design import design_run, layout_search, problem
from model.answer.answer_report import query_one
from model.config.document import read_document
from model.errors import InputError
from model.rig.rig_file import example_rig_path, load_rig
from model.table.table_file import build_table

pytestmark = pytest.mark.usefixtures("plain_pictures", "small")

RIG_PATH = example_rig_path()
RIG = load_rig(RIG_PATH)


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """A design of few candidates, frequencies and contact sets."""
    monkeypatch.setattr(problem, "EDGE_CANDIDATES", 12)
    monkeypatch.setattr(problem, "SEARCH_FINGERS", 6)
    monkeypatch.setattr(problem, "SEARCH_FREQUENCIES", 3)
    monkeypatch.setattr(layout_search, "FINEST_STEP", 0.02)
    monkeypatch.setattr(problem, "JUDGED_SETS", 3)


def run_design(*arguments: str | Path) -> Result:
    """Run `era design` for the example."""
    typed = ["design", str(RIG_PATH), "--workers", "1", *map(str, arguments)]
    return CliRunner().invoke(app, typed)


def design(*arguments: str | Path) -> dict[str, Any]:
    """Return the object that `era design --json` prints."""
    result = run_design(*arguments, "--json")
    assert result.exit_code == 0, result.output
    report: dict[str, Any] = json.loads(result.stdout)
    return report


@pytest.mark.long
def test_design_writes_a_rig_that_loads(tmp_path: Path) -> None:
    """Five ERAs, one kept, on two amplifiers; pictures and the weight on each ERA."""
    arguments = ("--eras", "5", "--keep", "NE", "--starts", "1", "-o", tmp_path)

    report = design(*arguments)
    text = run_design(*arguments).stdout

    rig = load_rig(tmp_path / "rig.yaml")
    assert [added.name for added in rig.eras] == list(report["eras"])
    kept = rig.era("NE")
    assert (kept.x, kept.y) == (RIG.era("NE").x, RIG.era("NE").y)
    assert rig.wiring["NE"] == RIG.wiring["NE"]
    assert [added.damping for added in rig.eras] == pytest.approx([RIG.eras[0].damping] * 5)
    assert len(set(rig.wiring.values())) == 5
    assert set(read_document(tmp_path / "rig.yaml").data["amplifiers"]) == {"main", "amplifier2"}
    names = {Path(name).name for name in report["files"]}
    assert names == {"rig.yaml", "layouts.csv", "contrast.png", "count.png", "template.svg"}
    loads = [carried["static_load_n"] for carried in report["eras"].values()]
    assert sum(loads) == pytest.approx(9.80665 * rig.plate.mass)
    assert list(report["by_count_db"]) == ["3", "4", "5", "6"]
    mean = report["own_contrast_db"]["mean"]
    assert f"the rig's own 4 ERAs: mean {mean:.1f} dB" in text


@pytest.mark.long
def test_design_writes_the_best_of_several_stiffnesses(tmp_path: Path) -> None:
    """That whose layout has more contrast, at new ERAs alone."""
    options = ("--eras", "4", "--keep", "NE", "--starts", "1", "-o", tmp_path)

    report = design(*options, "--stiffness", "8 kN/m,30 kN/m")

    by_stiffness = report["by_stiffness_db"]
    assert set(by_stiffness) == {"8000", "30000"}
    best = max(by_stiffness, key=by_stiffness.get)
    assert report["contrast_db"]["mean"] == by_stiffness[best]
    rig = load_rig(tmp_path / "rig.yaml")
    stiffness = {spring.name: spring.stiffness for spring in rig.eras}
    assert stiffness.pop("NE") == RIG.era("NE").stiffness
    assert set(stiffness.values()) == {float(best)}


def test_interrupted_design_keeps_its_layouts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Ctrl-C while the third layout is judged: two are printed with a contrast.

    The file has all layouts of the search, of three to five ERAs, and finishes the design with the
    same contrasts.
    """
    assess = design_run.assess
    assessments: list[Any] = []

    def interrupted_assess(*arguments: Any, **options: Any) -> Any:
        if len(assessments) == 2:
            raise KeyboardInterrupt
        assessments.append(assess(*arguments, **options))
        return assessments[-1]

    typed = ["design", str(RIG_PATH), "--workers", "1", "--eras", "5", "--starts", "1"]
    with monkeypatch.context() as patch:
        patch.setattr(design_run, "assess", interrupted_assess)
        assert run_era([*typed, "-o", str(tmp_path), "--json"]) == 130

    unfinished = json.loads(capsys.readouterr().out)
    assert unfinished["incomplete"] is True
    assert unfinished["layout_count"] == 3
    assert unfinished["judged"] == 2
    contrasts = [layout["contrast_db"] for layout in unfinished["layouts"]]
    assert [contrast is None for contrast in contrasts] == [False, False, True]
    (path,) = tmp_path.iterdir()
    assert path.name == "unfinished.yaml"
    assert unfinished["files"] == [str(path)]
    finished = design("--layouts", path, "-o", tmp_path)
    by_name = {layout["layout"][3:]: layout for layout in finished["layouts"]}
    for layout in unfinished["layouts"]:
        judged = by_name[layout["layout"]]
        assert list(judged["at_m"].values()) == list(layout["at_m"].values())
        assert layout["contrast_db"] in (None, judged["contrast_db"])


# Layouts and contents of a file

LAYOUTS = """layouts:
  corners: [[0, 0], [12 in, 0], [12 in, 9 in], [0, 9 in]]
  skew:    [[1 in, 0], [11 in, 0], [9 in, 9 in], [0, 7 in]]
  narrow:  [[4 in, 0], [8 in, 0], [8 in, 9 in], [4 in, 9 in]]
"""
TWO_CONTENTS = """sets:
  - {own: [[3 cm, 3 cm], [26 cm, 18 cm]]}
  - {own: [[5 cm, 18 cm], [20 cm, 4 cm]], quiet: [[14 cm, 11 cm]]}
"""
QUESTIONS = (
    {"own": [{"at": [0.03, 0.03]}, {"at": [0.26, 0.18]}]},
    {"own": [{"at": [0.05, 0.18]}, {"at": [0.2, 0.04]}], "quiet": [[0.14, 0.11]]},
)


def promises_of(positions: list[list[object]]) -> list[float]:
    """Return what the table of a layout promises at the worst finger of each set."""
    data = read_document(RIG_PATH).data
    sections = data["eras"].values()
    eras = {}
    for number, (section, at) in enumerate(zip(sections, positions, strict=True), start=1):
        eras[f"E{number}"] = {**section, "at": at}
    rig = era.rig(data["plate"], eras, amplifiers=data["amplifiers"])
    table = build_table(rig, drive_mode="phased")
    return [query_one(table, question)["promised_worst_db"] for question in QUESTIONS]


def test_layouts_are_ranked_by_the_promise_of_two_contents(tmp_path: Path) -> None:
    """By the promises at the worst finger of tables of all layouts."""
    layouts, contacts = tmp_path / "layouts.yaml", tmp_path / "contacts.yaml"
    layouts.write_text(LAYOUTS)
    contacts.write_text(TWO_CONTENTS)
    files = ("--layouts", layouts, "--contacts", contacts, "-o", tmp_path / "out")

    report = design(*files, "--contents", "2")

    assert report["contents"] == 2
    ranked = {layout["layout"]: layout["contrast_db"] for layout in report["layouts"]}
    means = {}
    for name, positions in yaml.safe_load(LAYOUTS)["layouts"].items():
        without, with_quiet = promises_of(positions)
        means[name] = (without + with_quiet) / 2
        expected = {"median_0_quiet": without, "median_1_quiet": with_quiet, "mean": means[name]}
        assert ranked[name] == pytest.approx(expected, abs=0.01), name
    assert list(ranked) == sorted(means, key=means.get, reverse=True)


REJECTED = {
    "no content": ("--contents 0 --contacts contacts.yaml", TWO_CONTENTS),
    "more than the sets have": ("--contents 3 --contacts contacts.yaml", TWO_CONTENTS),
    "more than plates keep apart": ("--contents 7 --contacts contacts.yaml", TWO_CONTENTS),
    "tips": ("--layouts contacts.yaml", "layouts: {side: [[0, 0], [0, 10 cm], [5 cm, 0]]}\n"),
    "sags": ("--eras 4 --lowest 5000 --starts 1", ""),
}


@pytest.mark.parametrize("name", REJECTED)
def test_impossible_design_is_refused(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Other contents than those of the sets, ERAs at one side alone, a bound out of reach."""
    options, text = REJECTED[name]
    monkeypatch.chdir(tmp_path)
    Path("contacts.yaml").write_text(text)

    result = run_design(*options.split(), "-o", "out")

    assert result.exit_code == 2 or isinstance(result.exception, InputError)


def test_design_from_python_is_that_of_the_command(tmp_path: Path) -> None:
    """The best of ten layouts and two stiffnesses with a kept ERA; all steps are reported."""
    options = ("--layouts", "random:10", "--finalists", "1", "--keep", "NE")
    design(*options, "--stiffness", "8 kN/m,30 kN/m", "-o", tmp_path)
    steps: list[tuple[int, int]] = []

    best = era.design(
        RIG,
        layouts="random:10",
        finalists=1,
        keep=["NE"],
        stiffness=[8e3, 30e3],
        progress=lambda *step: steps.append(step),
    ).best

    era.save_rig(best.rig, tmp_path / "best.yaml")
    assert load_rig(tmp_path / "best.yaml") == load_rig(tmp_path / "rig.yaml")
    done, total = steps[-1]
    assert done == total > 0
