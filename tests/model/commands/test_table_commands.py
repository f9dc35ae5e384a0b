"""Commands on tables, designs, figures, plates and configuration files, as typed by a user.

What they write and print: files and pictures, progress and next lines; what others print that
succeed, by the cases of `printed.yaml`.
"""

import io
import json
import os
import re
import shlex
import shutil
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from click.testing import Result
from typer.testing import CliRunner

import era_haptics as api
from cases import read_yaml
from controller.cli.config_cli import app as config_commands
from era_haptics.command import run_era
from era_haptics.lab.cli import app as lab_app
from era_haptics.lab.design import design_run, layout_search, problem
from kit.plates import small_table, smooth_table, write_rig
from model.cli import app
from model.commands.options import next_line
from model.compiled.kernels import WITHOUT_KERNELS
from model.config.document import read_document
from model.errors import InputError
from model.rig.rig_file import example_rig_path, load_rig
from model.study import overview
from model.table.table_file import save_table
from model.vibration import study_convergence

RIG = str(example_rig_path())
QUICK = ["--mesh", "12x9", "--frequencies", "60,110,250", "--grid", "4x3"]


def era(*arguments: str | Path) -> Result:
    """Run `era`; what it raises is raised here."""
    result = CliRunner().invoke(app, [*map(str, arguments)])
    if isinstance(result.exception, Exception):
        raise result.exception
    return result


def as_json(*arguments: str | Path) -> dict[str, Any]:
    """The one object that it prints."""
    answer: dict[str, Any] = json.loads(era(*arguments, "--json").stdout)
    return answer


