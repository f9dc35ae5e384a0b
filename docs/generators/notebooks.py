"""Convert notebooks in percent format to Markdown: text, code, output and pictures.

    python docs/generators/notebooks.py examples/researcher.py

The directive `notebook` (docs/conf.py) runs this when the pages are built. A file without cell
marks is a single cell.
"""

import ast
import contextlib
import io
import re
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
_CELL = re.compile(r"^# %%( \[markdown\])?.*\n", re.MULTILINE)


def cells(text: str) -> Iterator[tuple[bool, str]]:
    """Yield for each cell whether it is text, and its source without the mark."""
    _, *parts = _CELL.split(text if _CELL.match(text) else f"# %%\n{text}")
    for is_text, source in zip(parts[::2], parts[1::2], strict=True):
        yield bool(is_text), source.strip().strip('"').strip() if is_text else source.strip()


def as_markdown(notebook: Path, pictures: Path) -> str:
    """Run all cells in a namespace; return text, sources, output and links to pictures.

    A figure at the end of a cell is saved as a file in `pictures`.
    """
    names: dict[str, Any] = {"__name__": "__main__", "__file__": str(notebook)}
    sys.path.insert(0, str(notebook.parent))  # like Python does for a script
    shown: list[str] = []
    for number, (is_text, source) in enumerate(cells(notebook.read_text("utf-8"))):
        if is_text:
            shown.append(source)
            continue
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            result = _result(source, str(notebook), names)
        shown.append(f"````python\n{source}\n````")
        if printed.getvalue():
            shown.append(f"````text\n{printed.getvalue().rstrip()}\n````")
        if hasattr(result, "savefig"):
            picture = pictures / f"{notebook.stem}-{number}.png"
            result.savefig(picture, dpi=100)
            shown.append(f"![The figure of this cell](/{picture.relative_to(ROOT / 'docs')})")
    return "\n\n".join(shown)


def _result(source: str, name: str, names: dict[str, Any]) -> Any:
    """Run a cell; return the value of its last line, None if it has no value."""
    tree = ast.parse(source, name)
    last = tree.body[-1] if tree.body else None
    if isinstance(last, ast.Expr):
        tree.body.pop()
    exec(compile(tree, name, "exec"), names)  # noqa: S102  # an example of the project
    if not isinstance(last, ast.Expr):
        return None
    return eval(compile(ast.Expression(last.value), name, "eval"), names)  # noqa: S307  # as above


def main(arguments: Sequence[str]) -> None:
    """Run a notebook and print it as Markdown; write its pictures to the folder of built pages."""
    pictures = ROOT / "docs" / "_build" / "notebooks"
    pictures.mkdir(parents=True, exist_ok=True)
    sys.argv = [*arguments]
    sys.stdout.write(as_markdown(ROOT / arguments[0], pictures))


if __name__ == "__main__":
    main(sys.argv[1:])
