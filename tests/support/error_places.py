"""Every place in the program where an error for people is made, with the pattern of its text."""

import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

ROOT = Path(__file__).parents[2]
PACKAGES = ("registry", "controller", "drivers", "era_haptics", "model", "sim")

ERRORS = {
    *("InputError", "ConfigError", "CommandError", "CommandRefused", "LinkError", "LinkTimeout"),
    *("FrameError", "RpcError", "HTTPException", "Unreachable", "EventError", "OscError"),
    *("ValueError", "GaveWay", "BadParameter", "Malformed"),
}
"""Exceptions whose text people read. A validator's ValueError becomes a line about a key."""

NOTES = {"add", "problem", "Problem", "_error", "_whole"}
"""Calls that note what is wrong in a file, where several things may be."""

_LEAST = 7  # letters of its own that make a text recognisable


@dataclass(frozen=True)
class Place:
    """One text of an error: its file, the line now, and a pattern that what is said matches."""

    file: str
    line: int
    pattern: str

    def is_told_by(self, text: str) -> bool:
        """Whether a text that was printed, its blanks single, came from here."""
        fixed = all(part in text for part in self.parts)  # few get further, and a search is dear
        return fixed and re.search(self.pattern, text) is not None

    @cached_property
    def parts(self) -> list[str]:
        """The text's constant parts."""
        return [re.sub(r"\\(.)", r"\1", part) for part in self.pattern.split(".*?")]

    @property
    def begin(self) -> str:
        """The text's constant parts, for people and for the list of exceptions."""
        return re.sub(r"\\(.)", r"\1", self.pattern.replace(".*?", "{}"))


def places() -> list[Place]:
    """All of them, in the order of files and lines."""
    found: dict[tuple[str, str], Place] = {}
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            for place in _Reader(path).places():
                found.setdefault((place.file, place.pattern), place)
    return sorted(found.values(), key=lambda place: (place.file, place.line))


class _Reader:
    """Reads one module."""

    def __init__(self, path: Path) -> None:
        self._file = str(path.relative_to(ROOT))
        self._tree = ast.parse(path.read_text("utf-8"))
        self._functions = {
            node.name: node for node in ast.walk(self._tree) if isinstance(node, ast.FunctionDef)
        }
        self._constants = {
            node.targets[0].id: node.value
            for node in self._tree.body
            if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name)
        }

    def places(self) -> Iterator[Place]:
        for function, node in self._errors():
            for pattern in self._texts(node, function, depth=0):
                if len(re.sub(r"[^a-zA-Z]", "", pattern)) >= _LEAST:
                    yield Place(self._file, node.lineno, pattern)

    def _errors(self) -> Iterator[tuple[ast.AST, ast.expr]]:
        for outer in ast.walk(self._tree):
            if not isinstance(outer, ast.Module | ast.FunctionDef | ast.AsyncFunctionDef):
                continue
            for node in _own(outer):
                if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call):
                    if self._is_error(node.exc.func):
                        yield outer, node.exc
                elif isinstance(node, ast.Call) and _name(node.func) in NOTES | ERRORS:
                    yield outer, node

    def _is_error(self, function: ast.expr) -> bool:
        name = _name(function)
        if name == "error":  # `raise self.error(...)`, whichever its owner was given
            return True
        made = self._functions.get(name)
        returned = ast.unparse(made.returns) if made is not None and made.returns else name
        return returned in ERRORS

    def _texts(self, node: ast.expr, scope: ast.AST, *, depth: int) -> list[str]:
        """Patterns of the texts that an expression may be or hold."""
        if depth > 4:
            return []
        match node:
            case ast.Constant(value=str() as text):
                return [_escaped(text)]
            case ast.JoinedStr(values=parts):
                return self._joined(parts, scope, depth)
            case ast.BinOp(left=left, op=ast.Add(), right=right):
                lefts = self._texts(left, scope, depth=depth) or [".*?"]
                rights = self._texts(right, scope, depth=depth) or [".*?"]
                return [a + b for a in lefts for b in rights]
            case ast.BoolOp(values=values):
                return [t for n in values for t in self._texts(n, scope, depth=depth)]
            case ast.IfExp(body=body, orelse=orelse):
                return [t for n in (body, orelse) for t in self._texts(n, scope, depth=depth)]
            case ast.Name(id=name):
                assigned = [
                    n.value
                    for n in _own(scope)
                    if isinstance(n, ast.Assign)
                    and isinstance(n.targets[0], ast.Name)
                    and n.targets[0].id == name
                ]
                if not assigned and name in self._constants:
                    assigned = [self._constants[name]]
                return [t for n in assigned for t in self._texts(n, scope, depth=depth + 1)]
            case ast.Call(func=function, args=arguments, keywords=keywords):
                given = [*arguments, *(k.value for k in keywords if k.arg not in {"where", "code"})]
                if isinstance(function, ast.Attribute) and function.attr in {"join", "get"}:
                    return []
                found = [t for n in given for t in self._texts(n, scope, depth=depth + 1)]
                helper = self._functions.get(_name(function))
                if helper is not None and helper is not scope:
                    for inner in _own(helper):
                        if isinstance(inner, ast.Return) and inner.value is not None:
                            found += self._texts(inner.value, helper, depth=depth + 1)
                return found
            case _:
                return []

    def _joined(self, parts: list[ast.expr], scope: ast.AST, depth: int) -> list[str]:
        """An f-string is one pattern; a choice within it makes no more of them."""
        pattern = ""
        for part in parts:
            pattern += _escaped(str(part.value)) if isinstance(part, ast.Constant) else ".*?"
        return [pattern]


def _own(scope: ast.AST) -> Iterator[ast.AST]:
    """Nodes of a scope without those of functions in it."""
    waiting = list(ast.iter_child_nodes(scope))
    while waiting:
        node = waiting.pop(0)
        yield node
        if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            waiting += ast.iter_child_nodes(node)


def _escaped(text: str) -> str:
    return re.escape(re.sub(r"\s+", " ", text))


def _name(function: ast.expr) -> str:
    if isinstance(function, ast.Attribute):
        return function.attr
    return function.id if isinstance(function, ast.Name) else ""
