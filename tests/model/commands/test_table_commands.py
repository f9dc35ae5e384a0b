"""`era table` as a user types it."""

import json
import re
import shlex
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from click.testing import Result
from typer.testing import CliRunner

from model.cli import app
from model.compiled.kernels import WITHOUT_KERNELS
from model.errors import InputError
from model.rig.rig_file import example_rig_path
from model.study import overview
from model.table.table_file import load_table, save_table

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