@pytest.fixture(autouse=True, scope="module")
def few_sets() -> Iterator[None]:
    """Distributions of few contact sets."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(overview, "CONTACT_SETS", 12)
        yield


@pytest.mark.usefixtures("plain_pictures")
def test_show_prints_summary_map_and_a_query_that_has_an_answer(tmp_path: Path) -> None:
    """The map is 4 by 3, each star of it is in the list, and the next command is quoted."""
    spaced = tmp_path / "my table.npz"
    era("table", "build", RIG, "-o", spaced, *QUICK)
    lines = era("table", "show", spaced, "--weak").stdout.splitlines()
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
    program, group, *words = shlex.split(lines[-1])[1:]
    assert (program, group, words[1]) == ("era", "table", str(spaced))
    assert as_json("table", *words)["promised_worst_db"] > 0


@pytest.mark.usefixtures("plain_pictures")
def test_commands_say_that_there_are_no_kernels(
    without_kernels: Callable[[], None], tmp_path: Path
) -> None:
    """`era table build` and `era config check`, with how much longer answers take."""
    without_kernels()
    built = era("table", "build", RIG, "-o", tmp_path / "t.npz", *QUICK)
    checked = CliRunner().invoke(config_commands, ["config", "check", RIG, "--json"])
    assert (built.exit_code, checked.exit_code) == (0, 0)
    assert WITHOUT_KERNELS in built.stderr
    (warning,) = json.loads(checked.stdout)["warnings"]
    assert warning.startswith(WITHOUT_KERNELS)


@pytest.fixture
def small(monkeypatch):
    """A design of few candidates, frequencies and contact sets."""
    monkeypatch.setitem(problem.CANDIDATES, True, 12)
    monkeypatch.setattr(problem, "SEARCH_FINGERS", 6)
    monkeypatch.setattr(problem, "SEARCH_FREQUENCIES", 3)
    monkeypatch.setattr(layout_search, "FINEST_STEP", 0.02)
    monkeypatch.setattr(problem, "JUDGED_SETS", 3)


def design(*arguments: str | Path) -> dict[str, Any]:
    """What `era design --json` prints, by its keys; `stderr` beside it."""
    typed = ["design", RIG, "--workers", "1", "--json", *map(str, arguments)]
    result = CliRunner().invoke(lab_app, typed)
    assert result.exit_code == 0, result.output
    return {**json.loads(result.stdout), "stderr": result.stderr}


@pytest.mark.usefixtures("plain_pictures")
@pytest.mark.long
def test_design_writes_a_rig_that_loads(small, tmp_path: Path) -> None:
    """Five ERAs, one kept: channels are distinct, pictures there, and what is printed."""
    arguments = ("--eras", "5", "--keep", "NE", "--starts", "1", "-o", str(tmp_path))
    found = design(*arguments)
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
    again = CliRunner().invoke(lab_app, ["design", RIG, "--workers", "1", *arguments]).stdout
    assert load_rig(tmp_path / "rig.yaml").eras == rig.eras
    assert f"the rig's own 4 ERAs: mean {found['own_contrast_db']['mean']:.1f} dB" in again


@pytest.mark.usefixtures("plain_pictures")
@pytest.mark.long
def test_the_best_of_several_stiffnesses_is_written(small, tmp_path: Path) -> None:
    """Two are designed; the rig has the one whose layout has more contrast, at new ERAs alone."""
    arguments = ("--eras", "4", "--keep", "NE", "--starts", "1", "-o", tmp_path)
    found = design(*arguments, "--stiffness", "8 kN/m,30 kN/m")
    by_stiffness = found["by_stiffness_db"]
    assert set(by_stiffness) == {"8000", "30000"}
    assert found["contrast_db"]["mean"] == max(by_stiffness.values())
    best, rig = max(by_stiffness, key=by_stiffness.get), load_rig(tmp_path / "rig.yaml")
    assert {era.stiffness for era in rig.eras if era.name != "NE"} == {float(best)}
    assert rig.era("NE").stiffness == load_rig(RIG).era("NE").stiffness


@pytest.mark.usefixtures("plain_pictures")
@pytest.mark.parametrize(("depth", "is_light"), [("4.6 in", True), ("9 in", False)])
def test_design_warns_of_a_plate_that_nearly_tips(small, tmp_path: Path, depth, is_light) -> None:
    """An ERA a tenth of an inch behind the center of mass carries all but 2 % of the weight."""
    layout = f"layouts:\n  tee: [[0, 0], [12 in, 0], [6 in, {depth}]]\n"
    (tmp_path / "layouts.yaml").write_text(layout)
    found = design("--layouts", tmp_path / "layouts.yaml", "-o", tmp_path)
    assert sum(name in found["stderr"] for name in found["eras"]) == 2 * is_light


@pytest.mark.usefixtures("plain_pictures")
def test_interrupted_design_keeps_its_layouts(
    small,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Ctrl-C while the third of its layouts is judged: two are printed with a contrast.

    The file of layouts has all that were found, of three to five ERAs, and finishes the design,
    with the same contrast.
    """
    judged = []

    def interrupted_judge(*arguments: Any, **options: Any) -> Any:
        if len(judged) == 2:
            raise KeyboardInterrupt
        judged.append(judge(*arguments, **options))
        return judged[-1]

    judge = design_run.assess
    typed = ["design", RIG, "--workers", "1", "--eras", "5", "--starts", "1", "-o", str(tmp_path)]
    with monkeypatch.context() as patch:
        patch.setattr(design_run, "assess", interrupted_judge)
        assert run_era([*typed, "--json"]) == 130
    unfinished = json.loads(capsys.readouterr().out)
    assert unfinished["incomplete"] is True
    assert (unfinished["layout_count"], unfinished["judged"]) == (3, 2)
    contrasts = [layout["contrast_db"] for layout in unfinished["layouts"]]
    assert [contrast is None for contrast in contrasts] == [False, False, True]
    assert unfinished["files"] == [str(tmp_path / "unfinished.yaml")]
    assert [path.name for path in tmp_path.iterdir()] == ["unfinished.yaml"]
    finished = design("--layouts", tmp_path / "unfinished.yaml", "-o", tmp_path)
    by_name = {layout["layout"][3:]: layout for layout in finished["layouts"]}
    for layout in unfinished["layouts"]:
        again = by_name[layout["layout"]]
        assert list(again["at_m"].values()) == list(layout["at_m"].values())
        assert layout["contrast_db"] in (None, again["contrast_db"])


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


@pytest.mark.usefixtures("plain_pictures")
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
        era("table", "build", of, "-o", table, "--mode", "phased")
        lines = era("table", "query", table, "--batch", tmp_path / "own.jsonl", "--json").stdout
        promised[name] = [json.loads(each)["promised_worst_db"] for each in lines.splitlines()]
    means = {name: sum(each) / 2 for name, each in promised.items()}
    found = design(
        *("--layouts", tmp_path / "layouts.yaml", "--contents", "2"),
        *("--contacts", tmp_path / "contacts.yaml", "-o", tmp_path / "out"),
    )
    ranked = {each["layout"]: each["contrast_db"] for each in found["layouts"]}
    assert list(ranked) == sorted(means, key=means.get, reverse=True)
    for name, (without, with_quiet) in promised.items():
        expected = {"median_0_quiet": without, "median_1_quiet": with_quiet, "mean": means[name]}
        assert ranked[name] == pytest.approx(expected, abs=0.01)
    assert found["contents"] == 2


