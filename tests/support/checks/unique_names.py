"""Public names that are defined in two modules: `make lint` lists them and fails.

A reader who meets a function, class, constant or type alias must not have to look up which one it
is. Imports and re-exports are not definitions. Some names repeat by design: names that other
modules expect (`app` of command modules), commands and conformance checks, whose names users type
and read, and functions of the Python API, which wrap functions of the same name.
"""

import ast
import sys
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[3]
PACKAGES = ("controller", "drivers", "era_haptics", "model", "registry", "sim")

REQUIRED_OF_MODULES = {"app", "EXIT_STATUS", "command_modules", "main"}
"""Names by which other modules, or Python itself, use a module: `CommandModule`, `__main__`."""

COMMAND_MODULES = ("/cli.py", "_cli.py", "/commands.py", "/demo.py")
"""Endings of modules whose functions are commands of `era`, and whose typer applications group
them."""

CHECK_MODULES = "era_haptics/lab/conformance/checks/"
"""Folder of modules whose decorated functions are checks of conformance."""

API_STUB = "era_haptics/__init__.pyi"


@dataclass(frozen=True)
class Definition:
    """A public name that a module defines."""

    name: str
    file: str
    line: int

    def __str__(self) -> str:
        """The place of the definition."""
        return f"{self.file}:{self.line}"


def repeated_names(root: Path) -> Iterator[str]:
    """Yield one line for each public name that several modules of a checkout define."""
    definitions: dict[str, list[Definition]] = defaultdict(list)
    api = _api_definitions(root)
    for package in PACKAGES:
        for path in sorted((root / package).rglob("*.py")):
            file = path.relative_to(root).as_posix()
            for definition in _definitions(file, ast.parse(path.read_text("utf-8"))):
                if (definition.file, definition.name) not in api:
                    definitions[definition.name].append(definition)
    for name, places in sorted(definitions.items()):
        if len({place.file for place in places}) > 1:
            yield (
                f"{name} must be defined in one module, got {', '.join(map(str, places))}; give "
                "each a name of its own, or _ at its beginning if only its module uses it"
            )


def _definitions(file: str, tree: ast.Module) -> Iterator[Definition]:
    """Public names of a module, with classes in classes, without names that may be repeated."""
    nested_classes = [
        node for node in ast.walk(tree) if isinstance(node, ast.ClassDef) and node not in tree.body
    ]
    for node in [*_top_level(tree.body), *nested_classes]:
        match node:
            case ast.FunctionDef() | ast.AsyncFunctionDef() if _is_typed_or_read(file, node):
                names = []
            case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name):
                names = [name]
            case ast.ClassDef(name=name):
                names = [name]
            case ast.Assign(value=ast.Call(func=func)) if _makes_group(file, func):
                names = []
            case ast.Assign(targets=targets):
                names = [name for target in targets for name in _assigned(target)]
            case ast.AnnAssign(target=target):
                names = [*_assigned(target)]
            case _:
                names = []
        for name in names:
            if not name.startswith("_") and name not in REQUIRED_OF_MODULES:
                yield Definition(name, file, node.lineno)


def _top_level(body: list[ast.stmt]) -> Iterator[ast.stmt]:
    """Statements of a module, also those under a condition."""
    for node in body:
        yield node
        if isinstance(node, ast.If | ast.Try):
            yield from _top_level([*node.body, *node.orelse])


def _assigned(target: ast.expr) -> Iterator[str]:
    """Names that an assignment binds, without attributes and items."""
    for node in ast.walk(target):
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.id


def _makes_group(file: str, function: ast.expr) -> bool:
    """Whether the call of a function makes a group of commands."""
    return file.endswith(COMMAND_MODULES) and ast.unparse(function) == "typer.Typer"


def _is_typed_or_read(file: str, function: ast.FunctionDef | ast.AsyncFunctionDef) -> bool:
    """Whether a function's name is the word of a command or of a check of conformance."""
    if file.endswith(COMMAND_MODULES):
        return True
    return file.startswith(CHECK_MODULES) and bool(function.decorator_list)


def _api_definitions(root: Path) -> set[tuple[str, str]]:
    """File and name of each definition in `era_haptics` itself that its stub exports."""
    exported: set[tuple[str, str]] = set()
    stub = root / API_STUB
    if not stub.is_file():
        return exported
    for node in ast.parse(stub.read_text("utf-8")).body:
        if isinstance(node, ast.ImportFrom) and node.module:
            file = node.module.replace(".", "/") + ".py"
            if file.startswith("era_haptics/"):
                exported |= {(file, alias.name) for alias in node.names}
    return exported


if __name__ == "__main__":
    sys.exit("\n".join(repeated_names(ROOT)) or None)
