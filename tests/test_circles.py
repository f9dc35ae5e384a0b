"""No circle of files outside the packages, whose own circles an import contract excludes."""

import ast
from graphlib import TopologicalSorter
from pathlib import Path

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


def test_no_circle_of_programs() -> None:
    """Modules of one name in several folders count as one: none of them is in a circle either."""
    graph: dict[str, set[str]] = {}
    for folder in FOLDERS:
        for file in (ROOT / folder).rglob("*.py"):
            graph.setdefault(file.stem, set()).update(imported(file) - {file.stem})
    assert len([*TopologicalSorter(graph).static_order()]) >= len(graph)
