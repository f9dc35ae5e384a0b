import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from model.commands.config_cli import config_app
from model.errors import InputError
from model.rig.file import example_rig_path, load_rig

RUNNER = CliRunner()


def test_init_writes_a_rig_that_is_good(tmp_path: Path) -> None:
    """The new rig is the example's, names its schema, and the next step is told."""
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


def test_check_of_a_good_rig_is_a_yes() -> None:
    """Exit status 0 and the rig in a line; as JSON, ok without errors."""
    path = str(example_rig_path())
    result = RUNNER.invoke(config_app, ["check", path])
    assert result.exit_code == 0
    assert "304.8 x 228.6 x 1.5 mm of aluminium" in result.stdout
    result = RUNNER.invoke(config_app, ["check", path, "--json"])
    assert result.exit_code == 0
    assert json.loads(result.stdout) == {"ok": True, "errors": [], "warnings": []}


def test_check_of_a_bad_rig_is_a_no(tmp_path: Path) -> None:
    """Exit status 1 and every error on standard output; as JSON, each with line and key."""
    path = tmp_path / "rig.yaml"
    text = example_rig_path().read_text(encoding="utf-8")
    path.write_text(text.replace("1.5 mm", "1.5 kg").replace("level: 1.0", "level: 2"))
    result = RUNNER.invoke(config_app, ["check", str(path)])
    assert result.exit_code == 1
    assert result.stdout.splitlines()[0] == f"{path} has 2 errors:"
    result = RUNNER.invoke(config_app, ["check", "--json", str(path)])
    assert result.exit_code == 1
    answer = json.loads(result.stdout)
    assert answer["ok"] is False
    assert answer["warnings"] == []
    assert [error["key"] for error in answer["errors"]] == ["plate.thickness", "limits.level"]
    lines = text.splitlines()
    assert "thickness" in lines[answer["errors"][0]["line"] - 1]
    assert "level" in lines[answer["errors"][1]["line"] - 1]


def test_check_names_urls_that_no_wire_knows_beside_all_else(tmp_path: Path) -> None:
    """At their line and key, with what is known; and two links are a warning, not an error."""
    path = tmp_path / "rig.yaml"
    text = example_rig_path().read_text(encoding="utf-8")
    path.write_text(
        text.replace('"sim://"', '"seriel:///dev/ttyS0"').replace("level: 1.0", "level: 2")
    )
    result = RUNNER.invoke(config_app, ["check", str(path), "--json"])
    assert result.exit_code == 1
    url, level = json.loads(result.stdout)["errors"]
    assert (url["key"], level["key"]) == ("amplifiers.main.url", "limits.level")
    assert "seriel" in path.read_text().splitlines()[url["line"] - 1]
    assert "did you mean serial://?" in url["message"]
    both = text.replace(
        'main: {url: "sim://"}',
        "main: {url: 'serial:///dev/ttyS0'}\n  two: {url: 'can+virtual://v#1'}",
    ).replace("amplifier: main, channel: 3", "amplifier: two, channel: 0")
    path.write_text(both)
    result = RUNNER.invoke(config_app, ["check", str(path)])
    assert result.exit_code == 0
    assert "\nwarning: " in result.stdout


def test_check_of_no_file_is_a_no(tmp_path: Path) -> None:
    """A missing file is an answer like any other, so that scripts have one case."""
    result = RUNNER.invoke(config_app, ["check", "--json", str(tmp_path / "none.yaml")])
    assert result.exit_code == 1
    (error,) = json.loads(result.stdout)["errors"]
    assert error["line"] is None
    assert "no such file" in error["message"]