ONE_SIDE = "layouts: {side: [[0, 0], [0, 10 cm], [5 cm, 0]]}\n"


@pytest.mark.usefixtures("plain_pictures")
@pytest.mark.parametrize(
    ("options", "given"),
    [
        *((f"--contents {count} --contacts given.yaml", TWO_CONTENTS) for count in (0, 3, 7)),
        ("--layouts given.yaml", ONE_SIDE),
        ("--eras 4 --lowest 5000 --starts 1", ""),
    ],
    ids=["no content", "more than the sets have", "more than plates keep apart", "tips", "sags"],
)
def test_designs_that_cannot_be_are_refused(
    small, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: str, given: str
) -> None:
    """Other contents than those of the sets, ERAs at one side alone, a bound out of reach."""
    monkeypatch.chdir(tmp_path)
    Path("given.yaml").write_text(given)
    typed = ["design", RIG, "--workers", "1", *options.split(), "-o", "out"]
    result = CliRunner().invoke(lab_app, typed)
    assert result.exit_code == 2 or isinstance(result.exception, InputError)


@pytest.mark.usefixtures("plain_pictures")
def test_design_of_python_is_that_of_the_command(small, tmp_path: Path) -> None:
    """The best of ten layouts and two stiffnesses with a kept ERA, saved; what is done is all."""
    names = ("--layouts", "random:10", "--finalists", "1", "--keep", "NE")
    design(*names, "--stiffness", "8 kN/m,30 kN/m", "-o", tmp_path)
    steps: list[tuple[int, int]] = []
    found = api.design(
        load_rig(RIG), layouts="random:10", finalists=1, keep=["NE"], stiffness=[8e3, 30e3],
        progress=lambda *done: steps.append(done),
    )  # fmt: skip
    api.save_rig(found.best.rig, tmp_path / "best.yaml")
    assert load_rig(tmp_path / "best.yaml") == load_rig(tmp_path / "rig.yaml")
    assert steps[-1][0] == steps[-1][1] > 0


@pytest.mark.usefixtures("plain_pictures")
def test_map_has_its_maximum_and_is_in_proportion_to_the_level():
    """A raster row per y, its maximum named; half the level is half."""
    result, half = (
        as_json(
            *("plate", "map", RIG, "--mesh", "24x18", "--points", "13x10"),
            *("--drive", f"SW=110@{level}", "--drive", f"NE=110@{level / 2}:90"),
        )
        for level in (1, 0.5)
    )
    peak = np.array(result["peak_acceleration_m_s2"])
    assert peak.shape == (10, 13)
    x, y = result["max_at_m"]
    at = result["y_m"].index(y), result["x_m"].index(x)
    assert result["max_m_s2"] == peak.max() == peak[at]
    np.testing.assert_allclose(half["peak_acceleration_m_s2"], peak / 2, rtol=1e-12)


@pytest.mark.usefixtures("plain_pictures")
@pytest.mark.long
def test_map_states_levels_above_the_threshold_of_the_frequency() -> None:
    """By hand, of 0.249 m/s² at 100 Hz on the page about people; unknown below 10 Hz."""
    drawn = as_json("plate", "map", RIG, "--drive", "SW=100", "--points", "31x23")
    levels = 20 * np.log10(np.array(drawn["peak_acceleration_m_s2"]) / 0.249)
    assert drawn["median_level_db_sl"] == pytest.approx(np.median(levels), abs=0.02)
    assert drawn["level_on_99_percent_db_sl"] == pytest.approx(np.percentile(levels, 1), abs=0.02)
    assert as_json("plate", "map", RIG, "--drive", "SW=9")["median_level_db_sl"] is None


