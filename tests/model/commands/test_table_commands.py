"""Commands on tables, figures, plates and configuration files, as typed by a user.

Most commands that succeed are cases of `printed.yaml`.
"""

import io
import json
import os
import re
import shlex
import shutil
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import Result
from typer.testing import CliRunner

from cases import read_yaml
from controller.cli.config_cli import app as config_commands
from era_haptics.command import run_era
from kit.plates import small_table, smooth_table, write_rig
from model.cli import app
from model.commands.options import next_line
from model.compiled.kernels import WITHOUT_KERNELS
from model.rig.rig_file import example_rig_path
from model.study import overview
from model.table.table_file import save_table
from model.vibration import study_convergence

pytestmark = pytest.mark.usefixtures("plain_pictures")

RIG = str(example_rig_path())
QUICK = ["--mesh", "12x9", "--frequencies", "60,110,250", "--grid", "4x3"]


def era(*arguments: str | Path) -> Result:
    """Run `era`; exceptions are raised here."""
    result = CliRunner().invoke(app, [*map(str, arguments)])
    if isinstance(result.exception, Exception):
        raise result.exception
    return result


def as_json(*arguments: str | Path) -> dict[str, Any]:
    """Return the object that `era` prints."""
    report: dict[str, Any] = json.loads(era(*arguments, "--json").stdout)
    return report


@pytest.fixture(autouse=True, scope="module")
def few_sets() -> Iterator[None]:
    """Distributions of few contact sets."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(overview, "CONTACT_SETS", 12)
        yield


# Tables


@pytest.fixture(scope="module")
def show_lines(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """The lines of `era table show --weak`, for a file with a space in its name."""
    path = tmp_path_factory.mktemp("show_lines") / "my table.npz"
    era("table", "build", RIG, "-o", path, *QUICK)
    return era("table", "show", path, "--weak").stdout.splitlines()


def test_show_prints_a_summary(show_lines: list[str]) -> None:
    """Dead zones, feasible cells, contrast, mesh and fingerprint."""
    rows = {line[:20].strip(): line[20:].strip() for line in show_lines}

    assert rows["dead zones"].startswith("0 %")
    for name in ("feasible cells", "contrast to 3 others", "mesh", "fingerprint"):
        assert rows[name], name


def test_show_prints_a_map(show_lines: list[str]) -> None:
    """The map is 4 by 3, with errors of its values, and each of its stars is in the list."""
    (start,) = [
        number
        for number, line in enumerate(show_lines)
        if line.startswith("promised felt contrast")
    ]
    rows = show_lines[start + 2 : start + 5]

    errors = [float(error) for error in re.findall(r"± ([\d.]+) dB", show_lines[start + 1])]
    assert len(errors) == 2
    assert 0 < min(errors) <= max(errors) < 10
    assert [len(row.split()) for row in rows] == [4, 4, 4]
    stars = "".join(rows).count("*")
    listed = [line for line in show_lines if line.startswith("(0.")]
    assert len(listed) == stars > 0


def test_show_ends_with_a_query_that_has_an_answer(show_lines: list[str]) -> None:
    """Quoted for the shell."""
    _, program, *arguments = shlex.split(show_lines[-1])

    assert program == "era"
    assert Path(arguments[2]).name == "my table.npz"
    assert as_json(*arguments)["promised_worst_db"] > 0


@pytest.mark.usefixtures("assumed_costs")
def test_commands_warn_if_there_are_no_kernels(
    without_kernels: Callable[[], None], tmp_path: Path
) -> None:
    """`era table build` and `era config check`, with how much longer answers take."""
    without_kernels()

    build = era("table", "build", RIG, "-o", tmp_path / "t.npz", *QUICK)
    check = CliRunner().invoke(config_commands, ["config", "check", RIG, "--json"])

    assert build.exit_code == check.exit_code == 0
    assert WITHOUT_KERNELS in build.stderr
    (warning,) = json.loads(check.stdout)["warnings"]
    assert warning.startswith(WITHOUT_KERNELS)


# Plates


@pytest.mark.long
def test_map_states_levels_above_the_threshold_of_the_frequency() -> None:
    """By hand, from 0.249 m/s² at 100 Hz on the page about people; unknown below 10 Hz."""
    report = as_json("plate", "map", RIG, "--drive", "SW=100", "--points", "31x23")
    low = as_json("plate", "map", RIG, "--drive", "SW=9")

    levels = 20 * np.log10(np.array(report["peak_acceleration_m_s2"]) / 0.249)
    assert report["median_level_db_sl"] == pytest.approx(np.median(levels), abs=0.02)
    first_percentile = np.percentile(levels, 1)
    assert report["level_on_99_percent_db_sl"] == pytest.approx(first_percentile, abs=0.02)
    assert low["median_level_db_sl"] is None


def test_convergence_lists_errors_of_finer_meshes(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Errors fall from mesh to mesh, and the rig's own is marked; text and JSON agree."""
    studies = []

    def study_once(*arguments: Any, **options: Any) -> Any:
        if not studies:
            studies.append(study_convergence(*arguments, **options))
        return studies[0]

    monkeypatch.setattr("model.vibration.study_convergence", study_once)
    monkeypatch.setattr("model.vibration.MESH_DOUBLINGS", 1)
    rig = write_rig(tmp_path / "rig.yaml", ("[40 Hz, 500 Hz]", "[40 Hz, 125 Hz]"))
    command = ("plate", "convergence", rig, "--mesh", "6x5", "--frequencies", "110")

    report = as_json(*command)
    text = era(*command).stdout

    assert report["drive_frequencies_hz"] == [110.0]
    meshes = report["meshes"]
    assert meshes[0]["dof"] == 126
    assert [mesh["is_the_rigs"] for mesh in meshes] == [True, False, False, False]
    assert [mesh["element"] for mesh in meshes[2:]] == ["Legendre", "Q5"]
    errors = [mesh["response_error_percent"][0] for mesh in meshes]
    coarse, fine, *accurate = errors
    assert coarse > fine > max(accurate)
    for error in errors:
        assert f"{error:.3f} %" in text


