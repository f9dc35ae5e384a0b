"""The signatures in docs/reference/python-api.md, from the source of `era_haptics`.

`python docs/generators/signatures_page.py docs/reference/python-api.md` writes them anew between
the page's two marks.
"""

import ast
import inspect
import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import era_haptics
from page_part import insert

WRITER = "docs/generators/signatures_page.py"
_WIDTH = 100


def signatures() -> str:
    """All functions and classes by name, as Python, with the first sentence of each docstring."""
    found = [getattr(era_haptics, name) for name in era_haptics.__all__]
    kept = [thing for thing in found if not _is_exception(thing)]
    trees = [_tree(thing) for thing in kept]
    trees.sort(key=lambda tree: isinstance(tree, ast.FunctionDef))
    parts = ["\n".join(_entry(tree)) for tree in trees]
    return "```python\n" + "\n\n".join(parts) + "\n```"


def _tree(thing: Any) -> ast.stmt:
    """The source of a function, or of a class with that of the coroutines that it wraps."""
    tree = ast.parse(textwrap.dedent(inspect.getsource(thing))).body[0]
    if isinstance(tree, ast.ClassDef):
        tree.body = [_unwrapped(thing, member) for member in tree.body]
    return tree


def _unwrapped(kind: type, member: ast.stmt) -> ast.stmt:
    """A member of a class; as a plain function, if it is one that wraps a coroutine function."""
    if not isinstance(member, ast.Assign):
        return member
    wrapper = getattr(kind, ast.unparse(member.targets[0]))
    if not hasattr(wrapper, "__wrapped__"):
        return member
    tree = _tree(wrapper.__wrapped__)
    return ast.FunctionDef(**{name: getattr(tree, name) for name in tree._fields})


def _is_exception(thing: object) -> bool:
    return isinstance(thing, type) and issubclass(thing, BaseException)


def _entry(tree: ast.AST, indent: str = "") -> Iterator[str]:
    """Lines of a function, or of a class with its public fields and methods."""
    if isinstance(tree, ast.FunctionDef | ast.AsyncFunctionDef):
        yield from _function(tree, indent)
    elif isinstance(tree, ast.ClassDef):
        yield f"class {tree.name}:  # {_summary(tree)}"
        for member in tree.body:
            if isinstance(member, ast.AnnAssign) and not ast.unparse(member.target).startswith("_"):
                yield f"    {ast.unparse(member)}"
            elif isinstance(member, ast.FunctionDef | ast.AsyncFunctionDef) and (
                not member.name.startswith("_") or member.name == "__init__"
            ):
                yield from _function(member, "    ")


def _function(tree: ast.FunctionDef | ast.AsyncFunctionDef, indent: str) -> Iterator[str]:
    decorators = {ast.unparse(each) for each in tree.decorator_list}
    result = "" if tree.returns is None else f" -> {ast.unparse(tree.returns)}"
    if decorators & {"property", "cached_property"}:
        yield f"{indent}{tree.name}{result.replace(' ->', ':')}"
        return
    keyword = "async def" if isinstance(tree, ast.AsyncFunctionDef) else "def"
    line = f"{indent}{keyword} {tree.name}({ast.unparse(tree.args)}){result}"
    if len(line) > _WIDTH:
        yield from textwrap.wrap(line, _WIDTH, subsequent_indent=f"{indent}        ")
    else:
        yield line
    if not indent:
        yield f"    # {_summary(tree)}"


def _summary(tree: ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef) -> str:
    return (ast.get_docstring(tree) or "").splitlines()[0]


if __name__ == "__main__":
    path = Path(sys.argv[1])
    page = path.read_text("utf-8")
    path.write_text(insert(page, signatures(), writer=WRITER), "utf-8")
