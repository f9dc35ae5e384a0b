"""Planted faults: each pattern matches its code exactly once, and no fault is stale."""

import ast
from pathlib import Path

import pytest

from cases import COLLECTED
from planting import Edit, StaleEdit, planted
from run import (
    collected,
    load_faults,
    missing_imports,
    missing_tests_report,
    stale_report,
)

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
MAX_FAULTS = 500
SOURCE = """
class Valve:
    def open(self, pressure: float) -> bool:
        if pressure > self._limit and not self._is_shut():
            raise ValueError("too high")
        width = self._width_of(pressure, margin=1, steps=3)
        return width > 0

def close(valve):
    valve.shut()
"""
REWRITTEN = """
class Valve:
    def open(self, bar: float) -> bool:
        # The seal does not hold more.
        if (
            bar > self._highest
            and not self._is_closed()
        ):
            raise ValueError(f"must be lower, got {bar}")
        opening = self._opening(bar, margin=1, steps=3)
        return opening > 0

def close(valve):
    valve.shut()
"""
PATTERNS = {
    "expression": (
        "pressure > self._limit and not self._is_shut()",
        "pressure > self._limit",
        "if bar > self._highest:",
    ),
    "statement": (
        "width = self._width_of(...)",
        "width = self._width_of(...) / 2",
        "opening = self._opening(bar, margin=1, steps=3) / 2",
    ),
    "arguments": (
        "self._width_of(..., steps=3)",
        "self._width_of(..., steps=2)",
        "opening = self._opening(bar, steps=2, margin=1)",
    ),
    "body": (
        "if pressure > self._limit and ...:\n    ...",
        "if ...:\n    ...",
        "if not self._is_closed():",
    ),
    "function": (
        "def open(self, pressure: float) -> bool:\n    ...\n    return width > 0",
        "def open(self, pressure: float) -> bool:\n    ...\n    return width > 1",
        "return opening > 1",
    ),
}
C_SOURCE = """
static int level(int x) { /* as asked */ return x + 1; }
int stop(int x)
{
    return x
        + 1; // at once
}
"""


@pytest.mark.parametrize(("find", "replacement", "line"), PATTERNS.values(), ids=PATTERNS)
def test_pattern_matches_code_with_other_names_and_layout(
    find: str, replacement: str, line: str
) -> None:
    """In rewritten code one line changes, as described, and has the names of that code."""
    edit = Edit("valve.py", "Valve", find, replacement)
    assert planted(edit, SOURCE) != SOURCE
    original = ast.unparse(ast.parse(REWRITTEN)).splitlines()
    mutated = ast.unparse(ast.parse(planted(edit, REWRITTEN))).splitlines()
    changed = [new.strip() for old, new in zip(original, mutated, strict=True) if old != new]
    assert changed == [line]


@pytest.mark.parametrize(
    ("scope", "find", "replacement", "reason"),
    [
        ("", "pressure > self.limit", "True", "matches nothing"),
        ("Valve.opens", "return ... > 0", "return True", "did you mean open"),
        ("Valve", "self._unknown", "0", "matches in lines"),
        ("", "valve.close()", "pass", r"nearest, in line 10: valve.shut\(\)"),
        ("", "valve.shut()", "valve._leak()", "private names"),
        ("", "return ... > 0", "return ...; ...", "must not have more"),
        ("", "return ... >", "return", "must be Python"),
    ],
)
def test_pattern_must_match_once(scope: str, find: str, replacement: str, reason: str) -> None:
    """A pattern without or with several matches is stale; public names must be the same."""
    edit = Edit("valve.py", scope, find, replacement)
    with pytest.raises(StaleEdit, match=reason):
        planted(edit, SOURCE)


def test_other_languages_are_compared_by_tokens_of_a_function() -> None:
    """Whitespace and comments do not count, and the rest of the file stays as it is."""
    edit = Edit("stop.c", "stop", "return x+1;", "return x;")
    assert planted(edit, C_SOURCE) == C_SOURCE.replace("return x\n        + 1;", "return x;")
    with pytest.raises(StaleEdit, match="matches in lines 2, 5, must match once"):
        planted(Edit("stop.c", "", "return x+1;", ""), C_SOURCE)
    with pytest.raises(StaleEdit, match="no function halt"):
        planted(Edit("stop.c", "halt", "return x+1;", ""), C_SOURCE)


def test_no_fault_is_stale(request: pytest.FixtureRequest) -> None:
    """Every pattern matches once; names, imports and tests that a fault mentions exist."""
    faults = load_faults()
    assert len(faults) <= MAX_FAULTS
    reports = stale_report(faults, ROOT) + missing_imports(faults)
    assert not reports, "\n".join(reports)
    folder = request.node.getparent(pytest.Dir)
    single_checks = pytest.Module.from_parent(folder, path=HERE / "one_conformance.py")
    existing = request.config.stash[COLLECTED] | {test.nodeid for test in single_checks.collect()}
    unknown = {test for fault in faults for test in fault.tests} - existing
    files = {test.partition("::")[0] for test in unknown}
    not_collected = [file for file in sorted(files) if (ROOT / file).is_file()]
    if not_collected:
        existing |= collected(*not_collected)
    missing = missing_tests_report(faults, existing)
    assert not missing, "\n".join(missing)
