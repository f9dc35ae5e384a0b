"""Names of the product that mislead: `make lint` lists them and fails where there is one.

    python tests/support/names.py

A public class is defined once. A module has a name of its own, but for those that a package may
have by custom. A class is a noun of the field, no bare participle; only an error may be named by
what happened.
"""

import ast
import re
import sys
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

ROOT = Path(__file__).parents[2]
PACKAGES = ("controller", "drivers", "era_haptics", "model", "registry", "sim")
SHARED_MODULES = ("__init__", "__main__", "cli", "errors")

_REGULAR = re.compile(r"[A-Z][a-z]+ed")
_IRREGULAR = re.compile(
    "Built|Chosen|Drawn|Felt|Found|Given|Heard|Held|Kept|Known|Left|Made|Meant|Met|Playing|Sent"
    "|Shown|Sought|Taken|Told|Unknown|Unsent"
)


def misleading_names(root: Path) -> Iterator[str]:
    """Yield one line for each name in the packages of a checkout that breaks a rule."""
    modules: dict[str, list[str]] = defaultdict(list)
    classes: dict[str, list[str]] = defaultdict(list)
    bases: dict[str, list[str]] = defaultdict(list)
    for package in PACKAGES:
        for path in sorted((root / package).rglob("*.py")):
            file = path.relative_to(root).as_posix()
            modules[path.stem].append(file)
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.ClassDef):
                    classes[node.name].append(f"{file}:{node.lineno}")
                    bases[node.name] += map(ast.unparse, node.bases)
    for name, files in modules.items():
        if len(files) > 1 and name not in SHARED_MODULES:
            yield f"module {name} must have a name of its own, got {', '.join(files)}"
    for name, places in classes.items():
        if len(places) > 1 and not name.startswith("_"):
            yield f"class {name} must be defined once, got {', '.join(places)}"
        if is_participle(name) and not _is_error(name, bases):
            yield f"class {name} must be a noun, got a bare participle in {places[0]}"


def is_participle(name: str) -> bool:
    """Return whether a class is named by a participle alone, such as `Chosen` or `_Joined`."""
    plain = name.strip("_")
    return bool(_REGULAR.fullmatch(plain) or _IRREGULAR.fullmatch(plain))


def _is_error(name: str, bases: Mapping[str, Sequence[str]]) -> bool:
    """Return whether a class derives from an error, over classes of the product."""
    return name.endswith("Error") or any(_is_error(base, bases) for base in bases.get(name, ()))


if __name__ == "__main__":
    sys.exit("\n".join(misleading_names(ROOT)) or None)
