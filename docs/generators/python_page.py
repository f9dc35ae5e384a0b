"""The entries of docs/reference/python-api.md: signatures and docstrings of `era_haptics`.

Each block is between `<!-- end -->` and a comment that lists its names: `<!-- begin: api: query;
Drive: frequency, level; Client(): * -->` is a function, a class with two of its members, and a
class that other code creates, with all of its members. Functions form a list. A class has a
heading and a list of its members, documented fields first. `Example:` at the end of a docstring is
a session, which tests/docs/test_pages.py types.
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
    """The page with every block as its comment and the source have it."""
    return _BLOCK.sub(lambda block: block[1] + _public("\n".join(_entries(block[2]))) + "\n", page)


def _public(text: str) -> str:
    """A text with the public name of every class that has another one where it is defined."""
    for name, (_, own) in era_haptics._HOMES.items():
        text = text if name == own else re.sub(rf"\b{own}\b", name, text)
    return text


def named(page: str) -> set[str]:
    """The names that the page has entries for."""
    entries = ";".join(block[2] for block in _BLOCK.finditer(page)).split(";")
    return {entry.partition(":")[0].strip(" ()") for entry in entries}


def _entries(names: str) -> Iterator[str]:
    """The lines of a block."""
    is_list = True
    for place, entry in enumerate(names.split(";")):
        name, _, members = entry.strip().partition(":")
        tree = _tree(getattr(era_haptics, name.strip("()")))
        if isinstance(tree, ast.ClassDef):
            tree.name = name.strip("()")  # that of the API, whatever it is called in its module
            yield from [""] if place else []
            yield from _class(tree, members.replace(",", " ").split(), name.endswith("()"))
        elif isinstance(tree, Function):
            yield from [] if is_list else [""]
            yield from _item(tree)
        is_list = not isinstance(tree, ast.ClassDef)


def _tree(thing: Any) -> ast.stmt:
    """The source of a function, or of a class with that of the coroutine functions it wraps."""
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
    """A member of a class; as a plain function, if it is one that wraps a coroutine function."""
    if not isinstance(member, ast.Assign):
        return member
    wrapper = getattr(kind, ast.unparse(member.targets[0]))
    if not hasattr(wrapper, "__wrapped__"):
        return member
    tree = _tree(wrapper.__wrapped__)
    return ast.FunctionDef(**{name: getattr(tree, name) for name in tree._fields})


def _class(tree: ast.ClassDef, members: list[str], is_made_elsewhere: bool) -> Iterator[str]:
    """A class with its fields; below its text those of its members that are named, `*` for all."""
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
    """A function or a property as an item of a list."""
    yield from _text(tree, f"- `{_signature(tree)}`: ", "  ")


def _signature(tree: Function) -> str:
    """A function or a property as it is used."""
    result = "" if tree.returns is None else f" -> {ast.unparse(tree.returns)}"
    decorators = {ast.unparse(each) for each in tree.decorator_list}
    if decorators & {"property", "cached_property"}:
        return tree.name + result.replace(" -> ", ": ")
    arguments = re.sub(r"^(self|cls)(, )?", "", ast.unparse(tree.args))
    keyword = "async " if isinstance(tree, ast.AsyncFunctionDef) else ""
    return f"{keyword}{tree.name}({arguments}){result}"


def _text(tree: ast.ClassDef | Function, start: str, indent: str) -> Iterator[str]:
    """The docstring as one line, as on the other written pages, and the example below it.

    Items of a list are parts of a sentence.
    """
    told, _, example = (ast.get_docstring(tree) or "").partition("\n\nExample:\n")
    told = re.sub(r"(?<=[^.])\n\n(?=[A-Z])", ". ", told)
    told = re.sub(r"\n+- ", "; ", told).replace(".; ", ". ")
    yield start + " ".join(told.split())
    if example:
        session = textwrap.dedent(example).splitlines()
        yield from (f"{indent}{line}" for line in ("```pycon", *session, "```"))
