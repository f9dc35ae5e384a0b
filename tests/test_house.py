"""Rules for the tree: no circular imports between programs, no foreign sentences.

Import contracts exclude circles within the packages. These tests check the folders of programs, the
table of tests to run after a change, and files that users copy.
"""

import ast
import re
from graphlib import TopologicalSorter
from pathlib import Path
from typing import Any

import pytest

from changed_tests import ALSO, also
from checks import english

ROOT = Path(__file__).parents[1]
FOLDERS = ("tests", "docs", "examples", "firmware")


def imported(file: Path) -> set[str]:
    """Names of modules without a package that a file imports, anywhere in it."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
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


FOREIGN = {
    "README.md": "# Plate\n\nCode such as `what is` is free.\n\nIt plays what\nis asked.\n",
    "docs/how-to/page.md": "```\nat once\n```\n\n| key | all that plays |\n",
    "examples/rig.yaml": "plate: 1\nmass: 2  # nine of ten\n",
    "model/module.py": '''"""Answers of it."""

WEIGHT = 1  # kg; beside the plate


@app.command()
def stop() -> None:
    """Stop at once."""
    raise InputError(
        f"the plate {name} deviates "
        "anew"
    )


_logger.warning("as of %s", "what", "is")
''',
}


def test_foreign_sentences_are_found_at_their_lines(tmp_path: Path) -> None:
    """In pages, YAML comments, docstrings, comments, help, errors and the log, but not in code."""
    for name, text in FOREIGN.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text, "utf-8")
    prose = english.read(tmp_path, allowed=["asked"])
    findings_of_files = {
        name: [(finding.line, finding.pattern) for finding in part.findings]
        for name, part in prose.items()
        if part.findings
    }
    assert findings_of_files == {
        "README.md": [(5, "clause for a noun")],
        "docs/how-to/page.md": [(5, "pronoun for a noun")],
        "examples/rig.yaml": [(2, "nine of ten")],
        "model: docs": [(1, "of it"), (3, "beside")],
        "model: texts": [(8, "at once"), (10, "deviate"), (11, "archaic"), (15, "as of")],
    }
    settings: dict[str, Any] = {"budgets": {"default": 2.0, "docs": 6.0}, "exceptions": {}}
    reported = "\n".join(english.over_budget(prose, settings))
    assert "model/module.py:8: at once: 'Stop at once'; write immediately" in reported
    settings["exceptions"] = {name: {"budget": 2000.0} for name in prose}
    assert not [*english.over_budget(prose, settings)]
