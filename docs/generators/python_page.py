"""The entries of docs/reference/python-api.md: signatures and docstrings of `era_haptics`.

Each block is between `<!-- end -->` and a comment that lists its names: `<!-- begin: api: query;
Drive: frequency, level; Client(): * -->` is a function, a class with two of its members, and a
class that other code creates, with all its members. Functions form a list. A class has a heading
and a list of its members, documented fields first. An `Example:` at the end of a docstring is an
interactive session, which tests/docs/test_pages.py runs.
"""

import ast
import dataclasses
import inspect
import re
import textwrap
from collections.abc import Iterator
from itertools import pairwise
from typing import Any, TypeAlias

import era_haptics

_BLOCK = re.compile(r"(<!-- begin: api: (.+?) -->\n\n).*?(?=\n<!-- end -->)", re.DOTALL)

Function: TypeAlias = ast.FunctionDef | ast.AsyncFunctionDef


def with_entries(page: str) -> str:
    """Return the page with all blocks regenerated."""
    return _BLOCK.sub(lambda block: block[1] + _public("\n".join(_entries(block[2]))) + "\n", page)


def _public(text: str) -> str:
    """Replace internal class names in a text by the names in the API."""
    for name, (_, own) in era_haptics._HOMES.items():
        text = text if name == own else re.sub(rf"\b{own}\b", name, text)
    return text


def named(page: str) -> set[str]:
    """Return the names with an entry on the page."""
    entries = ";".join(block[2] for block in _BLOCK.finditer(page)).split(";")
    return {entry.partition(":")[0].strip(" ()") for entry in entries}


def _entries(names: str) -> Iterator[str]:
    """Yield the lines of a block."""
    is_list = True
    for place, entry in enumerate(names.split(";")):
        name, _, members = entry.strip().partition(":")
        tree = _tree(getattr(era_haptics, name.strip("()")))
        if isinstance(tree, ast.ClassDef):
            tree.name = name.strip("()")  # the name in the API, which can differ
            yield from [""] if place else []
            yield from _class(tree, members.replace(",", " ").split(), name.endswith("()"))
        elif isinstance(tree, Function):
            yield from [] if is_list else [""]
            yield from _item(tree)
        is_list = not isinstance(tree, ast.ClassDef)


def _tree(thing: Any) -> ast.stmt:
    """Return the syntax tree of a function, or of a class with wrapped coroutine functions."""
    tree = ast.parse(textwrap.dedent(inspect.getsource(thing))).body[0]
    if isinstance(tree, ast.ClassDef):
        tree.body = [_unwrapped(thing, member) for member in tree.body]
        text, *members = tree.body
        for base in thing.__bases__:
            if dataclasses.is_dataclass(base):
                members = [*_class_body(base)[1:], *members]
        tree.body = [text, *members]
    return tree


def _class_body(kind: Any) -> list[ast.stmt]:
    """The members of a class, its docstring first."""
    (tree,) = ast.parse(textwrap.dedent(inspect.getsource(kind))).body
    return tree.body if isinstance(tree, ast.ClassDef) else []


def _unwrapped(kind: type, member: ast.stmt) -> ast.stmt:
    """Return a member of a class; for a wrapper of a coroutine, the plain function."""
    if not isinstance(member, ast.Assign):
        return member
    wrapper = getattr(kind, ast.unparse(member.targets[0]))
    if not hasattr(wrapper, "__wrapped__"):
        return member
    tree = _tree(wrapper.__wrapped__)
    return ast.FunctionDef(**{name: getattr(tree, name) for name in tree._fields})


def _class(tree: ast.ClassDef, members: list[str], is_made_elsewhere: bool) -> Iterator[str]:
    """Yield a class with its fields, its text, and the named members (`*` for all)."""
    fields, listed, documented = [], [], []
    for member, below in pairwise([*tree.body, ast.Pass()]):
        if isinstance(member, ast.AnnAssign) and not ast.unparse(member.target).startswith("_"):
            name, default, value = ast.unparse(member).partition(" = ")
            fields.append(name if is_made_elsewhere else name + default + value)
            if isinstance(below, ast.Expr):
                told = " ".join(ast.literal_eval(below.value).split())
                documented.append(f"- `{name}`: {told}")
        elif isinstance(member, Function):
            if member.name == "__init__" and not is_made_elsewhere:
                fields.append(ast.unparse(member.args).removeprefix("self, "))
            if not member.name.startswith("_") and {member.name, "*"} & set(members):
                listed.append(member)
    yield from [f"### {tree.name}", ""]
    yield from _text(tree, f"`{tree.name}({', '.join(fields)})`: " if fields else "", "")
    described = [member for member in listed if ast.get_docstring(member)]
    yield from [""] if documented or listed else []
    yield from documented
    for member in described:
        yield from _item(member)
    others = [f"`{_signature(each)}`" for each in listed if each not in described]
    yield from [f"- {', '.join(others)}: as in the API."] if others else []


def _item(tree: Function) -> Iterator[str]:
    """Yield a function or property as a list item."""
    yield from _text(tree, f"- `{_signature(tree)}`: ", "  ")


def _signature(tree: Function) -> str:
    """Return the signature of a function or property."""
    result = "" if tree.returns is None else f" -> {ast.unparse(tree.returns)}"
    decorators = {ast.unparse(each) for each in tree.decorator_list}
    if decorators & {"property", "cached_property"}:
        return tree.name + result.replace(" -> ", ": ")
    arguments = re.sub(r"^(self|cls)(, )?", "", ast.unparse(tree.args))
    keyword = "async " if isinstance(tree, ast.AsyncFunctionDef) else ""
    return f"{keyword}{tree.name}({arguments}){result}"


def _text(tree: ast.ClassDef | Function, start: str, indent: str) -> Iterator[str]:
    """Yield the docstring as a single line, and its example below.

    Items of a list are joined to a sentence.
    """
    told, _, example = (ast.get_docstring(tree) or "").partition("\n\nExample:\n")
    told = re.sub(r"(?<=[^.])\n\n(?=[A-Z])", ". ", told)
    told = re.sub(r"\n+- ", "; ", told).replace(".; ", ". ")
    yield start + " ".join(told.split())
    if example:
        session = textwrap.dedent(example).splitlines()
        yield from (f"{indent}{line}" for line in ("```pycon", *session, "```"))