# The next command


@pytest.mark.parametrize(
    ("system", "line"),
    [
        ("posix", "Next: era table show 'my $plates/t.npz' --weak"),
        ("nt", 'Next: era table show "my $plates/t.npz" --weak'),
    ],
)
def test_next_line_is_quoted_for_the_shell(
    monkeypatch: pytest.MonkeyPatch, system: str, line: str
) -> None:
    """A name with a space is a single word to the shells of Unix, and to those of Windows."""
    with monkeypatch.context() as patch:
        patch.setattr(os, "name", system)
        printed = next_line("era", "table", "show", "my $plates/t.npz", "--weak")

    assert printed == line


# Cases

CASES: list[dict[str, Any]] = read_yaml(Path(__file__).with_name("printed.yaml"))


@pytest.fixture(scope="module")
def tables(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the tables."""
    folder = tmp_path_factory.mktemp("tables")
    table = small_table()
    save_table(table, folder / "table.npz")
    save_table(replace(table, omega=1.1 * table.omega), folder / "false.npz")
    save_table(smooth_table(), folder / "smooth.npz")
    return folder


@pytest.fixture
def folder(tables: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working directory, with a rig and tables."""
    shutil.copy(example_rig_path(), tmp_path / "rig.yaml")
    shutil.copytree(tables, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def agrees(value: Any, expected: Any) -> bool:
    """Return whether a value is as a case expects it."""
    match expected:
        case {"within": [low, high]}:
            return bool(low <= value <= high)
        case {"has": count}:
            return len(value) == count
        case {"says": text}:
            return text in value
        case int() | float():
            return bool(value == pytest.approx(expected, rel=1e-4))
        case [*entries]:
            return len(value) == len(entries) and all(map(agrees, value, entries))
    return bool(value == expected)


def at_path(value: Any, path: str) -> Any:
    """Return the value at a path of keys and numbers."""
    for key in path.split("."):
        value = value[int(key)] if isinstance(value, list) else value[key]
    return value


def prepare(folder: Path, case: Mapping[str, Any]) -> None:
    """Edit the rig and write the files of a case."""
    rig = folder / "rig.yaml"
    for old, new in case.get("edit", {}).items():
        text = rig.read_text("utf-8")
        assert old in text
        rig.write_text(text.replace(old, new, 1), "utf-8")
    for name, text in case.get("files", {}).items():
        (folder / name).write_text(text, "utf-8")


def expect_files(folder: Path, new: set[Path], expected: Mapping[str, str]) -> None:
    """Require new files, each with a pattern."""
    assert {str(path.relative_to(folder)) for path in new} == set(expected)
    for name, pattern in expected.items():
        content = (folder / name).read_bytes()
        assert re.search(pattern.encode(), content, re.MULTILINE), name


def files_in(folder: Path) -> set[Path]:
    """Return all files in a folder and its subfolders."""
    return {path for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("case", [pytest.param(case, id=case["printed"]) for case in CASES])
@pytest.mark.usefixtures("assumed_costs")
def test_command_prints_and_writes_the_output_of_its_case(
    case: Mapping[str, Any],
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """As text and, with `--json`, as objects; no other file remains."""
    prepare(folder, case)
    files = files_in(folder)

    def run(line: str) -> tuple[str, str]:
        monkeypatch.setattr("sys.stdin", io.StringIO(case.get("input", "")))
        _, *arguments = shlex.split(line)
        assert run_era(arguments) == case.get("status", 0)
        return tuple(capsys.readouterr())

    typed = case["typed"]
    *preparing, command = [typed] if isinstance(typed, str) else typed
    for line in preparing:
        run(line)

    output, errors = run(command)

    for pattern in case.get("prints", ()):
        assert re.search(pattern, output, re.MULTILINE), output
    for pattern in case.get("warns", ()):
        assert re.search(pattern, errors, re.MULTILINE), errors
    if case.get("silent"):
        assert errors == ""
    if "wrote" in case:
        expect_files(folder, files_in(folder) - files, case["wrote"])
    if "json" in case:
        output, _ = run(f"{command} --json")
        lines = [json.loads(line) for line in output.splitlines()]
        for path, expected in case["json"].items():
            value = at_path(lines if path[0].isdigit() else lines[0], path)
            assert agrees(value, expected), (path, value)
