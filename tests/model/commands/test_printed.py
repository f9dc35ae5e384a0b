"""What commands print and write that succeed, by the cases of `printed.yaml`."""

import io
import json
import re
import shlex
import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from controller.cli.main import run
from model.rig.rig_file import example_rig_path
from model.table.table_file import save_table
from plates import small_table, smooth_table
from yaml_files import read_yaml

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
        assert run(shlex.split(line)[1:]) == case.get("status", 0)
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
