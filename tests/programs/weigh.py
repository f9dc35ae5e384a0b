"""Print the weight and density of the tree: `make weigh`, `make weigh WEIGH=FOLDER`.

Weight is counted in thousands of syntax-tree nodes (docstrings excluded), so that nesting does not
hide work. Density shows how much one line asks of its reader:

- expr: expression nodes per statement (constants excluded)
- comp: comprehensions and conditional expressions per 1000 statements
- pron: percentage of bound names that are pronouns or participles instead of nouns
- words: words of Markdown, excluding generated blocks and tables

Nothing here fails a build. A reviewer compares the figures before and after a change.
"""

import ast
import re
import subprocess
import sys
from collections import Counter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))
from packages import PACKAGES

ROOT = Path(__file__).resolve().parents[2]
PYTHON = (*PACKAGES, "tests", "benchmarks", "examples")
_PRONOUNS = """
    each one ones found other others own several every all_ known made given shown seen left then
    before after said told asked tried kept taken such these those what which whose who rest here
    there nothing anything something everything least most less more much some any_ both
"""
PRONOUNS = frozenset(_PRONOUNS.split())
COMPREHENSIONS = (ast.ListComp, ast.SetComp, ast.DictComp, ast.GeneratorExp, ast.IfExp)
_GENERATED = re.compile(r"<!-- begin: .*?<!-- end -->", re.DOTALL)


def _is_docstring(node: ast.AST) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)


def python_weight(source: str) -> Counter[str]:
    """Count the nodes, statements, expressions and names of one module."""
    tree = ast.parse(source)
    docstrings = {
        id(part) for node in ast.walk(tree) if _is_docstring(node) for part in ast.walk(node)
    }
    counts = Counter(files=1, lines=source.count("\n"))
    for node in ast.walk(tree):
        if id(node) in docstrings or isinstance(node, ast.expr_context):
            continue
        counts["nodes"] += 1
        counts["statements"] += isinstance(node, ast.stmt)
        counts["expressions"] += isinstance(node, ast.expr) and not isinstance(node, ast.Constant)
        counts["comprehensions"] += isinstance(node, COMPREHENSIONS)
        name = _bound_name(node)
        if name is not None:
            counts["names"] += 1
            counts["pronouns"] += name.strip("_") in PRONOUNS
    return counts


def _bound_name(node: ast.AST) -> str | None:
    """Return the name that a node binds: an assignment target or a parameter."""
    if isinstance(node, ast.arg):
        return node.arg
    if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
        return node.id
    return None


def prose_weight(text: str) -> Counter[str]:
    """Count the words of one page."""
    lines = _GENERATED.sub("", text).splitlines()
    authored = [line for line in lines if not line.startswith("|")]
    return Counter(files=1, lines=len(lines), words=len(" ".join(authored).split()))


def weights(root: Path) -> dict[str, Counter[str]]:
    """Return the counts of each folder with Python, its subfolders, and of all pages (`prose`)."""
    listing = subprocess.run(
        ["git", "-C", str(root), "ls-files"], check=True, capture_output=True, text=True
    ).stdout
    totals: dict[str, Counter[str]] = {}
    for name in listing.splitlines():
        path = root / name
        parts = Path(name).parts
        if not path.is_file():
            continue
        if path.suffix == ".md":
            counts = prose_weight(path.read_text(encoding="utf-8"))
            folders = ["prose"]
        elif path.suffix == ".py" and parts[0] in PYTHON:
            counts = python_weight(path.read_text(encoding="utf-8"))
            folders = ["/".join(parts[:depth]) for depth in (1, 2) if depth < len(parts)]
            if parts[0] in PACKAGES:
                folders.append("product")
        else:
            continue
        for folder in folders:
            totals.setdefault(folder, Counter()).update(counts)
    return totals


def row(folder: str, counts: Counter[str]) -> str:
    """Return one line of the table."""
    statements = max(counts["statements"], 1)
    return (
        f"{folder:26}{counts['files']:6}{counts['lines']:8}{counts['statements']:12}"
        f"{counts['nodes'] / 1000:8.1f}{counts['expressions'] / statements:6.2f}"
        f"{1000 * counts['comprehensions'] / statements:6.0f}"
        f"{100 * counts['pronouns'] / max(counts['names'], 1):6.1f}{counts['words']:8}"
    )


def main() -> int:
    """Print the table, or the rows of one folder; return 2 for a folder without any."""
    prefix = sys.argv[1] if len(sys.argv) > 1 else None
    totals = sorted(weights(ROOT).items())
    rows = [(folder, counts) for folder, counts in totals if _is_shown(folder, prefix)]
    if not rows:
        sys.stderr.write(f"folder must be one with Python of the first two levels, got {prefix}\n")
        return 2
    header = f"{'folder':26}{'files':>6}{'lines':>8}{'statements':>12}{'knodes':>8}"
    sys.stdout.write(f"{header}{'expr':>6}{'comp':>6}{'pron':>6}{'words':>8}\n")
    for folder, counts in rows:
        sys.stdout.write(f"{row(folder, counts)}\n")
    return 0


def _is_shown(folder: str, prefix: str | None) -> bool:
    if prefix is None:
        return "/" not in folder
    return f"{folder}/".startswith(f"{prefix.rstrip('/')}/")


if __name__ == "__main__":
    sys.exit(main())