def test_convergence_lists_errors_of_finer_and_finer_meshes(monkeypatch, tmp_path):
    """Errors fall from mesh to mesh, and the rig's own is marked; text and JSON agree."""
    studied = []

    def study_once(*args, **keywords):
        studied.append(studied[0] if studied else study_convergence(*args, **keywords))
        return studied[0]

    monkeypatch.setattr("model.vibration.study_convergence", study_once)
    monkeypatch.setattr("model.vibration.MESH_DOUBLINGS", 1)
    rig = write_rig(tmp_path / "rig.yaml", ("[40 Hz, 500 Hz]", "[40 Hz, 125 Hz]"))
    arguments = ("convergence", rig, "--mesh", "6x5", "--frequencies", "110")
    found = as_json("plate", *arguments)
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
    text = era("plate", *arguments).stdout
    assert all(f"{error:.3f} %" in text for error in [*errors, *estimates[-2]])


@pytest.mark.usefixtures("plain_pictures")
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


def test_next_line_has_the_path_of_era_when_era_is_not_on_the_path(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Typed as `.venv/bin/era` in a shell without the environment, the next command works, too."""
    monkeypatch.setattr(sys, "argv", [".venv/bin/era", "demo"])
    monkeypatch.setenv("PATH", "")
    assert next_line("era", "status") == "Next: .venv/bin/era status"


CASES: list[dict[str, Any]] = read_yaml(Path(__file__).with_name("printed.yaml"))


@pytest.fixture(scope="module")
def tables(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the tables."""
    folder, small = tmp_path_factory.mktemp("tables"), small_table()
    save_table(small, folder / "table.npz")
    save_table(replace(small, omega=1.1 * small.omega), folder / "false.npz")
    save_table(smooth_table(), folder / "smooth.npz")
    return folder


def agrees(found: Any, expected: Any) -> bool:
    """Whether a value is the expected one, or as it must be."""
    match expected:
        case {"within": [least, most]}:
            return bool(least <= found <= most)
        case {"has": count}:
            return len(found) == count
        case {"says": text}:
            return text in found
        case int() | float():
            return bool(found == pytest.approx(expected, rel=1e-4))
        case [*each]:
            return len(found) == len(each) and all(map(agrees, found, each))
    return bool(found == expected)


def at_path(printed: Any, path: str) -> Any:
    """The value at a path of keys and numbers."""
    for key in path.split("."):
        printed = printed[int(key)] if isinstance(printed, list) else printed[key]
    return printed


@pytest.fixture
def folder(tables: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, with a rig and tables."""
    shutil.copy(example_rig_path(), tmp_path / "rig.yaml")
    shutil.copytree(tables, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.usefixtures("plain_pictures")
@pytest.mark.parametrize("case", [pytest.param(case, id=case["printed"]) for case in CASES])
def test_a_command_prints_and_writes_what_its_case_says(
    case: Mapping[str, Any],
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """As a person reads it and, with `--json`, as a program does; no other file is left."""
    rig = folder / "rig.yaml"
    for old, new in case.get("edit", {}).items():
        assert old in rig.read_text("utf-8")
        rig.write_text(rig.read_text("utf-8").replace(old, new, 1), "utf-8")
    for name, text in case.get("files", {}).items():
        (folder / name).write_text(text, "utf-8")
    before = {*folder.rglob("*")}

    def printed(line: str) -> tuple[str, str]:
        monkeypatch.setattr("sys.stdin", io.StringIO(case.get("input", "")))
        assert run_era(shlex.split(line)[1:]) == case.get("status", 0)
        return tuple(capsys.readouterr())

    *first, last = [case["typed"]] if isinstance(case["typed"], str) else case["typed"]
    for line in first:
        printed(line)
    out, err = printed(last)
    for text, patterns in ((out, case.get("prints", ())), (err, case.get("warns", ()))):
        for pattern in patterns:
            assert re.search(pattern, text, re.MULTILINE), text
    assert not (case.get("silent") and err)
    made = {path for path in {*folder.rglob("*")} - before if path.is_file()}
    for name, pattern in case.get("wrote", {}).items():
        assert re.search(pattern.encode(), (folder / name).read_bytes(), re.MULTILINE), name
    if "wrote" in case:
        assert made == {folder / name for name in case["wrote"]}
    if "json" in case:
        lines = [json.loads(line) for line in printed(f"{last} --json")[0].splitlines()]
        for path, expected in case["json"].items():
            found = at_path(lines if path[0].isdigit() else lines[0], path)
            assert agrees(found, expected), (path, found)
