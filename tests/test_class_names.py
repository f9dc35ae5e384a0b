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

EXPECTED = {
    "Felt": "what fingers feel in a study: renamed with the answer that it judges",
    "Content": "rows of a file of a table, and what plays: renamed with the commands",
    "Playing": "what plays, and a message of the API about it: renamed with the layers",
    "Requested": "of what plays: renamed with the layers",
    "Chosen": "of what plays: renamed with the layers",
    "_Intended": "of what plays: renamed with the layers",
    "Explained": "a message of the API: renamed with its methods",
    "Acceptor": "of the API's socket, and of the gateway's: renamed with the API",
}
"""Names that are still to be replaced, and with what; a line goes with its name."""


def test_classes_are_nouns_that_are_defined_once() -> None:
    """No bare participle, and no name twice, but for those that are expected."""
    names = Counter(
        node.name
        for package in PACKAGES
        for path in sorted((ROOT / package).rglob("*.py"))
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.ClassDef)
    )
    assert {name for name, count in names.items() if count > 1 or _is_participle(name)} == {
        *EXPECTED
    }


def _is_participle(name: str) -> bool:
    plain = name.strip("_")
    return bool(_REGULAR.fullmatch(plain) or _IRREGULAR.fullmatch(plain))
