"""Classes of the model and the controller are nouns of the field, each defined once."""

import ast
import re
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGES = ("controller", "model")

_REGULAR = re.compile(r"[A-Z][a-z]+ed")
_IRREGULAR = re.compile(
    "Built|Chosen|Drawn|Felt|Found|Given|Heard|Held|Kept|Known|Left|Made|Meant|Met|Playing|Sent"
    "|Shown|Sought|Taken|Told|Unknown|Unsent"
)


def test_classes_are_nouns_that_are_defined_once() -> None:
    """No bare participle, and no name twice."""
    names = Counter(
        node.name
        for package in PACKAGES
        for path in sorted((ROOT / package).rglob("*.py"))
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.ClassDef)
    )
    assert [name for name, count in names.items() if count > 1 or _is_participle(name)] == []


def _is_participle(name: str) -> bool:
    plain = name.strip("_")
    return bool(_REGULAR.fullmatch(plain) or _IRREGULAR.fullmatch(plain))
