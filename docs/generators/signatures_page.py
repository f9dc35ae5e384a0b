"""The signatures in docs/reference/python-api.md, from the source of `era_haptics`.

`python docs/generators/signatures_page.py docs/reference/python-api.md` writes them anew between
the page's two marks.
"""

import ast
import inspect
import re
import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import era_haptics
from page_part import insert

WRITER = "docs/generators/signatures_page.py"
_WIDTH = 100


def signatures(page: str) -> str:
    """Functions and classes by name, as Python, with the first sentence of each docstring.

    Of a class the members that this page documents: those named behind `:members:`, or all.
    """
    found = [getattr(era_haptics, name) for name in era_haptics.__all__]
    trees = [_tree(thing) for thing in found if not _is_exception(thing)]
    trees.sort(key=lambda tree: isinstance(tree, ast.FunctionDef))
    parts = ["\n".join(_entry(tree, page)) for tree in trees]
    return "```python\n" + "\n\n".join(parts) + "\n```"


def _tree(thing: Any) -> ast.stmt:
    """The source of a function, or of a class with that of the coroutines that it wraps."""
    tree = ast.parse(textwrap.dedent(inspect.getsource(thing))).body[0]
    if isinstance(tree, ast.ClassDef):
        tree.body = [_unwrapped(thing, member) for member in tree.body]
        for base in thing.__bases__:
            tree.body += _of_stub(base)
    return tree


def _of_stub(base: type) -> list[ast.stmt]:
    """The members of a class in the stub file of its module, if there is one."""
    stub = Path(inspect.getfile(base)).with_suffix(".pyi") if base is not object else Path("none")
    if not stub.is_file():
        return []
    (found,) = (
        each
        for each in ast.parse(stub.read_text("utf-8")).body
        if isinstance(each, ast.ClassDef) and each.name == base.__name__
    )
    return found.body


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


def _entry(tree: ast.AST, page: str) -> Iterator[str]:
    """Lines of a function, or of a class with its fields, properties and methods."""
    if isinstance(tree, ast.FunctionDef | ast.AsyncFunctionDef):
        yield from _function(tree)
        yield f"    # {_summary(tree)}"
    elif isinstance(tree, ast.ClassDef):
        fields, properties, methods = [], [], []
        for member in tree.body:
            if isinstance(member, ast.AnnAssign):
                if not ast.unparse(member.target).startswith("_"):
                    fields.append(ast.unparse(member))
            elif isinstance(member, ast.FunctionDef | ast.AsyncFunctionDef):
                if member.name == "__init__" and not _is_made_elsewhere(tree.name, page):
                    fields.append(ast.unparse(member.args).removeprefix("self, "))
                if not _is_documented(member.name, tree.name, page):
                    continue
                if _decorators(member) & {"property", "cached_property"}:
                    properties.append(f"{member.name}: {ast.unparse(member.returns or member)}")
                else:
                    methods.append(member)
        yield from _wrapped(f"class {tree.name}({', '.join(fields)})")
        yield f"    # {_summary(tree)}"
        if properties:
            yield from _wrapped(f"    {', '.join(properties)}")
        for method in methods:
            yield from _function(method, "    ")


def _is_made_elsewhere(owner: str, page: str) -> bool:
    """Whether the page's directive of this class leaves its constructor out."""
    return f"autoclass:: era_haptics.{owner}()" in page


def _is_documented(name: str, owner: str, page: str) -> bool:
    """Whether the page's directive of this class names the member."""
    directive = re.search(rf"autoclass:: era_haptics\.{owner}\b.*((?:\n   .*)*)", page)
    members = re.search(r":members:(.*)", directive[1]) if directive else None
    if members is None or name.startswith("_"):
        return False
    return not members[1].strip() or name in re.split(r"[, ]+", members[1].strip())


def _decorators(tree: ast.FunctionDef | ast.AsyncFunctionDef) -> set[str]:
    return {ast.unparse(each) for each in tree.decorator_list}


def _function(tree: ast.FunctionDef | ast.AsyncFunctionDef, indent: str = "") -> Iterator[str]:
    result = "" if tree.returns is None else f" -> {ast.unparse(tree.returns)}"
    keyword = "async def" if isinstance(tree, ast.AsyncFunctionDef) else "def"
    yield from _wrapped(f"{indent}{keyword} {tree.name}({ast.unparse(tree.args)}){result}")


def _wrapped(line: str) -> Iterator[str]:
    """The line, or several where it is long, each ended by a comma."""
    indent = line[: len(line) - len(line.lstrip())]
    text = re.sub("(?<!,) ", "\N{NO-BREAK SPACE}", line.lstrip())
    wrapped = textwrap.wrap(
        text, _WIDTH, initial_indent=indent, subsequent_indent=f"{indent}        "
    )
    yield from (part.replace("\N{NO-BREAK SPACE}", " ") for part in wrapped)


def _summary(tree: ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef) -> str:
    return (ast.get_docstring(tree) or "").splitlines()[0]


if __name__ == "__main__":
    path = Path(sys.argv[1])
    page = path.read_text("utf-8")
    path.write_text(insert(page, signatures(page), writer=WRITER), "utf-8")
