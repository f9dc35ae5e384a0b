"""What keeps the house in order: imports of programs, names, retired words, tests of a change.

Import contracts exclude circles within the packages; here the folders beside them are checked. What
a machine lacks skips the tests that use it, by name, and fails them in CI.
"""

import ast
import re
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

from changed_tests import ALSO, also
from checks import vocabulary
from checks.vocabulary import retired_identifiers

ROOT = Path(__file__).parents[1]
FOLDERS = ("tests", "docs", "examples", "firmware")


def imported(file: Path) -> set[str]:
    """Names of modules without a package that a file imports, anywhere in it."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {each.name for each in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module)
    return names


@pytest.mark.long
def test_no_circle_of_programs() -> None:
    """Modules of one name in several folders count as one: none of them is in a circle either."""
    graph: dict[str, set[str]] = {}
    for folder in FOLDERS:
        for file in (ROOT / folder).rglob("*.py"):
            graph.setdefault(file.stem, set()).update(imported(file) - {file.stem})
    assert len([*TopologicalSorter(graph).static_order()]) >= len(graph)


def test_rows_name_what_there_is() -> None:
    """Files or folders, and targets of the Makefile."""
    targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text("utf-8"), re.MULTILINE)
    for paths, commands in ALSO:
        assert [path for path in paths if not (ROOT / path).exists()] == []
        named = [command.split()[1] for command in commands if command.startswith("make ")]
        assert set(named) <= set(targets)
    assert also(["drivers/wires/can_frames.py"]) == ["make pages", "make fuzz"]


def test_what_users_copy_keeps_the_rule(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An example, and a program on a page at its line there; text beside programs is free."""
    files = {
        "examples/one.py": "begin = 1\n",
        "README.md": "begin = 0\n\n```python\nstart = 1\nbegin = start\n```\n",
        "docs/how-to/two.md": "```python\nstart = 1\n```\n```\nbegin = 1\n```\n",
    }
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text, "utf-8")
    monkeypatch.setattr(vocabulary, "ROOT", tmp_path)
    found = [each.partition(", use")[0] for each in retired_identifiers()]
    assert found == ["examples/one.py:1: begin", "README.md:5: begin"]
