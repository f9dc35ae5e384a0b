"""Weight of every package beside its ceiling in pyproject.toml; `make lint` fails above one.

    python tests/support/checks/ceilings.py [--lower]

Counts statements, not lines: blank lines, comments, docstrings and line breaks are free, so that a
clear layout costs nothing. `--lower` takes ceilings down to what stands, rounded up to 50
statements; up goes one only by hand, with a decision that names what a user gets for it.
"""

import ast
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[3]
STEP = 50
_ROW = re.compile(r'^"(?P<folder>[\w/]+)" = \{ statements = (\d+), files = (\d+) \}$', re.MULTILINE)


def statements(source: str) -> int:
    """Count the statements of a module's source without its docstrings."""
    return sum(
        isinstance(node, ast.stmt)
        and not (isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant))
        for node in ast.walk(ast.parse(source))
    )


def weight(folder: Path) -> tuple[int, int]:
    """Return the statements and the files of Python in a folder and all below it."""
    files = sorted(folder.rglob("*.py"))
    return sum(statements(file.read_text(encoding="utf-8")) for file in files), len(files)


def excesses(root: Path) -> Iterator[str]:
    """Yield one sentence for each package of a checkout that is heavier than its ceiling."""
    text = (root / "pyproject.toml").read_text(encoding="utf-8")
    for folder, ceiling in tomllib.loads(text)["tool"]["era"]["ceilings"].items():
        for what, now in zip(("statements", "files"), weight(root / folder), strict=True):
            if now > ceiling[what]:
                grown = ", ".join(_grown(root, folder)) or "none that main lacks"
                yield (
                    f"{folder}: {what} must be at most {ceiling[what]}, got {now}, "
                    f"{now - ceiling[what]} more; files that grew since main: {grown}"
                )


def _grown(root: Path, folder: str) -> Iterator[str]:
    """Yield the files of a folder that have more statements than on main, the most grown first."""

    def git(*arguments: str) -> str:
        done = subprocess.run(
            ["git", "-C", str(root), *arguments], check=False, capture_output=True, text=True
        )
        return done.stdout if done.returncode == 0 else ""

    base = git("merge-base", "HEAD", "main").strip() or "HEAD"
    growth = {}
    for file in (root / folder).rglob("*.py"):
        name = file.relative_to(root).as_posix()
        before = git("show", f"{base}:{name}")
        growth[name] = statements(file.read_text(encoding="utf-8")) - statements(before)
    for name, more in sorted(growth.items(), key=lambda item: -item[1]):
        if more > 0:
            yield f"{name} ({more:+d})"


def lowered(text: str, root: Path) -> str:
    """Return the text of pyproject.toml with ceilings at what stands, where that is lower."""

    def row(match: re.Match[str]) -> str:
        folder = match["folder"]
        now, files = weight(root / folder)
        up = -(-now // STEP) * STEP
        return (
            f'"{folder}" = {{ statements = {min(int(match[2]), up)}, '
            f"files = {min(int(match[3]), files)} }}"
        )

    return _ROW.sub(row, text)


def main() -> int:
    """Check the ceilings of this checkout, or lower them; return the exit status."""
    if sys.argv[1:] == ["--lower"]:
        path = ROOT / "pyproject.toml"
        path.write_text(lowered(path.read_text(encoding="utf-8"), ROOT), encoding="utf-8")
    found = list(excesses(ROOT))
    sys.stdout.writelines(f"{line}\n" for line in found)
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
