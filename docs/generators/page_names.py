"""Find names of code on pages that are private, or that no longer exist.

`make lint` lists them. A page can name a class of the project and its public members. In place of a
private name, which can change with any rewrite, a page describes the behavior or names the module.
"""

import ast
import re
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from packages import PACKAGES

PAGES = ("README.md", "CONTRIBUTING.md", "SECURITY.md", "docs/**/*.md", "tests/support/*.md")
SOURCES = (*PACKAGES, "benchmarks", "docs", "examples", "tests")
_FENCED = re.compile(r"^```.*?^```", re.MULTILINE | re.DOTALL)
_SPAN = re.compile(r"`([^`\n]+)`")
_PRIVATE = re.compile(r"(?<![\w./-])\.?(?:[A-Za-z]\w*\.)*_[A-Za-z]\w*")
_MEMBER = re.compile(r"(?<![\w.])([A-Z]\w*[a-z]\w*)\.(\w+)")
_SUFFIXES = ("c", "csv", "h", "json", "md", "py", "txt", "yaml")


@dataclass
class _Class:
    members: set[str] = field(default_factory=set)
    bases: set[str] = field(default_factory=set)


def wrong_names(root: Path) -> Iterator[str]:
    """Yield a line for each private name, and each class or member that does not exist."""
    classes = _classes(root)
    for pattern in PAGES:
        for path in sorted(root.glob(pattern)):
            page = path.relative_to(root)
            text = _FENCED.sub(_blank, path.read_text("utf-8"))
            for number, line in enumerate(text.splitlines(), 1):
                for reason in _wrong_in(line, classes):
                    yield f"{page}:{number}: {reason}"


def _wrong_in(line: str, classes: dict[str, _Class]) -> Iterator[str]:
    for span in _SPAN.findall(line):
        for name in _PRIVATE.findall(span):
            yield f"must not name private code, got {name}"
        for owner, member in _MEMBER.findall(span):
            if member in _SUFFIXES:
                continue
            if owner not in classes:
                yield f"must name a class of the project, got {owner} in {span}"
            elif member not in _members(owner, classes):
                yield f"must name a member of {owner}, got {member}"


def _blank(block: re.Match[str]) -> str:
    """Return as many line ends as a block contains."""
    return "\n" * block[0].count("\n")


def _classes(root: Path) -> dict[str, _Class]:
    """Return all classes of the project by name; classes with equal names are merged."""
    classes: dict[str, _Class] = defaultdict(_Class)
    for folder in SOURCES:
        for path in (root / folder).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text("utf-8"))):
                if isinstance(node, ast.ClassDef):
                    classes[node.name].members |= _own_members(node)
                    classes[node.name].bases |= {_last_name(base) for base in node.bases}
    return dict(classes)


def _own_members(definition: ast.ClassDef) -> set[str]:
    """Return methods, fields, and attributes that methods assign."""
    members: set[str] = set()
    for node in ast.walk(definition):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            members.add(node.name)
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            members.add(node.attr)
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            members.add(node.id)
    return members


def _last_name(base: ast.expr) -> str:
    return ast.unparse(base).partition("[")[0].rpartition(".")[2]


def _members(name: str, classes: dict[str, _Class]) -> set[str]:
    """Return the members of a class and of its bases in the project."""
    if name not in classes:
        return set()
    own = classes[name]
    inherited = [_members(base, classes) for base in own.bases if base != name]
    return own.members.union(*inherited)
