"""The reference of commands against the commands."""

import json
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from typer.core import TyperCommand, TyperGroup
from typer.testing import CliRunner

from controller.cli.main import load_commands
from model.cli import app
from model.study import overview

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "reference" / "commands.md").read_text("utf-8")
RIG = str(ROOT / "examples" / "paper_plate.yaml")
COARSE = ["--frequencies", "100:200:50", "--grid", "4x3", "--mesh", "12x9"]


def commands(group: TyperGroup, name: str = "era") -> Iterator[tuple[str, TyperCommand]]:
    """Every command by its full name."""
    for command in group.commands.values():
        full = f"{name} {command.name}"
        if isinstance(command, TyperGroup):
            yield from commands(command, full)
        else:
            assert isinstance(command, TyperCommand)
            yield full, command
            for flag, variant in getattr(command, "variants", {}).items():
                yield f"{full} {flag}", variant


def test_page_lists_every_command_with_its_options() -> None:
    """The names on the page are those of the program; what it says once, it says above them."""
    parts = re.split(r"^### ", PAGE, flags=re.MULTILINE)[1:]
    listed = {part.splitlines()[0]: part for part in parts}
    known = dict(commands(load_commands()[0]))
    common = set(re.findall(r"^- `(--[a-z-]+)", parts[0], re.MULTILINE))
    assert {name for name in listed if name.startswith("era ")} == set(known)
    for name, command in known.items():
        own = re.findall(r"^- `(?:-\w, )?(--[a-z-]+)", listed[name], re.MULTILINE)
        also = re.findall(
            r"`(--[a-z-]+)", listed[name].lower().partition("also with ")[2].split("\n")[0]
        )
        assert set(also) <= common, name
        named = {*own, *also}
        names = {max(option.opts, key=len) for option in command.params}
        options = {name for name in names if name.startswith("--")}
        assert named == options - {"--help"}, name


def test_every_command_with_json_tells_its_keys() -> None:
    """A command that has the option is in the table of keys."""
    table = PAGE.partition("## What `--json` prints")[2].partition("## All commands")[0]
    listed = " ".join(re.findall(r"^\| (`era .*?) \|", table, re.MULTILINE))
    parts = re.split(r"^### era ", PAGE, flags=re.MULTILINE)[1:]
    with_json = [
        part.splitlines()[0] for part in parts if re.search(r"[Aa]lso with .*`--json`", part)
    ]
    assert len(with_json) > 30
    for name in with_json:
        assert f"`era {name}`" in listed or f"`{name.split()[-1]}`" in listed, name


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a small table."""
    folder = tmp_path_factory.mktemp("built")
    arguments = ["table", "build", RIG, "-o", str(folder / "table.npz"), *COARSE]
    assert CliRunner().invoke(app, arguments).exit_code == 0
    return folder


@pytest.mark.parametrize(
    "arguments",
    [
        ["config", "check", RIG],
        ["plate", "modes", RIG, "--mesh", "12x9"],
        ["plate", "map", RIG, "--mesh", "12x9", "--drive", "SW=110"],
        ["plate", "show", RIG],
        ["plate", "materials"],
        ["plate", "template", RIG, "-o", "template.svg"],
        ["table", "build", RIG, "-o", "another.npz", *COARSE],
        ["table", "show", "table.npz"],
        ["table", "query", "table.npz", "--target", "0.06,0.05", "--quiet", "0.2,0.1"],
        ["table", "export", "table.npz", "--format", "csv", "-o", "table.csv"],
    ],
    ids=lambda arguments: " ".join(arguments[:2]),
)
def test_the_keys_are_those_that_are_printed(
    arguments: list[str], built: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The table names the keys at the top of what `--json` prints, and no others."""
    monkeypatch.chdir(built)
    monkeypatch.setattr(overview, "CONTACT_SETS", 12)
    result = CliRunner().invoke(app, [*arguments, "--json"])
    assert result.exit_code == 0, result.output
    name = " ".join(["era", *arguments[:2]])
    (row,) = re.findall(rf"^\| .*`{name}`.* \| (.*) \|$", PAGE, re.MULTILINE)
    row = re.sub(r"\(.*?\)", "", row)
    keys = set(re.findall(r"`(\w+)`", row))
    for key in [key for key in keys if "_N_" in key]:
        keys = keys - {key} | {key.replace("N", number) for number in "123"}
    assert keys == set(json.loads(result.stdout))
