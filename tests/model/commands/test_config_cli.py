"""`era config` as a user types it."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from model.commands.config_cli import config_app
from model.errors import InputError
from model.rig.file import example_rig_path, load_rig

RUNNER = CliRunner()
EXAMPLE = example_rig_path().read_text(encoding="utf-8")


def test_init_writes_a_rig_and_its_schema(tmp_path: Path) -> None:
    """The new rig is the example's and names its schema."""
    path = tmp_path / "mine.yaml"
    result = RUNNER.invoke(config_app, ["init", str(path)])
    assert result.exit_code == 0
    assert load_rig(path).fingerprint == load_rig(example_rig_path()).fingerprint
    first = path.read_text(encoding="utf-8").splitlines()[0]
    assert first == "# yaml-language-server: $schema=mine.schema.json"
    schema = json.loads((tmp_path / "mine.schema.json").read_text(encoding="utf-8"))
    assert "eras" in schema["required"]
    assert result.stdout.splitlines()[-1] == f"Next: era config check {path}"


@pytest.mark.parametrize("name", ["kept.yaml", "rig.txt", "no/rig.yaml"])
def test_init_refuses_names_that_it_cannot_write(tmp_path: Path, name: str) -> None:
    """A file that exists is left as it was; another ending or a missing folder is refused."""
    (tmp_path / "kept.yaml").write_text("mine", encoding="utf-8")
    result = RUNNER.invoke(config_app, ["init", str(tmp_path / name)])
    assert isinstance(result.exception, InputError)
    assert name in str(result.exception)
    assert (tmp_path / "kept.yaml").read_text(encoding="utf-8") == "mine"
    assert [path.name for path in tmp_path.iterdir()] == ["kept.yaml"]


def check(path: Path, text: str | None = None) -> tuple[int, list[dict[str, str]], list[str]]:
    """Check a file; returns exit status, errors and warnings of the JSON."""
    if text is not None:
        path.write_text(text, encoding="utf-8")
    result = RUNNER.invoke(config_app, ["check", "--json", str(path)])
    answer = json.loads(result.stdout)
    assert answer["ok"] is (result.exit_code == 0)
    plain = RUNNER.invoke(config_app, ["check", str(path)])
    assert plain.exit_code == result.exit_code
    for named in [*answer["warnings"], *(error["key"] or "" for error in answer["errors"])]:
        assert named in plain.stdout
    return result.exit_code, answer["errors"], answer["warnings"]


def test_check_passes_a_good_rig_with_warnings(tmp_path: Path) -> None:
    """The example has none; two links have one, and so has a section of uncertainty in part."""
    assert check(example_rig_path()) == (0, [], [])
    links = EXAMPLE.replace(
        'main: {url: "sim://"}',
        "main: {url: 'serial:///dev/ttyS0'}\n  two: {url: 'can+python-can://virtual/v#1'}",
    ).replace("amplifier: main, channel: 3", "amplifier: two, channel: 0")
    status, errors, warnings = check(tmp_path / "rig.yaml", links)
    assert (status, errors, len(warnings)) == (0, [], 1)
    partial = EXAMPLE + "\nuncertainty: {fingertip: 0.5}\n"
    status, errors, (warning,) = check(tmp_path / "rig.yaml", partial)
    assert (status, errors) == (0, [])
    assert "thickness" in warning


def test_check_lists_all_errors_with_line_and_key(tmp_path: Path) -> None:
    """Units, values and URLs; a missing file is an answer like any other, for scripts."""
    path = tmp_path / "rig.yaml"
    bad = EXAMPLE.replace('"sim://"', '"seriel:///dev/ttyS0"').replace("1.5 mm", "1.5 kg")
    status, errors, _ = check(path, bad.replace("level: 1.0", "level: 2"))
    assert status == 1
    lines = path.read_text().splitlines()
    found = {error["key"]: lines[int(error["line"]) - 1] for error in errors}
    assert found.keys() == {"plate.thickness", "amplifiers.main.url", "limits.level"}
    assert all(key.split(".")[-1] in line for key, line in found.items())
    assert any("serial://" in error["message"] for error in errors)
    status, (missing,), _ = check(tmp_path / "none.yaml")
    assert (status, missing["line"]) == (1, None)
